"""MERL BRDF tables (`.binary`): reader, writer, and look-up.

Layout: 3 × int32 dimensions (90, 90, 180), then three planes (R, G, B) of float64, θ_h slowest and φ_d fastest. Stored
numbers times 1/1500, 1.15/1500, 1.66/1500 are the BRDF in 1/sr, without the cosine. With Rusinkiewicz' half and
difference angles, cell (a, b, c) spans θ_h = (π/2)(a/90)² … (π/2)((a + 1)/90)², one degree of θ_d in [0°, 90°] and one
degree of φ_d in [0°, 180°): φ_d and φ_d + 180° share a cell, so that the table is reciprocal by construction. Entries
without a measurement, most of them with a direction below the horizon, are negative.

Matusik et al., "A Data-Driven Reflectance Model", 2003; Rusinkiewicz 1998.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from .atomic import replacing
from .brdf_source import from_half_difference, half_difference, in_chunks

DIMS = (90, 90, 180)
"""Cells along θ_h, θ_d and φ_d."""
SCALES = np.array([1.0, 1.15, 1.66]) / 1500.0
"""1/sr per stored unit, R, G, B."""


class MERL:
    """A MERL table as a BRDF source.

    Args:
        name: Material name.
        table: (90, 90, 180, 3) BRDF values in 1/sr; negative and non-finite entries are masked.
        lookup: "trilinear" between cell centres, masked entries left out of the weights; or "nearest", the cell that
            holds the direction, as the code published with the data does.

    Where no entry around a direction is measured, the nearest measured one with smaller θ_d counts (else with smaller
    θ_h): near the horizon the last measured value is kept, where a 0 would draw a dark rim.
    """

    isotropic = True
    symmetry = "reciprocal"

    def __init__(self, name: str, table: np.ndarray, lookup: str = "trilinear"):
        if lookup not in ("trilinear", "nearest"):
            raise ValueError(f"lookup must be 'trilinear' or 'nearest', got {lookup!r}")
        table = _as_table(table)
        self.name, self.lookup = name, lookup
        good = np.isfinite(table) & (table >= 0)
        self.masked = int(good.size - np.count_nonzero(good))
        """How many of the 3 · 1 458 000 entries are negative or not finite."""
        below = ~above_horizon()[..., None] & ~good
        self.masked_above = self.masked - int(np.count_nonzero(below))
        """How many of those have both directions of the cell centre above the horizon: gaps in the measurement."""
        self._table = np.where(good, table, 0).astype(np.float32)
        self._good = None
        if self.masked:
            _fill(self._table, good)
            self._good = good.astype(np.float32).reshape(-1, 3)
        self._table = self._table.reshape(-1, 3)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was masked, in words."""
        if not self.masked:
            return ()
        total = 3 * int(np.prod(DIMS))
        return (
            f"{self.masked} of {total} entries are masked (negative or not finite), {self.masked_above} of them above"
            " the horizon",
        )

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(self._trilinear if self.lookup == "trilinear" else self._nearest, wi, wo)

    def _nearest(self, wi, wo):
        a, b, c = (np.floor(t).astype(np.int64) for t in _coordinates(wi, wo))
        return self._table[_flat(np.minimum(a, 89), np.minimum(b, 89), c % 180)]

    def _trilinear(self, wi, wo):
        low, weight = [], []
        for axis, t in enumerate(_coordinates(wi, wo)):
            t = t - np.float32(0.5)  # cell centres lie at whole numbers
            if axis < 2:
                t = np.clip(t, 0.0, np.float32(DIMS[axis] - 1))
            floor = np.floor(t)
            low.append(floor.astype(np.int64))
            weight.append((1.0 - (t - floor), t - floor))
        value = np.zeros((len(wi), 3), np.float32)
        total = np.zeros_like(value)
        for corner in range(8):
            i, j, k = corner >> 2, corner >> 1 & 1, corner & 1
            cell = _flat(np.minimum(low[0] + i, 89), np.minimum(low[1] + j, 89), (low[2] + k) % 180)
            w = (weight[0][i] * weight[1][j] * weight[2][k])[:, None]
            if self._good is not None:
                w = w * self._good[cell]
                total += w
            value += w * self._table[cell]
        if self._good is None:
            return value
        empty = total < 1e-6
        value /= np.where(empty, 1.0, total)
        if empty.any():
            rows = np.flatnonzero(empty.any(1))
            value[rows] = np.where(empty[rows], self._nearest(wi[rows], wo[rows]), value[rows])
        return value


def read_merl(path, lookup: str = "trilinear") -> MERL:
    """Return the MERL table at ``path`` as a BRDF source named after the file.

    Raises:
        ValueError: If the dimensions or the length are not those of a MERL file, or no entry is measured.
        OSError: If the file cannot be read.
    """
    path = Path(path)
    count = int(np.prod(DIMS))
    length, expected = path.stat().st_size, 12 + 8 * 3 * count
    with open(path, "rb") as file:
        dims = np.fromfile(file, "<i4", 3)
        if len(dims) < 3 or tuple(dims) != DIMS:
            raise ValueError(f"{path}: not a MERL table, its dimensions are {dims.tolist()}, not {list(DIMS)}")
        if length != expected:
            raise ValueError(f"{path}: holds {length} bytes where a MERL table has {expected}; fetch the file again")
        stored = np.fromfile(file, "<f8", 3 * count)
    table = np.moveaxis(stored.reshape(3, *DIMS) * SCALES[:, None, None, None], 0, -1)
    source = MERL(path.stem, table, lookup)
    if source.masked == table.size:
        raise ValueError(f"{path}: every entry is negative or not finite; fetch the file again")
    return source


