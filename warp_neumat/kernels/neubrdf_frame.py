"""How NeuBRDF's grids see a pair of directions: frames, symmetries, and the weights of the corners around them.

Frames (docs/conventions.md for ω_i, ω_o; side 0 and side 1 are the two grids):

- ``absolute``: ω_i and ω_o as they are (paper [neubrdf]);
- ``isotropic``: both turned about z until ω_o has azimuth 0, then ω_i mirrored to y ≥ 0;
- ``half``: half vector and difference vector (Rusinkiewicz 1998, Sec. 3), the half vector warped by θ' ~ √θ, which
  spends the grid near the pole, where highlights are;
- ``half-isotropic``: the same with the half vector turned to azimuth 0.

The half frames know two symmetries that hold exactly: ``reciprocal`` takes the difference vectors of (ω_i, ω_o) and
(ω_o, ω_i), d and −d in x and y, for the same; ``bilateral`` also mirrors it to x, y ≥ 0.

All of it is branch-free, so a lane loop around it is widened.
"""

import functools

import warp as wp

from warp_neumat.kernels.dispatch import module_options
from warp_neumat.kernels.healpix import corner_number, corners_of
from warp_neumat.kernels.healpix_chart import chart, square

wp.set_module_options(module_options())

FRAMES = ("absolute", "isotropic", "half", "half-isotropic", "half-light")
"""Frames by name."""

SYMMETRIES = ("none", "reciprocal", "bilateral")
"""Symmetries by name; all but the first belong to the half frames."""

INTERPOLATIONS = ("bilinear", "idw", "uniform")
"""Corner weights by name."""

_NEAREST = wp.constant(1.0e-6)
"""Least distance that an inverse distance is taken of [rad]."""


@wp.func
def azimuth_of(x: float, y: float):
    """Return cosine and sine of the azimuth of (x, y); (1, 0) within 1e-6 of the pole."""
    s2 = x * x + y * y
    off_axis = s2 >= 1.0e-12
    scale = 1.0 / wp.sqrt(wp.max(s2, 1.0e-12))
    return wp.where(off_axis, x * scale, 1.0), wp.where(off_axis, y * scale, 0.0)


@functools.cache
def make_half_frame(frame: str, symmetry: str):
    """Return a Warp function (ω_i, ω_o) → (warped half vector, difference vector) of unit directions with z ≥ 0.

    ``"half-light"`` gives ω_i in place of the difference vector.

    The difference vector is taken from (ω_i − ω_o)/2 and |ω_i + ω_o|/2 rather than from ω_i alone: equal in exact
    arithmetic, and swapping the two then negates it to the last bit, so that a symmetric material is reciprocal to the
    last bit. Where its y is 0 the sign of x decides which of the two stands for both.

    Error: that of the evaluation behind it, 5e-5 of 1 + f, held by test_neubrdf_kernel_matches_float64; and swapped
    directions give the same bits, held by test_symmetric_half_frames_are_reciprocal_to_the_last_bit.
    """

    @wp.func
    def half_frame(wi: wp.vec3, wo: wp.vec3):
        x = wi[0] + wo[0]
        y = wi[1] + wo[1]
        z = wi[2] + wo[2]
        length2 = x * x + y * y + z * z
        usable = length2 >= 1.0e-12
        scale = 1.0 / wp.sqrt(wp.max(length2, 1.0e-12))
        hx = wp.where(usable, x * scale, 0.0)
        hy = wp.where(usable, y * scale, 0.0)
        hz = wp.where(usable, z * scale, 1.0)
        s2 = hx * hx + hy * hy
        pole = s2 < 1.0e-12
        s = wp.sqrt(s2)
        inverse = 1.0 / wp.sqrt(wp.max(s2, 1.0e-12))
        c = wp.where(pole, 1.0, hx * inverse)
        n = wp.where(pole, 0.0, hy * inverse)

        ex = 0.5 * (wi[0] - wo[0])
        ey = 0.5 * (wi[1] - wo[1])
        ez = 0.5 * (wi[2] - wo[2])
        dx = (ex * c + ey * n) * hz - ez * s
        dy = ey * c - ex * n
        dz = 0.5 * wp.sqrt(length2)
        if wp.static(symmetry == "reciprocal"):
            flip = wp.where(dy < 0.0, -1.0, wp.where(dy > 0.0, 1.0, wp.where(dx < 0.0, -1.0, 1.0)))
            dx = dx * flip
            dy = dy * flip
        if wp.static(symmetry == "bilateral"):
            dx = wp.abs(dx)
            dy = wp.abs(dy)

        gz = hz / wp.sqrt(1.0 + s)
        gx = wp.sqrt(s)
        gy = 0.0
        if wp.static(frame != "half-isotropic"):
            q = 1.0 / wp.sqrt(wp.max(s, 1.0e-12))
            gx = hx * q
            gy = hy * q
        if wp.static(frame == "half-light"):
            return wp.vec3(gx, gy, gz), wi
        return wp.vec3(gx, gy, gz), wp.vec3(dx, dy, dz)

    return half_frame


