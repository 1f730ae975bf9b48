"""Camera raster: which triangle each pixel sees, where on it, and how far away.

Homogeneous rasterisation (Olano and Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997): with pixel
coordinates (X/w, Y/w) and p_i = (X_i, Y_i, w_i), edge i has the coefficients p_j × p_k, and a pixel centre is covered where
all three edge functions E_i are ≥ 0. Their sum is det/w, so E_i / ΣE is the perspective-correct weight of vertex i, and no
triangle is ever clipped: those that cross the near plane are cut per pixel by 1/w.

Precision. Vertices are projected in float64. Within a tile of pixels, edges are set up in float64 about the tile's middle
and evaluated in float32, so a pixel is placed to 4e-6 of its width wherever it lies in the picture. Both triangles at an
edge compute it from the lower to the higher vertex index and flip its sign, which makes their values exact negatives of
each other: a mesh has no holes, whatever the rounding.

On the CPU, triangles are binned into tiles of a hierarchical grid (a triangle lives at the level where it spans at most
2 × 2 cells, so the lists have a fixed size), by count, scan and fill over groups of triangles; then each worker draws whole
tiles in a cache-sized scratch of its own and writes each pixel once. Tiles that were empty and stay empty are not touched.
On CUDA, one thread per triangle takes the minimum of 64-bit keys (depth, triangle) and one per pixel resolves them.

Pixels: row 0 on top, (x, y) is centred at (x + 0.5, y + 0.5). Clip space: docs/conventions.md.
"""

import functools
import math

import numpy as np
import warp as wp

from .arrays import Kind, take
from .dispatch import Job, blocks, lanes, module_options, worker_count

__all__ = ["MAX_SIZE", "CameraRaster", "depth_range", "pixel_matrix"]

wp.set_module_options(module_options())

MAX_SIZE = 32767
"""Largest width and height [px]: bounds are stored in 16 bits."""

_BITS = 6
_TILE = 1 << _BITS
_LEVELS = 5  # cells of 64, 256, 1024, 4096 and 16384 pixels: at the last one, everything spans at most 2 × 2
_STRIDE = _TILE + 8  # a row of scratch: eight lanes may start at any pixel of the tile
_PLANE = _TILE * _STRIDE
_GROUP = 2048  # fewest triangles that share a row of counters
_MARGIN = 1.0 / 1024.0  # [px] added to bounds: far more than their rounding, far less than a pixel
_EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))


@functools.cache
def _make_project(lanes: int):
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
def _bounds(p0: wp.vec4d, p1: wp.vec4d, p2: wp.vec4d, sided: wp.uint8, near: wp.float64, width: int, height: int):
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
            wp.min(wp.min(x0, x1), x2), wp.min(wp.min(y0, y1), y2), wp.max(wp.max(x0, x1), x2), wp.max(wp.max(y0, y1), y2)
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
def _cells(box: wp.vec4s, grid: wp.array(dtype=wp.int32)):
    """First cell of a box in the grid, cells per grid row, and how many cells it spans across and down (1 or 2 each)."""
    x0 = int(box[0])
    y0 = int(box[1])
    x1 = int(box[2])
    y1 = int(box[3])
    level = int(0)
    shift = int(_BITS)
    while (x1 >> shift) - (x0 >> shift) > 1 or (y1 >> shift) - (y0 >> shift) > 1:
        level += 1
        shift += 2
    across = grid[2 * level + 1]
    return wp.vec4i(
        grid[2 * level] + (y0 >> shift) * across + (x0 >> shift),
        across,
        (x1 >> shift) - (x0 >> shift) + 1,
        (y1 >> shift) - (y0 >> shift) + 1,
    )


