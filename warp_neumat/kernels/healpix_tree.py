"""The HEALPix corner grid as a tree: which coarser point a point descends from, and what pruned points fall back to.

Points of the hemisphere grid (``kernels/healpix.py``) have whole pyramid coordinates (i, j) in a quarter k of the
longitude, with i + j the ring. The grid of nside/2 is the points of even (i, j); the *parent* of any other is (i>>1,
j>>1) there, the corner nearest the pole of the coarse pixel that the point lies in. So the tree halves as often as
nside is even. (The last ring of the coarse grid lies beyond the fine one, and is nobody's parent.)

A pruned material (paper [neubrdf], sparse measurements) stores the indices of its *live* points alone. NumPy only: it
runs once, when an asset is written or opened.
"""

import functools

import numpy as np

_CHUNK = 256  # rows of a distance table at a time


def _count(nside: int) -> int:
    return 6 * nside * (nside + 1) + 1


@functools.lru_cache(maxsize=4)
def _places(nside: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return quarter k and pyramid coordinates i, j of every point of the hemisphere grid, (n,) int64 each."""
    ring = np.arange(1, 2 * nside + 2)
    quarter = np.minimum(ring, nside)  # points of a ring within a quarter
    r = np.repeat(ring, 4 * quarter)
    c = np.minimum(r, nside)
    first = np.cumsum(4 * quarter) - 4 * quarter
    number = np.arange(len(r)) - np.repeat(first, 4 * quarter)
    k, along = number // c, number % c
    i = along + (r - c + 1) // 2  # c = r in the cap
    zero = np.zeros(1, np.int64)
    return np.concatenate([zero, k]), np.concatenate([zero, i]), np.concatenate([zero, r - i])


def _numbers(nside: int, k: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return the number of each point (i, j) of quarter k; the inverse of :func:`_places`."""
    r = i + j
    c = np.minimum(r, nside)
    first = np.minimum(r, 1) + 2 * c * (c - 1) + 4 * nside * (r - c)
    return first + (k * c + ((i - j + c) >> 1)) % np.maximum(4 * c, 1)


def directions(nside: int) -> np.ndarray:
    """Return the unit direction of every point of the hemisphere grid, (n, 3) float64."""
    k, i, j = _places(nside)
    r = i + j
    cap = r < nside
    low = r * r / (3.0 * nside * nside)
    z = np.where(cap, 1.0 - low, (2 * nside - r) * 2.0 / (3.0 * nside))
    sine = np.sqrt(np.where(cap, low * (2.0 - low), 1.0 - z * z))
    t = np.where(cap, i / np.maximum(r, 1), (i - j + nside) / (2.0 * nside))
    phi = (k + t) * (np.pi / 2.0)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1)


def parents(nside: int) -> np.ndarray:
    """Return the parent of every point of the hemisphere grid: its number on the grid of nside/2, (n,) int64.

    A point that both grids have is its own parent.

    Raises: ValueError: If ``nside`` is odd: there is no grid of half its side.
    """
    if nside < 2 or nside % 2:
        raise ValueError(f"nside must be even to have a grid of half of it, got {nside}")
    k, i, j = _places(nside)
    return _numbers(nside // 2, k, i >> 1, j >> 1)


def _on_finer(nside: int) -> np.ndarray:
    """Return where on the grid of 2 nside the points of this one lie, all but the last ring, (n − 4 nside,) int64."""
    k, i, j = (x[: -4 * nside] for x in _places(nside))
    return _numbers(2 * nside, k, 2 * i, 2 * j)


def sources(nside: int, live: np.ndarray) -> np.ndarray:
    """Return, for every point of one hemisphere grid, the live point whose value it takes, (n,) int64.

    A live point takes its own; another one its nearest live ancestor's; and where even the point of the coarsest grid
    is not live, that point takes the nearest live point's by angle (the lowest number wins).

    Args:
        nside: Resolution.
        live: Which points are live, (n,) bool.

    Raises: ValueError: If ``live`` has another length, or no point is live.
    """
    live = np.asarray(live, bool)
    if live.shape != (_count(nside),):
        raise ValueError(f"live must have shape ({_count(nside)},) for nside {nside}, got {live.shape}")
    if not live.any():
        raise ValueError("live must hold at least one point of each side, got none")
    return _resolved(nside, np.where(live, np.arange(len(live)), -1), np.flatnonzero(live), directions(nside))


def _resolved(nside: int, source: np.ndarray, known: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Fill the −1 in ``source``; ``known`` are the live points and ``place`` the directions, of the finest grid."""
    lost = np.flatnonzero(source < 0)
    if not len(lost):
        return source
    if nside % 2 == 0:
        coarse = np.concatenate([source[_on_finer(nside // 2)], np.full(2 * nside, -1)])
        parent = _resolved(nside // 2, coarse, known, place)
        return np.where(source < 0, parent[parents(nside)], source)
    # The coarsest grid. Its points are spread over the finest: the nearest by angle has the largest cosine.
    here, result = directions(nside), source.copy()
    for rows in np.array_split(lost, -(-len(lost) // _CHUNK)):
        cosine = np.round(here[rows] @ place[known].T, 12)  # so that rounding does not decide between equals
        result[rows] = known[np.argmax(cosine, axis=1)]
    return result


def expand(nside: int, live: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the indices of all points of both sides from those of the live ones, (2n,), of the type of ``indices``.

    Args:
        nside: Resolution.
        live: Which points are live, (2n,) bool, side 0's before side 1's.
        indices: Indices of the live points, in order, (m,).

    Raises: ValueError: If a length does not fit, or a side has no live point.
    """
    live, indices = np.asarray(live, bool), np.asarray(indices)
    points = _count(nside)
    if live.shape != (2 * points,):
        raise ValueError(f"live must have shape ({2 * points},) for nside {nside}, got {live.shape}")
    if indices.shape != (int(live.sum()),):
        raise ValueError(f"indices must have shape ({int(live.sum())},), one for each live point, got {indices.shape}")
    full = np.zeros(2 * points, indices.dtype)
    full[live] = indices
    return np.concatenate(
        [side[sources(nside, mask)] for side, mask in zip(np.split(full, 2), np.split(live, 2), strict=True)]
    )
