"""Sparse BRDF samples in a text file (`.csv`): one pair of directions and one RGB value a row.

The first row that is no comment names the columns, in any order: `wi_x,wi_y,wi_z` or `theta_i,phi_i` (degrees from the
normal and around it) for the light, `wo_…` or `theta_o,phi_o` for the viewer, and `r,g,b`: the BRDF in 1/sr, linear
Rec. 709, without the cosine. Other columns are left alone. A line that begins with `#` is a comment;
`# isotropic: true` and `# symmetry: none|reciprocal|bilateral` say what the material guarantees.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .atomic import replacing
from .brdf_source import SYMMETRIES, checked, half_difference, in_chunks

_BOOLEANS = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}


class BRDFSamples:
    """Sparse samples as a BRDF source; a fit reads :attr:`samples`, not ``eval``.

    Args:
        name: Material name.
        wi: Unit directions to the light, (N, 3).
        wo: Unit directions to the viewer, (N, 3).
        value: BRDF in 1/sr without the cosine, (N, 3). Rows that are negative or not finite, or have a direction that
            is not above the horizon, are masked: left out and counted.
        isotropic: Whether the material is.
        symmetry: What it guarantees: "none", "reciprocal", or "bilateral" (isotropic only).

    Raises:
        ValueError: If shapes differ, the symmetry is unknown, or no row is left.
    """

    def __init__(self, name: str, wi, wo, value, isotropic: bool = False, symmetry: str = "reciprocal"):
        if symmetry not in SYMMETRIES:
            raise ValueError(f"{name}: symmetry must be one of {', '.join(SYMMETRIES)}, got {symmetry!r}")
        if symmetry == "bilateral" and not isotropic:
            raise ValueError(f"{name}: symmetry bilateral holds for isotropic materials only; say isotropic as well")
        self.name, self.isotropic, self.symmetry = name, bool(isotropic), symmetry
        wi, wo = checked(wi, wo)
        value = np.ascontiguousarray(value, np.float32)
        if value.shape != wi.shape:
            raise ValueError(f"{name}: value must have shape {wi.shape}, got {value.shape}")
        wrong = ~(np.isfinite(value) & (value >= 0)).all(1)
        below = ~((wi[:, 2] > 0) & (wo[:, 2] > 0)) & ~wrong
        self.masked = int(np.count_nonzero(wrong | below))
        """How many rows are left out."""
        keep = ~(wrong | below)
        if not keep.any():
            raise ValueError(f"{name}: no sample is left; every value is negative or not finite, or below the horizon")
        self.samples = tuple(np.ascontiguousarray(array[keep]) for array in (wi, wo, value))
        """(ω_i, ω_o, value): (N, 3) float32 each."""
        notes = [f"{int(np.count_nonzero(keep))} sparse samples; between them, the nearest one counts"]
        if wrong.any():
            notes.append(f"{int(np.count_nonzero(wrong))} of {len(wi)} samples are masked (negative or not finite)")
        if below.any():
            notes.append(f"{int(np.count_nonzero(below))} of {len(wi)} samples are masked (below the horizon)")
        self.notes = tuple(notes)
        self._keys = None

    def eval(self, wi, wo):
        """Return the value of the nearest sample, (N, 3) float32 in 1/sr without the cosine: for pictures and metrics.

        Near is near in warped half vector and difference vector, (g, d/2), in which highlights are about as wide as
        they are far from the normal (g as in MERL's spacing, θ' ~ √θ); with the azimuth taken out where isotropic, and
        among the samples' mirror images under ``symmetry``. A piecewise constant function: train on :attr:`samples`.
        The time is proportional to directions × samples, unless SciPy is installed, whose tree finds the same samples.
        """
        if self._keys is None:
            self._keys = self._images(*self.samples[:2])
            self._tree = _tree(self._keys[0])
        keys, number = self._keys
        values = self.samples[2]
        if self._tree is not None:
            return in_chunks(lambda i, o: values[number[self._tree.query(self._key(i, o))[1]]], wi, wo)
        size = max(1, int(2**24 // len(keys)))  # bounds the table of distances

        def nearest(i, o):
            out = np.empty((len(i), 3), np.float32)
            query = self._key(i, o)
            for start in range(0, len(i), size):
                score = query[start : start + size] @ keys.T  # all keys have one length: the nearest is the most alike
                out[start : start + size] = values[number[score.argmax(1)]]
            return out

        return in_chunks(nearest, wi, wo)

    def _key(self, wi, wo, turn: float = 1.0, mirror: float = 1.0) -> np.ndarray:
        rows, cos_phi, sin_phi = half_difference(wi, wo)
        hx, hz, dx, dy, dz = rows
        root = np.sqrt(np.maximum(hx, 0.0))
        if self.isotropic:
            cos_phi, sin_phi = np.ones_like(root), np.zeros_like(root)
        g = (root * cos_phi, root * sin_phi, hz / np.sqrt(1.0 + hx))
        return np.stack([*g, 0.5 * turn * dx, 0.5 * turn * mirror * dy, 0.5 * dz], 1)

    def _images(self, wi, wo) -> tuple[np.ndarray, np.ndarray]:
        """Return the keys of all samples and of their images under the symmetry, and which sample each belongs to."""
        turns = (1.0,) if self.symmetry == "none" else (1.0, -1.0)
        mirrors = (1.0, -1.0) if self.symmetry == "bilateral" else (1.0,)
        keys = [self._key(wi, wo, turn, mirror) for turn in turns for mirror in mirrors]
        return np.concatenate(keys), np.tile(np.arange(len(wi)), len(keys))


def _tree(keys: np.ndarray):
    """Return SciPy's k-d tree of the keys, or None where it is not installed."""
    try:
        from scipy.spatial import KDTree
    except ImportError:
        return None
    return KDTree(keys)


