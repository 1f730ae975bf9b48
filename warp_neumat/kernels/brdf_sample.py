"""Importance sampling of a reflectance by a proxy: a cosine lobe and three GGX reflection lobes, mixed by θ_o.

    p(ω_i | ω_o) = w₀(θ_o) cos θ_i/π + Σ_j w_j(θ_o) D_j(h) / (2 (k_j cos θ_o + |S_j ω_o|)),   S_j = diag(α_xj, α_yj, 1)

The density of a lobe is that of the visible normals (Heitz, "Sampling the GGX Distribution of Visible Normals", JCGT
7(4), 2018), reflected, and bounded to directions that can leave the surface: k_j is Eq. 5 of Eto and Tokuyoshi,
"Bounded VNDF Sampling for Smith-GGX Reflections", SIGGRAPH Asia 2023 technical communications. Samples are drawn on the
spherical cap of Dupuy and Benyoub, "Sampling Visible GGX Normals with Spherical Caps", HPG 2023. What still falls below
the horizon is lost: it gets density and weight 0, so the density integrates to a little less than 1.

The weights are tabulated over :data:`NODES` values of sqrt(1 − cos θ_o), which is √2 sin(θ_o/2): nearly even steps of
the angle, without an arc cosine. A node's four weights are four 16-bit numbers that add up to 65535, in one 64-bit
word, cosine first: one gather fetches them, and linear interpolation keeps their sum. ω_i is the sampled direction, to
the light; ω_o to the viewer; both in the frame with z = normal. Densities are per solid angle [1/sr].

Everything is a ``wp.func`` for one sample without calls into libm. The gather keeps LLVM from widening the lane loop:
on a CPU drawing a sample costs about as much as evaluating a material of the usual size, and a density half of that.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels.frame import safe_normalize

wp.set_module_options(dispatch.module_options())

NODES = 32
"""Nodes of the weight table: node i lies at cos θ_o = 1 − (i/(NODES − 1))²."""

LOBES = 3
"""GGX lobes beside the cosine lobe."""

ALPHA_RANGE = (0.002, 1.0)
"""Least and greatest α [1] of a lobe: below, float32 directions no longer resolve it."""

_LAST = wp.constant(NODES - 1)
_STEP = wp.constant(float(NODES - 1))
_MASK = wp.constant(wp.uint64(0xFFFF))
_SHIFT1, _SHIFT2, _SHIFT3 = (wp.constant(wp.uint64(16 * n)) for n in (1, 2, 3))
_UNIT = wp.constant(1.0 / 65535.0)
_BELOW_ONE = wp.constant(1.0 - 2.0**-24)
_INV_PI = wp.constant(0.318309886183790672)


@wp.struct
class Proxy:
    """A material's sampling density on a device; :func:`make_proxy` fills it."""

    alpha_x: wp.vec3
    alpha_y: wp.vec3
    weights: wp.array(dtype=wp.uint64)


def quantize_weights(weights) -> np.ndarray:
    """Return the weights, shape [NODES, 4], as the device holds them: whole numbers over 65535 that add up to 1.

    The cosine lobe (column 0) takes the rounding. Raises: ValueError: If the shape is another, or a row is negative or
    does not add up to 1.
    """
    weights = np.asarray(weights, np.float64)
    if weights.shape != (NODES, LOBES + 1):
        raise ValueError(f"weights must have shape ({NODES}, {LOBES + 1}), got {weights.shape}")
    if not (weights >= 0).all() or np.abs(weights.sum(1) - 1).max() > 1e-6:
        raise ValueError("weights must be at least 0 and add up to 1 in every row; divide each row by its sum")
    steps = np.floor(weights * 65535.0 + 1e-6)
    steps[:, 0] = 65535.0 - steps[:, 1:].sum(1)
    return steps / 65535.0


