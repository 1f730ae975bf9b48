"""HEALPix in NumPy float64: the pixel that holds a direction, and the grid corners around it with bilinear weights.

Written from Górski et al. 2005, Sec. 5, zone by zone: north cap, belt, south cap. Frames, the numbering of the corner
grid and the order of the four corners are those of ``kernels/healpix.py``.

A direction that lies on a pixel border belongs to the pixel that the float64 rounding of the formulas below gives. For
that the order of their operations matters, and the arc tangent has to be libm's (NumPy may bring one of its own):
with both, :func:`vec2pix` equals healpy on borders too.
"""

import math

import numpy as np


def _sphere(vec: np.ndarray):
    """Return z in [-1, 1], the longitude in quarter turns [0, 4), and sin(theta) of directions (N, 3)."""
    vec = np.asarray(vec, dtype=np.float64)
    x, y, z = vec.T
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    phi = np.fromiter(map(math.atan2, y, x), dtype=np.float64, count=len(vec))
    phi[(x == 0.0) & (y == 0.0)] = 0.0  # atan2(0, -0.0) is pi
    tt = phi * (2.0 / np.pi)
    tt = np.where(tt < 0.0, tt + 4.0, tt)
    return z * scale, np.where(tt >= 4.0, 0.0, tt), np.sqrt(x * x + y * y) * scale


def _cap_radius(nside: int, z: np.ndarray, sin: np.ndarray) -> np.ndarray:
    """Return nside √(3(1 − |z|)) in a polar cap: rings from the pole, measured along a meridian. Eq. (4)."""
    za = np.abs(z)
    with np.errstate(invalid="ignore"):
        return np.where(za < 0.99, nside * np.sqrt(3.0 * (1.0 - za)), nside * sin / np.sqrt((1.0 + za) / 3.0))


def _interleave(ix: np.ndarray, iy: np.ndarray) -> np.ndarray:
    """Return the number whose even bits are ``ix`` and odd bits ``iy``. Sec. 5.3."""
    bits = np.arange(14)
    return (((ix[:, None] >> bits & 1) << 2 * bits) | ((iy[:, None] >> bits & 1) << 2 * bits + 1)).sum(axis=1)


def vec2pix(nside: int, vec: np.ndarray, *, nest: bool) -> np.ndarray:
    """Return the pixel that holds each direction (N, 3), of any length but zero, as (N,) int64."""
    z, tt, sin = _sphere(vec)
    belt = np.abs(z) <= 2.0 / 3.0
    north = z >= 0.0

    # Belt: lines of constant tt ∓ 3/4 z, Eq. (8)–(9). Counted from the line through (tt, z) = (−1/2, 0).
    ascending = np.floor(nside * (0.5 + tt) - nside * z * 0.75).astype(np.int64)
    descending = np.floor(nside * (0.5 + tt) + nside * z * 0.75).astype(np.int64)

    # Caps: Eq. (4)–(7), per quarter.
    quarter = tt.astype(np.int64)
    tp = tt - quarter
    radius = _cap_radius(nside, z, sin)
    east, west = (tp * radius).astype(np.int64), ((1.0 - tp) * radius).astype(np.int64)

    if nest:
        east, west = np.minimum(east, nside - 1), np.minimum(west, nside - 1)
        row, column = ascending // nside, descending // nside
        face = np.where(row == column, 4 + row % 4, np.where(row < column, row % 4, 8 + column % 4))
        face = np.where(belt, face, np.where(north, quarter, quarter + 8))
        ix = np.where(belt, descending % nside, np.where(north, nside - 1 - west, east))
        iy = np.where(belt, nside - 1 - ascending % nside, np.where(north, nside - 1 - east, west))
        return face * nside * nside + _interleave(ix, iy)

    ring = ascending - descending + 2 * nside  # 1 … 4 nside − 1
    shift = (ring - nside) % 2
    belt_pixel = 2 * nside * (nside - 1) + 4 * nside * (ring - nside)
    belt_pixel += (ascending + descending - nside + 1 + shift) // 2 % (4 * nside)
    ring = east + west + 1  # from the nearer pole
    first = np.where(north, 2 * ring * (ring - 1), 12 * nside * nside - 2 * ring * (ring + 1))
    return np.where(belt, belt_pixel, first + (tt * ring).astype(np.int64))


def corner_point_count(nside: int) -> int:
    """Return how many points the corner grid of the sphere has."""
    return 12 * nside * nside + 2


