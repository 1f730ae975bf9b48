"""BRDF sources by name: fitted measurements (`FILE.npz:NAME`) and analytic models (`analytic:ggx?roughness=0.2`).

ω_i points to the light and ω_o to the viewer, both unit and away from the surface, in a frame with z = shading normal.
A source returns the BRDF value in 1/sr, linear Rec. 709 RGB, **without** the cosine; below the horizon it is 0.

Half and difference vector are those of Rusinkiewicz, "A New Change of Variables for Efficient BRDF Representation",
1998. The functions in the npz files are those of Sztrajman et al., "Neural BRDF Representation and Importance
Sampling", 2021. The microfacet model is GGX (Walter et al. 2007) with Heitz's height-correlated Smith shadowing (2014,
Eq. 99).
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import urllib.parse
import zipfile
from pathlib import Path
from typing import Protocol

import numpy as np

_CHUNK = 1 << 15  # directions evaluated at a time, so that the intermediate rows stay in cache


class BRDFSource(Protocol):
    """What a fit needs of a reflectance: a name, whether it is isotropic, and its values."""

    name: str
    isotropic: bool

    def eval(self, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return the BRDF for unit directions (N, 3) and (N, 3) as (N, 3) float32 in 1/sr, without the cosine."""


def open_brdf(spec: str) -> BRDFSource:
    """Return the BRDF source that ``spec`` names.

    Args:
        spec: ``FILE.npz:NAME`` (one of the functions stored in the file), ``analytic:ggx?KEY=VALUE&…`` with the
            fields of :class:`GGX`, or ``analytic:lambert?albedo=R,G,B``. FILE may contain colons.

    Raises:
        ValueError: If the specification, a key or a value is wrong; unknown names list the nearest known ones.
        FileNotFoundError: If FILE does not exist.
    """
    if spec.startswith("analytic:"):
        return _open_analytic(spec)
    match = re.fullmatch(r"(?P<file>.+\.npz):(?P<name>[^:/\\]+)", spec, flags=re.IGNORECASE | re.DOTALL)
    if match:
        return _open_npz(Path(match["file"]), match["name"])
    if spec.lower().endswith(".npz"):
        raise ValueError(f"{spec}: the file holds many materials; name one as {spec}:NAME{_example(spec)}")
    raise ValueError(
        f"{spec!r} is no BRDF source; use FILE.npz:NAME, analytic:ggx?roughness=0.2&f0=0.9,0.6,0.3"
        " or analytic:lambert?albedo=0.5"
    )


def _checked(wi, wo) -> tuple[np.ndarray, np.ndarray]:
    wi, wo = np.ascontiguousarray(wi, np.float32), np.ascontiguousarray(wo, np.float32)
    for name, value in (("wi", wi), ("wo", wo)):
        if value.ndim != 2 or value.shape[1] != 3:
            raise ValueError(f"{name} must have shape (N, 3), got {value.shape}")
    if len(wi) != len(wo):
        raise ValueError(f"wi and wo must have one length, got {len(wi)} and {len(wo)}")
    return wi, wo


def _in_chunks(evaluate, wi, wo) -> np.ndarray:
    """Evaluate chunk by chunk and set the values below the horizon to 0."""
    wi, wo = _checked(wi, wo)
    values = np.empty((len(wi), 3), np.float32)
    for start in range(0, len(wi), _CHUNK):
        part = slice(start, start + _CHUNK)
        values[part] = evaluate(wi[part], wo[part])
    values[(wi[:, 2] <= 0) | (wo[:, 2] <= 0)] = 0.0
    return values


def _nearest(key: str, known) -> str:
    close = difflib.get_close_matches(key, list(known), n=3, cutoff=0.4)
    return f"nearest: {', '.join(close)}" if close else f"known: {', '.join(sorted(known)[:12])}"


# --- functions fitted to measurements ---------------------------------------------------------------------------------