def make_proxy(alphas, weights, device=None) -> Proxy:
    """Return the device form of a proxy.

    Args:
        alphas: α_x and α_y of each lobe, shape [3, 2], within :data:`ALPHA_RANGE`.
        weights: Shape [NODES, 4], cosine lobe first, rows that add up to 1; :func:`quantize_weights` is applied.
        device: Warp device.

    Raises: ValueError: If a shape or a value is out of range.
    """
    alphas = np.asarray(alphas, np.float64)
    if alphas.shape != (LOBES, 2):
        raise ValueError(f"alphas must have shape ({LOBES}, 2), got {alphas.shape}")
    low, high = ALPHA_RANGE
    if not ((alphas >= low) & (alphas <= high)).all():
        raise ValueError(f"alphas must be in [{low}, {high}], got {alphas.ravel().tolist()}")
    steps = np.round(quantize_weights(weights) * 65535.0).astype(np.uint64)
    words = steps[:, 0] | steps[:, 1] << np.uint64(16) | steps[:, 2] << np.uint64(32) | steps[:, 3] << np.uint64(48)
    proxy = Proxy()
    proxy.alpha_x, proxy.alpha_y = wp.vec3(*alphas[:, 0]), wp.vec3(*alphas[:, 1])
    proxy.weights = wp.array(words, dtype=wp.uint64, device=device)
    return proxy


@wp.func
def proxy_weights(proxy: Proxy, cosine: float) -> wp.vec4:
    """Return the weights of the four lobes, cosine lobe first, for cos θ_o; they add up to 1."""
    x = wp.sqrt(wp.clamp(1.0 - cosine, 0.0, 1.0)) * _STEP
    k = wp.min(int(x), _LAST - 1)
    f = x - float(k)
    a = proxy.weights[k]
    b = proxy.weights[k + 1]
    g = (1.0 - f) * _UNIT
    h = f * _UNIT
    return wp.vec4(
        g * float(int(a & _MASK)) + h * float(int(b & _MASK)),
        g * float(int((a >> _SHIFT1) & _MASK)) + h * float(int((b >> _SHIFT1) & _MASK)),
        g * float(int((a >> _SHIFT2) & _MASK)) + h * float(int((b >> _SHIFT2) & _MASK)),
        g * float(int(a >> _SHIFT3)) + h * float(int(b >> _SHIFT3)),
    )


@wp.func
def cap_bound(wo: wp.vec3, ax: float, ay: float) -> float:
    """Return k: how far below the pole, in parts of the stretched viewer's z, the sampled cap has to reach."""
    a = wp.min(ax, ay)
    a2 = a * a
    s = 1.0 + wp.sqrt(wo[0] * wo[0] + wo[1] * wo[1])
    s2 = s * s
    return (1.0 - a2) * s2 / (s2 + a2 * wo[2] * wo[2])


@wp.func
def ggx_lobe_pdf(h: wp.vec3, wo: wp.vec3, ax: float, ay: float) -> float:
    """Return the density of ω_i of a bounded GGX lobe [1/sr] for its unit half vector ``h``; ω_o above the horizon."""
    x = h[0] / ax
    y = h[1] / ay
    stretch = x * x + y * y + h[2] * h[2]
    sx = ax * wo[0]
    sy = ay * wo[1]
    length = wp.sqrt(sx * sx + sy * sy + wo[2] * wo[2])
    return 0.5 * _INV_PI / (ax * ay * stretch * stretch * (cap_bound(wo, ax, ay) * wo[2] + length))


@wp.func
def quarter_sine(q: float) -> float:
    """Return sin(2πq) for q in [-1/4, 1/4]: its series to q¹³, whose remainder is 1e-9 at a quarter turn."""
    w = q * q
    p = 3.81995258
    p = p * w - 15.0946426
    p = p * w + 42.0586939
    p = p * w - 76.7058598
    p = p * w + 81.6052493
    p = p * w - 41.3417022
    p = p * w + 6.28318531
    return p * q


@wp.func
def turn(t: float) -> wp.vec2:
    """Return (cos, sin) of 2π ``t``, t in [0, 1]; exact to 2e-7."""
    s = t - 0.5  # half a turn back: both change their sign
    far = wp.abs(s) - 0.25
    folded = wp.min(wp.abs(s), 0.25 - far)
    return wp.vec2(quarter_sine(far), quarter_sine(wp.where(s > 0.0, -folded, folded)))


@wp.func
def ggx_lobe_sample(wo: wp.vec3, ax: float, ay: float, u: float, v: float) -> wp.vec3:
    """Return ω_i drawn from a bounded GGX lobe; it may lie below the horizon. ``u`` and ``v`` in [0, 1)."""
    s = safe_normalize(wp.vec3(ax * wo[0], ay * wo[1], wo[2]))
    b = cap_bound(wo, ax, ay) * s[2]
    z = wp.min((1.0 - u) * (1.0 + b) - b, 1.0)
    r = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    c = turn(v)
    m = safe_normalize(wp.vec3(ax * (r * c[0] + s[0]), ay * (r * c[1] + s[1]), wp.max(z + s[2], 0.0)))
    return m * (2.0 * wp.dot(wo, m)) - wo


