"""The chart under HEALPix: where a direction lies among the pixels, in float32, float64, and to the last bit.

Sphere geometry of Górski et al. 2005, Sec. 5. z points to the north pole, longitude phi = atan2(y, x) runs east of +x.

**Pyramid coordinates.** Everything here rests on one chart. Take the quarter k = 0 … 3 of the longitude and t in [0, 1)
along it, and mirror the south onto the north. Then with N = ``nside`` ::

    cap,  |z| > 2/3:  a = t · N √(3(1 − |z|))      b = (1 − t) · N √(3(1 − |z|))
    belt, |z| ≤ 2/3:  a = N (1/2 + t − 3/4 |z|)    b = N (3/2 − t − 3/4 |z|)

are continuous, a grows eastwards and b westwards, and a + b counts rings from the pole. Pixels are the unit squares
of (a, b), grid corners its whole points.

:func:`chart` has no branches and no library calls, so a lane loop around it is widened to vector code. It is as exact
as its float type. :func:`exact_chart` rounds every step as the HEALPix library does, and calls libm's atan2 for that.
"""

from typing import Any

import numpy as np
import warp as wp

# Odd minimax polynomials of (2/pi) atan(t) on [0, 1], lowest power first: relative error 1.5e-8 and 1.0e-15.
# fmt: off
_ATAN32 = wp.constant(wp.types.vector(9, wp.float32)(
    0.6366197627, -0.2122049356, 0.1272769655, -0.09042318752, 0.06774220225, -0.04777363035, 0.0271780322,
    -0.01022946039, 0.001814258774,
))
_ATAN64 = wp.constant(wp.types.vector(18, wp.float64)(
    0.6366197723675806949, -0.2122065907887618403, 0.1273239544255799025, -0.09094567965189198914,
    0.07073548085147476676, -0.05787381855895228595, 0.04896402300000840819, -0.04239610287812587504,
    0.0372253836968328012, -0.03267750261676366398, 0.02793719879858328207, -0.02231743932792189034,
    0.01579386678491464191, -0.009328907374167363179, 0.004307229858854799817, -0.001432901152184284097,
    0.0003021457819109836662, -0.00003011321697159802951,
))
# fmt: on
_QUARTERS_PER_RADIAN = wp.constant(wp.float64(2.0 / np.pi))
_TWO_THIRDS = wp.constant(wp.float64(2.0 / 3.0))
_POLAR = wp.constant(wp.float64(0.99))
_LOWEST = wp.constant(wp.float64(-1e300))
_UP32 = wp.constant(wp.float32(2.0**100))
_DOWN32 = wp.constant(wp.float32(2.0**-80))
_SMALL64 = wp.constant(wp.float64(2.0**-480))
_LARGE64 = wp.constant(wp.float64(2.0**480))
_UP64 = wp.constant(wp.float64(2.0**600))
_DOWN64 = wp.constant(wp.float64(2.0**-600))
_NEAR = wp.constant(wp.float64(4e-14))
"""A float64 direction within _NEAR · nside of a pixel border [pixel] is decided by the exact form."""


@wp.func
def quarters(t: wp.float32):
    """Return atan(t) in quarter turns, t in [0, 1]."""
    u = t * t
    p = _ATAN32[8]
    for i in range(8):
        p = p * u + _ATAN32[7 - i]
    return p * t


@wp.func
def quarters(t: wp.float64):  # noqa: F811  (an overload)
    u = t * t
    v = u * u
    even = _ATAN64[16]  # two chains, so that neither waits for the other's multiply-adds
    odd = _ATAN64[17]
    for i in range(8):
        even = even * v + _ATAN64[14 - 2 * i]
        odd = odd * v + _ATAN64[15 - 2 * i]
    return (odd * u + even) * t


@wp.func
def _even_out(m: wp.float32):
    """Return a power of two for a vector of largest component ``m``, with which its squares stay in range."""
    return wp.where(m < 1.0e-18, _UP32, wp.where(m > 1.0e18, _DOWN32, 1.0))


@wp.func
def _even_out(m: wp.float64):  # noqa: F811  (an overload)
    return wp.where(m < _SMALL64, _UP64, wp.where(m > _LARGE64, _DOWN64, wp.float64(1.0)))


