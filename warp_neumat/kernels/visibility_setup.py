"""Triangle setup of the camera raster: projected vertices, bounds in pixels, and edge functions about a tile's middle.

Homogeneous rasterisation (Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997): with
pixel coordinates (X/w, Y/w) and p_i = (X_i, Y_i, w_i), edge i has the coefficients p_j × p_k, and a pixel centre is
covered where all three edge functions E_i are ≥ 0. Their sum is det/w, so E_i / ΣE is the perspective-correct weight
of vertex i, and no triangle is ever clipped: those that cross the near plane are cut per pixel by 1/w.

Vertices are projected in float64. Edges are set up in float64 about the middle of a tile and evaluated in float32, so
a pixel is placed to 4e-6 of its width wherever it lies in the picture. Both triangles at an edge compute it from the
higher to the lower vertex index and sign it, which makes their values exact negatives of each other: a mesh has no
holes, whatever the rounding.
"""

import functools

import warp as wp

from .dispatch import module_options

__all__ = ["BITS", "TILE", "bounds_of", "make_project", "planes"]

wp.set_module_options(module_options())

BITS = 6
TILE = 1 << BITS
"""Side of a tile [px], whose middle is the origin of edge functions: larger loses precision, smaller repeats setups."""

_MARGIN = 1.0 / 1024.0  # [px] added to bounds: far more than their rounding, far less than a pixel


@functools.cache
def make_project(lanes: int):
    """Points (V, 3) → (X, Y, w, 1/w) in pixels, float64."""
    L = lanes

    @wp.func
    def project(x: wp.float64, y: wp.float64, z: wp.float64, m: wp.mat44d):
        one = wp.float64(1.0)
        w = m[3, 0] * x + m[3, 1] * y + m[3, 2] * z + m[3, 3]
        px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        return wp.vec4d(px, py, w, one / w)

    @wp.kernel
    def project_kernel(
        first: int, points: wp.array(dtype=wp.float32), m: wp.mat44d, n: int, projected: wp.array(dtype=wp.vec4d)
    ):
        b = first + wp.tid()
        P = wp.array(ptr=points.ptr + wp.uint64(b) * wp.uint64(L * 12), shape=(L * 3,), dtype=wp.float32)
        Q = wp.array(ptr=projected.ptr + wp.uint64(b) * wp.uint64(L * 32), shape=(L,), dtype=wp.vec4d)
        if (b + 1) * L <= n:
            for l in range(L):
                Q[l] = project(wp.float64(P[3 * l]), wp.float64(P[3 * l + 1]), wp.float64(P[3 * l + 2]), m)
        else:
            for l in range(L):
                if b * L + l < n:
                    Q[l] = project(wp.float64(P[3 * l]), wp.float64(P[3 * l + 1]), wp.float64(P[3 * l + 2]), m)

    return project_kernel


@wp.func
def _grow(box: wp.vec4d, x: wp.float64, y: wp.float64):
    return wp.vec4d(wp.min(box[0], x), wp.min(box[1], y), wp.max(box[2], x), wp.max(box[3], y))


@wp.func
def _grow_edge(box: wp.vec4d, p: wp.vec4d, q: wp.vec4d, near: wp.float64):
    """Grow a box by p, if it is beyond the near plane, and by the point where p q crosses it, if it does."""
    if p[2] >= near:
        box = _grow(box, p[0] * p[3], p[1] * p[3])
    if (p[2] < near) != (q[2] < near):
        t = (near - p[2]) / (q[2] - p[2])
        box = _grow(box, (p[0] + t * (q[0] - p[0])) / near, (p[1] + t * (q[1] - p[1])) / near)
    return box