@wp.kernel
def count_kernel(
    first: int,
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    near: wp.float64,
    width: int,
    height: int,
    grid: wp.array(dtype=wp.int32),
    cells: int,
    group: int,
    n: int,
    bounds: wp.array(dtype=wp.vec4s),
    counters: wp.array(dtype=wp.int32),
):
    """Bounds of the triangles of one group, and how many of them each cell gets."""
    g = first + wp.tid()
    row = g * cells
    for c in range(cells):
        counters[row + c] = 0
    for t in range(g * group, wp.min(n, (g + 1) * group)):
        p0 = projected[faces[3 * t]]
        p1 = projected[faces[3 * t + 1]]
        p2 = projected[faces[3 * t + 2]]
        box = _bounds(p0, p1, p2, sided[t], near, width, height)
        bounds[t] = box
        if box[0] <= box[2]:
            at = _cells(box, grid)
            for y in range(at[3]):
                for x in range(at[2]):
                    c = row + at[0] + y * at[1] + x
                    counters[c] = counters[c] + 1


@wp.kernel
def scan_kernel(
    first: int, cells: int, groups: int, counters: wp.array(dtype=wp.int32), starts: wp.array(dtype=wp.int32)
):
    """Counts → where each group writes in each cell's list; one thread."""
    total = int(0)
    for c in range(cells):
        starts[c] = total
        for g in range(groups):
            count = counters[g * cells + c]
            counters[g * cells + c] = total
            total += count
    starts[cells] = total


@wp.kernel
def fill_kernel(
    first: int,
    bounds: wp.array(dtype=wp.vec4s),
    grid: wp.array(dtype=wp.int32),
    cells: int,
    group: int,
    n: int,
    counters: wp.array(dtype=wp.int32),
    lists: wp.array(dtype=wp.int32),
):
    """Triangle ids into the cells' lists, ascending in each."""
    g = first + wp.tid()
    row = g * cells
    for t in range(g * group, wp.min(n, (g + 1) * group)):
        box = bounds[t]
        if box[0] <= box[2]:
            at = _cells(box, grid)
            for y in range(at[3]):
                for x in range(at[2]):
                    c = row + at[0] + y * at[1] + x
                    k = counters[c]
                    lists[k] = t
                    counters[c] = k + 1


# The three parts of a tile, in C++ vectors of eight pixels. Scratch: planes of 1/w, triangle, weights 1 and 2.
_CLEAR = f"""
#ifndef __CUDA_ARCH__
    float* q = scratch.data + (size_t)slot * {4 * _PLANE};
    for (int i = 0; i < {_PLANE}; ++i) q[i] = -1.0f;
#endif
"""

