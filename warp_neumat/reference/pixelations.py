"""Grids over the hemisphere in NumPy float64: the points around a direction, their weights, and the nearest point.

Frames, numbering and sizes are those of ``kernels/pixelations.py``; every function takes the grid's own size. Each grid
is located by its own geometry, in another order of steps than the kernels: arc tangents instead of polynomials, the
cube's points by their place on the cube, the Fibonacci lattice by a search.
"""

import numpy as np


def lonlat_corners(size: int, vec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four corners (N, 4) of the cell of each direction (N, 3) and their bilinear weights."""
    x, y, z = np.asarray(vec, np.float64).T
    step = 0.5 * np.pi / size
    row = np.arctan2(np.hypot(x, y), np.maximum(z, 0.0)) / step
    column = np.mod(np.arctan2(y, x), 2.0 * np.pi) / step
    i, j = np.minimum(row.astype(int), size - 1), np.minimum(column.astype(int), 4 * size - 1)
    index, weight = [], []
    for down in (0, 1):
        for east in (0, 1):
            point = 1 + (i + down - 1) * 4 * size + (j + east) % (4 * size)
            index.append(np.where(i + down == 0, 0, point))
            weight.append((row - i if down else 1 - row + i) * (column - j if east else 1 - column + j))
    return np.stack(index, 1), np.stack(weight, 1)


def sukharev_corners(size: int, vec: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four corners of the cell of each direction on the cube [−1, 1]² × [0, 1], and their weights."""
    index, weight = np.empty((len(vec), 4), int), np.empty((len(vec), 4))
    for n, (x, y, z) in enumerate(np.asarray(vec, np.float64)):
        z = max(z, 0.0)
        face = max(range(3), key=lambda axis: (abs((x, y, z)[axis]), axis == 2))
        cube = 0.5 * size * (np.array([x, y, z]) / abs((x, y, z)[face]) + 1.0)
        free = [axis for axis in range(3) if axis != face]
        low = [min(int(np.ceil(cube[a] - 1e-12)) - 1 if a == 2 else int(cube[a]), size - 1) for a in free]
        for q in range(4):
            corner, w = cube.copy(), 1.0
            for axis, first, bit in zip(free, low, (q & 1, q >> 1), strict=True):
                corner[axis] = first + bit
                w *= cube[axis] - first if bit else 1.0 - cube[axis] + first
            index[n, q], weight[n, q] = _cube_point(size, *np.round(corner).astype(int)), w
    return index, weight


def _cube_point(size: int, x: int, y: int, z: int) -> int:
    """Return the number of the point at whole coordinates 0 … size of the cube."""
    if z == size:
        return y * (size + 1) + x
    round_ = y if x == size else 2 * size - x if y == size else 3 * size - y if x == 0 else 3 * size + x
    return (size + 1) ** 2 + (size - z - 1) * 4 * size + round_ % (4 * size)


def fibonacci_nearest(points: np.ndarray, vec: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``count`` nearest of ``points`` (n, 3) to each direction, nearest first, and their distances [rad]."""
    vec = np.asarray(vec, np.float64)
    index = np.empty((len(vec), count), int)
    for start in range(0, len(vec), 512):
        cosine = vec[start : start + 512] @ points.T
        near = np.argpartition(-cosine, count, axis=1)[:, :count]
        order = np.argsort(-np.take_along_axis(cosine, near, 1), axis=1)
        index[start : start + 512] = np.take_along_axis(near, order, 1)
    chord = np.linalg.norm(points[index] - vec[:, None], axis=2)
    return index, 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))


def fibonacci_coordinates(sphere: int, vec: np.ndarray) -> np.ndarray:
    """Return (longitude [turns], real-valued index) of directions on a lattice of ``sphere`` points, (N, 2)."""
    x, y, z = np.asarray(vec, np.float64).T
    return np.stack([np.arctan2(y, x) / (2.0 * np.pi), 0.5 * sphere * (1.0 - z) - 0.5], 1)
