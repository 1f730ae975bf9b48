"""What every BRDF source shares: the protocol, half and difference vectors, evaluation in chunks on all cores.

ω_i points to the light and ω_o to the viewer, both unit and away from the surface, in a frame with z = shading normal.
A source returns the BRDF value in 1/sr, linear Rec. 709 RGB, **without** the cosine; below the horizon it is 0.

Half and difference vector are those of Rusinkiewicz, "A New Change of Variables for Efficient BRDF Representation",
1998.
"""

from __future__ import annotations

import concurrent.futures
import difflib
import os
from typing import Protocol

import numpy as np

CHUNK = 1 << 14
"""Directions evaluated at a time, so that the intermediate rows stay in cache."""


class BRDFSource(Protocol):
    """What a fit needs of a reflectance: its name, its symmetries, and its values."""

    name: str
    isotropic: bool
    """Whether turning both directions about the normal changes nothing."""
    symmetry: str
    """What holds exactly: "none"; "reciprocal", f(i, o) = f(o, i); "bilateral", also mirrored (isotropic only)."""
    notes: tuple[str, ...]
    """Readable lines about the data: what was masked, converted or assumed."""

    def eval(self, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return the BRDF for unit directions (N, 3) and (N, 3) as (N, 3) float32 in 1/sr, without the cosine."""


SYMMETRIES = ("none", "reciprocal", "bilateral")


def checked(wi, wo) -> tuple[np.ndarray, np.ndarray]:
    """Return both as C-contiguous (N, 3) float32.

    Raises:
        ValueError: If the shapes are others, or the lengths differ.
    """
    wi, wo = np.ascontiguousarray(wi, np.float32), np.ascontiguousarray(wo, np.float32)
    for name, value in (("wi", wi), ("wo", wo)):
        if value.ndim != 2 or value.shape[1] != 3:
            raise ValueError(f"{name} must have shape (N, 3), got {value.shape}")
    if len(wi) != len(wo):
        raise ValueError(f"wi and wo must have one length, got {len(wi)} and {len(wo)}")
    return wi, wo


def in_chunks(evaluate, wi, wo, chunk: int = CHUNK) -> np.ndarray:
    """Return ``evaluate`` of all directions, chunk by chunk on all cores; 0 where one is not above the horizon.

    A direction that is not finite counts as not above.

    Args:
        evaluate: (wi (n, 3), wo (n, 3)) float32 → (n, 3), without side effects: NumPy lets go of the interpreter lock,
            so chunks run side by side.
        wi: Unit directions (N, 3).
        wo: Unit directions (N, 3).
        chunk: Directions at a time.
    """
    wi, wo = checked(wi, wo)
    values = np.empty((len(wi), 3), np.float32)

    def fill(start: int) -> None:
        part = slice(start, start + chunk)
        i, o = wi[part], wo[part]
        above = (i[:, 2] > 0) & (o[:, 2] > 0)
        if not np.isfinite(np.vdot(i, i) + np.vdot(o, o)):
            above &= np.isfinite(i).all(1) & np.isfinite(o).all(1)
        hidden = np.flatnonzero(~above)
        if len(hidden):  # evaluate sees directions above the horizon only
            i, o = i.copy(), o.copy()
            i[hidden] = o[hidden] = (0.0, 0.0, 1.0)
        values[part] = evaluate(i, o)
        values[start + hidden] = 0.0

    starts = range(0, len(wi), chunk)
    workers = min(len(starts), cores())
    if workers > 1:
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            list(pool.map(fill, starts))
    else:
        for start in starts:
            fill(start)
    return values


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def suggest(key: str, known) -> str:
    """Return "nearest: …" where names like ``key`` are known, else "known: …"."""
    close = difflib.get_close_matches(key, list(known), n=3, cutoff=0.4)
    return f"nearest: {', '.join(close)}" if close else f"known: {', '.join(sorted(known)[:12])}"


def rusinkiewicz(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return (h', d) of unit ω_i, ω_o: shape (N, 6), dtype of ``wi``; h' has azimuth 0, d is in the frame of h.

    Rusinkiewicz 1998, Sec. 3: h' = R_z(−φ_h) h, d = R_y(−θ_h) R_z(−φ_h) ω_i. Where h is the pole, φ_h is taken as 0;
    where |ω_i + ω_o| < 1e-6, opposite along the surface, h is taken as the pole.
    """
    rows, _, _ = half_difference(wi, wo)
    out = np.zeros((len(wi), 6), rows.dtype)
    out[:, [0, 2, 3, 4, 5]] = rows.T
    return out


def half_difference(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows (sin θ_h, cos θ_h, d_x, d_y, d_z) of shape (5, N), and cos φ_h, sin φ_h: see :func:`rusinkiewicz`."""
    ix, iy, iz = np.ascontiguousarray(wi.T)
    x, y, z = np.ascontiguousarray(wo.T)
    x, y, z = x + ix, y + iy, z + iz
    sine2 = x * x + y * y
    length = np.sqrt(sine2 + z * z)
    scale = 1.0 / np.maximum(length, 1e-6)
    sine = np.sqrt(sine2)
    divisor = np.maximum(sine, 1e-12)
    cos_phi, sin_phi = x / divisor, y / divisor
    opposite = length < 1e-6
    pole = (sine < 1e-12) | opposite
    cos_phi[pole], sin_phi[pole] = 1.0, 0.0
    rows = np.empty((5, len(wi)), wi.dtype)
    hx = np.multiply(sine, scale, out=rows[0])
    hz = np.multiply(z, scale, out=rows[1])
    hx[opposite], hz[opposite] = 0.0, 1.0
    along = ix * cos_phi + iy * sin_phi
    np.subtract(along * hz, iz * hx, out=rows[2])
    np.subtract(iy * cos_phi, ix * sin_phi, out=rows[3])
    np.add(along * hx, iz * hz, out=rows[4])
    return rows, cos_phi, sin_phi


def from_half_difference(theta_h, theta_d, phi_d) -> tuple[np.ndarray, np.ndarray]:
    """Return (ω_i, ω_o), (N, 3) float64 each, of Rusinkiewicz angles in radians, with φ_h = 0; the inverse of above.

    ω_i = R_y(θ_h) d, and ω_o is ω_i mirrored about h; either may lie below the horizon.
    """
    theta_h, theta_d, phi_d = np.broadcast_arrays(*(np.asarray(t, np.float64) for t in (theta_h, theta_d, phi_d)))
    hx, hz = np.sin(theta_h).ravel(), np.cos(theta_h).ravel()
    sine, dz = np.sin(theta_d).ravel(), np.cos(theta_d).ravel()
    dx, dy = sine * np.cos(phi_d).ravel(), sine * np.sin(phi_d).ravel()
    return (
        np.stack([dz * hx + dx * hz, dy, dz * hz - dx * hx], 1),
        np.stack([dz * hx - dx * hz, -dy, dz * hz + dx * hx], 1),
    )