class NetworkBRDF:
    """An isotropic BRDF stored as a 6→21→21→3 network of half and difference vector.

    Args:
        name: Material name.
        weights: ``w0 (6, 21), b0, w1 (21, 21), b1, w2 (21, 3), b2`` float32, as in the file.

    With x = (h', d), h' = (sin θ_h, 0, cos θ_h): f = max(exp(MLP(x)) − 1, 0), ReLU in between.

    Error: at most 6e-6 of 1 + f against float64, held by test_network_matches_float64.
    """

    isotropic = True

    def __init__(self, name: str, weights: dict[str, np.ndarray]):
        self.name = name
        self._w = [np.ascontiguousarray(weights[k], np.float32) for k in ("w0", "b0", "w1", "b1", "w2", "b2")]

    def eval(self, wi, wo):
        return _in_chunks(self._eval, wi, wo)

    def _eval(self, wi, wo):
        w0, b0, w1, b1, w2, b2 = self._w
        a = rusinkiewicz(wi, wo) @ w0
        np.maximum(a + b0, 0.0, out=a)
        a = a @ w1
        np.maximum(a + b1, 0.0, out=a)
        y = a @ w2 + b2
        return np.maximum(np.expm1(np.minimum(y, 80.0)), 0.0)  # exp(80) is still finite in float32