_DRAW = f"""
#ifndef __CUDA_ARCH__
    // Keeps blend and store apart: the masked stores that LLVM would make of them take ten times as long on AMD cores.
#if defined(__x86_64__)
#define OPAQUE(v) __asm__("" : "+x"(v))
#else
#define OPAQUE(v)
#endif
    typedef float f4 __attribute__((ext_vector_type(4)));
    typedef float f8 __attribute__((ext_vector_type(8)));
    typedef int i8 __attribute__((ext_vector_type(8)));
    typedef float f8u __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8u __attribute__((ext_vector_type(8), aligned(4)));
    typedef double d4 __attribute__((ext_vector_type(4)));
    typedef long long l4 __attribute__((ext_vector_type(4)));

    float* Q = scratch.data + (size_t)slot * {4 * _PLANE};
    int* N = (int*)(Q + {_PLANE});
    float* U = Q + {2 * _PLANE};
    float* V = Q + {3 * _PLANE};
    const double ox = tx + {_TILE // 2}, oy = ty + {_TILE // 2};
    const f8 iota = {{0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f}};
    int drawn = 0;

    for (int k = begin; k < end; ++k) {{
        const int t = lists.data[k];
        const short* box = (const short*)(bounds.data + t);
        const int x0 = box[0] > tx ? box[0] - tx : 0, x1 = box[2] - tx < {_TILE - 1} ? box[2] - tx : {_TILE - 1};
        const int y0 = box[1] > ty ? box[1] - ty : 0, y1 = box[3] - ty < {_TILE - 1} ? box[3] - ty : {_TILE - 1};
        if (x0 > x1 || y0 > y1) continue;

        // Vertices about the middle of the tile; lane i of a, b, c is edge i, from vertex i + 1 to i + 2.
        const int i0 = faces.data[3 * t], i1 = faces.data[3 * t + 1], i2 = faces.data[3 * t + 2];
        const double* p0 = (const double*)(projected.data + i0);
        const double* p1 = (const double*)(projected.data + i1);
        const double* p2 = (const double*)(projected.data + i2);
        const d4 w = {{p0[2], p1[2], p2[2], 0.0}};
        const d4 X = (d4){{p0[0], p1[0], p2[0], 0.0}} - ox * w;
        const d4 Y = (d4){{p0[1], p1[1], p2[1], 0.0}} - oy * w;
        const d4 Xj = X.yzxw, Xk = X.zxyw, Yj = Y.yzxw, Yk = Y.zxyw, wj = w.yzxw, wk = w.zxyw;
        // Always from the higher to the lower vertex, then signed: the neighbour's edge is the exact negative.
        const l4 swap = {{-(long long)(i1 > i2), -(long long)(i2 > i0), -(long long)(i0 > i1), 0}};
        const d4 Xa = swap ? Xj : Xk, Xb = swap ? Xk : Xj, Ya = swap ? Yj : Yk, Yb = swap ? Yk : Yj;
        const d4 wa = swap ? wj : wk, wb = swap ? wk : wj;
        const d4 sign = swap ? (d4)(-1.0) : (d4)(1.0);
        d4 a = sign * (Ya * wb - Yb * wa);
        d4 b = sign * (wa * Xb - wb * Xa);
        d4 c = sign * (Xa * Yb - Xb * Ya);
        double det = X.x * a.x + Y.x * b.x + w.x * c.x;
        if (det < 0.0 && sided.data[t]) {{
            a = -a; b = -b; c = -c; det = -det;
        }}
        if (!(det > 1e-280 && det < 1e280)) continue;
        const double inverse = 1.0 / det;
        const double qa = (a.x + a.y + a.z) * inverse, qb = (b.x + b.y + b.z) * inverse, qc = (c.x + c.y + c.z) * inverse;
        // A power of two brings the edges into the range of float32 and leaves their signs and ratios exact.
        const double scale = __builtin_bit_cast(double, (2046ull << 52) - (__builtin_bit_cast(unsigned long long, det) & (2047ull << 52)));
        a *= scale; b *= scale; c *= scale;
        a.w = qa; b.w = qb; c.w = qc;
        const f4 A = __builtin_convertvector(a, f4), B = __builtin_convertvector(b, f4), C = __builtin_convertvector(c, f4);
        const f4 most = C + {_TILE / 2}f * (__builtin_elementwise_abs(A) + __builtin_elementwise_abs(B));
        if (!(most.x >= 0.0f && most.y >= 0.0f && most.z >= 0.0f)) continue;

        float dy = (float)y0 - {_TILE // 2 - 0.5}f;
        for (int y = y0; y <= y1; ++y, dy += 1.0f) {{
            const f4 R = __builtin_elementwise_fma(B, (f4)dy, C);
            for (int x = x0; x <= x1; x += 8) {{
                const f8 dx = iota + (float)(x - {_TILE // 2});
                const f8 e0 = __builtin_elementwise_fma((f8)A.x, dx, (f8)R.x);
                const f8 e1 = __builtin_elementwise_fma((f8)A.y, dx, (f8)R.y);
                const f8 e2 = __builtin_elementwise_fma((f8)A.z, dx, (f8)R.z);
                const f8 q = __builtin_elementwise_fma((f8)A.w, dx, (f8)R.w);
                const int at = y * {_STRIDE} + x;
                const f8 q_old = *(const f8u*)(Q + at);
                const i8 n_old = *(const i8u*)(N + at);
                i8 pass = (e0 >= 0.0f) & (e1 >= 0.0f) & (e2 >= 0.0f) & (q <= q_near) & (q >= q_far)
                    & ((q > q_old) | ((q == q_old) & ((i8)t < n_old)));
                OPAQUE(pass);
                if (__builtin_reduce_or(pass) == 0) continue;
                const f8 r = 1.0f / (e0 + e1 + e2);
                f8 u_old = *(const f8u*)(U + at), v_old = *(const f8u*)(V + at);
                OPAQUE(u_old);
                OPAQUE(v_old);
                *(f8u*)(Q + at) = pass < 0 ? q : q_old;
                *(i8u*)(N + at) = pass < 0 ? (i8)t : n_old;
                *(f8u*)(U + at) = pass < 0 ? e1 * r : u_old;
                *(f8u*)(V + at) = pass < 0 ? e2 * r : v_old;
                drawn = 1;
            }}
        }}
    }}
    return drawn;
#else
    return 0;
#endif
"""