def read_samples(path, isotropic: bool | None = None, symmetry: str | None = None) -> BRDFSamples:
    """Return the samples in the `.csv` file at ``path`` as a BRDF source named after the file.

    Args:
        path: The file.
        isotropic: Overrides what the file says; where neither does, false.
        symmetry: Overrides what the file says; where neither does, "reciprocal".

    Raises:
        ValueError: If a column is missing, or a row has the wrong number of fields, a field that is no number, or a
            direction that is not of unit length: one line with file, line number and rule.
        OSError: If the file cannot be read.
    """
    path = Path(path)
    said, header, rows = {}, None, []
    try:
        with open(path, encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                line = line.strip()
                if line.startswith("#"):
                    said.update(_said(path, number, line))
                elif line and header is None:
                    header = [field.strip().strip('"').lower() for field in line.split(",")]
                elif line:
                    rows.append((number, line))
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; a list of samples is comma-separated text") from None
    if header is None or not rows:
        raise ValueError(f"{path}: holds no samples; the first row names the columns, the others are numbers")
    numbers = np.array([number for number, _ in rows])
    table = _parse(path, header, rows)
    columns = {name: table[:, place] for place, name in enumerate(header)}
    wi, wo = (_directions(path, columns, numbers, side) for side in "io")
    missing = [name for name in "rgb" if name not in columns]
    if missing:
        raise ValueError(f"{path}: no column {missing[0]!r}; the header names {', '.join(header)}")
    isotropic = said.get("isotropic", False) if isotropic is None else isotropic
    symmetry = said.get("symmetry", "reciprocal") if symmetry is None else symmetry
    try:
        return BRDFSamples(path.stem, wi, wo, np.stack([columns[c] for c in "rgb"], 1), isotropic, symmetry)
    except ValueError as error:
        raise ValueError(f"{path}: {str(error).removeprefix(path.stem + ': ')}") from None


def write_samples(path, wi, wo, value, isotropic: bool = False, symmetry: str = "reciprocal") -> Path:
    """Write samples as a `.csv` file that :func:`read_samples` reads, and return its path.

    Args:
        path: File to write; it appears whole or not at all.
        wi: Unit directions to the light, (N, 3).
        wo: Unit directions to the viewer, (N, 3).
        value: BRDF in 1/sr without the cosine, (N, 3).
        isotropic: Written as a comment line.
        symmetry: Written as a comment line.

    Raises:
        ValueError: If the shapes differ or the symmetry is unknown.
        OSError: If the file cannot be written.
    """
    wi, wo = checked(wi, wo)
    value = np.asarray(value, np.float32)
    if value.shape != wi.shape or symmetry not in SYMMETRIES:
        raise ValueError(f"{path}: value must have shape {wi.shape} and symmetry be one of {', '.join(SYMMETRIES)}")
    with replacing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="\n") as file:
        file.write(f"# isotropic: {str(bool(isotropic)).lower()}\n# symmetry: {symmetry}\n")
        file.write("wi_x,wi_y,wi_z,wo_x,wo_y,wo_z,r,g,b\n")
        np.savetxt(file, np.concatenate([wi, wo, value], 1), "%.9g", ",")  # nine digits give back every float32
    return Path(path)


