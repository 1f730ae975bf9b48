"""Shading of surface samples from a work list of 2×2 quads, under point lights (MobileVR §4.2).

A *sample image* says which point of the mesh each of its texels stands for: a triangle id (−1 = none) and the weights
of the triangle's second and third vertex. The atlas is one, the camera raster another, so texture-space and
screen-space shading are the same kernel. A word names a quad by its column and row and says which of its texels are
wanted (:data:`ROW_SHIFT`, :data:`MASK_SHIFT`) and at which rate (:data:`RATE_SHIFT`): at rate r, only every 2^r-th
texel each way is shaded.

A block holds the texels of 64 quads. Position, normal and the local ω_o are computed once per texel; each light adds
its share for the lanes it reaches. A light does not reach a lane that is out of its range, outside its cone, or whose
horizon it is below (:data:`LIGHT_SKIPS`); that pair costs no evaluation of the material, and a light that reaches no
lane of a block costs it one short loop. Range and cone attenuate as in KHR_lights_punctual:

    E = intensity · max(min(1 − (d / range)⁴, 1), 0) / d² · clamp(scale · cos γ + offset, 0, 1)²,

γ being the angle between the spot's axis and the direction from the light to the texel.

Radiance leaves as float16, because the gather is bound by the bytes it reads: RGB, and in A the *change* of the texel
against the radiance it overwrites, |√Y_new − √Y_old| with Y the luminance of what a display shows, clamp(gain · RGB, 0,
1). An old A below 0 says that there was none; the change is then :data:`FIRST`.

A *textured* material also gets each lane's uv and the mip level its footprint asks for (``kernels/lod.py``); the
others' kernels hold nothing of that.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.frame import frame_tangent, safe_normalize, to_local
from warp_neumat.kernels.lod import lod_of, pixel_rho2
from warp_neumat.kernels.proxy import ProxyColors, proxy_terms

ROW_SHIFT, MASK_SHIFT = 13, 26
"""A quad's word is column | row << ROW_SHIFT | wanted texels << MASK_SHIFT, so an image has at most 2¹³ quads a side.

Bit 0 of the wanted texels is the upper left one, bit 1 the upper right, bits 2 and 3 are the lower ones.
"""

COLUMN_MASK = (1 << ROW_SHIFT) - 1

RATE_SHIFT = 30
"""Rate r = 0, 1 or 2: the quad's texels are those of columns (2 · column + 0 or 1) · 2^r, and rows alike.

A textured material is then filtered r levels higher than an atlas texel asks for. Rate 2 sets the word's sign.
"""

RATE_MASK = 3

LIGHT_SKIPS = ("range", "spot", "horizon")
"""Why a light is skipped for a texel: bit k of the kernel's ``skip`` switches reason k on, counter k + 1 counts it.