@wp.func
def bounds_of(p0: wp.vec4d, p1: wp.vec4d, p2: wp.vec4d, sided: wp.uint8, near: wp.float64, width: int, height: int):
    """x0, y0, x1, y1 [px] of all pixels whose centre the triangle may cover; x0 > x1 if there are none."""
    nothing = wp.vec4s(wp.int16(1), wp.int16(1), wp.int16(0), wp.int16(0))
    total = p0[0] + p0[1] + p0[2] + p1[0] + p1[1] + p1[2] + p2[0] + p2[1] + p2[2]
    if total - total != wp.float64(0.0):  # a NaN or an infinity somewhere
        return nothing
    half = wp.float64(0.5)
    margin = wp.float64(_MARGIN)
    box = wp.vec4d()
    if wp.min(wp.min(p0[2], p1[2]), p2[2]) >= near:
        x0 = p0[0] * p0[3]
        y0 = p0[1] * p0[3]
        x1 = p1[0] * p1[3]
        y1 = p1[1] * p1[3]
        x2 = p2[0] * p2[3]
        y2 = p2[1] * p2[3]
        box = wp.vec4d(
            wp.min(wp.min(x0, x1), x2),
            wp.min(wp.min(y0, y1), y2),
            wp.max(wp.max(x0, x1), x2),
            wp.max(wp.max(y0, y1), y2),
        )
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        # Surely seen from behind; what is nearly edge-on is decided when it is drawn.
        if sided == wp.uint8(0) and area > margin * (box[2] - box[0] + box[3] - box[1]):
            return nothing
    else:
        if wp.max(wp.max(p0[2], p1[2]), p2[2]) < near:
            return nothing
        huge = wp.float64(1.0e300)
        box = wp.vec4d(huge, huge, -huge, -huge)
        box = _grow_edge(box, p0, p1, near)
        box = _grow_edge(box, p1, p2, near)
        box = _grow_edge(box, p2, p0, near)
    # Clamped as floating point first: coordinates may be far beyond what an integer holds.
    zero = wp.float64(0.0)
    bx0 = wp.ceil(wp.clamp(box[0] - half - margin, zero, wp.float64(width)))
    by0 = wp.ceil(wp.clamp(box[1] - half - margin, zero, wp.float64(height)))
    bx1 = wp.floor(wp.clamp(box[2] - half + margin, -half, wp.float64(width - 1)))
    by1 = wp.floor(wp.clamp(box[3] - half + margin, -half, wp.float64(height - 1)))
    if bx0 > bx1 or by0 > by1:
        return nothing
    return wp.vec4s(wp.int16(bx0), wp.int16(by0), wp.int16(bx1), wp.int16(by1))


@wp.func
def planes(
    p0: wp.vec4d, p1: wp.vec4d, p2: wp.vec4d, i0: int, i1: int, i2: int, ox: wp.float64, oy: wp.float64, sided: wp.uint8
):
    """Rows a, b, c of the three edge functions and of 1/w about (ox, oy); c = −1 throughout if nothing is drawn."""
    q0 = wp.vec3d(p0[0] - ox * p0[2], p0[1] - oy * p0[2], p0[2])
    q1 = wp.vec3d(p1[0] - ox * p1[2], p1[1] - oy * p1[2], p1[2])
    q2 = wp.vec3d(p2[0] - ox * p2[2], p2[1] - oy * p2[2], p2[2])
    # Always from the higher to the lower vertex, then signed: the neighbour's edge is the exact negative.
    e0 = wp.where(i1 > i2, -wp.cross(q1, q2), wp.cross(q2, q1))
    e1 = wp.where(i2 > i0, -wp.cross(q2, q0), wp.cross(q0, q2))
    e2 = wp.where(i0 > i1, -wp.cross(q0, q1), wp.cross(q1, q0))
    det = wp.dot(q0, e0)
    zero = wp.float64(0.0)
    if det < zero and sided != wp.uint8(0):
        det = -det
        e0 = -e0
        e1 = -e1
        e2 = -e2
    if not (det > wp.float64(1.0e-280) and det < wp.float64(1.0e280)):
        return wp.matrix_from_rows(wp.vec4f(), wp.vec4f(), wp.vec4f(-1.0, -1.0, -1.0, -1.0))
    q = (e0 + e1 + e2) / det
    scale = wp.pow(wp.float64(2.0), -wp.floor(wp.log2(det)))
    e0 = e0 * scale
    e1 = e1 * scale
    e2 = e2 * scale
    return wp.matrix_from_rows(
        wp.vec4f(float(e0[0]), float(e1[0]), float(e2[0]), float(q[0])),
        wp.vec4f(float(e0[1]), float(e1[1]), float(e2[1]), float(q[1])),
        wp.vec4f(float(e0[2]), float(e1[2]), float(e2[2]), float(q[2])),
    )
