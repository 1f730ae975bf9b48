"""Four grids over the hemisphere behind one interface: HEALPix, and what NeuBRDF's choice of it is measured against.

[neubrdf] Sec. 3.2.1, Table 1 and Fig. 8. z is the normal, longitude phi = atan2(y, x); every grid covers z ≥ 0, and a
direction with z < 0 counts as lying on the horizon. A *point* carries a feature, a *pixel* is what a direction indexes.

- ``healpix``: :mod:`warp_neumat.kernels.healpix`; size N, 6N² + 6N + 1 points.
- ``lonlat``: R + 1 rows of equal theta, the pole one point, the others 4R points of equal phi; 4R² + 1 points. Pixel:
  the cell between two rows and two meridians.
- ``sukharev``: Layered Sukharev grid on a cube seen from its centre (Yershova and LaValle 2004, "Deterministic
  Sampling Methods for Spheres and SO(3)"): M² square cells a face, the upper face and ⌈M/2⌉ rows of the four sides.
  Pixel: the cell, whose centre is Sukharev's point. Features lie on its corners, as with HEALPix, (M + 1)² +
  4M⌈M/2⌉ of them.
- ``fibonacci``: :mod:`warp_neumat.kernels.fibonacci`; the first n points of a lattice of S on the sphere, S such that
  all neighbours of the hemisphere are among them. Pixel: the nearest point.

Weights are bilinear in the cell's own coordinates: theta and phi; the plane of the cube's face; for Fibonacci the
parallelogram of the local lattice in (phi, z), in which the lattice is regular. The first three are continuous. A
Fibonacci lattice has no cells that meet everywhere: its parallelogram changes shape from one latitude zone to the next,
where the interpolation jumps, and the first points around the pole form none: there the nearest four count, inversely
to their distance. Forward only: this module generates no adjoints.
"""

import functools
import math
import types
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_neumat.kernels import healpix
from warp_neumat.kernels.arrays import kind_of, take
from warp_neumat.kernels.dispatch import blocks, lanes, launch, module_options
from warp_neumat.kernels.fibonacci import (
    fibonacci_cell,
    fibonacci_lattice,
    fibonacci_nearest,
    fibonacci_search,
    fibonacci_sphere,
    turn_of,
    upper,
)
from warp_neumat.kernels.healpix_chart import quarters

wp.set_module_options(module_options())


@wp.func
def _colatitude(x: float, y: float, z: float) -> float:
    """Return acos(z) in quarter turns, [0, 1], for a unit vector with z ≥ 0."""
    sine = wp.sqrt(x * x + y * y)
    larger = wp.max(sine, z)
    t = quarters(wp.min(sine, z) / wp.where(larger > 0.0, larger, 1.0))
    return wp.where(sine > z, 1.0 - t, t)


@wp.func
def _lonlat(size: int, d: wp.vec3):
    """Return row, column and the fractions within the cell."""
    x, y, z = upper(d)
    row = _colatitude(x, y, z) * float(size)
    column = turn_of(x, y) * float(size)
    i = wp.min(int(row), size - 1)
    j = wp.min(int(column), 4 * size - 1)
    return i, j, row - float(i), column - float(j)


@wp.func
def lonlat_pixel(size: int, d: wp.vec3) -> int:
    """Return the cell of ``d``, row · 4R + column."""
    i, j, _u, _v = _lonlat(size, d)
    return i * (4 * size) + j


@wp.func
def _lonlat_point(size: int, i: int, j: int) -> int:
    return wp.where(i == 0, 0, 1 + (i - 1) * (4 * size) + wp.where(j == 4 * size, 0, j))