def _said(path: Path, number: int, line: str) -> dict:
    """Return what a comment line declares, if anything."""
    match = re.fullmatch(r"#\s*(isotropic|symmetry)\s*[:=]\s*(\S+)\s*", line, flags=re.IGNORECASE)
    if not match:
        return {}
    key, value = match[1].lower(), match[2].lower()
    known = _BOOLEANS if key == "isotropic" else {name: name for name in SYMMETRIES}
    if value not in known:
        raise ValueError(f"{path}, line {number}: {key} must be one of {', '.join(known)}, got {match[2]!r}")
    return {key: known[value]}


def _parse(path: Path, header: list[str], rows) -> np.ndarray:
    """Return the numbers (N, columns) float64; the first row that cannot be read is named."""
    try:
        table = np.loadtxt([line for _, line in rows], delimiter=",", ndmin=2, comments="#")
        if table.shape == (len(rows), len(header)):
            return table
    except ValueError:
        pass
    # Row by row: slower, with words for what is wrong; and text in columns that nothing reads is fine here.
    wanted = [name in _COLUMNS for name in header]
    table = np.zeros((len(rows), len(header)))
    for place, (number, line) in enumerate(rows):
        fields = line.partition("#")[0].split(",")
        if len(fields) != len(header):
            raise ValueError(f"{path}, line {number}: {len(fields)} fields where the header names {len(header)}")
        for column, field in enumerate(fields):
            if not wanted[column]:
                continue
            try:
                table[place, column] = float(field)
            except ValueError:
                text = field.strip()
                raise ValueError(f"{path}, line {number}: {header[column]} must be a number, got {text!r}") from None
    return table


_VECTORS = {side: tuple(f"w{side}_{axis}" for axis in "xyz") for side in "io"}
_ANGLES = {side: (f"theta_{side}", f"phi_{side}") for side in "io"}
_COLUMNS = {"r", "g", "b", *_VECTORS["i"], *_VECTORS["o"], *_ANGLES["i"], *_ANGLES["o"]}


def _directions(path: Path, columns, numbers, side: str) -> np.ndarray:
    if all(name in columns for name in _VECTORS[side]):
        w = np.stack([columns[name] for name in _VECTORS[side]], 1)
        length = np.sqrt((w * w).sum(1))
        bad = ~(np.abs(length - 1.0) < 0.01)
        if bad.any():
            first = int(np.argmax(bad))
            raise ValueError(
                f"{path}, line {numbers[first]}: w{side} must have length 1, got {length[first]:.4g}"
                f" ({int(bad.sum())} such rows)"
            )
        return w / length[:, None]
    if all(name in columns for name in _ANGLES[side]):
        theta, phi = (np.radians(columns[name]) for name in _ANGLES[side])
        bad = ~(np.isfinite(phi) & (theta >= 0) & (theta <= np.pi))
        if bad.any():
            first = int(np.argmax(bad))
            raise ValueError(f"{path}, line {numbers[first]}: theta_{side} must be 0 to 180 degrees, phi_{side} finite")
        return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    what = f"{', '.join(_VECTORS[side])} or {', '.join(_ANGLES[side])}"
    raise ValueError(f"{path}: the header needs {what}; it names {', '.join(columns)}")
