"""RGL measurements (`.bsdf`): the adaptive parameterisation of Dupuy & Jakob, evaluated in NumPy.

For a direction ω (azimuth φ, elevation θ from the normal) and the half vector m:

    f cosθ = S(u; φ, θ) · D(m) / (4 σ(ω)),   u = R(m; φ, θ)

S is the measured table, D the distribution of normals, σ the projected area, and R the map from half vectors to the
unit square along which the distribution of *visible* normals (`vndf`) is uniform. D, σ and `vndf` are tables over
(√(2θ/π), (φ + π)/2π); tables are bilinear between entries, and linear in the measured φ and θ. In an isotropic file (at
most two φ) the azimuth of m counts from that of ω, and σ is averaged over φ; an anisotropic one may cover half or a
quarter of the circle, and is continued by symmetry. Spectra become linear Rec. 709 RGB through
:mod:`warp_neumat.io.spectra` as the file is read, which is the same as converting each value, since look-ups are
linear.

Here ω is our ω_o, the viewer, and the cosine that of ω_i, so that Mitsuba's `measured` plugin, whose `wi` is the
camera's side, gives f(ω_i, ω_o)·cosθ_i for the same file. Interpolation makes such data not exactly reciprocal.

Dupuy & Jakob, "An Adaptive Parameterization for Efficient Material Acquisition and Rendering", 2018.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .brdf_source import in_chunks
from .spectra import rgb_weights
from .tensor_file import read_tensors

_PI = np.float32(np.pi)


class RGL:
    """A measured BRDF in the adaptive parameterisation, as a BRDF source.

    Args:
        name: Material name.
        fields: Arrays as in the file: ``theta_i (t,), phi_i (p,), ndf (h, w), sigma (h, w), vndf (p, t, h, w),
            rgb (p, t, 3, n, n)`` or ``spectra (p, t, l, n, n)`` with ``wavelengths (l,)``, ``jacobian (1,)``.

    Raises:
        ValueError: If a field is missing or has another shape.

    Error: at most 4e-6 of 1 + f against Mitsuba's `measured`, held by test_rgl_matches_mitsuba.
    """

    symmetry = "none"

    def __init__(self, name: str, fields: dict[str, np.ndarray]):
        self.name = name
        shapes = _check(name, fields)
        self._phi, self._theta = (np.asarray(fields[key], np.float32) for key in ("phi_i", "theta_i"))
        self._relative = len(self._phi) <= 2
        self._jacobian = bool(np.asarray(fields["jacobian"]).ravel()[0])
        self._ndf, self._sigma = _Table(fields["ndf"]), _Table(fields["sigma"])
        self._warp = _Warp(np.asarray(fields["vndf"], np.float64))
        notes = [] if not self._description(fields) else [f"file says: {self._description(fields)}"]
        if "spectra" in fields:
            weights = rgb_weights(fields["wavelengths"])
            p, t, _, n, _ = shapes["spectra"]
            table = np.empty((p, t, n, n, 3), np.float32)
            for k in range(p):  # a slice at a time: the spectra of an anisotropic material may be a gigabyte
                table[k] = np.einsum("cl,tlyx->tyxc", weights, np.asarray(fields["spectra"][k], np.float64))
            low, high = fields["wavelengths"][0], fields["wavelengths"][-1]
            notes.append(f"{shapes['spectra'][2]} wavelengths ({low:g} to {high:g} nm) as linear Rec. 709 under D65")
        else:
            table = np.ascontiguousarray(np.moveaxis(np.asarray(fields["rgb"], np.float32), 2, -1))
        bad = ~np.isfinite(table)
        table[bad] = 0.0
        self.masked = int(np.count_nonzero(bad))
        """How many entries of the table, as RGB, are not finite; they count as 0."""
        negative = int(np.count_nonzero(table < 0))
        if self.masked:
            notes.append(f"{self.masked} of {table.size} entries are not finite, and count as 0")
        if negative:
            why = "noise, or colours outside Rec. 709" if "spectra" in fields else "noise"
            notes.append(f"{negative} of {table.size} entries are negative ({why}); values below 0 are returned as 0")
        self._values = _Table(table)
        # With two measured φ that agree, the azimuth of ω drops out.
        self.isotropic = self._relative and all(
            np.array_equal(a[0], a[-1]) for a in (table, np.asarray(fields["vndf"]))
        )
        if self.isotropic:  # σ is looked up at the azimuth of ω; averaged over it, that drops out exactly
            rows = np.asarray(fields["sigma"], np.float64)
            mean = np.trapezoid(rows, axis=0) / (len(rows) - 1)
            spread = float(np.abs(rows / mean - 1.0).max())
            if spread > 1e-3:
                notes.append(f"sigma varies by {100 * spread:.1f} % over the azimuth of an isotropic file; averaged")
            self._sigma = _Table(np.stack([mean, mean]))
        self._reduction = 1
        if not self._relative:
            self._reduction = round(2.0 * np.pi / float(self._phi[-1] - self._phi[0]))
            if self._reduction not in (1, 2, 4):
                span = np.degrees(float(self._phi[-1] - self._phi[0]))
                raise ValueError(f"{name}: phi_i must span 360°, 180° or 90°, not {span:.0f}°")
        self.notes = tuple(notes)

    @staticmethod
    def _description(fields) -> str:
        return bytes(np.asarray(fields.get("description", ()), np.uint8)).decode("utf-8", "replace").strip("\0 \n")

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(self._eval, wi, wo)

    def _eval(self, wi, wo):
        cosine = np.maximum(wi[:, 2], 1e-7)
        w, (ix, iy, iz) = np.ascontiguousarray(wo.T), np.ascontiguousarray(wi.T)
        if self._reduction > 1:  # bring ω into the measured part of the circle, φ from −π, and turn the other with it
            sy = np.where(np.signbit(w[1]), np.float32(1), np.float32(-1))
            sx = sy if self._reduction == 2 else np.where(np.signbit(w[0]), np.float32(1), np.float32(-1))
            w[0] *= sx
            w[1] *= sy
            ix, iy = ix * sx, iy * sy
        m = np.stack([ix + w[0], iy + w[1], iz + w[2]])
        m /= np.maximum(np.sqrt((m * m).sum(0)), np.float32(1e-20))
        theta, phi = _elevation(w), np.arctan2(w[1], w[0])
        phi_m = np.arctan2(m[1], m[0])
        azimuth = ((phi_m - phi if self._relative else phi_m) + _PI) / (2 * _PI)
        u = np.stack([np.sqrt(_elevation(m) * (2 / _PI)), azimuth - np.floor(azimuth)])
        slices = _slices(self._phi, phi, self._theta, theta)
        value = self._values.at(*self._warp.invert(*u, slices), slices)
        if self._jacobian:
            sigma = self._sigma.at(np.sqrt(theta * (2 / _PI)), (phi + _PI) / (2 * _PI))
            value = value * (self._ndf.at(*u) / (4.0 * np.maximum(sigma, 1e-9)))[:, None]
        return np.maximum(value / cosine[:, None], 0.0)


def read_rgl(path) -> RGL:
    """Return the `.bsdf` file at ``path`` as a BRDF source named after the file.

    Raises:
        ValueError: If it is no tensor file, or fields are missing or have other shapes.
        OSError: If it cannot be read.
    """
    path = Path(path)
    try:
        return RGL(path.stem, read_tensors(path))
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {str(error).removeprefix(path.stem + ': ')}") from None


def _check(name: str, fields) -> dict[str, tuple]:
    """Raise a ValueError that names the first field that is missing or does not fit; return the shapes."""
    data = "spectra" if "spectra" in fields else "rgb"
    shapes = {key: np.shape(value) for key, value in fields.items()}
    needed = ["theta_i", "phi_i", "ndf", "sigma", "vndf", data, "jacobian", *(["wavelengths"] * (data == "spectra"))]
    for key in needed:
        if key not in fields:
            what = "rgb, or spectra with wavelengths" if key == "rgb" else key
            raise ValueError(
                f"{name}: not an RGL measurement, it has no field {what}; it has {', '.join(sorted(fields))}"
            )
    rank = {"theta_i": 1, "phi_i": 1, "ndf": 2, "sigma": 2, "vndf": 4, data: 5, "wavelengths": 1, "jacobian": 1}
    for key in needed:
        if len(shapes[key]) != rank[key] or 0 in shapes[key]:
            raise ValueError(f"{name}: field {key} must have {rank[key]} dimensions, got shape {shapes[key]}")
    lead = (*shapes["phi_i"], *shapes["theta_i"])
    for key in ("vndf", data):
        if shapes[key][:2] != lead:
            raise ValueError(f"{name}: field {key} must begin with {lead}, got shape {shapes[key]}")
    bands = 3 if data == "rgb" else shapes["wavelengths"][0]
    if shapes[data][2] != bands:
        raise ValueError(f"{name}: field {data} must hold {bands} bands, got shape {shapes[data]}")
    for key in ("ndf", "sigma", "vndf", data):
        if min(shapes[key][-2:]) < 2:
            raise ValueError(f"{name}: field {key} must be at least 2 by 2, got shape {shapes[key]}")
    for key in ("ndf", "sigma", "vndf"):
        if not np.isfinite(fields[key]).all():
            raise ValueError(f"{name}: field {key} holds values that are not finite; fetch the file again")
    for key in ("phi_i", "theta_i"):
        if (np.diff(fields[key]) <= 0).any():
            raise ValueError(f"{name}: field {key} must ascend")
    return shapes


def _elevation(w) -> np.ndarray:
    """Return the angle of unit (3, N) from the normal; arcsin of half the chord keeps the digits near the pole."""
    chord = np.sqrt(w[0] * w[0] + w[1] * w[1] + (w[2] - 1) ** 2)
    return 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))


def _slices(phi_i, phi, theta_i, theta) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return up to four (slice number, weight) that interpolate linearly in the measured φ and θ."""
    parts = []
    for nodes, at in ((phi_i, phi), (theta_i, theta)):
        if len(nodes) == 1:
            parts.append([(np.zeros(len(at), np.int64), np.float32(1))])
            continue
        low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
        t = np.clip((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)
        parts.append([(low, 1.0 - t), (low + 1, t)])
    return [(p * len(theta_i) + t, wp * wt) for p, wp in parts[0] for t, wt in parts[1]]


class _Table:
    """Tables (…, h, w) or (…, h, w, 3) over the unit square, x along w, bilinear between entries."""

    def __init__(self, values: np.ndarray):
        values = np.asarray(values, np.float32)
        colour = values.ndim in (3, 5)
        self.h, self.w = values.shape[-3:-1] if colour else values.shape[-2:]
        self._flat = values.reshape(-1, 3) if colour else values.reshape(-1)

    def at(self, x, y, slices=((0, 1),)) -> np.ndarray:
        """Return the values at (x, y) in [0, 1], summed over the weighted ``slices``."""
        i, x = _cell(x, self.w)
        j, y = _cell(y, self.h)
        place, total = j * self.w + i, 0.0
        for number, weight in slices:
            first = place + number * (self.h * self.w)
            for step, part in ((0, (1 - x) * (1 - y)), (1, x * (1 - y)), (self.w, (1 - x) * y), (self.w + 1, x * y)):
                part = part * weight
                total = total + self._flat[first + step] * (part[:, None] if self._flat.ndim == 2 else part)
        return total


class _Warp:
    """The map of the unit square along which densities (p, t, h, w) become uniform: columns given the row, then rows.

    x' = ∫₀ˣ p(s, y) ds / ∫₀¹ p(s, y) ds and y' = ∫₀ʸ ∫₀¹ p, for p bilinear between entries and linear between slices.
    """

    def __init__(self, density: np.ndarray):
        h, w = density.shape[-2:]
        density = density.reshape(-1, h, w)
        rows = np.zeros((len(density), h, w))  # ∫₀ˣ along each row of entries, at each entry
        np.cumsum((density[:, :, 1:] + density[:, :, :-1]) * (0.5 / (w - 1)), axis=2, out=rows[:, :, 1:])
        columns = np.zeros((len(density), h))  # ∫₀ʸ of the rows' totals, at each row
        np.cumsum((rows[:, 1:, -1] + rows[:, :-1, -1]) * (0.5 / (h - 1)), axis=1, out=columns[:, 1:])
        total = np.maximum(columns[:, -1], 1e-30)
        self.h, self.w = h, w
        self._density = (density / total[:, None, None]).astype(np.float32).ravel()
        self._rows = (rows / total[:, None, None]).astype(np.float32).ravel()
        self._columns = (columns / total[:, None]).astype(np.float32).ravel()

    def invert(self, x, y, slices) -> tuple[np.ndarray, np.ndarray]:
        """Return (x', y') in [0, 1] of (x, y)."""
        w = self.w
        i, x = _cell(x, w)
        j, y = _cell(y, self.h)
        place = j * w + i

        def mix(table, at, stride):
            return sum(table[at + number * stride] * weight for number, weight in slices)

        plane = self.h * w
        p0 = mix(self._density, place, plane) * (1 - y) + mix(self._density, place + w, plane) * y
        p1 = mix(self._density, place + 1, plane) * (1 - y) + mix(self._density, place + w + 1, plane) * y
        before = mix(self._rows, place, plane) * (1 - y) + mix(self._rows, place + w, plane) * y
        end = j * w + (w - 1)
        row0, row1 = mix(self._rows, end, plane), mix(self._rows, end + w, plane)
        part = x * (p0 + (p1 - p0) * (0.5 * x)) / (w - 1)  # the integral within the cell, a trapezium
        across = (before + part) / np.maximum(row0 * (1 - y) + row1 * y, np.float32(1e-30))
        up = mix(self._columns, j, self.h) + y * (row0 + (row1 - row0) * (0.5 * y)) / (self.h - 1)
        return across, up


def _cell(t, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell of t in [0, 1] between ``size`` entries, and the place in it."""
    t = np.clip(t, 0.0, 1.0) * np.float32(size - 1)
    low = np.minimum(t.astype(np.int64), size - 2)
    return low, t - low.astype(np.float32)
