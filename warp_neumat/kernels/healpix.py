"""HEALPix on the sphere: the pixel that holds a direction, and the grid corners around it with bilinear weights.

Sphere geometry of Górski et al. 2005, "HEALPix: A Framework for High-Resolution Discretization and Fast Analysis of
Data Distributed on the Sphere", Sec. 5; the corner grid is that of [neubrdf] Sec. 3.2.2. z points to the north pole,
longitude phi = atan2(y, x) runs east from +x.

Directions are located in the pyramid coordinates (a, b) of ``healpix_chart``, where pixels are unit squares: the floors
give the pixel, the fractions its bilinear weights. A point with whole (a, b) is a grid corner on ring r = a + b; with
c = min(r, N) it has the number k c + ⌊(a − b + c)/2⌋ on its ring of 4c, modulo 4c, in quarter k of the longitude. The
same formula with r = a + b + 1 numbers pixels on their ring of centres.

**Corner grid.** 12N² + 2 points on rings r = 0 … 4N, numbered ring by ring from the north pole, eastwards on a ring.
Cap rings hold 4r points at phi = j (pi/2)/r, belt rings N ≤ r ≤ 3N hold 4N at phi = (j + ((r − N) mod 2)/2) pi/(2N),
the poles are one point each. The northern hemisphere with one ring beyond the equator is the prefix of 6N² + 6N + 1
points. ``reference.healpix.corner_directions`` lists where they lie.

Forward only: this module generates no adjoints.
"""

import functools
import types

import numpy as np
import warp as wp

from warp_neumat.kernels.arrays import kind_of, take
from warp_neumat.kernels.dispatch import blocks, lanes, launch, module_options
from warp_neumat.kernels.healpix_chart import chart, exact_chart, settled, square

wp.set_module_options(module_options())

NSIDE_MAX = 8192
"""Largest resolution: the largest power of two whose 12 nside² pixels are counted by an int32."""


@wp.func
def _ring_number(k: int, i: int, j: int, c: int):
    """Return the number, on its ring of 4c, of the pixel or corner (i, j) of quarter k."""
    number = k * c + ((i - j + c) >> 1)
    number = wp.where(number < 0, number + 4 * c, number)
    return wp.where(number >= 4 * c, number - 4 * c, number)


@wp.func
def _ring_pixel(nside: int, ring: int, c: int, number: int, north: bool):
    """Return the RING index of pixel ``number`` on the ``ring`` of 4c that counts from the north or the south pole."""
    belt = 4 * nside * (ring - c)
    first = wp.where(north, 2 * c * (c - 1) + belt, 12 * nside * nside - 2 * c * (c + 1) - belt)
    return first + number


@wp.func
def _spread(x: int):
    """Move bit i of a 16-bit number to bit 2i."""
    x = (x | (x << 8)) & 0x00FF00FF
    x = (x | (x << 4)) & 0x0F0F0F0F
    x = (x | (x << 2)) & 0x33333333
    return (x | (x << 1)) & 0x55555555


@wp.func
def _nest_pixel(nside: int, k: int, i: int, j: int, north: bool):
    """Return the NESTED index of the pixel with whole pyramid coordinates (i, j) in quarter k."""
    last = nside - 1
    east = i >= nside
    west = j >= nside
    x = i & last
    y = j & last
    # A polar face where neither coordinate has left it (the face across, if both have), else an equatorial one.
    pole = wp.where(north != east, k, k + 8)
    face = wp.where(east == west, pole, 4 + ((k + wp.where(east, 1, 0)) & 3))
    ix = wp.where(north, last - y, x)
    iy = wp.where(north, last - x, y)
    return face * nside * nside + (_spread(ix) | (_spread(iy) << 1))


@wp.func
def vec2pix_ring(nside: int, d: wp.vec3) -> int:
    """Return the RING pixel that holds ``d`` (any length), −1 for a zero or non-finite ``d``. Branch-free.

    Exact but for directions within float32 rounding of a pixel border, which may land in the pixel next to it.
    """
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    ring = i + j + 1
    c = wp.min(ring, nside)
    return wp.where(valid, _ring_pixel(nside, ring, c, _ring_number(k, i, j, c), d[2] >= 0.0), -1)


@wp.func
def vec2pix_nest(nside: int, d: wp.vec3) -> int:
    """Return the NESTED pixel that holds ``d``; otherwise as :func:`vec2pix_ring`. ``nside`` must be a power of two."""
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    return wp.where(valid, _nest_pixel(nside, k, i, j, d[2] >= 0.0), -1)


