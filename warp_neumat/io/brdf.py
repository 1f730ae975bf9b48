"""BRDF sources by name: measured files, functions fitted to them, sparse samples, and analytic models.

Conventions are those of :mod:`warp_neumat.io.brdf_source`: ω_i to the light, ω_o to the viewer, value in 1/sr without
the cosine. The functions in the npz files are those of Sztrajman et al., "Neural BRDF Representation and Importance
Sampling", 2021.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np

from .brdf_source import CHUNK, BRDFSource, half_difference, in_chunks, rusinkiewicz, suggest

__all__ = ["FORMS", "BRDFSource", "NetworkBRDF", "function_names", "open_brdf", "rusinkiewicz"]

FORMS = {
    "FILE.npz:NAME": "a function fitted to measurements",
    "FILE.binary": "MERL table (options lookup=trilinear|nearest)",
    "FILE.bsdf": "RGL tensor file, RGB or spectral",
    "FILE.csv": "sparse samples (options isotropic=0|1, symmetry=none|reciprocal|bilateral)",
    "analytic:MODEL?KEY=VALUE&…": "ggx, layered or lambert",
    "svbrdf:FOLDER": "PBR maps as a reflectance that varies in space",
}
"""Every form of a source that :func:`open_brdf` knows, with what it is."""


def open_brdf(spec: str) -> BRDFSource:
    """Return the BRDF source that ``spec`` names.

    Args:
        spec: One of :data:`FORMS`: ``FILE.npz:NAME`` (one of the functions stored in the file), ``FILE.binary`` (MERL),
            ``FILE.bsdf`` (RGL), ``FILE.csv`` (sparse samples), options after ``?``; or ``analytic:ggx?KEY=VALUE&…``
            with the fields of :class:`~warp_neumat.io.analytic_brdf.GGX`, ``analytic:layered?…`` of
            :class:`~warp_neumat.io.layered_brdf.Layered`, ``analytic:lambert?albedo=R,G,B``. FILE may contain colons.

    Raises:
        ValueError: If the specification, a key, a value or the file is wrong; unknown names list what is known.
        FileNotFoundError: If FILE does not exist.
    """
    if spec.startswith("analytic:"):
        from .analytic_brdf import open_analytic

        return open_analytic(spec)
    match = re.fullmatch(r"(?P<file>.+\.npz):(?P<name>[^:/\\]+)", spec, flags=re.IGNORECASE | re.DOTALL)
    if match:
        return _open_npz(Path(match["file"]), match["name"])
    if spec.lower().endswith(".npz"):
        raise ValueError(f"{spec}: the file holds many materials; name one as {spec}:NAME{_example(spec)}")
    file, options = _split(spec)
    suffix = Path(file).suffix.lower()
    if suffix not in _OPENERS:
        known = "; ".join(f"{form} ({what})" for form, what in FORMS.items())
        raise ValueError(f"{spec!r} is no BRDF source; use {known}")
    if not Path(file).is_file():
        raise FileNotFoundError(f"{file}: no such file; give the path of a {suffix} file")
    opener, allowed = _OPENERS[suffix]
    return opener(file, **_options(spec, options, allowed))


def _split(spec: str) -> tuple[str, str]:
    """Split FILE?OPTIONS; a question mark that belongs to an existing file's name stays there."""
    if Path(spec).is_file():
        return spec, ""
    file, _, options = spec.rpartition("?")
    return (file, options) if file else (spec, "")


def _options(spec: str, text: str, allowed: dict[str, dict]) -> dict:
    values = {}
    for part in filter(None, text.split("&")):
        key, _, value = part.partition("=")
        if key not in allowed:
            raise ValueError(f"{spec}: no option {key!r} here; known: {', '.join(allowed) or 'none'}")
        if value not in allowed[key] or key in values:
            raise ValueError(f"{spec}: option {key!r} must be given once, as {key}={'|'.join(allowed[key])}")
        values[key] = allowed[key][value]
    return values


def _merl(file, **options):
    from .merl import read_merl

    return read_merl(file, **options)


def _rgl(file):
    from .rgl import read_rgl

    return read_rgl(file)


def _csv(file, **options):
    from .brdf_samples import read_samples

    return read_samples(file, **options)


def _names_of(*values: str) -> dict[str, str]:
    return {value: value for value in values}