def rusinkiewicz(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return (h', d) of unit ω_i, ω_o: shape (N, 6), dtype of ``wi``; h' has azimuth 0, d is in the frame of h.

    Rusinkiewicz 1998, Sec. 3: h' = R_z(−φ_h) h, d = R_y(−θ_h) R_z(−φ_h) ω_i. Where h is the pole, φ_h is taken as 0.
    """
    x, y, z = (wi[:, k] + wo[:, k] for k in range(3))
    scale = 1.0 / np.maximum(np.sqrt(x * x + y * y + z * z), 1e-20)
    sine = np.sqrt(x * x + y * y)
    pole = sine < 1e-12
    cos_phi = np.where(pole, 1.0, x / np.where(pole, 1.0, sine))
    sin_phi = np.where(pole, 0.0, y / np.where(pole, 1.0, sine))
    out = np.zeros((len(wi), 6), wi.dtype)
    hx, hz = sine * scale, z * scale
    out[:, 0], out[:, 2] = hx, hz
    along = wi[:, 0] * cos_phi + wi[:, 1] * sin_phi
    out[:, 3] = along * hz - wi[:, 2] * hx
    out[:, 4] = wi[:, 1] * cos_phi - wi[:, 0] * sin_phi
    out[:, 5] = along * hx + wi[:, 2] * hz
    return out


def _names(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        return sorted({entry.rsplit("/", 1)[0] for entry in archive.namelist() if "/" in entry})


def _example(path: str) -> str:
    try:
        return f", as {path}:{_names(Path(path))[0]}"
    except (OSError, zipfile.BadZipFile, IndexError):
        return ""


def _open_npz(path: Path, name: str) -> NetworkBRDF:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the path of an .npz with BRDF functions")
    try:
        names = _names(path)
        if name not in names:
            raise ValueError(f"{path}: no material {name!r}; {_nearest(name, names)}")
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


# --- analytic models --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Lambert:
    """A perfectly diffuse surface: f = albedo/π."""

    albedo: tuple = (0.5, 0.5, 0.5)
    """Reflected fraction, RGB in [0, 1]."""

    name = "lambert"
    isotropic = True

    def eval(self, wi, wo):
        return _in_chunks(lambda i, o: np.broadcast_to(np.float32(self.albedo) / np.float32(np.pi), i.shape), wi, wo)


@dataclasses.dataclass(frozen=True)
class GGX:
    """GGX reflection over a diffuse base: f = diffuse/π + F·D·V, V = G₂/(4 cosθ_i cosθ_o).

    alpha = roughness². With anisotropy a, aspect = sqrt(1 − 0.9 a): alpha_x = alpha/aspect along x, alpha_y =
    alpha·aspect. G₂ is the height-correlated Smith term; F is Schlick's with ``f0``. The diffuse part is not dimmed by
    F, so the model is reciprocal but conserves energy only for diffuse + f0 < 1.
    """

    roughness: float = 0.3
    """Perceptual roughness in [0.01, 1]; alpha = roughness²."""
    f0: tuple = (0.04, 0.04, 0.04)
    """Reflectance at normal incidence, RGB in [0, 1]."""
    diffuse: tuple = (0.0, 0.0, 0.0)
    """Albedo of the diffuse part, RGB in [0, 1]."""
    anisotropy: float = 0.0
    """0 is isotropic, towards 1 the highlight stretches across x; in [0, 1]."""
    ior: float | None = None
    """Index of refraction ≥ 1; where given, f0 = ((ior − 1)/(ior + 1))² in all channels."""

    name = "ggx"

    @property
    def isotropic(self) -> bool:
        return self.anisotropy == 0.0

    def eval(self, wi, wo):
        return _in_chunks(self._eval, wi, wo)

    def _eval(self, wi, wo):
        alpha, aspect = self.roughness**2, np.sqrt(1.0 - 0.9 * self.anisotropy)
        ax, ay = np.float32(alpha / aspect), np.float32(alpha * aspect)
        f0 = np.float32(self.f0 if self.ior is None else [((self.ior - 1.0) / (self.ior + 1.0)) ** 2] * 3)
        half = wi + wo
        half /= np.maximum(np.sqrt((half * half).sum(1, keepdims=True)), np.float32(1e-20))
        hx, hy, hz = half.T
        # |h/alpha|² = 1 + (tan² terms) written without 1 − z², which would cancel near the pole.
        stretch = (hx / ax) ** 2 + (hy / ay) ** 2 + hz * hz
        distribution = 1.0 / (np.float32(np.pi) * ax * ay * stretch * stretch)
        zi, zo = np.maximum(wi[:, 2], 1e-7), np.maximum(wo[:, 2], 1e-7)
        si = zo * np.sqrt((ax * wi[:, 0]) ** 2 + (ay * wi[:, 1]) ** 2 + zi * zi)
        so = zi * np.sqrt((ax * wo[:, 0]) ** 2 + (ay * wo[:, 1]) ** 2 + zo * zo)
        weak = 1.0 - np.clip((wi * half).sum(1), 0.0, 1.0)
        square = weak * weak
        fresnel = f0 + (1.0 - f0) * (square * square * weak)[:, None]
        return fresnel * (0.5 * distribution / (si + so))[:, None] + np.float32(self.diffuse) / np.float32(np.pi)


_ANALYTIC = {"ggx": GGX, "lambert": Lambert}
_RANGES = {
    "roughness": (0.01, 1.0),
    "f0": (0, 1),
    "diffuse": (0, 1),
    "albedo": (0, 1),
    "anisotropy": (0, 1),
    "ior": (1, 10),
}
_COLOURS = ("f0", "diffuse", "albedo")


def _open_analytic(spec: str) -> BRDFSource:
    kind, _, query = spec.removeprefix("analytic:").partition("?")
    if kind not in _ANALYTIC:
        raise ValueError(f"{spec}: no analytic model {kind!r}; {_nearest(kind, _ANALYTIC)}")
    fields = {field.name for field in dataclasses.fields(_ANALYTIC[kind])}
    values = {}
    for part in filter(None, query.split("&")):
        key, equals, text = part.partition("=")
        if key not in fields:
            raise ValueError(f"{spec}: {kind} has no parameter {key!r}; {_nearest(key, fields)}")
        if not equals or key in values:
            raise ValueError(f"{spec}: parameter {key!r} must be given once, as {key}=VALUE")
        values[key] = _parse(spec, key, urllib.parse.unquote(text))
    return _ANALYTIC[kind](**values)


def _parse(spec: str, key: str, text: str):
    low, high = _RANGES[key]
    try:
        numbers = [float(t) for t in text.split(",")]
    except ValueError:
        numbers = []
    wanted = (1, 3) if key in _COLOURS else (1,)
    if len(numbers) not in wanted or not all(low <= x <= high for x in numbers):
        form = "one number or R,G,B" if key in _COLOURS else "one number"
        raise ValueError(f"{spec}: {key} must be {form} in [{low}, {high}], got {text!r}")
    if key in _COLOURS:
        return tuple(numbers * 3 if len(numbers) == 1 else numbers)
    return numbers[0]