@wp.func
def _distance(nside: int, i: int, j: int, t: float, z: float, sine: float):
    """Return the great-circle distance [rad] from grid corner (i, j) to the point (z, sine) at longitude t [quarters].

    Haversine: sin²(δ/2) = |chord in the meridian plane|²/4 + sin θ₁ sin θ₂ sin²(Δφ/2), which keeps its digits where the
    two are close. At most π/2 for a corner of the pixel that holds the point.
    """
    ring = i + j
    n = float(nside)
    r = float(ring)
    cap = ring < nside
    low = r * r / (3.0 * n * n)  # 1 - z in the cap
    corner_z = wp.where(cap, 1.0 - low, (2.0 * n - r) * (2.0 / (3.0 * n)))
    corner_sine = wp.sqrt(wp.max(wp.where(cap, low * (2.0 - low), 1.0 - corner_z * corner_z), 0.0))
    corner_t = wp.where(cap, float(i) / wp.max(r, 1.0), (float(i - j) + n) / (2.0 * n))
    x = (corner_t - t) * 0.7853981633974483  # Δφ/2, within ±π/4 or so: a Taylor series is exact to float32
    x2 = x * x
    turn = x * (1.0 + x2 * (-0.16666667 + x2 * (8.3333333e-3 + x2 * (-1.9841270e-4 + x2 * 2.7557319e-6))))
    dz = corner_z - z
    ds = corner_sine - sine
    q = wp.clamp(0.25 * (dz * dz + ds * ds) + corner_sine * sine * turn * turn, 0.0, 0.5)
    # asin(√q)/√q on [0, 1/2], minimax of the relative error (1.5e-8 before rounding) by Lawson's iteration.
    p = 0.113449916
    p = p * q - 0.09664520584
    p = p * q + 0.08001017728
    p = p * q + 0.01522288113
    p = p * q + 0.04674162628
    p = p * q + 0.07485973466
    p = p * q + 0.1666702035
    p = p * q + 0.9999999854
    return 2.0 * wp.sqrt(q) * p


@wp.func
def corners_by_distance(nside: int, d: wp.vec3):
    """Return the four grid corners around ``d`` (z ≥ 0) with inverse-distance weights; as ``healpix.corners_of``.

    Weights are 1/max(δ, 1e-6) of the great-circle distance δ, over their sum (paper [neubrdf], Sec. 3.2.2). They are
    continuous over a pixel but jump at its edges.

    Error: that of the evaluation behind it, 5e-5 of 1 + f; held by test_neubrdf_kernel_matches_float64.
    """
    a, b, k, valid = chart(nside, d)
    i, j = square(nside, a, b)
    n = float(nside)
    rings = a + b
    t = wp.where(rings < n, a / wp.max(rings, 1.0e-30), (a - b + n) / (2.0 * n))
    sin2 = d[0] * d[0] + d[1] * d[1]
    scale = 1.0 / wp.sqrt(wp.max(sin2 + d[2] * d[2], 1.0e-30))
    z = d[2] * scale
    sine = wp.sqrt(sin2) * scale
    w0 = 1.0 / wp.max(_distance(nside, i, j, t, z, sine), _NEAREST)
    w1 = 1.0 / wp.max(_distance(nside, i + 1, j, t, z, sine), _NEAREST)
    w2 = 1.0 / wp.max(_distance(nside, i, j + 1, t, z, sine), _NEAREST)
    w3 = 1.0 / wp.max(_distance(nside, i + 1, j + 1, t, z, sine), _NEAREST)
    total = 1.0 / (w0 + w1 + w2 + w3)
    index = wp.vec4i(
        corner_number(nside, k, i, j, True),
        corner_number(nside, k, i + 1, j, True),
        corner_number(nside, k, i, j + 1, True),
        corner_number(nside, k, i + 1, j + 1, True),
    )
    return index, wp.vec4(w0 * total, w1 * total, w2 * total, w3 * total)


def corner_function(interpolation: str):
    """Return the Warp function (nside, direction) → (corner numbers, weights) of an interpolation.

    ``uniform`` has none of its own: its weights, 1/4 each (the paper's run time), are kept in the tables.
    """
    return corners_by_distance if interpolation == "idw" else corners_of