@wp.func
def vec2pix_ring(nside: int, d: wp.vec3d) -> int:  # noqa: F811  (an overload)
    """Return the RING pixel that holds ``d``, exactly as the HEALPix library rounds; −1 for zero or non-finite ``d``.

    Calls libm's atan2, so a lane loop around it is not widened: :func:`vec2pix` asks it on borders only.
    """
    i, j, k, t, cap, valid = exact_chart(nside, d)
    if not valid:
        return -1
    ring = i + j + 1
    # Where caps and belt meet, rounding can name a pixel beyond the zone. The library counts on by the zone's own rule.
    c = nside
    number = _ring_number(k, i, j, c)
    if cap:
        c = ring
        number = int(t * wp.float64(ring))
    return _ring_pixel(nside, ring, c, number, d[2] >= wp.float64(0.0))


@wp.func
def vec2pix_nest(nside: int, d: wp.vec3d) -> int:  # noqa: F811  (an overload)
    """Return the NESTED pixel that holds ``d``; otherwise as :func:`vec2pix_ring`. ``nside`` must be a power of two."""
    i, j, k, t, cap, valid = exact_chart(nside, d)
    if not valid:
        return -1
    if cap:
        i = wp.min(i, nside - 1)
        j = wp.min(j, nside - 1)
    return _nest_pixel(nside, k, i, j, d[2] >= wp.float64(0.0))


@wp.func
def _settled_ring(nside: int, d: wp.vec3d) -> int:
    """Return the RING pixel of ``d`` without branches, −1 where :func:`vec2pix_ring` has to decide."""
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    ring = i + j + 1
    c = wp.min(ring, nside)
    pixel = _ring_pixel(nside, ring, c, _ring_number(k, i, j, c), d[2] >= wp.float64(0.0))
    return wp.where(settled(nside, a, b, valid), pixel, -1)


@wp.func
def _settled_nest(nside: int, d: wp.vec3d) -> int:
    """Return the NESTED pixel of ``d`` without branches, −1 where :func:`vec2pix_nest` has to decide."""
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    return wp.where(settled(nside, a, b, valid), _nest_pixel(nside, k, i, j, d[2] >= wp.float64(0.0)), -1)


@wp.func
def corner_number(nside: int, k: int, i: int, j: int, north: bool):
    """Return the index of the grid corner at whole pyramid coordinates (i, j) of quarter k."""
    ring = i + j
    c = wp.min(ring, nside)
    belt = 4 * nside * (ring - c)
    first = wp.min(ring, 1) + 2 * c * (c - 1) + belt
    first = wp.where(north, first, 12 * nside * nside + 1 - 2 * c * (c + 1) - belt)
    return first + _ring_number(k, i, j, c)


@wp.func
def corners_of(nside: int, d: wp.vec3):
    """Return the four grid corners of the pixel that holds ``d``: (indices wp.vec4i, weights wp.vec4). Branch-free.

    Order: the corner nearest the pole of the hemisphere, east, west, nearest the equator. The weights are bilinear in
    the pixel's (a, b), continuous over the whole sphere, in [0, 1], and sum to 1. A ``d`` with z ≥ 0 only meets the
    6 nside² + 6 nside + 1 points of the hemisphere grid. A zero ``d`` gives the north pole. A non-finite ``d`` gives
    indices in range, and weights that sum to 1 or are NaN.
    """
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    u = wp.clamp(a - float(i), 0.0, 1.0)
    v = wp.clamp(b - float(j), 0.0, 1.0)
    north = d[2] >= 0.0
    index = wp.vec4i(
        corner_number(nside, k, i, j, north),
        corner_number(nside, k, i + 1, j, north),
        corner_number(nside, k, i, j + 1, north),
        corner_number(nside, k, i + 1, j + 1, north),
    )
    return index, wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@functools.cache
