"""Which mip level a sample needs (paper [bcf], Eq. 11): the footprint of a pixel or an atlas texel in a material's uv.

A level is counted in texels of the reference material, W × H: a footprint whose larger axis spans ρ of its texels
needs level log₂ ρ. Filtering is isotropic, so ρ is the longer of the two derivatives, as OpenGL has it:

    ρ = max(|∂q/∂x|, |∂q/∂y|),    q = (u W, v H).

**Of a pixel.** A triangle has one gradient of q over its plane, rows g_u and g_v [texel/scene unit], found once an
epoch. A step of a pixel moves the ray by X [at view depth 1] and its point, with e the vector from the eye to it and n
the triangle's normal, by

    ∂p/∂x = depth · (X − e (n·X)/(n·e)),    ∂q/∂x = (g_u·∂p/∂x, g_v·∂p/∂x),

which is exact for the plane, at any angle, anywhere in the picture. n is g_u × g_v: its length does not matter.

**Of an atlas texel.** The atlas maps a triangle's corners affinely, so the level is one constant per triangle, known
before the first frame (:func:`atlas_lod`).

In texture space a sample takes the larger level of the two: the texture must neither hold what the atlas cannot store
nor what the picture, which fetches one point per pixel, cannot show.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch

wp.set_module_options(dispatch.module_options())

LOD_RANGE = wp.constant(32.0)
"""Levels are kept in ±32: beyond, a footprint is a point or everything."""

NO_LOD = -32.0
"""Level of a footprint that is a point."""


@wp.func
def log2(x: float) -> float:
    """Return log₂ x for normal positive x, by its exponent and a polynomial of its mantissa.

    Error: at most 4e-6; held by test_log2_matches_float64.
    """
    bits = wp.cast(x, wp.int32)
    exponent = (bits >> 23) - 127
    f = wp.cast((bits & 0x7FFFFF) | 0x3F800000, wp.float32) - 1.0
    # Least largest error of f · p over [0, 1] with p(1) = 1, degree 6, by Lawson's iteration: no step at powers of two.
    p = -2.58414369e-2
    p = p * f + 0.121797871
    p = p * f - 0.2779053
    p = p * f + 0.457549174
    p = p * f - 0.718145252
    p = p * f + 1.442544943
    return float(exponent) + p * f


@wp.func
def lod_of(rho2: float) -> float:
    """Return log₂ ρ for ρ², within ±:data:`LOD_RANGE`."""
    return wp.clamp(0.5 * log2(wp.clamp(rho2, 1.0e-37, 1.0e37)), -LOD_RANGE, LOD_RANGE)


@wp.func
def pixel_rho2(to: wp.vec3, depth: float, right: wp.vec3, down: wp.vec3, gu: wp.vec3, gv: wp.vec3) -> float:
    """Return ρ² of a pixel.

    Args:
        to: Vector from the eye to the point.
        depth: View depth of the point.
        right, down: How a ray of view depth 1 moves over one pixel.
        gu, gv: Gradients of u W and v H over the triangle's plane.
    """
    n = wp.cross(gu, gv)
    facing = wp.dot(n, to)
    # Edge-on, the footprint is endless; a triangle whose uv is a line or a point has no n, and is seen face-on.
    scale = wp.where(wp.abs(facing) > 1.0e-30, 1.0 / facing, 0.0)
    px = depth * (right - to * (wp.dot(n, right) * scale))
    py = depth * (down - to * (wp.dot(n, down) * scale))
    ux = wp.dot(gu, px)
    vx = wp.dot(gv, px)
    uy = wp.dot(gu, py)
    vy = wp.dot(gv, py)
    return wp.max(ux * ux + vx * vx, uy * uy + vy * vy)


@wp.kernel
def uv_gradient_kernel(
    first: int,
    faces: wp.array(dtype=wp.int32),
    face_count: int,
    texels: wp.array(dtype=wp.float32),
    uv: wp.array(dtype=wp.float32),
    points: wp.array(dtype=wp.float32),
    side: wp.array(dtype=wp.int8),
    per_block: int,
    # outputs
    gradient: wp.array(dtype=wp.float32),
):
    """Write g_u and g_v, 6 numbers, of every triangle that faces the eye; 0 where uv or area is degenerate.

    ``texels`` [F, 2] holds W and H of each face's reference material.
    """
    b = first + wp.tid()
    for f in range(b * per_block, wp.min((b + 1) * per_block, face_count)):
        if side[f] == wp.int8(0):
            continue
        i0 = faces[3 * f]
        i1 = faces[3 * f + 1]
        i2 = faces[3 * f + 2]
        p = wp.vec3(points[3 * i0], points[3 * i0 + 1], points[3 * i0 + 2])
        a = wp.vec3(points[3 * i1], points[3 * i1 + 1], points[3 * i1 + 2]) - p
        c = wp.vec3(points[3 * i2], points[3 * i2 + 1], points[3 * i2 + 2]) - p
        n = wp.cross(a, c)
        n2 = wp.dot(n, n)
        scale = wp.where(n2 > 1.0e-36, 1.0 / n2, 0.0)
        # Dual vectors of the edges: a·ra = 1, c·ra = 0, and the reverse.
        ra = wp.cross(c, n) * scale
        rc = wp.cross(n, a) * scale
        for k in range(2):
            g = texels[2 * f + k] * (ra * (uv[2 * i1 + k] - uv[2 * i0 + k]) + rc * (uv[2 * i2 + k] - uv[2 * i0 + k]))
            for d in range(3):
                gradient[6 * f + 3 * k + d] = g[d]


def atlas_lod(corner_uv, uv, faces, texels) -> np.ndarray:
    """Return the level of an atlas texel of each triangle, shape [F], float32.

    Args:
        corner_uv: Corners on the atlas [texel], shape [F, 3, 2].
        uv: Texture coordinates of the vertices, shape [V, 2].
        faces: Vertices of the triangles, shape [F, 3].
        texels: W and H of each triangle's reference material, shape [F, 2].

    Degenerate triangles of the atlas have level :data:`NO_LOD`.
    """
    corner = np.asarray(corner_uv, np.float64)
    q = np.asarray(uv, np.float64)[np.asarray(faces)] * np.asarray(texels, np.float64)[:, None]
    (ax, ay), (cx, cy) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
    a, c = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    area = ax * cy - ay * cx
    good = (np.abs(area) > 1e-9) & np.isfinite(q).all(axis=(1, 2))
    area = np.where(good, area, 1.0)[:, None]
    dx = (a * cy[:, None] - c * ay[:, None]) / area
    dy = (c * ax[:, None] - a * cx[:, None]) / area
    rho2 = np.maximum((dx**2).sum(1), (dy**2).sum(1))
    lod = 0.5 * np.log2(np.maximum(np.where(good, rho2, 0.0), 2.0 ** (2 * NO_LOD)))
    return np.clip(lod, NO_LOD, -NO_LOD).astype(np.float32)
