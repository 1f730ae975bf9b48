"""Tangent frames, half vectors and the local directions that materials are evaluated in (docs/conventions.md)."""

import functools

import warp as wp

from warp_neumat.kernels import arrays, dispatch

wp.set_module_options(dispatch.module_options())


@wp.func
def safe_normalize(v: wp.vec3) -> wp.vec3:
    """Return ``v`` at unit length, also where its square leaves float32's range; +z where it is 0, infinite or NaN."""
    big = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))
    # max() passes over a NaN, so each component is compared with itself.
    usable = big > 0.0 and big <= 3.4028235e38 and v[0] == v[0] and v[1] == v[1] and v[2] == v[2]
    scale = wp.where(big < 1.2e-38, 8.5e37, 1.0 / wp.max(big, 1.2e-38))
    s = v * scale
    n = s / wp.sqrt(wp.max(wp.dot(s, s), 1.0e-30))
    # Components are selected one by one: a vector select would not become a blend in a lane loop.
    return wp.vec3(wp.where(usable, n[0], 0.0), wp.where(usable, n[1], 0.0), wp.where(usable, n[2], 1.0))


@wp.func
def tangent_of(n: wp.vec3) -> wp.vec3:
    """Return a unit tangent of the unit normal ``n``, smooth but at the sign change of its z.

    Duff et al. 2017, Building an Orthonormal Basis, Revisited, Listing 3.
    """
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def frame_tangent(n: wp.vec3, t: wp.vec3) -> wp.vec3:
    """Return ``t`` made orthogonal to the unit normal ``n``, at unit length; any tangent of ``n`` where it vanishes."""
    p = t - n * wp.dot(n, t)
    length2 = wp.dot(p, p)
    usable = length2 > 1.0e-12
    q = p / wp.sqrt(wp.max(length2, 1.0e-12))
    r = tangent_of(n)
    return wp.vec3(wp.where(usable, q[0], r[0]), wp.where(usable, q[1], r[1]), wp.where(usable, q[2], r[2]))


@wp.func
def to_local(v: wp.vec3, t: wp.vec3, b: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return the components of ``v`` in the frame (tangent, bitangent, normal)."""
    return wp.vec3(wp.dot(v, t), wp.dot(v, b), wp.dot(v, n))


@wp.func
def half_vector(wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """Return the unit vector half-way between unit ``wi`` and ``wo``; +z where they are opposite."""
    s = wi + wo
    length2 = wp.dot(s, s)
    usable = length2 > 1.0e-12
    h = s / wp.sqrt(wp.max(length2, 1.0e-12))
    return wp.vec3(wp.where(usable, h[0], 0.0), wp.where(usable, h[1], 0.0), wp.where(usable, h[2], 1.0))


@functools.cache
def _make_kernels(lanes: int):
    L = lanes
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel
    def half_kernel(
        first: int,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        h: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        I = wp.array(ptr=wi.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=wo.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        H = wp.array(ptr=h.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                v = half_vector(
                    wp.vec3(I[3 * l], I[3 * l + 1], I[3 * l + 2]), wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2])
                )
                H[3 * l] = v[0]
                H[3 * l + 1] = v[1]
                H[3 * l + 2] = v[2]

    @wp.kernel
    def frame_kernel(
        first: int,
        normal: wp.array(dtype=wp.float32),
        tangent: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        frame: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        N = wp.array(ptr=normal.ptr + wp.uint64(b) * wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        T = wp.array(ptr=tangent.ptr + wp.uint64(b) * wp.uint64(4 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        F = wp.array(ptr=frame.ptr + wp.uint64(b) * wp.uint64(9 * L) * FLOAT, shape=(9 * L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                n = safe_normalize(wp.vec3(N[3 * l], N[3 * l + 1], N[3 * l + 2]))
                t = frame_tangent(n, wp.vec3(T[4 * l], T[4 * l + 1], T[4 * l + 2]))
                s = wp.cross(n, t) * T[4 * l + 3]
                F[9 * l] = t[0]
                F[9 * l + 1] = t[1]
                F[9 * l + 2] = t[2]
                F[9 * l + 3] = s[0]
                F[9 * l + 4] = s[1]
                F[9 * l + 5] = s[2]
                F[9 * l + 6] = n[0]
                F[9 * l + 7] = n[1]
                F[9 * l + 8] = n[2]

    return half_kernel, frame_kernel


def half_vectors(wi, wo):
    """Return the unit half vectors of pairs of unit directions.

    Args:
        wi: Directions to the light, shape [n, 3], float32; numpy, torch or Warp.
        wo: Directions to the viewer, shape [n, 3].

    Returns: Shape [n, 3]; (0, 0, 1) where a pair is opposite to within 1e-6.
    Raises: ValueError: If a shape or device differs.
    Error: at most 4e-7 per component where |wi + wo| > 0.1; held by test_half_vectors_match_float64.
    """
    kind = arrays.kind_of(wi)
    a = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
    b = arrays.take(wo, "wo", (a.shape[0], 3), wp.float32, kind)
    out, lanes = kind.empty(a.shape, wp.float32), dispatch.lanes(kind.device)
    kernel = _make_kernels(lanes)[0]
    count = a.shape[0]
    if count == 0:  # Warp does not flatten an empty array
        return kind.give(out)
    dispatch.launch(
        kernel,
        dispatch.blocks(count, lanes),
        inputs=[a.flatten(), b.flatten(), count],
        outputs=[out.flatten()],
        device=kind.device,
    )
    return kind.give(out)


def tangent_frames(normals, tangents):
    """Return orthonormal frames from normals and glTF tangents.

    Args:
        normals: Shading normals of any length, shape [n, 3], float32; numpy, torch or Warp.
        tangents: Tangents with the handedness ±1 as fourth component, shape [n, 4].

    Returns: Frames with rows tangent, bitangent = cross(normal, tangent) · handedness, normal; shape [n, 3, 3]. Where
        the tangent is parallel to the normal or zero, some tangent is chosen; where the normal is zero or NaN, +z.
    Raises: ValueError: If a shape or device differs.
    Error: at most 2e-6 per component where tangent and normal are 0.1 rad apart or more; held by
        test_tangent_frames_match_float64.
    """
    kind = arrays.kind_of(normals)
    n = arrays.take(normals, "normals", ("n", 3), wp.float32, kind)
    t = arrays.take(tangents, "tangents", (n.shape[0], 4), wp.float32, kind)
    out, lanes = kind.empty((n.shape[0], 3, 3), wp.float32), dispatch.lanes(kind.device)
    count = n.shape[0]
    if count == 0:
        return kind.give(out)
    dispatch.launch(
        _make_kernels(lanes)[1],
        dispatch.blocks(count, lanes),
        inputs=[n.flatten(), t.flatten(), count],
        outputs=[out.flatten()],
        device=kind.device,
    )
    return kind.give(out)