_STORE = f"""
#ifndef __CUDA_ARCH__
    typedef float f8 __attribute__((ext_vector_type(8)));
    typedef int i8 __attribute__((ext_vector_type(8)));
    typedef float f16 __attribute__((ext_vector_type(16)));
    typedef float f8u __attribute__((ext_vector_type(8), aligned(4)));
    typedef int i8u __attribute__((ext_vector_type(8), aligned(4)));
    typedef float f16u __attribute__((ext_vector_type(16), aligned(4)));
    const float* Q = scratch.data + (size_t)slot * {4 * _PLANE};
    const int* N = (const int*)(Q + {_PLANE});
    const float* U = Q + {2 * _PLANE};
    const float* V = Q + {3 * _PLANE};
    const int across = width - tx < {_TILE} ? width - tx : {_TILE};
    const int down = height - ty < {_TILE} ? height - ty : {_TILE};
    for (int y = 0; y < down; ++y) {{
        const size_t to = (size_t)(ty + y) * width + tx;
        for (int x = 0; x < across; x += 8) {{
            const int at = y * {_STRIDE} + x;
            const f8 q = *(const f8u*)(Q + at);
            const i8 hit = q >= 0.0f;
            const i8 n = hit ? *(const i8u*)(N + at) : (i8)(-1);
            const f8 d = hit ? 1.0f / q : (f8)__builtin_inff();
            const f8 u = hit ? *(const f8u*)(U + at) : (f8)0.0f;
            const f8 v = hit ? *(const f8u*)(V + at) : (f8)0.0f;
            const f16 uv = __builtin_shufflevector(u, v, 0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15);
            if (x + 8 <= across) {{
                *(i8u*)(triangle.data + to + x) = n;
                *(f8u*)(depth.data + to + x) = d;
                *(f16u*)(barycentric.data + 2 * (to + x)) = uv;
            }} else {{
                for (int l = 0; l < across - x; ++l) {{
                    triangle.data[to + x + l] = n[l];
                    depth.data[to + x + l] = d[l];
                    barycentric.data[2 * (to + x + l)] = u[l];
                    barycentric.data[2 * (to + x + l) + 1] = v[l];
                }}
            }}
        }}
    }}
#endif
"""


@wp.func_native(_CLEAR)
def _clear_tile(slot: int, scratch: wp.array(dtype=wp.float32)): ...


@wp.func_native(_DRAW)
def _draw_tile(
    slot: int,
    tx: int,
    ty: int,
    begin: int,
    end: int,
    lists: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.vec4s),
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    q_near: float,
    q_far: float,
    scratch: wp.array(dtype=wp.float32),
) -> int: ...