def write_merl(path, source) -> Path:
    """Write a table or any isotropic BRDF source as a MERL `.binary` file, and return its path.

    Args:
        path: File to write; it appears whole or not at all.
        source: (90, 90, 180, 3) values in 1/sr (negative = no measurement), or a source: :func:`tabulate`.

    Raises:
        ValueError: If the table has another shape, or the source is anisotropic.
        OSError: If the file cannot be written.
    """
    table = tabulate(source) if hasattr(source, "eval") else _as_table(source)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.array(DIMS, "<i4").tofile(file)
        for channel, scale in enumerate(SCALES):
            plane = np.asarray(table[..., channel], np.float64)
            np.where(plane < 0, -1.0, plane / scale).astype("<f8").tofile(file)
    return Path(path)


def tabulate(source) -> np.ndarray:
    """Return (90, 90, 180, 3) float64 values of a source at the cell centres; −1 where a direction is not above.

    A table is reciprocal, so a source that is not is entered as the mean of f(ω_i, ω_o) and f(ω_o, ω_i).

    Raises:
        ValueError: If the source is anisotropic: a MERL table has no place for the azimuth.
    """
    if not source.isotropic:
        raise ValueError(
            f"{source.name}: anisotropic, and a MERL table holds isotropic BRDFs only; write an .npz or .csv"
        )
    above = above_horizon()
    table = np.full((*DIMS, 3), -1.0)
    for a in range(DIMS[0]):  # one θ_h at a time keeps the memory small
        wi, wo = centres(a)
        use = above[a].ravel()
        wi, wo = wi[use].astype(np.float32), wo[use].astype(np.float32)
        value = np.asarray(source.eval(wi, wo), np.float64)
        if source.symmetry == "none":
            value = 0.5 * (value + source.eval(wo, wi))
        table[a][above[a]] = value
    return table


def centres(a: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ω_i, ω_o at the centres of all cells of θ_h index ``a``, (90 · 180, 3) float64 each, φ_h = 0."""
    theta_h = 0.5 * np.pi * ((a + 0.5) / DIMS[0]) ** 2
    theta_d = 0.5 * np.pi * (np.arange(DIMS[1])[:, None] + 0.5) / DIMS[1]
    phi_d = np.pi * (np.arange(DIMS[2])[None, :] + 0.5) / DIMS[2]
    return from_half_difference(theta_h, theta_d, phi_d)


@functools.cache
def above_horizon() -> np.ndarray:
    """Return (90, 90, 180) bool: whether both directions of a cell's centre are above the horizon."""
    above = np.empty(DIMS, bool)
    for a in range(DIMS[0]):
        wi, wo = centres(a)
        above[a] = ((wi[:, 2] > 1e-9) & (wo[:, 2] > 1e-9)).reshape(DIMS[1:])
    return above


def _as_table(table) -> np.ndarray:
    table = np.asarray(table)
    if table.shape != (*DIMS, 3) or table.dtype.kind != "f":
        raise ValueError(f"a MERL table must be float of shape {(*DIMS, 3)}, got {table.dtype} {table.shape}")
    return table


def _fill(table: np.ndarray, good: np.ndarray) -> None:
    """Put into every masked entry the nearest good one with smaller θ_d, or else with smaller θ_h, in place."""
    good = good.copy()
    for axis in (1, 0):
        shape = [1] * 4
        shape[axis] = DIMS[axis]
        index = np.where(good, np.arange(DIMS[axis], dtype=np.int16).reshape(shape), np.int16(-1))
        np.maximum.accumulate(index, axis=axis, out=index)
        good |= index >= 0
        table[...] = np.take_along_axis(table, np.maximum(index, 0).astype(np.int64), axis)


def _coordinates(wi, wo) -> list[np.ndarray]:
    """Return the table coordinates of a direction pair, float32: cell k spans [k, k + 1) of each."""
    rows, _, _ = half_difference(wi, wo)
    hx, hz, dx, dy, dz = rows
    # atan2 of sine and cosine keeps the digits near the pole, where MERL's cells are 0.01° wide and acos has none left.
    theta_h = np.arctan2(hx, hz)
    theta_d = np.arctan2(np.sqrt(dx * dx + dy * dy), dz)
    phi_d = np.arctan2(dy, dx)
    phi_d = np.where(phi_d < 0, phi_d + np.float32(np.pi), phi_d)
    return [
        np.sqrt(theta_h * np.float32(2 / np.pi)) * 90,
        np.clip(theta_d * np.float32(180 / np.pi), 0.0, 90.0),
        phi_d * np.float32(180 / np.pi),
    ]


def _flat(a, b, c) -> np.ndarray:
    return (a * DIMS[1] + b) * DIMS[2] + c
