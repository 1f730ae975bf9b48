"""The Fibonacci lattice: its points, the nearest one to a direction, and the cell of the lattice around it.

Point i of S lies at z = 1 − (2i + 1)/S and phi = 2π·frac(i/Φ) (González 2010). In (phi, z) that is a regular lattice: a
step of F_k, the k-th Fibonacci number, turns by −(−1/Φ)^k, and at each latitude two neighbouring F_k span cells that
are nearly square on the sphere. Keinert et al. 2015, "Spherical Fibonacci Mapping", invert the lattice that way,
without a search. Around the pole, where the points form no cells, the first :data:`CAP` are searched.

z is the normal; a direction with z < 0 counts as lying on the horizon. Forward only.
"""

import math

import numpy as np
import warp as wp

from warp_neumat.kernels.approx import exp2
from warp_neumat.kernels.dispatch import module_options
from warp_neumat.kernels.healpix_chart import quarters

wp.set_module_options(module_options())

PHI = (1.0 + 5.0**0.5) / 2.0
"""The golden ratio Φ."""

GOLDEN = 2654435769
"""2³²/Φ: i·GOLDEN modulo 2³², read as a signed fraction of a turn, is the longitude of Fibonacci point i."""

CAP = 48
"""Fibonacci points around the pole that are searched one by one."""

_LOG2_PHI = wp.constant(wp.float32(np.log2(PHI)))
_LOG2_ZONE = wp.constant(wp.float32(np.log2(np.pi * 5.0**0.5)))
_PHI = wp.constant(wp.float32(PHI))
_SQRT5 = wp.constant(wp.float32(5.0**-0.5))
_TURN = wp.constant(wp.float32(2.0 * np.pi))
_GOLDEN = wp.constant(wp.uint32(GOLDEN))
_CAP = wp.constant(CAP)
_CANDIDATES = wp.constant(CAP + 40)


@wp.func
def upper(d: wp.vec3):
    """Return ``d`` (any length) as a unit vector with z ≥ 0; the pole for a zero or non-finite ``d``."""
    m = wp.max(wp.max(wp.abs(d[0]), wp.abs(d[1])), wp.abs(d[2]))
    ok = m > 0.0 and m < 3.0e38
    shift = 1.0 / wp.where(ok, m, 1.0)
    x = wp.where(ok, d[0] * shift, 0.0)
    y = wp.where(ok, d[1] * shift, 0.0)
    z = wp.where(ok, wp.max(d[2] * shift, 0.0), 1.0)
    norm2 = x * x + y * y + z * z
    whole = norm2 > 0.0  # not for (0, 0, −1), nor with a NaN
    scale = 1.0 / wp.sqrt(wp.where(whole, norm2, 1.0))
    return wp.where(whole, x * scale, 0.0), wp.where(whole, y * scale, 0.0), wp.where(whole, z * scale, 1.0)