# Suffix → reader and its options, each with the values it may take.
_OPENERS = {
    ".binary": (_merl, {"lookup": _names_of("trilinear", "nearest")}),
    ".bsdf": (_rgl, {}),
    ".csv": (
        _csv,
        {"isotropic": {"0": False, "1": True}, "symmetry": _names_of("none", "reciprocal", "bilateral")},
    ),
}


class NetworkBRDF:
    """An isotropic BRDF stored as a 6→21→21→3 network of half and difference vector.

    Args:
        name: Material name.
        weights: ``w0 (6, n), b0, w1 (n, n), b1, w2 (n, 3), b2`` float32, as in the file.

    With x = (h', d), h' = (sin θ_h, 0, cos θ_h): f = max(exp(MLP(x)) − 1, 0), ReLU in between. Neither mirror symmetric
    nor reciprocal, as the network is free in d.

    Error: at most 6e-6 of 1 + f against float64, held by test_network_matches_float64.
    """

    isotropic = True
    symmetry = "none"
    notes: tuple[str, ...] = ()

    def __init__(self, name: str, weights: dict[str, np.ndarray]):
        self.name = name
        w0, b0, w1, b1, w2, b2 = (np.asarray(weights[k], np.float32) for k in ("w0", "b0", "w1", "b1", "w2", "b2"))
        # Column-wise, without h'_y, which is 0, and with the first bias as the weight of a constant input.
        self._w0 = np.ascontiguousarray(np.concatenate([w0[[0, 2, 3, 4, 5]], b0[None]]).T)
        self._w1, self._b1 = np.ascontiguousarray(w1.T), np.ascontiguousarray(b1[:, None])
        self._w2, self._b2 = np.ascontiguousarray(w2.T), np.ascontiguousarray(b2[:, None])
        # OpenBLAS hands a product of more than 2^18 multiplications to threads of its own, which then fight with ours.
        self._block = max(16, 1 << max(0, int(np.log2(2**18 / w1.size))))

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(self._eval, wi, wo, CHUNK)

    def _eval(self, wi, wo):
        rows, _, _ = half_difference(wi, wo)
        count, width = len(wi), self._block
        blocks = -(-count // width)
        x = np.ones((blocks, 6, width), np.float32)
        if count < blocks * width:
            rows = np.pad(rows, ((0, 0), (0, blocks * width - count)))
        x[:, :5] = rows.reshape(5, blocks, width).transpose(1, 0, 2)
        a = self._w0 @ x
        np.maximum(a, 0.0, out=a)
        a = self._w1 @ a
        a += self._b1
        np.maximum(a, 0.0, out=a)
        y = self._w2 @ a
        y += self._b2
        np.minimum(y, 80.0, out=y)  # exp(80) is still finite in float32
        np.exp(y, out=y)  # six times as fast as expm1, and as close measured against 1 + f
        y -= 1.0
        np.maximum(y, 0.0, out=y)
        return y.transpose(0, 2, 1).reshape(-1, 3)[:count]


def function_names(path: Path) -> list[str]:
    """Return the names of the functions in an ``.npz``, sorted.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no ``.npz``.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the path of an .npz with BRDF functions")
    try:
        with zipfile.ZipFile(path) as archive:
            return sorted({entry.rsplit("/", 1)[0] for entry in archive.namelist() if "/" in entry})
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path}: not a readable .npz of BRDF functions ({error}); fetch the file again") from None


def _example(path: str) -> str:
    try:
        return f", as {path}:{function_names(Path(path))[0]}"
    except (OSError, ValueError, IndexError):
        return ""


def _open_npz(path: Path, name: str) -> NetworkBRDF:
    names = function_names(path)
    if name not in names:
        raise ValueError(f"{path}: no material {name!r}; {suggest(name, names)}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            weights = {key: archive[f"{name}/{key}"] for key in ("w0", "b0", "w1", "b1", "w2", "b2")}
    except (zipfile.BadZipFile, KeyError, EOFError) as error:
        raise ValueError(f"{path}: not a readable .npz of BRDF functions ({error}); fetch the file again") from None
    wide = weights["w1"].shape[0]
    shapes = {"w0": (6, wide), "b0": (wide,), "w1": (wide, wide), "b1": (wide,), "w2": (wide, 3), "b2": (3,)}
    for key, shape in shapes.items():
        if weights[key].shape != shape:
            raise ValueError(f"{path}: {name}/{key} must have shape {shape}, got {weights[key].shape}")
        if not np.isfinite(weights[key]).all():
            raise ValueError(f"{path}: {name}/{key} holds values that are not finite; fetch the file again")
    return NetworkBRDF(name, weights)