def hemisphere_point_count(nside: int) -> int:
    """Return how many points reach from the north pole to one ring beyond the equator."""
    return 6 * nside * nside + 6 * nside + 1


def _ring_starts(nside: int) -> np.ndarray:
    """Return the index of the first point of each ring 0 … 4 nside, and the number of points as the last entry."""
    r = np.arange(4 * nside + 1)
    sizes = np.clip(4 * np.minimum(r, 4 * nside - r), 1, 4 * nside)
    return np.concatenate([[0], np.cumsum(sizes)])


def corner_directions(nside: int) -> np.ndarray:
    """Return the unit direction of every point of the corner grid, (12 nside² + 2, 3). Eq. (4)–(9) at whole rings."""
    starts = _ring_starts(nside)
    index = np.arange(starts[-1])
    r = np.searchsorted(starts, index, side="right") - 1
    j = index - starts[r]
    s = np.minimum(r, 4 * nside - r)  # rings from the nearer pole
    cap = s < nside
    one_minus = s * s / (3.0 * nside * nside)  # 1 − |z| in a cap
    z = np.where(cap, np.where(r < 2 * nside, 1.0 - one_minus, one_minus - 1.0), (2 * nside - r) * 2.0 / (3.0 * nside))
    sin = np.where(cap, np.sqrt(one_minus * (2.0 - one_minus)), np.sqrt(1.0 - z * z))
    quarters = np.where(cap, j / np.maximum(s, 1), (j + 0.5 * ((r - nside) % 2)) / nside)
    phi = quarters * (np.pi / 2.0)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], axis=1)


def corners(nside: int, vec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four grid corners around each direction (N, 3) and their bilinear weights, both (N, 4).

    Order: the corner nearest the pole of the hemisphere, east, west, nearest the equator.
    """
    z, tt, sin = _sphere(vec)
    starts = _ring_starts(nside)
    north, cap = z >= 0.0, np.abs(z) > 2.0 / 3.0
    index, weight = np.empty((len(z), 4), np.int64), np.empty((len(z), 4))

    # Belt: bilinear in tt ∓ 3/4 z. A step along u goes south and east, along v north and east.
    u, v = nside * (0.5 + tt - 0.75 * z), nside * (0.5 + tt + 0.75 * z)
    p, m = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    fu, fv = u - p, v - m
    northern = [(0, 1), (1, 1), (0, 0), (1, 0)]  # steps along (u, v) to the north, east, west and south corner
    for q, (du, dv) in enumerate(northern):
        ring = np.clip(2 * nside + p + du - m - dv, nside - 1, 3 * nside + 1)
        along = p + du + m + dv - nside  # half point distances along the ring; the parity is the ring's
        # The ring just beyond the belt is a cap's: fewer points, counted per quarter from its first meridian.
        quarter = tt.astype(np.int64)
        inside = (ring >= nside) & (ring <= 3 * nside)
        number = np.where(inside, along // 2, quarter * (nside - 1) + (along - 2 * nside * quarter) // 2)
        size = np.maximum(np.where(inside, 4 * nside, 4 * (nside - 1)), 1)
        slot = np.where(north, q, 3 - q if q in (0, 3) else q)
        rows = np.flatnonzero(~cap)
        index[rows, slot[rows]] = (starts[ring] + number % size)[rows]
        weight[rows, slot[rows]] = ((fu if du else 1.0 - fu) * (fv if dv else 1.0 - fv))[rows]

    # Caps: bilinear in the distances from the two meridians that bound the quarter.
    quarter = tt.astype(np.int64)
    radius = _cap_radius(nside, z, sin)
    a, b = (tt - quarter) * radius, (1.0 - (tt - quarter)) * radius
    i, j = np.minimum(a.astype(np.int64), nside - 1), np.minimum(b.astype(np.int64), nside - 1)
    j = np.minimum(j, 2 * nside - 1 - i)
    for q, (di, dj) in enumerate([(0, 0), (1, 0), (0, 1), (1, 1)]):
        r = i + di + j + dj
        number = np.where(r <= nside, quarter * r + i + di, quarter * nside + i + di - (r - nside))
        size = np.maximum(4 * np.minimum(r, nside), 1)
        ring = np.where(north, r, 4 * nside - r)
        w = (a - i if di else 1.0 - (a - i)) * (b - j if dj else 1.0 - (b - j))
        index[cap, q] = (starts[ring] + number % size)[cap]
        weight[cap, q] = w[cap]
    return index, weight
