"""Periodic random fields on the unit square: band-limited noise, scattered cells, and smooth steps.

Fields have shape (size, size), row 0 on top; u and v run over [0, 1) at texel centres. All take a NumPy generator and
give the same field for the same state of it.
"""

from __future__ import annotations

import numpy as np


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u (1, size) and v (size, 1) of the texel centres, float64."""
    at = (np.arange(size) + 0.5) / size
    return at[None, :], at[:, None]


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Return 0 below ``low``, 1 above ``high``, and 3t² − 2t³ between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def band_noise(rng, size: int, fu: float, fv: float | None = None, octaves: int = 1) -> np.ndarray:
    """Return Gaussian noise of mean 0 and standard deviation 1 with features ``1/fu`` by ``1/fv`` large.

    White noise weighted in the frequency domain by f·exp(−f²), f the frequency over (fu, fv); every further octave
    doubles both and adds half as much.
    """
    fv = fu if fv is None else fv
    total = np.zeros((size, size))
    ku, kv = np.fft.rfftfreq(size, 1 / size)[None, :], np.fft.fftfreq(size, 1 / size)[:, None]
    for octave in range(octaves):
        f2 = (ku / (fu * 2.0**octave)) ** 2 + (kv / (fv * 2.0**octave)) ** 2
        white = np.fft.rfft2(rng.standard_normal((size, size)))
        part = np.fft.irfft2(white * np.sqrt(f2) * np.exp(-f2), (size, size))
        total += 0.5**octave * part / max(part.std(), 1e-12)
    return total / max(total.std(), 1e-12)


def sampled(field: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return a periodic field at (u, v), bilinearly; any shape."""
    rows, width = field.shape
    x, y = u * width - 0.5, v * rows - 0.5
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    a, b = x - i, y - j
    i0, i1, j0, j1 = i % width, (i + 1) % width, j % rows, (j + 1) % rows
    top = field[j0, i0] * (1 - a) + field[j0, i1] * a
    return top * (1 - b) + (field[j1, i0] * (1 - a) + field[j1, i1] * a) * b


def cells(rng, u: np.ndarray, v: np.ndarray, across: int, down: int | None = None, jitter: float = 1.0):
    """Return (d1, d2, number) of the nearest and second nearest of points scattered over a jittered grid.

    After Worley, "A Cellular Texture Basis Function", 1996, on a torus.

    Args:
        rng: Generator of the points.
        u, v: Positions, any finite values, of one shape.
        across, down: Cells of the grid along u and v; ``down`` = ``across`` where not given.
        jitter: How far points lie from their cells' centres, 0 to 1.

    Returns:
        Distances in cells, and the number of the nearest point in [0, across · down).
    """
    down = across if down is None else down
    offset = 0.5 + jitter * (rng.random((2, down, across)) - 0.5)
    x, y = u * across, v * down
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    d1, d2 = np.full(x.shape, np.inf), np.full(x.shape, np.inf)
    number = np.zeros(x.shape, np.int64)
    for dj in range(-2, 3):
        for di in range(-2, 3):
            ci, cj = (i + di) % across, (j + dj) % down
            d = (i + di + offset[0, cj, ci] - x) ** 2 + (j + dj + offset[1, cj, ci] - y) ** 2
            nearer = d < d1
            d2 = np.where(nearer, d1, np.minimum(d2, d))
            number = np.where(nearer, cj * across + ci, number)
            d1 = np.where(nearer, d, d1)
    return np.sqrt(d1), np.sqrt(d2), number