@wp.func
def turn_of(x: float, y: float) -> float:
    """Return atan2(y, x) in quarter turns, [0, 4)."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    larger = wp.max(ax, ay)
    t = quarters(wp.min(ax, ay) / wp.where(larger > 0.0, larger, 1.0))
    t = wp.where(ay > ax, 1.0 - t, t)
    t = wp.where(x < 0.0, 2.0 - t, t)
    t = wp.where(y < 0.0, 4.0 - t, t)
    return wp.where(t >= 4.0, 0.0, t)


@wp.func
def _longitude(i: int) -> float:
    """Return the longitude [turns] of Fibonacci point ``i``, [−1/2, 1/2]: exact, where i/Φ in float32 were not."""
    return float(int(wp.uint32(i) * _GOLDEN)) * 2.3283064365386963e-10


@wp.func
def _lattice(count: int, d: wp.vec3):
    """Return the cell of ``d`` in the local lattice: steps F_k, F_k+1, the first corner's index, and the fractions.

    Also the longitude [turns] and the height 1 − z of ``d``. Eq. (4)–(7) of Keinert et al.; a step of F_k in i turns by
    F_k/Φ − F_k−1 = −(−1/Φ)^k.
    """
    x, y, z = upper(d)
    sin2 = x * x + y * y
    height = sin2 / (1.0 + z)
    turn = 0.25 * turn_of(x, y)
    turn = wp.where(turn >= 0.5, turn - 1.0, turn)

    # The zone, with log2 from the bits of the float, good to 0.01: the zones overlap by more.
    s = wp.max(sin2 * float(count), 1.0)
    bits = wp.cast(s, wp.int32)
    f = float(bits & 0x7FFFFF) * 1.1920928955078125e-7
    log2 = float((bits >> 23) - 127) + f * (1.3465 - 0.3465 * f)
    k = wp.max(wp.floor((log2 + _LOG2_ZONE) * (0.5 / _LOG2_PHI)), 2.0)
    power = exp2(k * _LOG2_PHI)
    step = wp.floor(power * _SQRT5 + 0.5)
    next_step = wp.floor(power * _PHI * _SQRT5 + 0.5)
    sign = wp.where((int(k) & 1) == 0, -1.0, 1.0)
    swing = sign / power
    next_swing = -swing / _PHI
    # The lattice holds one point a turn: the determinant is ±1.
    at = 0.5 * float(count) * height - 0.5
    a = -sign * (next_swing * at - next_step * turn)
    b = -sign * (step * turn - swing * at)
    first = wp.floor(a)
    second = wp.floor(b)
    start = int(first) * int(step) + int(second) * int(next_step)
    return int(step), int(next_step), start, a - first, b - second, turn, height


@wp.func
def _apart(count: int, i: int, turn: float, height: float) -> float:
    """Return half the squared distance of point ``i`` to a unit vector of that longitude and height 1 − z.

    In a form that keeps its digits for near points: 1 − cos γ = (1 − cos(θ − θ_i)) + sin θ sin θ_i (1 − cos(φ − φ_i)).
    """
    h = (2.0 * float(i) + 1.0) / float(count)
    s = wp.sqrt(height * (2.0 - height))
    t = wp.sqrt(wp.max(h * (2.0 - h), 0.0))
    around = turn - _longitude(i)
    around = around - wp.floor(around + 0.5)
    r = around * around
    # sin(π x)/x, |x| ≤ 1/2, as a minimax polynomial in x²; relative error 2e-11 before rounding.
    p = -0.59925133 + r * (0.08204648 - r * 0.00702216)
    p = 3.14159265 + r * (-5.16771276 + r * (2.55016324 + r * p))
    along = s * (1.0 - h) - t * (1.0 - height)
    cosine = (1.0 - height) * (1.0 - h) + s * t
    return along * along / (1.0 + wp.max(cosine, 0.0)) + s * t * (2.0 * r * p * p)


@wp.func
def fibonacci_nearest(count: int, d: wp.vec3) -> int:
    """Return the nearest of a lattice of ``count``, −1 where the cap has to be searched. Branch-free."""
    step, next_step, start, _u, _v, turn, height = _lattice(count, d)
    best = float(1.0e9)
    found = int(0)
    for q in range(4):
        i = start + (q & 1) * step + (q >> 1) * next_step
        distance = _apart(count, wp.max(i, 0), turn, height)
        nearer = distance < best
        best = wp.where(nearer, distance, best)
        found = wp.where(nearer, wp.max(i, 0), found)
    return wp.where(0.5 * float(count) * height < float(_CAP), -1, found)


@wp.func
def fibonacci_cell(count: int, d: wp.vec3):
    """Return the corners of the lattice cell of ``d``, the first −1 where the cap has to be searched, and weights."""
    step, next_step, start, u, v, _turn, height = _lattice(count, d)
    index = wp.vec4i(start, start + step, start + next_step, start + step + next_step)
    cap = 0.5 * float(count) * height < float(_CAP)
    index[0] = wp.where(cap, -1, index[0])
    return index, wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)


@wp.func
def fibonacci_search(count: int, d: wp.vec3):
    """Return the nearest four points of the cap around the pole, the nearest first, and weights ~ 1/distance."""
    _step, _next, _start, _u, _v, turn, height = _lattice(count, d)
    near = wp.vec4(1.0e9, 1.0e9, 1.0e9, 1.0e9)
    index = wp.vec4i(0, 0, 0, 0)
    for i in range(wp.min(_CANDIDATES, count)):
        distance = _apart(count, i, turn, height)
        if distance < near[3]:
            near[3] = distance
            index[3] = i
            for back in range(3):  # one step of an insertion sort
                q = 2 - back
                if near[q + 1] < near[q]:
                    swap = near[q]
                    near[q] = near[q + 1]
                    near[q + 1] = swap
                    other = index[q]
                    index[q] = index[q + 1]
                    index[q + 1] = other
    weight = wp.vec4()
    total = float(0.0)
    for q in range(4):
        weight[q] = 1.0 / wp.sqrt(wp.max(near[q], 1.0e-13))
        total += weight[q]
    return index, weight / total


def fibonacci_sphere(count: int) -> int:
    """Return S, how many points the whole sphere's lattice has whose first ``count`` hold all cells of the hemisphere.

    A cell at the equator reaches at most F_k + F_k+1 points beyond.
    """
    sphere = 2 * count
    while True:
        zone = math.floor(math.log(sphere * math.pi * 5**0.5) / math.log(PHI * PHI) + 0.03)
        wide = round(PHI**zone / 5**0.5) + round(PHI ** (zone + 1) / 5**0.5)
        if sphere <= 2 * (count - wide - 1):
            return sphere
        sphere = min(sphere - 1, max(2 * (count - wide - 1), sphere * 9 // 10))


def fibonacci_lattice(count: int) -> np.ndarray:
    """Return the first ``count`` points of the lattice of :func:`fibonacci_sphere`, (count, 3) float64."""
    i = np.arange(count, dtype=np.int64)
    phi = (i * GOLDEN % 2**32) * (2.0 * np.pi / 2.0**32)
    z = 1.0 - (2.0 * i + 1.0) / fibonacci_sphere(count)
    sine = np.sqrt(1.0 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1)