@wp.func_native(_STORE)
def _store_tile(
    slot: int,
    tx: int,
    ty: int,
    width: int,
    height: int,
    scratch: wp.array(dtype=wp.float32),
    triangle: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def tile_kernel(
    first: int,
    slot: int,
    tiles: int,
    stride: int,
    grid: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    lists: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.vec4s),
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    q_near: float,
    q_far: float,
    width: int,
    height: int,
    scratch: wp.array(dtype=wp.float32),
    dirty: wp.array(dtype=wp.int32),
    triangle: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One tile: clear scratch, draw the lists of the cells above it, write the pixels. Skips what is and was empty."""
    # A stride spreads the picture's busy middle over all chunks of the launch.
    tile = int((wp.int64(first + wp.tid()) * wp.int64(stride)) % wp.int64(tiles))
    across = grid[1]
    tx = tile % across
    ty = tile // across
    entries = int(0)
    shift = int(0)
    for level in range(_LEVELS):
        cell = grid[2 * level] + (ty >> shift) * grid[2 * level + 1] + (tx >> shift)
        entries += starts[cell + 1] - starts[cell]
        shift += 2
    if entries == 0 and dirty[tile] == 0:
        return
    _clear_tile(slot, scratch)
    drawn = int(0)
    shift = int(0)
    for level in range(_LEVELS):
        cell = grid[2 * level] + (ty >> shift) * grid[2 * level + 1] + (tx >> shift)
        drawn += _draw_tile(
            slot, tx * _TILE, ty * _TILE, starts[cell], starts[cell + 1],
            lists, bounds, projected, faces, sided, q_near, q_far, scratch,
        )  # fmt: skip
        shift += 2
    if drawn == 0 and dirty[tile] == 0:
        return
    dirty[tile] = drawn
    _store_tile(slot, tx * _TILE, ty * _TILE, width, height, scratch, triangle, barycentric, depth)


@wp.func
def _planes(
    p0: wp.vec4d, p1: wp.vec4d, p2: wp.vec4d, i0: int, i1: int, i2: int, ox: wp.float64, oy: wp.float64, sided: wp.uint8
):
    """Rows a, b, c of the three edge functions and of 1/w about (ox, oy); c = −1 throughout if nothing is to be drawn."""
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


@wp.kernel
def clear_kernel(first: int, keys: wp.array(dtype=wp.int64)):
    keys[first + wp.tid()] = _EMPTY


@wp.kernel
def splat_kernel(
    first: int,
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    near: wp.float64,
    q_near: float,
    q_far: float,
    width: int,
    height: int,
    keys: wp.array(dtype=wp.int64),
):
    """One triangle into the keys: the nearest wins, then the lower id."""
    t = first + wp.tid()
    i0 = faces[3 * t]
    i1 = faces[3 * t + 1]
    i2 = faces[3 * t + 2]
    box = _bounds(projected[i0], projected[i1], projected[i2], sided[t], near, width, height)
    if box[0] > box[2]:
        return
    for ty in range(int(box[1]) >> _BITS, (int(box[3]) >> _BITS) + 1):
        for tx in range(int(box[0]) >> _BITS, (int(box[2]) >> _BITS) + 1):
            ox = tx * _TILE + _TILE // 2
            oy = ty * _TILE + _TILE // 2
            m = _planes(
                projected[i0], projected[i1], projected[i2], i0, i1, i2, wp.float64(ox), wp.float64(oy), sided[t]
            )
            for y in range(wp.max(int(box[1]), ty * _TILE), wp.min(int(box[3]), ty * _TILE + _TILE - 1) + 1):
                row = m[2] + m[1] * (float(y - oy) + 0.5)
                for x in range(wp.max(int(box[0]), tx * _TILE), wp.min(int(box[2]), tx * _TILE + _TILE - 1) + 1):
                    e = row + m[0] * (float(x - ox) + 0.5)
                    if wp.min(wp.min(e[0], e[1]), e[2]) >= 0.0 and e[3] <= q_near and e[3] >= q_far:
                        rank = wp.int64(0x7FFFFFFF) - wp.int64(wp.cast(e[3], wp.int32))
                        wp.atomic_min(keys, y * width + x, (rank << wp.int64(32)) | wp.int64(t))


@wp.kernel
def resolve_kernel(
    first: int,
    keys: wp.array(dtype=wp.int64),
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    width: int,
    triangle: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One pixel from its key."""
    i = first + wp.tid()
    key = keys[i]
    if key == _EMPTY:
        triangle[i] = -1
        barycentric[2 * i] = 0.0
        barycentric[2 * i + 1] = 0.0
        depth[i] = wp.inf
        return
    t = int(key & wp.int64(0x7FFFFFFF))
    x = i % width
    y = i // width
    ox = (x >> _BITS) * _TILE + _TILE // 2
    oy = (y >> _BITS) * _TILE + _TILE // 2
    i0 = faces[3 * t]
    i1 = faces[3 * t + 1]
    i2 = faces[3 * t + 2]
    m = _planes(projected[i0], projected[i1], projected[i2], i0, i1, i2, wp.float64(ox), wp.float64(oy), sided[t])
    e = (m[2] + m[1] * (float(y - oy) + 0.5)) + m[0] * (float(x - ox) + 0.5)
    r = 1.0 / (e[0] + e[1] + e[2])
    triangle[i] = t
    barycentric[2 * i] = e[1] * r
    barycentric[2 * i + 1] = e[2] * r
    depth[i] = 1.0 / e[3]


def depth_range(clip) -> tuple[float, float]:
    """Return the view depths (near, far) between which ``clip`` gives z/w in [0, 1]; far may be infinite.

    Args:
        clip: World → clip matrix, shape (4, 4), whose w is the view depth. Reversed z (1 at near) is allowed.

    Raises:
        ValueError: If the matrix is not finite, or is no perspective with 0 < near < far.
    """
    m = np.asarray(clip, dtype=np.float64)
    if m.shape != (4, 4):
        raise ValueError(f"clip must have shape (4, 4), got {m.shape}")
    if not np.isfinite(m).all():
        raise ValueError("clip must be finite")
    z, w = m[2], m[3]
    square = w[:3] @ w[:3]
    if square == 0.0:
        raise ValueError("clip must be a perspective whose w is the view depth; its last row is constant")
    # z = slope · w + shift for every point, up to the rounding of float32.
    slope = (z[:3] @ w[:3]) / square
    shift = z[3] - slope * w[3]
    if np.abs(z[:3] - slope * w[:3]).max() > 1e-4 * max(1.0, abs(slope)) * math.sqrt(square):
        raise ValueError("clip must map equal view depths to equal z; its third row is no multiple of its fourth")
    at = [-shift / slope if slope else math.inf, shift / (1.0 - slope) if slope != 1.0 else math.inf]
    near, far = sorted(d if d > 0.0 else math.inf for d in at)
    if not near < far:
        raise ValueError(f"clip must hold 0 < near < far, got z/w = 0 at depth {at[0]:g} and 1 at {at[1]:g}")
    return near, far


def pixel_matrix(clip, width: int, height: int) -> np.ndarray:
    """Return the matrix from world points to (X, Y, ·, w) with pixel coordinates (X/w, Y/w), shape (4, 4), float64."""
    m = np.asarray(clip, dtype=np.float64)
    return np.stack([0.5 * width * (m[3] + m[0]), 0.5 * height * (m[3] - m[1]), np.zeros(4), m[3]])


class CameraRaster:
    """Draws one mesh topology into triangle ids, barycentrics and depth, frame after frame, without allocating.

    A pixel shows the nearest triangle whose closed area holds its centre and whose depth there is within the clip matrix's
    near and far; of equal depths, the lower triangle id. So a centre on a shared edge belongs to either triangle, never to
    none. Front faces run counter-clockwise as seen; others are drawn only where ``double_sided``. Triangles of no area, or
    with a NaN or Inf in a vertex, draw nothing. The result does not depend on the number of workers.

    Args:
        faces: Vertex indices, shape (F, 3).
        vertex_count: Number of vertices V.
        width: Picture width [px], 1 … :data:`MAX_SIZE`.
        height: Picture height [px], likewise.
        double_sided: Whether each triangle is seen from behind too, shape (F,); ``None``: none is.
        device: Warp device; default: the current one.
        tiled: Draw tile by tile (the default on the CPU) or with one thread per triangle (the default on CUDA).

    Attributes:
        triangle: Triangle ids, shape (H, W), int32, −1 where nothing is drawn. Row 0 is the top one.
        barycentric: Perspective-correct weights of the triangle's second and third vertex, shape (H, W, 2), float32; each
            ≥ 0 and their sum ≤ 1 but for one rounding; 0 where nothing is drawn.
        depth: View depth w [scene unit], shape (H, W), float32, +inf where nothing is drawn.

    The three arrays are for reading: tiles that stay empty are not written again.

    Raises:
        ValueError: If shapes or sizes are off, or a face names a vertex that does not exist.

    Error: <FILL>
    """

    def __init__(self, faces, vertex_count, width, height, *, double_sided=None, device=None, tiled=None):
        self.device = wp.get_device(device)
        self.width, self.height, self.vertex_count = int(width), int(height), int(vertex_count)
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= MAX_SIZE:
                raise ValueError(f"{name} must be in 1..{MAX_SIZE}, got {size}")
        kind = Kind("warp", self.device)
        faces = np.ascontiguousarray(faces.numpy() if isinstance(faces, wp.array) else faces)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces must have shape [F, 3], got {faces.shape}")
        if faces.size and not (0 <= faces.min() and faces.max() < self.vertex_count):
            raise ValueError(
                f"faces must index {self.vertex_count} vertices, got indices from {faces.min()} to {faces.max()}"
            )
        self.triangle_count = n = len(faces)
        if double_sided is None:
            double_sided = np.zeros(n, np.uint8)
        self._sided = wp.clone(take(double_sided, "double_sided", (n,), wp.uint8, kind))
        self._faces = wp.array(faces.astype(np.int32).reshape(-1), dtype=wp.int32, device=self.device)

        def array(shape, dtype=wp.int32):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        pixels = self.width * self.height
        self.triangle = wp.full((self.height, self.width), -1, dtype=wp.int32, device=self.device)
        self.barycentric = array((self.height, self.width, 2), wp.float32)
        self.depth = wp.full((self.height, self.width), math.inf, dtype=wp.float32, device=self.device)
        flat = [self.triangle.flatten(), self.barycentric.flatten(), self.depth.flatten()]
        projected, bounds = array(self.vertex_count, wp.vec4d), array(n, wp.vec4s)
        mesh = [projected, self._faces, self._sided]
        size = [self.width, self.height]
        self._near, self._last = None, None

        L = lanes(self.device)
        points = array((self.vertex_count, 3), wp.float32)
        self._kind = kind
        self._project = Job(
            _make_project(L),
            blocks(self.vertex_count, L),
            [points.flatten(), wp.mat44d(), self.vertex_count, projected],
            device=self.device,
            grain=8,
        )
        self._tiled = self.device.is_cpu if tiled is None else bool(tiled)
        if self._tiled and not self.device.is_cpu:
            raise ValueError("tiled drawing needs the CPU; leave tiled at None")
        ranges = [0.0, 0.0]
        if self._tiled:
            grid, cells = [], 0
            for level in range(_LEVELS):
                across, down = (blocks(s, _TILE << 2 * level) for s in size)
                grid += [cells, across]
                cells += across * down
            grid = wp.array(grid, dtype=wp.int32, device=self.device)
            group = max(_GROUP, blocks(n, 64))
            groups = blocks(n, group)
            counters, starts, lists = array(groups * cells), array(cells + 1), array(4 * n)
            tiles = blocks(self.width, _TILE) * blocks(self.height, _TILE)
            self._starts, self._dirty, self._bounds = starts, array(tiles), bounds
            self._slots = worker_count()
            scratch = array(self._slots * 4 * _PLANE, wp.float32)
            binning = [grid, cells, group, n]
            make = functools.partial(Job, device=self.device, grain=1)
            self._count = make(count_kernel, groups, [*mesh, 0.0, *size, *binning, bounds, counters])
            self._scan = make(scan_kernel, 1, [cells, groups, counters, starts])
            self._fill = make(fill_kernel, groups, [bounds, *binning, counters, lists])
            self._tiles = make(
                tile_kernel,
                tiles,
                [tiles, _coprime(tiles), grid, starts, lists, bounds, *mesh, *ranges, *size, scratch, self._dirty, *flat],
            )
            self.stages = [("count", self._count), ("scan", self._scan), ("fill", self._fill), ("tiles", self._tiles)]
        else:
            keys = array(pixels, wp.int64)
            # Atomics on the CPU hold within one worker only, so there a single chunk takes all triangles.
            self._clear = Job(clear_kernel, pixels, [keys], device=self.device, grain=1 << 16)
            self._splat = Job(splat_kernel, n, [*mesh, 0.0, *ranges, *size, keys], device=self.device, grain=max(1, n))
            resolve = Job(resolve_kernel, pixels, [keys, *mesh, self.width, *flat], device=self.device, grain=1 << 14)
            self.stages = [("clear", self._clear), ("splat", self._splat), ("resolve", resolve)]
        self.stages.insert(0, ("project", self._project))

    def run(self, points, clip, eye=None) -> None:
        """Draw the mesh at ``points`` into :attr:`triangle`, :attr:`barycentric` and :attr:`depth`.

        Args:
            points: World positions, shape (V, 3), float32; numpy, torch or Warp.
            clip: World → clip matrix, shape (4, 4), as :func:`depth_range` takes it.
            eye: Not needed (facing follows from ``clip``); accepted for callers that carry the camera as a pair.

        Raises:
            ValueError: If a shape is wrong or the matrix is no perspective.
        """
        self._prepare(points, clip)
        for _, job in self.stages:
            job.run()

    def _prepare(self, points, clip) -> None:
        near, far = depth_range(clip)
        points = take(points, "points", (self.vertex_count, 3), wp.float32, self._kind)
        _set(self._project, points=points.flatten(), m=wp.mat44d(pixel_matrix(clip, self.width, self.height)))
        if self._last != (near, far):
            self._last = near, far
            ranges = {"q_near": float(np.float32(1.0 / near)), "q_far": float(np.float32(1.0 / far))}
            if self._tiled:
                _set(self._count, near=near)
                _set(self._tiles, **ranges)
            else:
                _set(self._splat, near=near, **ranges)
        if self._tiled and worker_count() > self._slots:
            self._slots = worker_count()
            _set(self._tiles, scratch=wp.empty(self._slots * 4 * _PLANE, dtype=wp.float32, device=self.device))

    def stats(self) -> dict[str, int]:
        """Return counts of the last frame: triangles, those that may cover a pixel, and tiles, those with pixels drawn.

        Only for tiled drawing; ``kept`` excludes back faces, degenerate triangles, and those outside or between pixels.
        """
        box = self._bounds.numpy()
        return {
            "triangles": self.triangle_count,
            "kept": int((box[:, 0] <= box[:, 2]).sum()),
            "entries": int(self._starts.numpy()[-1]),
            "tiles": int(self._dirty.shape[0]),
            "tiles_drawn": int(np.count_nonzero(self._dirty.numpy())),
        }


def _coprime(n: int) -> int:
    """Return a step near the golden section of ``n`` that visits all of 0 … n − 1."""
    step = max(1, round(0.618034 * n))
    while math.gcd(step, n) != 1:
        step += 1
    return step


def _set(job: Job, **values) -> None:
    """Set arguments of a recorded launch by name."""
    names = [argument.label for argument in job.kernel.adj.args if argument.label not in ("first", "slot")]
    for name, value in values.items():
        job.set(names.index(name), value)