A pair is counted once, under the first reason that holds and is on. With a reason off, its pairs are evaluated and
add nothing.
"""

SKIP_RANGE, SKIP_SPOT, SKIP_HORIZON = (wp.constant(1 << k) for k in range(3))

SKIP_ALL = (1 << len(LIGHT_SKIPS)) - 1

COUNTERS = 1 + len(LIGHT_SKIPS)
"""Counters per block: evaluations of the material, and the texel × light pairs skipped for each reason."""

FIRST = wp.constant(2.0)
"""Change of a texel that was never shaded before; any other is at most 1."""

HORIZON = wp.constant(0.01)
"""Least cos θ_o that is shaded [1]: interpolated normals may lean away from the viewer on a triangle that faces it."""


def words(layout, lanes: int, textured: bool) -> int:
    """Return the float32 words of scratch that the shading kernel of a material needs for one block."""
    return layout.scratch(lanes) + (43 if textured else 34) * lanes


@wp.struct
class Surface:
    """A sample image with the mesh it refers to; flat device arrays.

    The last three are read for textured materials only: texture coordinates per vertex, the gradients of
    ``kernels.lod.uv_gradient_kernel`` and the least mip level per triangle.
    """

    width: int
    triangle: wp.array(dtype=wp.int32)
    barycentric: wp.array(dtype=wp.float32)
    faces: wp.array(dtype=wp.int32)
    side: wp.array(dtype=wp.int8)
    points: wp.array(dtype=wp.float32)
    normals: wp.array(dtype=wp.float32)
    tangents: wp.array(dtype=wp.float32)
    uv: wp.array(dtype=wp.float32)
    uv_gradient: wp.array(dtype=wp.float32)
    least_lod: wp.array(dtype=wp.float32)


@wp.struct
class Viewer:
    """Where the picture is seen from: eye, unit view direction, and how a ray of view depth 1 moves over one pixel."""

    eye: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    down: wp.vec3


@wp.struct
class Lights:
    """Point lights and spots, flat arrays of [count, 3], made by :func:`make_lights`, filled by :func:`assign_lights`.

    Position [scene unit], radiant intensity [W/sr], the unit direction it shines in, and its limits: 1 / range² (0 =
    unlimited), and scale and offset of the cone (0 and 1 = no spot).
    """

    count: int
    position: wp.array(dtype=wp.float32)
    intensity: wp.array(dtype=wp.float32)
    direction: wp.array(dtype=wp.float32)
    limits: wp.array(dtype=wp.float32)


def make_lights(capacity: int, device) -> Lights:
    """Return a set of no lights with room for ``capacity``."""
    lights = Lights()
    lights.count = 0
    for name in ("position", "intensity", "direction", "limits"):
        setattr(lights, name, wp.zeros(3 * capacity, dtype=wp.float32, device=device))
    return lights


def assign_lights(lights: Lights, state) -> None:
    """Write the lights of ``state`` (``pipeline.lights.LightState``) that shine, those of intensity > 0, to the device.

    The struct is passed by value, so a recorded launch must be given it anew.

    Raises:
        ValueError: If there are more lights than there is room for.
    """
    count, capacity = len(state.position), lights.position.shape[0] // 3
    if count > capacity:
        raise ValueError(f"at most {capacity} lights were announced, got {count}")
    shining = np.asarray(state.intensity).any(axis=1)
    # Squared in float64: a range may be as small or large as float32 allows, its square not; inf gives 0.
    reach = np.minimum(1.0 / np.asarray(state.range, np.float64) ** 2, 3e38)
    limits = np.concatenate([reach[:, None], state.cones], axis=1)
    columns = {"position": state.position, "intensity": state.intensity, "direction": state.direction, "limits": limits}
    for name, values in columns.items():
        padded = np.zeros((capacity, 3), np.float32)
        padded[: shining.sum()] = np.asarray(values)[shining]
        getattr(lights, name).assign(padded.ravel())
    lights.count = int(shining.sum())


@wp.func
def local_view(v: wp.vec3, t: wp.vec3, b: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return unit ``v`` in the frame, raised to :data:`HORIZON` where it lies below."""
    w = to_local(v, t, b, n)
    z = wp.max(w[2], HORIZON)
    rest = wp.sqrt(wp.max(1.0 - z * z, 0.0) / wp.max(w[0] * w[0] + w[1] * w[1], 1.0e-12))
    low = w[2] < HORIZON
    return wp.vec3(wp.where(low, w[0] * rest, w[0]), wp.where(low, w[1] * rest, w[1]), z)