@wp.func
def proxy_pdf(proxy: Proxy, wi: wp.vec3, wo: wp.vec3) -> float:
    """Return p(ω_i | ω_o) [1/sr] for unit directions; 0 where either is below the horizon."""
    above = wi[2] > 0.0 and wo[2] > 0.0
    o = wp.vec3(wo[0], wo[1], wp.max(wo[2], 0.0))
    h = safe_normalize(wp.vec3(wi[0] + wo[0], wi[1] + wo[1], wp.max(wi[2] + wo[2], 0.0)))
    w = proxy_weights(proxy, o[2])
    p = w[0] * _INV_PI * wi[2]
    for j in range(LOBES):
        p += w[j + 1] * ggx_lobe_pdf(h, o, proxy.alpha_x[j], proxy.alpha_y[j])
    return wp.where(above, p, 0.0)


@wp.func
def proxy_sample(proxy: Proxy, wo: wp.vec3, u: wp.vec3) -> wp.vec3:
    """Return unit ω_i drawn by three numbers in [0, 1): ``u[0]`` chooses the lobe, the others the place in it.

    It may lie below the horizon, where :func:`proxy_pdf` is 0. ω_o below it is treated as if at it.
    """
    o = safe_normalize(wp.vec3(wo[0], wo[1], wp.max(wo[2], 0.0)))
    w = proxy_weights(proxy, o[2])
    # Numbers that are not in [0, 1) become 0 or the largest below 1; a NaN fails every comparison, so it becomes 0.
    a = wp.where(u[0] > 0.0, wp.min(u[0], _BELOW_ONE), 0.0)
    b = wp.where(u[1] > 0.0, wp.min(u[1], _BELOW_ONE), 0.0)
    c = wp.where(u[2] > 0.0, wp.min(u[2], _BELOW_ONE), 0.0)
    ax = proxy.alpha_x[0]
    ay = proxy.alpha_y[0]
    edge = w[0] + w[1]
    for j in range(1, LOBES):
        later = a >= edge and w[j + 1] > 0.0  # rounding may leave a past the last edge
        ax = wp.where(later, proxy.alpha_x[j], ax)
        ay = wp.where(later, proxy.alpha_y[j], ay)
        edge += w[j + 1]
    lobe = ggx_lobe_sample(o, ax, ay, b, c)
    e = turn(c)
    r = wp.sqrt(b)
    diffuse = a < w[0] or w[1] + w[2] + w[3] <= 0.0
    # Component by component: a vector select would not become a blend in a lane loop.
    return wp.vec3(
        wp.where(diffuse, r * e[0], lobe[0]),
        wp.where(diffuse, r * e[1], lobe[1]),
        wp.where(diffuse, wp.sqrt(1.0 - b), lobe[2]),
    )