@wp.func
def lonlat_corners(size: int, d: wp.vec3):
    """Return the corners of the cell of ``d`` and their bilinear weights, the row nearer the pole first."""
    i, j, u, v = _lonlat(size, d)
    index = wp.vec4i(
        _lonlat_point(size, i, j),
        _lonlat_point(size, i, j + 1),
        _lonlat_point(size, i + 1, j),
        _lonlat_point(size, i + 1, j + 1),
    )
    return index, wp.vec4((1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v)


@wp.func
def _cube(size: int, d: wp.vec3):
    """Return whether ``d`` meets the upper face, its cell (i, j) there or on the unrolled sides, and the fractions.

    On the upper face i runs along x, j along y; on the sides i goes round, counter-clockwise from (1, −1), and j down.
    """
    x, y, z = upper(d)
    ax = wp.abs(x)
    ay = wp.abs(y)
    m = float(size)
    top = z >= wp.max(ax, ay)
    along = ax >= ay
    depth = wp.where(top, z, wp.max(ax, ay))
    scale = 1.0 / depth
    side = wp.where(along, wp.where(x > 0.0, 0, 2), wp.where(y > 0.0, 1, 3))
    across = wp.where(along, wp.where(x > 0.0, y, -y), wp.where(y > 0.0, -x, x))
    a = 0.5 * m * (1.0 + wp.where(top, x, across) * scale)
    b = 0.5 * m * wp.where(top, 1.0 + y * scale, 1.0 - z * scale)
    rows = wp.where(top, size, (size + 1) >> 1)
    i = wp.clamp(int(a), 0, size - 1)
    j = wp.clamp(int(b), 0, rows - 1)
    u = wp.clamp(a - float(i), 0.0, 1.0)
    v = wp.clamp(b - float(j), 0.0, 1.0)
    return top, i + wp.where(top, 0, side * size), j, u, v


@wp.func
def sukharev_pixel(size: int, d: wp.vec3) -> int:
    """Return the cell of ``d``: those of the upper face, then row by row those of the sides."""
    top, i, j, _u, _v = _cube(size, d)
    return wp.where(top, j * size + i, size * size + j * (4 * size) + i)


@wp.func
def _cube_point(size: int, top: bool, i: int, j: int) -> int:
    """Return the point at corner (i, j); the sides' upper edge, j = 0, is the rim of the upper face."""
    n = size + 1
    turn = wp.where(i >= 4 * size, i - 4 * size, i)
    side = wp.where(turn >= size, 1, 0) + wp.where(turn >= 2 * size, 1, 0) + wp.where(turn >= 3 * size, 1, 0)
    k = turn - side * size
    x = wp.where(side == 0, size, wp.where(side == 1, size - k, wp.where(side == 2, 0, k)))
    y = wp.where(side == 0, k, wp.where(side == 1, size, wp.where(side == 2, size - k, 0)))
    rim = y * n + x
    return wp.where(top, j * n + i, wp.where(j == 0, rim, n * n + (j - 1) * (4 * size) + turn))


@wp.func
def sukharev_corners(size: int, d: wp.vec3):
    """Return the corners of the cell of ``d`` and their bilinear weights."""
    top, i, j, u, v = _cube(size, d)
    index = wp.vec4i(
        _cube_point(size, top, i, j),
        _cube_point(size, top, i + 1, j),
        _cube_point(size, top, i, j + 1),
        _cube_point(size, top, i + 1, j + 1),
    )
    return index, wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@wp.func
def healpix_pixel(size: int, d: wp.vec3) -> int:
    """Return the RING pixel of ``d``."""
    return healpix.vec2pix_ring(size, wp.vec3(d[0], d[1], wp.max(d[2], 0.0)))


@wp.func
def healpix_corners(size: int, d: wp.vec3):
    """Return the corners of the pixel of ``d`` and their bilinear weights."""
    return healpix.corners_of(size, wp.vec3(d[0], d[1], wp.max(d[2], 0.0)))


@wp.func
def _no_search(count: int, d: wp.vec3):
    return wp.vec4i(0, 0, 0, 0), wp.vec4(1.0, 0.0, 0.0, 0.0)


@functools.cache
def _kernels(L: int):
    """Return name → (pixel kernel, corner kernel) for ``L`` lanes; one module, compiled once."""

    def make(pixel_of, corners_of, search, searches: bool):
        @wp.kernel
        def pixel_kernel(
            first: int, size: int, vec: wp.array(dtype=wp.float32), n: int, pixel: wp.array(dtype=wp.int32)
        ):
            block = first + wp.tid()
            X = wp.array(ptr=vec.ptr + wp.uint64(block) * wp.uint64(12 * L), shape=(3 * L,), dtype=wp.float32)
            P = wp.array(ptr=pixel.ptr + wp.uint64(block) * wp.uint64(4 * L), shape=(L,), dtype=wp.int32)
            count = wp.min(L, n - block * L)
            if count == L:
                for l in range(L):
                    P[l] = pixel_of(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
            else:
                for l in range(count):
                    P[l] = pixel_of(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
            if wp.static(searches):
                for l in range(count):
                    if P[l] < 0:
                        index, _weight = search(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                        P[l] = index[0]

        @wp.kernel
        def corners_kernel(
            first: int,
            size: int,
            vec: wp.array(dtype=wp.float32),
            n: int,
            indices: wp.array(dtype=wp.int32),
            weights: wp.array(dtype=wp.float32),
        ):
            block = first + wp.tid()
            X = wp.array(ptr=vec.ptr + wp.uint64(block) * wp.uint64(12 * L), shape=(3 * L,), dtype=wp.float32)
            I = wp.array(ptr=indices.ptr + wp.uint64(block) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.int32)
            W = wp.array(ptr=weights.ptr + wp.uint64(block) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.float32)
            count = wp.min(L, n - block * L)
            if count == L:
                for l in range(L):
                    index, weight = corners_of(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                    for q in range(4):
                        I[4 * l + q] = index[q]
                        W[4 * l + q] = weight[q]
            else:
                for l in range(count):
                    index, weight = corners_of(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                    for q in range(4):
                        I[4 * l + q] = index[q]
                        W[4 * l + q] = weight[q]
            if wp.static(searches):
                for l in range(count):
                    if I[4 * l] < 0:
                        index, weight = search(size, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                        for q in range(4):
                            I[4 * l + q] = index[q]
                            W[4 * l + q] = weight[q]

        return types.SimpleNamespace(pixel=pixel_kernel, corners=corners_kernel)

    return {
        "healpix": make(healpix_pixel, healpix_corners, _no_search, False),
        "lonlat": make(lonlat_pixel, lonlat_corners, _no_search, False),
        "sukharev": make(sukharev_pixel, sukharev_corners, _no_search, False),
        "fibonacci": make(fibonacci_nearest, fibonacci_cell, fibonacci_search, True),
    }


class Pixelation(NamedTuple):
    """A grid over the hemisphere; :data:`PIXELATIONS` holds the known ones.

    ``nside`` is the resolution of the HEALPix grid that it replaces, ``size`` the grid's own.
    """

    name: str
    size: Callable[[int], int]
    """``nside`` → size with the nearest number of points to HEALPix's."""
    count: Callable[[int], int]
    """Size → number of points."""
    lattice: Callable[[int], np.ndarray]
    """Size → directions of the points, (n, 3) float64."""
    cells: Callable[[int], int]
    """Size → number of pixels that a hemisphere meets, or a little above."""
    resolution: Callable[[int], int] = int
    """Size → the number that the kernels take."""

    def points(self, nside: int) -> int:
        """Return how many points the grid has in place of HEALPix's of resolution ``nside``."""
        return self.count(self.size(_checked(nside)))

    def positions(self, nside: int) -> np.ndarray:
        """Return the unit directions of the points, (n, 3) float64; a few lie beyond the equator."""
        return self.lattice(self.size(_checked(nside)))

    def corners(self, nside: int, directions, *, device=None):
        """Return the four points around each direction and their weights.

        Args:
            nside: Resolution of the HEALPix grid that is replaced, 4 … 512.
            directions: Of any length, (B, 3); numpy, torch or Warp; z < 0 counts as 0.
            device: Warp device for numpy input.

        Returns:
            indices: (B, 4) int32, below :meth:`points`.
            weights: (B, 4) float32 in [0, 1] that sum to 1.

        Raises:
            ValueError: If ``nside`` is out of range or the shape is wrong.

        Error: at ``nside`` 64 ``lonlat`` and ``sukharev`` interpolate a table of values in [−1, 1] to within 8e-5 of
        the float64 reference (worst seen 3.2e-5); held by test_corners_match_reference. ``fibonacci`` reproduces the
        longitude to within 6e-6 turns; held by test_fibonacci_weights_reproduce_the_lattice_coordinates.
        """
        return self.corners_at(self.size(_checked(nside)), directions, device=device)

    def corners_at(self, size: int, directions, *, out=None, device=None):
        """Return what :meth:`corners` does for a grid of its own ``size``; ``out`` are Warp arrays to write to."""
        kind, vectors, n = _taken(directions, device)
        dtypes = (wp.int32, wp.float32)
        if out is None:
            indices, weights = (kind.empty((n, 4), dtype) for dtype in dtypes)
        else:
            indices, weights = (take(a, "out", (n, 4), dtype, kind) for a, dtype in zip(out, dtypes, strict=True))
        if n:
            _launch(self, "corners", size, vectors, n, [indices.flatten(), weights.flatten()], kind.device)
        return (kind.give(indices), kind.give(weights)) if out is None else out

    def pixels(self, nside: int, directions, *, out=None, device=None):
        """Return the pixel of each direction, (B,) int32; ``out`` is a Warp array to write to."""
        return self.pixels_at(self.size(_checked(nside)), directions, out=out, device=device)

    def pixels_at(self, size: int, directions, *, out=None, device=None):
        """Return what :meth:`pixels` does for a grid of the pixelation's own ``size``."""
        kind, vectors, n = _taken(directions, device)
        pixel = kind.empty((n,), wp.int32) if out is None else take(out, "out", (n,), wp.int32, kind)
        if n:
            _launch(self, "pixel", size, vectors, n, [pixel], kind.device)
        return kind.give(pixel) if out is None else out


def _checked(nside) -> int:
    if isinstance(nside, bool) or not isinstance(nside, (int, np.integer)) or not 4 <= nside <= 512:
        raise ValueError(f"nside must be a whole number in [4, 512], got {nside!r}")
    return int(nside)


def _taken(directions, device):
    kind = kind_of(directions, device)
    vectors = take(directions, "directions", ("n", 3), wp.float32, kind)
    return kind, vectors, vectors.shape[0]


def _launch(grid: Pixelation, what: str, size: int, vectors, n: int, outputs, device):
    L = lanes(device)
    kernel = getattr(_kernels(L)[grid.name], what)
    launch(kernel, blocks(n, L), [grid.resolution(size), vectors.flatten(), n], outputs, device=device, grain=16)


def _nearest_size(count: Callable[[int], int], guess: Callable[[int], float]):
    """Return the function from nside to the size whose count is nearest to HEALPix's."""

    def size(nside: int) -> int:
        wanted = healpix.hemisphere_point_count(nside)
        about = int(guess(wanted))
        return min(range(max(about - 2, 1), about + 3), key=lambda s: abs(count(s) - wanted))

    return size


def _polar(z, phi) -> np.ndarray:
    sine = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1)


def _healpix_lattice(size: int) -> np.ndarray:
    ring = np.concatenate([np.full(4 * min(r, size) if r else 1, r) for r in range(2 * size + 2)])
    j = np.arange(len(ring)) - np.searchsorted(ring, ring)
    cap = ring < size
    z = np.where(cap, 1.0 - ring**2 / (3.0 * size**2), 2.0 * (2 * size - ring) / (3.0 * size))
    quarters = np.where(cap, j / np.maximum(ring, 1), (j + 0.5 * ((ring - size) % 2)) / size)
    return _polar(z, 0.5 * np.pi * quarters)


def _lonlat_lattice(size: int) -> np.ndarray:
    row, column = (a.ravel() for a in np.meshgrid(np.arange(1, size + 1), np.arange(4 * size), indexing="ij"))
    theta, phi = row * (0.5 * np.pi / size), column * (0.5 * np.pi / size)
    rest = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    return np.concatenate([[[0.0, 0.0, 1.0]], rest])


def _sukharev_count(size: int) -> int:
    return (size + 1) ** 2 + 4 * size * ((size + 1) // 2)


def _sukharev_lattice(size: int) -> np.ndarray:
    edge = 2.0 * np.arange(size + 1) / size - 1.0
    y, x = (a.ravel() for a in np.meshgrid(edge, edge, indexing="ij"))
    top = np.stack([x, y, np.ones_like(x)], 1)
    one, run = np.ones(size), edge[:-1]
    ring = np.concatenate([np.stack(side, 1) for side in ((one, run), (-run, one), (-one, -run), (run, -one))])
    rows = 1.0 - 2.0 * np.arange(1, (size + 1) // 2 + 1) / size
    sides = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in rows])
    cube = np.concatenate([top, sides])
    return cube / np.linalg.norm(cube, axis=1, keepdims=True)


PIXELATIONS: dict[str, Pixelation] = {
    grid.name: grid
    for grid in (
        Pixelation(
            "healpix",
            int,
            healpix.hemisphere_point_count,
            _healpix_lattice,
            lambda size: 6 * size * size + 2 * size,
        ),
        Pixelation(
            "lonlat",
            _nearest_size(lambda size: 4 * size * size + 1, lambda count: math.sqrt(count / 4)),
            lambda size: 4 * size * size + 1,
            _lonlat_lattice,
            lambda size: 4 * size * size,
        ),
        Pixelation(
            "sukharev",
            _nearest_size(_sukharev_count, lambda count: math.sqrt(count / 3)),
            _sukharev_count,
            _sukharev_lattice,
            lambda size: size * size + 4 * size * ((size + 1) // 2),
        ),
        Pixelation(
            "fibonacci",
            healpix.hemisphere_point_count,
            int,
            fibonacci_lattice,
            int,
            fibonacci_sphere,
        ),
    )
}
"""Name → grid, HEALPix first."""