@wp.func
def chart(nside: int, d: Any):
    """Return pyramid coordinates (a, b) of ``d``, its quarter k, and whether ``d`` is valid: finite and not 0."""
    zero = type(d[0])(0.0)
    one = type(d[0])(1.0)
    half = type(d[0])(0.5)
    three = type(d[0])(3.0)
    n = type(d[0])(nside)
    ax = wp.abs(d[0])
    ay = wp.abs(d[1])
    az = wp.abs(d[2])
    shift = _even_out(wp.max(wp.max(ax, ay), az))
    ax = ax * shift
    ay = ay * shift
    az = az * shift
    sin2 = ax * ax + ay * ay
    norm2 = sin2 + az * az
    valid = wp.where(norm2 > zero, norm2 * zero, one) == zero
    norm2 = wp.where(valid, norm2, one)
    norm = wp.sqrt(norm2)

    # Longitude: atan of the smaller over the larger component, folded out to the quarter turn that the signs name.
    steep = ay > ax
    larger = wp.max(ax, ay)
    t = quarters(wp.min(ax, ay) / wp.where(larger > zero, larger, one))
    west = d[0] < zero
    south = d[1] < zero
    odd = west != south
    t = wp.where(steep != odd, one - t, t)
    k = wp.where(south, wp.where(west, 2, 3), wp.where(west, 1, 0))
    full = t >= one
    t = wp.where(full, zero, t)
    k = wp.where(full, (k + 1) & 3, k)

    # 1 - |z| = sin² / (1 + |z|), which keeps its digits at the poles.
    cap2 = three * sin2 / (norm2 + az * norm)
    rings = n * wp.sqrt(cap2)
    cap = cap2 < one
    belt = half - type(d[0])(0.75) * (az / norm)
    a = wp.where(cap, t * rings, n * (belt + t))
    b = wp.where(cap, (one - t) * rings, n * (belt + (one - t)))
    return a, b, k, valid


@wp.func
def square(nside: int, a: Any, b: Any):
    """Return the whole parts of (a, b), kept inside the northern half and safe for NaN."""
    i = wp.clamp(int(wp.floor(a)), 0, 2 * nside - 1)
    j = wp.clamp(int(wp.floor(b)), 0, 2 * nside - 1 - i)
    return i, j


@wp.func
def _sealed(x: wp.float64):
    """Return ``x``, and keep the compiler from fusing the product that made it into the sum that uses it.

    The exact form owes its last bit to products and sums that are rounded one by one.
    """
    return wp.max(x, _LOWEST)


@wp.func
def exact_chart(nside: int, d: wp.vec3d):
    """Return whole pyramid coordinates (i, j), quarter k, longitude [quarters], whether in a cap, whether valid.

    Every operation rounds in the order in which the HEALPix library rounds, since on a border only that decides.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    three = wp.float64(3.0)
    n = wp.float64(nside)
    shift = _even_out(wp.max(wp.max(wp.abs(d[0]), wp.abs(d[1])), wp.abs(d[2])))
    x = d[0] * shift
    y = d[1] * shift
    z = d[2] * shift
    sin2 = _sealed(x * x) + _sealed(y * y)
    norm2 = sin2 + _sealed(z * z)
    valid = wp.where(norm2 > zero, norm2 * zero, one) == zero
    scale = one / wp.sqrt(wp.where(valid, norm2, one))
    za = _sealed(wp.abs(z) * scale)

    t = wp.where(x == zero and y == zero, zero, _sealed(wp.atan2(y, x) * _QUARTERS_PER_RADIAN))
    t = wp.where(t < zero, t + wp.float64(4.0), t)
    t = wp.where(valid and t < wp.float64(4.0), t, zero)
    k = int(t)
    if za > _TWO_THIRDS:
        tp = t - wp.float64(k)
        rings = n * wp.sqrt(three * (one - za))
        if za >= _POLAR:
            rings = n * (wp.sqrt(sin2) * scale) / wp.sqrt((one + za) / three)
        return int(tp * rings), int((one - tp) * rings), k, t, True, valid

    middle = _sealed(n * (wp.float64(0.5) + t))
    tilt = _sealed(n * za * wp.float64(0.75))
    i = int(middle - tilt) - k * nside
    j = (2 + k) * nside - 1 - int(middle + tilt)
    if j < 0:  # rounding took the direction over the end of its quarter
        return i - nside, j + nside, (k + 1) & 3, t, False, valid
    return i, j, k, t, False, valid


@wp.func
def settled(nside: int, a: wp.float64, b: wp.float64, valid: bool):
    """Return whether (a, b) is so far from every pixel border that rounding cannot change the pixel."""
    near = _NEAR * wp.float64(nside)
    da = wp.abs(a - wp.floor(a + wp.float64(0.5)))
    db = wp.abs(b - wp.floor(b + wp.float64(0.5)))
    return wp.where(valid, wp.min(da, db), wp.float64(0.0)) > near