@functools.cache
def _make_kernels(lanes: int):
    L = STRIDE = lanes  # two names, because a constant that is cast keeps the new type in the rest of the kernel
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel
    def proxy_sample_kernel(
        first: int,
        proxy: Proxy,
        wo: wp.array(dtype=wp.float32),
        numbers: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        wi: wp.array(dtype=wp.float32),
        density: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        single = wp.uint64(b) * wp.uint64(STRIDE) * FLOAT
        O = wp.array(ptr=wo.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        U = wp.array(ptr=numbers.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        I = wp.array(ptr=wi.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        P = wp.array(ptr=density.ptr + single, shape=(L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                o = safe_normalize(wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2]))
                i = proxy_sample(proxy, o, wp.vec3(U[3 * l], U[3 * l + 1], U[3 * l + 2]))
                I[3 * l] = i[0]
                I[3 * l + 1] = i[1]
                I[3 * l + 2] = i[2]
                P[l] = proxy_pdf(proxy, i, o)

    @wp.kernel
    def proxy_pdf_kernel(
        first: int,
        proxy: Proxy,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        density: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        I = wp.array(ptr=wi.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=wo.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        P = wp.array(ptr=density.ptr + wp.uint64(b) * wp.uint64(STRIDE) * FLOAT, shape=(L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                i = safe_normalize(wp.vec3(I[3 * l], I[3 * l + 1], I[3 * l + 2]))
                o = safe_normalize(wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2]))
                P[l] = proxy_pdf(proxy, i, o)

    @wp.kernel
    def weight_kernel(
        first: int,
        value: wp.array(dtype=wp.float32),
        density: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        weight: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        V = wp.array(ptr=value.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        P = wp.array(ptr=density.ptr + wp.uint64(b) * wp.uint64(STRIDE) * FLOAT, shape=(L,), dtype=wp.float32)
        W = wp.array(ptr=weight.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                p = P[l]
                s = wp.where(p > 0.0, 1.0 / wp.max(p, 1.0e-30), 0.0)
                W[3 * l] = V[3 * l] * s
                W[3 * l + 1] = V[3 * l + 1] * s
                W[3 * l + 2] = V[3 * l + 2] * s

    return proxy_sample_kernel, proxy_pdf_kernel, weight_kernel


def _same_device(proxy: Proxy, kind: arrays.Kind, name: str) -> None:
    if kind.device != proxy.weights.device:
        raise ValueError(
            f"{name} must be on {proxy.weights.device}, where the proxy is, got {kind.device}; move it first"
        )


def _run(kernel: int, inputs, outputs, count, device) -> None:
    if count:
        lanes = dispatch.lanes(device)
        flat = [v.flatten() if isinstance(v, wp.array) else v for v in inputs]
        outputs = [v.flatten() for v in outputs]
        dispatch.launch(
            _make_kernels(lanes)[kernel], dispatch.blocks(count, lanes), [*flat, count], outputs, device=device
        )


def sample_proxy(proxy: Proxy, wo, u):
    """Draw ω_i for every ω_o and return (ω_i [n, 3], density [n] in 1/sr), float32, of the kind of ``wo``.

    Args:
        proxy: As :func:`make_proxy` returns it.
        wo: Directions to the viewer, shape [n, 3], any length; numpy, torch or Warp.
        u: Numbers in [0, 1), shape [n, 3]; the result depends on nothing else.

    ω_i is a unit vector; where it or ω_o lies below the horizon, the density is 0.

    Raises: ValueError: If a shape or device differs.
    Error: for α ≥ 0.005 at most 1e-3 in ω_i (1.2e-4 for α ≥ 0.02) and 7e-4 relative in the density, 1.2e-2 within
        three degrees of the horizon; held by test_sample_matches_float64.
    """
    kind = arrays.kind_of(wo, proxy.weights.device)
    _same_device(proxy, kind, "wo")
    outgoing = arrays.take(wo, "wo", ("n", 3), wp.float32, kind)
    count = outgoing.shape[0]
    numbers = arrays.take(u, "u", (count, 3), wp.float32, kind)
    wi, density = kind.empty((count, 3), wp.float32), kind.empty((count,), wp.float32)
    _run(0, [proxy, outgoing, numbers], [wi, density], count, kind.device)
    return kind.give(wi), kind.give(density)


def pdf_proxy(proxy: Proxy, wi, wo):
    """Return p(ω_i | ω_o) [1/sr], shape [n], float32, of the kind of ``wi``; 0 below the horizon.

    Args:
        proxy: As :func:`make_proxy` returns it.
        wi: Directions to the light, shape [n, 3], any length; numpy, torch or Warp.
        wo: Directions to the viewer, shape [n, 3].

    Raises: ValueError: If a shape or device differs.
    Error: for α ≥ 0.005 at most 7e-4 relative, 1.2e-2 within three degrees of the horizon; held by
        test_pdf_matches_float64.
    """
    kind = arrays.kind_of(wi, proxy.weights.device)
    _same_device(proxy, kind, "wi")
    incoming = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
    count = incoming.shape[0]
    outgoing = arrays.take(wo, "wo", (count, 3), wp.float32, kind)
    density = kind.empty((count,), wp.float32)
    _run(1, [proxy, incoming, outgoing], [density], count, kind.device)
    return kind.give(density)


def sample_weights(value, density):
    """Return ``value`` [n, 3] over ``density`` [n], float32, of the kind of ``value``; 0 where the density is 0.

    Error: at most 2e-7 relative; held by test_weights_are_quotients.
    """
    kind = arrays.kind_of(value)
    value = arrays.take(value, "value", ("n", 3), wp.float32, kind)
    density = arrays.take(density, "density", (value.shape[0],), wp.float32, kind)
    weight = kind.empty(value.shape, wp.float32)
    _run(2, [value, density], [weight], value.shape[0], kind.device)
    return kind.give(weight)