@wp.func
def raised_view(v: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return unit ``v``, raised to :data:`HORIZON` over the plane of unit ``n`` where it lies below."""
    z = wp.dot(n, v)
    flat = v - n * z
    rest = wp.sqrt((1.0 - HORIZON * HORIZON) / wp.max(wp.dot(flat, flat), 1.0e-12))
    return flat * wp.where(z < HORIZON, rest, 1.0) + n * wp.max(z, HORIZON)


@wp.func
def half_at(word: wp.uint64, channel: int) -> wp.float16:
    """Return a channel of an RGBA texel of four float16 in one word."""
    return wp.cast(wp.uint16(word >> wp.uint64(16 * channel)), wp.float16)


@wp.func
def in_word(value: wp.float16, channel: int) -> wp.uint64:
    """Return the word whose ``channel`` is ``value``, the others 0."""
    return wp.uint64(wp.cast(value, wp.uint16)) << wp.uint64(16 * channel)


@wp.func
def display_root(red: float, green: float, blue: float, gain: float) -> float:
    """Return √Y of what a display shows of a radiance: Y its luminance (Rec. 709) after gain and clamping to [0, 1]."""
    y = 0.2126 * wp.clamp(gain * red, 0.0, 1.0)
    y += 0.7152 * wp.clamp(gain * green, 0.0, 1.0)
    y += 0.0722 * wp.clamp(gain * blue, 0.0, 1.0)
    return wp.sqrt(y)


@wp.func
def renewed(old: wp.uint64, radiance: wp.vec3, unit: wp.vec3, epsilon: float, gain: float) -> wp.uint64:
    """Return the texel that takes the place of ``old``: what is stored of the radiance and, in A, its change.

    Stored is (radiance + ε) / unit. Where a texture holds radiance itself, ε is 0 and the unit 1.
    """
    r = wp.float16(wp.min((radiance[0] + epsilon) / unit[0], 65504.0))
    g = wp.float16(wp.min((radiance[1] + epsilon) / unit[1], 65504.0))
    b = wp.float16(wp.min((radiance[2] + epsilon) / unit[2], 65504.0))
    red = float(half_at(old, 0)) * unit[0] - epsilon
    green = float(half_at(old, 1)) * unit[1] - epsilon
    blue = float(half_at(old, 2)) * unit[2] - epsilon
    before = display_root(red, green, blue, gain)
    after = display_root(float(r) * unit[0] - epsilon, float(g) * unit[1] - epsilon, float(b) * unit[2] - epsilon, gain)
    a = wp.float16(wp.where(float(half_at(old, 3)) >= 0.0, wp.abs(after - before), FIRST))
    return in_word(r, 0) | in_word(g, 1) | in_word(b, 2) | in_word(a, 3)


@functools.cache
def make_shade_kernel(functions_of, layout, lanes: int, textured: bool = False):
    """Return the shading kernel of one kind of material.

    Args:
        functions_of: ``functions(layout, lanes)`` of the material's kernel file.
        layout: The material's compile-time layout.
        lanes: Lanes of a block, a multiple of 4 on the CPU; 1 on CUDA, where a block is one texel.
        textured: Which of the two sets of functions it is; see ``materials.base.Shader``.

    The kernel's arguments, beside what their structs say:

    - ``quads``, the words, ``quad_count`` of them, and ``material``, what its functions ask for;
    - ``scratch``: :func:`words` float32 per worker;
    - ``skip``: bits of the :data:`LIGHT_SKIPS` that are on; they change ``counts``, and no radiance;
    - ``gain``: what radiance is multiplied by before it is shown, for the change;
    - ``proxy``: of the material where the texture holds ratios to it (``kernels/carry.py``), else of ε 0;
    - ``radiance``: the sample image's RGBA, read and written;
    - ``counts``: :data:`COUNTERS` per block.

    Error: that of float16, at most 4.9e-4 of the radiance, and beyond it 3e-8 for radiance up to 1 of a plain BRDF;
        held by test_range_and_cone_match_float64. A material adds its own.
    """
    evaluate = functions_of(layout, lanes)
    view, light = evaluate.view, evaluate.light
    L = lanes
    # Two names, because a constant that is cast keeps the new type in the rest of the kernel.
    TOTAL = STRIDE = words(layout, lanes, textured)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def shade_kernel(
        first: int,
        slot: int,
        material: evaluate.Arguments,
        quads: wp.array(dtype=wp.int32),
        quad_count: int,
        surface: Surface,
        lights: Lights,
        viewer: Viewer,
        scratch: wp.array(dtype=wp.float32),
        skip: int,
        gain: float,
        proxy: ProxyColors,
        # outputs
        radiance: wp.array(dtype=wp.float16),
        counts: wp.array(dtype=wp.int32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        P = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)
        N = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        T = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        O = wp.array(ptr=own + wp.uint64(10 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        I = wp.array(ptr=own + wp.uint64(13 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        Y = wp.array(ptr=own + wp.uint64(16 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        E = wp.array(ptr=own + wp.uint64(19 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        R = wp.array(ptr=own + wp.uint64(22 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        address = wp.array(ptr=own + wp.uint64(25 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        active = wp.array(ptr=own + wp.uint64(26 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        chosen = wp.array(ptr=own + wp.uint64(27 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        kept = wp.array(ptr=own + wp.uint64(28 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        moved = wp.array(ptr=own + wp.uint64(29 * L) * FLOAT, shape=(L,), dtype=wp.uint64)
        S = wp.array(ptr=own + wp.uint64(31 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        own = own + wp.uint64(34 * L) * FLOAT
        if wp.static(textured):
            Q = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)  # u, v and mip level
            G = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(6 * L,), dtype=wp.float32)
            own = own + wp.uint64(9 * L) * FLOAT

        # Which texels, and what they see of the mesh: gathers, so no vector code, and none is wanted.
        for l in range(L):
            item = b * L + l
            word = quads[wp.min(item >> 2, quad_count - 1)]
            rate = (word >> RATE_SHIFT) & RATE_MASK
            x = (2 * (word & COLUMN_MASK) + (item & 1)) << rate
            y = (2 * ((word >> ROW_SHIFT) & COLUMN_MASK) + ((item >> 1) & 1)) << rate
            at = y * surface.width + x
            mine = (item >> 2) < quad_count and ((word >> (MASK_SHIFT + (item & 3))) & 1) == 1
            address[l] = at
            chosen[l] = wp.where(mine, 1.0, 0.0)
            if mine:
                f = wp.max(surface.triangle[at], 0)
                b1 = surface.barycentric[2 * at]
                b2 = surface.barycentric[2 * at + 1]
                b0 = 1.0 - b1 - b2
                i0 = surface.faces[3 * f]
                i1 = surface.faces[3 * f + 1]
                i2 = surface.faces[3 * f + 2]
                sign = wp.where(surface.side[f] < wp.int8(0), -1.0, 1.0)
                for c in range(3):
                    P[c * L + l] = (
                        b0 * surface.points[3 * i0 + c]
                        + b1 * surface.points[3 * i1 + c]
                        + b2 * surface.points[3 * i2 + c]
                    )
                    N[c * L + l] = sign * (
                        b0 * surface.normals[3 * i0 + c]
                        + b1 * surface.normals[3 * i1 + c]
                        + b2 * surface.normals[3 * i2 + c]
                    )
                    T[c * L + l] = (
                        b0 * surface.tangents[4 * i0 + c]
                        + b1 * surface.tangents[4 * i1 + c]
                        + b2 * surface.tangents[4 * i2 + c]
                    )
                T[3 * L + l] = sign * surface.tangents[4 * i0 + 3]
                if wp.static(textured):
                    for c in range(2):
                        Q[c * L + l] = (
                            b0 * surface.uv[2 * i0 + c] + b1 * surface.uv[2 * i1 + c] + b2 * surface.uv[2 * i2 + c]
                        )
                    Q[2 * L + l] = surface.least_lod[f] + float(rate)
                    for c in range(6):
                        G[c * L + l] = surface.uv_gradient[6 * f + c]
            else:
                for c in range(3):
                    P[c * L + l] = 0.0
                    N[c * L + l] = wp.where(c == 2, 1.0, 0.0)
                    T[c * L + l] = wp.where(c == 0, 1.0, 0.0)
                T[3 * L + l] = 1.0
                if wp.static(textured):
                    for c in range(3):
                        Q[c * L + l] = 0.0
                    for c in range(6):
                        G[c * L + l] = 0.0

        for l in range(L):
            n = safe_normalize(wp.vec3(N[l], N[L + l], N[2 * L + l]))
            t = frame_tangent(n, wp.vec3(T[l], T[L + l], T[2 * L + l]))
            s = wp.cross(n, t) * T[3 * L + l]
            v = safe_normalize(viewer.eye - wp.vec3(P[l], P[L + l], P[2 * L + l]))
            o = local_view(v, t, s, n)
            N[l] = n[0]
            N[L + l] = n[1]
            N[2 * L + l] = n[2]
            T[l] = t[0]
            T[L + l] = t[1]
            T[2 * L + l] = t[2]
            O[l] = o[0]
            O[L + l] = o[1]
            O[2 * L + l] = o[2]
        if wp.static(textured):
            for l in range(L):
                to = wp.vec3(P[l], P[L + l], P[2 * L + l]) - viewer.eye
                gu = wp.vec3(G[l], G[L + l], G[2 * L + l])
                gv = wp.vec3(G[3 * L + l], G[4 * L + l], G[5 * L + l])
                rho2 = pixel_rho2(to, wp.dot(to, viewer.forward), viewer.right, viewer.down, gu, gv)
                Q[2 * L + l] = wp.max(Q[2 * L + l], lod_of(rho2))
        for l in range(3 * L):
            R[l] = 0.0
            Y[l] = 0.0
            S[l] = wp.where(proxy.epsilon > 0.0, proxy.epsilon, 1.0)

        wanted = int(0)
        for l in range(L):
            if chosen[l] > 0.0:
                active[wanted] = l
                wanted += 1
        if wp.static(textured):
            view(material, Q, O, active, wanted, own, R)
        else:
            view(material, O, active, wanted, own)
        # A reason that is switched off has a limit that no lane breaks.
        reach = wp.where((skip & SKIP_RANGE) != 0, 1.0, 3.0e38)
        edge = wp.where((skip & SKIP_SPOT) != 0, 0.0, -3.0e38)
        floor = wp.where((skip & SKIP_HORIZON) != 0, 0.0, -3.0e38)
        below = wp.where((skip & SKIP_HORIZON) != 0, 0.0, 1.0)
        total = int(0)
        far = int(0)
        outside = int(0)
        for j in range(lights.count):
            source = wp.vec3(lights.position[3 * j], lights.position[3 * j + 1], lights.position[3 * j + 2])
            power = wp.vec3(lights.intensity[3 * j], lights.intensity[3 * j + 1], lights.intensity[3 * j + 2])
            axis = wp.vec3(lights.direction[3 * j], lights.direction[3 * j + 1], lights.direction[3 * j + 2])
            inverse = lights.limits[3 * j]
            scale = lights.limits[3 * j + 1]
            offset = lights.limits[3 * j + 2]
            # Who is reached comes first, because a light that reaches no lane is then nearly free. E is what is left
            # of the light there, without cosine and distance; `kept` says whose material is asked.
            reached = int(0)
            if inverse > 0.0 or scale > 0.0:
                for l in range(L):
                    d = source - wp.vec3(P[l], P[L + l], P[2 * L + l])
                    z = wp.dot(wp.vec3(N[l], N[L + l], N[2 * L + l]), d)
                    d2 = wp.dot(d, d)
                    q = d2 * inverse
                    cone = offset - scale * wp.dot(d, axis) / wp.sqrt(wp.max(d2, 1.0e-24))
                    near = q < reach and chosen[l] > 0.0
                    inside = near and cone > edge
                    keep = inside and z > floor
                    far += wp.where(chosen[l] > 0.0 and not near, 1, 0)
                    outside += wp.where(near and not inside, 1, 0)
                    reached += wp.where(keep, 1, 0)
                    angular = wp.clamp(cone, 0.0, 1.0)
                    kept[l] = wp.where(keep, 1.0, 0.0)
                    E[l] = wp.where(keep and z > 0.0, wp.max(1.0 - q * q, 0.0) * angular * angular, 0.0)
            else:
                for l in range(L):
                    d = source - wp.vec3(P[l], P[L + l], P[2 * L + l])
                    z = wp.dot(wp.vec3(N[l], N[L + l], N[2 * L + l]), d)
                    above = wp.where(z * chosen[l] > 0.0, 1.0, 0.0)
                    keep_it = wp.max(above, below * chosen[l])
                    reached += wp.where(keep_it > 0.0, 1, 0)
                    kept[l] = keep_it
                    E[l] = above
            total += reached
            if reached > 0 and proxy.epsilon > 0.0:
                for l in range(L):
                    p = wp.vec3(P[l], P[L + l], P[2 * L + l])
                    n = wp.vec3(N[l], N[L + l], N[2 * L + l])
                    d = source - p
                    v = raised_view(safe_normalize(viewer.eye - p), n)
                    k = proxy_terms(proxy.alpha2, n, safe_normalize(d), v)
                    k = k * (E[l] / wp.max(wp.dot(d, d), 1.0e-12))
                    for c in range(3):
                        value = proxy.diffuse[c] * k[0] + proxy.specular[c] * k[1] + proxy.grazing[c] * k[2]
                        S[c * L + l] = S[c * L + l] + power[c] * value
            if reached > 0:
                for l in range(L):
                    n = wp.vec3(N[l], N[L + l], N[2 * L + l])
                    t = wp.vec3(T[l], T[L + l], T[2 * L + l])
                    s = wp.cross(n, t) * T[3 * L + l]
                    d = source - wp.vec3(P[l], P[L + l], P[2 * L + l])
                    w = to_local(safe_normalize(d), t, s, n)
                    # Inverse square; within a millionth of the unit of length the light is inside the surface.
                    e = E[l] / wp.max(wp.dot(d, d), 1.0e-12)
                    if wp.static(not textured):  # else the cosine is that of the map's normal, known to the material
                        e = e * wp.max(w[2], 0.0)
                    I[l] = w[0]
                    I[L + l] = w[1]
                    # Mirrored where it is below and asked for all the same: the material is owed a unit vector above.
                    I[2 * L + l] = wp.max(wp.abs(w[2]), 1.0e-7)
                    E[l] = e * power[0]
                    E[L + l] = e * power[1]
                    E[2 * L + l] = e * power[2]
                lit = int(0)
                for l in range(L):
                    # Written in any case and kept if counted: a branch would be mispredicted often.
                    active[lit] = l
                    lit += wp.where(kept[l] > 0.0, 1, 0)
                light(material, I, active, lit, own, Y)
                for l in range(3 * L):
                    R[l] = R[l] + E[l] * Y[l]

        texels = wp.array(ptr=radiance.ptr, shape=(1 << 28,), dtype=wp.uint64)
        if wp.static(L == 1):
            if chosen[0] > 0.0:
                texels[address[0]] = renewed(
                    texels[address[0]], wp.vec3(R[0], R[1], R[2]), wp.vec3(S[0], S[1], S[2]), proxy.epsilon, gain
                )
        else:
            for l in range(L):
                moved[l] = texels[wp.where(chosen[l] > 0.0, address[l], 0)]
            for l in range(L):
                radiant = wp.vec3(R[l], R[L + l], R[2 * L + l])
                unit = wp.vec3(S[l], S[L + l], S[2 * L + l])
                moved[l] = renewed(moved[l], radiant, unit, proxy.epsilon, gain)
            for l in range(L):
                if chosen[l] > 0.0:
                    texels[address[l]] = moved[l]
        counts[COUNTERS * b] = total
        counts[COUNTERS * b + 1] = far
        counts[COUNTERS * b + 2] = outside
        counts[COUNTERS * b + 3] = wanted * lights.count - total - far - outside

    return shade_kernel
