"""Shading of surface samples from a work list of 2×2 quads, under point lights (MobileVR §4.2).

A *sample image* says which point of the mesh each of its texels stands for: a triangle id (−1 = none) and the weights
of the triangle's second and third vertex. The atlas is one, the camera raster another, so texture-space and
screen-space shading are the same kernel. A word names a quad by its column and row and says which of its texels are
wanted (:data:`ROW_SHIFT`, :data:`MASK_SHIFT`).

A block holds the texels of 64 quads. Position, normal and the local ω_o are computed once per texel; each light adds
its share for the lanes it reaches, and a light below a lane's horizon costs that lane nothing. Radiance leaves as
float16, RGB and coverage, because the gather is bound by the bytes it reads.

A *textured* material also gets each lane's uv and the mip level its footprint asks for (``kernels/lod.py``); the
others' kernels hold nothing of that.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.frame import frame_tangent, safe_normalize, to_local
from warp_neumat.kernels.lod import lod_of, pixel_rho2

ROW_SHIFT, MASK_SHIFT = 13, 26
"""A quad's word is column | row << ROW_SHIFT | wanted texels << MASK_SHIFT, so an image has at most 2¹³ quads a side.

Bit 0 of the wanted texels is the upper left one, bit 1 the upper right, bits 2 and 3 are the lower ones.
"""

COLUMN_MASK = (1 << ROW_SHIFT) - 1

HORIZON = wp.constant(0.01)
"""Least cos θ_o that is shaded [1]: interpolated normals may lean away from the viewer on a triangle that faces it."""


def words(layout, lanes: int, textured: bool) -> int:
    """Return the float32 words of scratch that the shading kernel of a material needs for one block."""
    return layout.scratch(lanes) + (37 if textured else 28) * lanes


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
    """Point lights: position [m] and radiant intensity [W/sr], both [count, 3], flat."""

    count: int
    position: wp.array(dtype=wp.float32)
    intensity: wp.array(dtype=wp.float32)


@wp.func
def local_view(v: wp.vec3, t: wp.vec3, b: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return unit ``v`` in the frame, raised to :data:`HORIZON` where it lies below."""
    w = to_local(v, t, b, n)
    z = wp.max(w[2], HORIZON)
    rest = wp.sqrt(wp.max(1.0 - z * z, 0.0) / wp.max(w[0] * w[0] + w[1] * w[1], 1.0e-12))
    low = w[2] < HORIZON
    return wp.vec3(wp.where(low, w[0] * rest, w[0]), wp.where(low, w[1] * rest, w[1]), z)


@functools.cache
def make_shade_kernel(functions_of, layout, lanes: int, textured: bool = False):
    """Return the shading kernel of one kind of material.

    Args:
        functions_of: ``functions(layout, lanes)`` of the material's kernel file.
        layout: The material's compile-time layout.
        lanes: Lanes of a block, a multiple of 4 on the CPU; 1 on CUDA, where a block is one texel.
        textured: Which of the two sets of functions it is; see ``materials.base.Shader``.
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
        # outputs
        radiance: wp.array(dtype=wp.float16),
        evaluations: wp.array(dtype=wp.int32),
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
        own = own + wp.uint64(28 * L) * FLOAT
        if wp.static(textured):
            Q = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)  # u, v and mip level
            G = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(6 * L,), dtype=wp.float32)
            own = own + wp.uint64(9 * L) * FLOAT

        # Which texels, and what they see of the mesh: gathers, so no vector code, and none is wanted.
        for l in range(L):
            item = b * L + l
            word = quads[wp.min(item >> 2, quad_count - 1)]
            x = 2 * (word & COLUMN_MASK) + (item & 1)
            y = 2 * ((word >> ROW_SHIFT) & COLUMN_MASK) + ((item >> 1) & 1)
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
                    Q[2 * L + l] = surface.least_lod[f]
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

        wanted = int(0)
        for l in range(L):
            if chosen[l] > 0.0:
                active[wanted] = l
                wanted += 1
        if wp.static(textured):
            view(material, Q, O, active, wanted, own, R)
        else:
            view(material, O, active, wanted, own)
        total = int(0)
        for j in range(lights.count):
            source = wp.vec3(lights.position[3 * j], lights.position[3 * j + 1], lights.position[3 * j + 2])
            power = wp.vec3(lights.intensity[3 * j], lights.intensity[3 * j + 1], lights.intensity[3 * j + 2])
            facing = int(0)  # first, because a light behind all lanes is then nearly free
            for l in range(L):
                d = source - wp.vec3(P[l], P[L + l], P[2 * L + l])
                z = wp.dot(wp.vec3(N[l], N[L + l], N[2 * L + l]), d)
                facing += wp.where(z * chosen[l] > 0.0, 1, 0)
            lit = int(0)
            if facing > 0:
                for l in range(L):
                    n = wp.vec3(N[l], N[L + l], N[2 * L + l])
                    t = wp.vec3(T[l], T[L + l], T[2 * L + l])
                    s = wp.cross(n, t) * T[3 * L + l]
                    d = source - wp.vec3(P[l], P[L + l], P[2 * L + l])
                    w = to_local(safe_normalize(d), t, s, n)
                    # Inverse square; within a millionth of the unit of length the light is inside the surface.
                    gain = wp.max(w[2], 0.0)
                    if wp.static(textured):  # the cosine is that of the map's normal, which the material knows
                        gain = wp.where(w[2] > 0.0, 1.0, 0.0)
                    e = chosen[l] * gain / wp.max(wp.dot(d, d), 1.0e-12)
                    I[l] = w[0]
                    I[L + l] = w[1]
                    I[2 * L + l] = wp.max(w[2], 0.0)
                    E[l] = e * power[0]
                    E[L + l] = e * power[1]
                    E[2 * L + l] = e * power[2]
                for l in range(L):
                    if E[l] + E[L + l] + E[2 * L + l] > 0.0:
                        active[lit] = l
                        lit += 1
                if lit > 0:
                    light(material, I, active, lit, own, Y)
                    for l in range(3 * L):
                        R[l] = R[l] + E[l] * Y[l]
            total += lit
        for l in range(L):
            if chosen[l] > 0.0:
                at = 4 * address[l]
                for c in range(3):
                    radiance[at + c] = wp.float16(wp.min(R[c * L + l], 65504.0))
                radiance[at + 3] = wp.float16(1.0)
        evaluations[b] = total

    return shade_kernel