def _kernels(L: int):
    """Return the kernels for ``L`` lanes by name; one module, compiled once."""

    def pixel_kernel32(pixel_of):
        @wp.kernel
        def vec2pix_kernel(
            first: int, nside: int, vec: wp.array(dtype=wp.float32), n: int, ipix: wp.array(dtype=wp.int64)
        ):
            block = first + wp.tid()
            X = wp.array(ptr=vec.ptr + wp.uint64(block) * wp.uint64(12 * L), shape=(3 * L,), dtype=wp.float32)
            # Each int64 is written as its low and its high int32: a 64-bit type in the loop would halve its lanes.
            P = wp.array(ptr=ipix.ptr + wp.uint64(block) * wp.uint64(8 * L), shape=(2 * L,), dtype=wp.int32)
            if (block + 1) * L <= n:
                for l in range(L):
                    pixel = pixel_of(nside, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                    P[2 * l] = pixel
                    P[2 * l + 1] = pixel >> 31
            else:
                for l in range(n - block * L):
                    pixel = pixel_of(nside, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                    P[2 * l] = pixel
                    P[2 * l + 1] = pixel >> 31

        return vec2pix_kernel

    def pixel_kernel64(fast, exact):
        @wp.kernel
        def vec2pix64_kernel(
            first: int, nside: int, vec: wp.array(dtype=wp.float64), n: int, ipix: wp.array(dtype=wp.int64)
        ):
            block = first + wp.tid()
            X = wp.array(ptr=vec.ptr + wp.uint64(block) * wp.uint64(24 * L), shape=(3 * L,), dtype=wp.float64)
            P = wp.array(ptr=ipix.ptr + wp.uint64(block) * wp.uint64(8 * L), shape=(L,), dtype=wp.int64)
            count = wp.min(L, n - block * L)
            if count == L:
                for l in range(L):
                    P[l] = wp.int64(fast(nside, wp.vec3d(X[3 * l], X[3 * l + 1], X[3 * l + 2])))
            else:
                for l in range(count):
                    P[l] = wp.int64(-1)
            for l in range(count):
                if P[l] < wp.int64(0):
                    P[l] = wp.int64(exact(nside, wp.vec3d(X[3 * l], X[3 * l + 1], X[3 * l + 2])))

        return vec2pix64_kernel

    @wp.kernel
    def corners_kernel(
        first: int,
        nside: int,
        vec: wp.array(dtype=wp.float32),
        n: int,
        indices: wp.array(dtype=wp.int32),
        weights: wp.array(dtype=wp.float32),
    ):
        block = first + wp.tid()
        X = wp.array(ptr=vec.ptr + wp.uint64(block) * wp.uint64(12 * L), shape=(3 * L,), dtype=wp.float32)
        I = wp.array(ptr=indices.ptr + wp.uint64(block) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.int32)
        W = wp.array(ptr=weights.ptr + wp.uint64(block) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.float32)
        if (block + 1) * L <= n:
            for l in range(L):
                index, weight = corners_of(nside, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                I[4 * l] = index[0]
                I[4 * l + 1] = index[1]
                I[4 * l + 2] = index[2]
                I[4 * l + 3] = index[3]
                W[4 * l] = weight[0]
                W[4 * l + 1] = weight[1]
                W[4 * l + 2] = weight[2]
                W[4 * l + 3] = weight[3]
        else:
            for l in range(n - block * L):
                index, weight = corners_of(nside, wp.vec3(X[3 * l], X[3 * l + 1], X[3 * l + 2]))
                for q in range(4):
                    I[4 * l + q] = index[q]
                    W[4 * l + q] = weight[q]

    return types.SimpleNamespace(
        vec2pix={
            (False, wp.float32): pixel_kernel32(vec2pix_ring),
            (True, wp.float32): pixel_kernel32(vec2pix_nest),
            (False, wp.float64): pixel_kernel64(_settled_ring, vec2pix_ring),
            (True, wp.float64): pixel_kernel64(_settled_nest, vec2pix_nest),
        },
        corners=corners_kernel,
    )


def _checked_nside(nside, nest: bool = False) -> int:
    if isinstance(nside, bool) or not isinstance(nside, (int, np.integer)):
        raise TypeError(f"nside must be a whole number, got {nside!r}")
    if not 1 <= nside <= NSIDE_MAX:
        raise ValueError(f"nside must be between 1 and {NSIDE_MAX}, got {nside}")
    if nest and nside & (nside - 1):
        raise ValueError(f"nside must be a power of two in NESTED order, got {nside}; use nest=False or 1, 2, 4, …")
    return int(nside)


def _result(out, name: str, shape: tuple, dtype, kind) -> wp.array:
    """Return the array to write: ``out`` seen through Warp, or a new one."""
    if out is None:
        return kind.empty(shape, dtype)
    array = take(out, name, shape, dtype, kind)
    if kind_of(out) != kind or array.ptr != _address(out):
        raise ValueError(f"{name} must be a C-contiguous {kind.name} array of {dtype.__name__}, to be written in place")
    return array


def _address(array) -> int:
    if isinstance(array, wp.array):
        return array.ptr
    return array.ctypes.data if isinstance(array, np.ndarray) else array.data_ptr()


def _precision_of(vec, precision: str):
    if precision not in ("auto", "float32", "float64"):
        raise ValueError(f"precision must be 'auto', 'float32' or 'float64', got {precision!r}")
    if precision == "auto":
        dtype = vec.dtype if hasattr(vec, "dtype") else np.asarray(vec).dtype
        double = getattr(dtype, "_wp_scalar_type_", dtype) == wp.float64 or str(dtype) in ("float64", "torch.float64")
        return wp.float64 if double else wp.float32
    return getattr(wp, precision)


def vec2pix(nside: int, vec, *, nest: bool, precision: str = "auto", out=None, device=None):
    """Return the HEALPix pixel that holds each direction.

    Args:
        nside: Resolution, 1 … 8192; a power of two in NESTED order.
        vec: Directions of any length, shape (N, 3); numpy, torch or Warp.
        nest: ``True`` for NESTED, ``False`` for RING order. Required: a silent default would scramble the other order.
        precision: ``"float64"`` equals healpy to the last bit also on borders; ``"float32"`` is several times faster;
            ``"auto"`` takes float64 for float64 input, else float32.
        out: Written in place when given, shape (N,) int64, of the kind of ``vec``.
        device: Warp device for numpy input.

    Returns:
        ipix: Pixel indices, shape (N,) int64, of the kind of ``vec``; −1 for a zero or non-finite vector.

    Raises:
        ValueError: If a value or shape is out of range.
        TypeError: If ``nside`` is no whole number or ``vec`` holds no numbers.

    Error: float64 none against healpy, borders included, where both use the same libm (CPU); on CUDA the last bit of
    atan2 may decide a border otherwise. float32 differs only within 1.9 nside 2⁻²⁴ of a border [pixel], by one pixel.
    Held by test_vec2pix_equals_healpy_on_random_directions, test_vec2pix_equals_healpy_on_centres_borders_and_axes and
    test_vec2pix_float32_errs_only_at_borders.

    Source: Górski et al. 2005, Eq. (2)–(9) and Sec. 5.3.
    """
    if not isinstance(nest, (bool, np.bool_)):
        raise TypeError(f"nest must be True (NESTED) or False (RING), got {nest!r}")
    nside = _checked_nside(nside, bool(nest))
    dtype = _precision_of(vec, precision)
    kind = kind_of(vec, device)
    vectors = take(vec, "vec", ("n", 3), dtype, kind)
    n = vectors.shape[0]
    ipix = _result(out, "out", (n,), wp.int64, kind)
    L = lanes(kind.device)
    kernel = _kernels(L).vec2pix[bool(nest), dtype]
    if n:
        launch(kernel, blocks(n, L), [nside, vectors.flatten(), n], [ipix], device=kind.device, grain=64)
    return kind.give(ipix) if out is None else out


def corners(nside: int, vec, *, out=None, device=None):
    """Return the four grid corners around each direction and their bilinear weights.

    Corner order, the zero vector and non-finite input: :func:`corners_of`; numbering: the module's docstring.

    Args:
        nside: Resolution, 1 … 8192.
        vec: Directions of any length, shape (N, 3); numpy, torch or Warp, computed in float32.
        out: ``(indices, weights)``, written in place when given.
        device: Warp device for numpy input.

    Returns:
        indices: Corner indices, shape (N, 4) int32, below :func:`corner_point_count`.
        weights: Weights in [0, 1] that sum to 1, shape (N, 4) float32.

    Raises:
        ValueError: If a value or shape is out of range.
        TypeError: If ``nside`` is no whole number or ``vec`` holds no numbers.

    Error: a table of values in [−1, 1] is interpolated to within 3.4e-7 nside of the float64 reference; held by
    test_corners_match_reference.

    Source: NeuBRDF Sec. 3.2.2 for the grid. Differs: the paper weighs each corner by 1/4 at run time, which jumps at
    pixel borders; these weights do not.
    """
    nside = _checked_nside(nside)
    kind = kind_of(vec, device)
    vectors = take(vec, "vec", ("n", 3), wp.float32, kind)
    n = vectors.shape[0]
    given = (None, None) if out is None else out
    indices = _result(given[0], "out[0]", (n, 4), wp.int32, kind)
    weights = _result(given[1], "out[1]", (n, 4), wp.float32, kind)
    L = lanes(kind.device)
    if n:
        outputs = [indices.flatten(), weights.flatten()]
        kernel = _kernels(L).corners
        launch(kernel, blocks(n, L), [nside, vectors.flatten(), n], outputs, device=kind.device, grain=64)
    return (kind.give(indices), kind.give(weights)) if out is None else out


def corner_point_count(nside: int) -> int:
    """Return how many points the corner grid of the sphere has: 12 nside² + 2."""
    return 12 * _checked_nside(nside) ** 2 + 2


def hemisphere_point_count(nside: int) -> int:
    """Return how many points reach from the north pole to one ring beyond the equator: 6 nside² + 6 nside + 1."""
    return 6 * _checked_nside(nside) * (nside + 1) + 1
