"""Tiled drawing on the CPU: triangles are binned into a hierarchical grid, then each worker draws whole tiles.

A triangle lives at the level of the grid where it spans at most 2 × 2 cells, so the lists have a fixed size whatever
the scene. Binning is count, scan and fill over groups of triangles, each with counters of its own; so lists are
ascending and no worker waits for another. A tile is drawn in scratch that fits a core's cache, eight pixels of a row
at a time, and each pixel is written once. Tiles that were empty and stay empty are not touched.
"""

import warp as wp

from .dispatch import module_options
from .visibility_setup import BITS, TILE, bounds_of

__all__ = ["GROUP", "LEVELS", "SCRATCH", "count_kernel", "fill_kernel", "scan_kernel", "tile_kernel"]

wp.set_module_options(module_options())

LEVELS = 5
"""Levels of the grid, with cells of 64, 256, 1024, 4096 and 16384 pixels; on the last, anything spans 2 × 2 at most."""

GROUP = 2048
"""Fewest triangles that share a row of counters."""

_STRIDE = TILE + 8  # a row of scratch: eight lanes may start at any pixel of the tile
_PLANE = TILE * _STRIDE

SCRATCH = 4 * _PLANE
"""Floats of scratch per worker: planes of 1/w, triangle, and the weights of the second and third vertex."""


@wp.func
def _cells(box: wp.vec4s, grid: wp.array(dtype=wp.int32)):
    """First cell of a box in the grid, cells per grid row, and how many cells it spans across and down (1 or 2)."""
    x0 = int(box[0])
    y0 = int(box[1])
    x1 = int(box[2])
    y1 = int(box[3])
    level = wp.int32(0)
    shift = int(BITS)
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
        box = bounds_of(p0, p1, p2, sided[t], near, width, height)
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
    total = wp.int32(0)
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


# The three parts of a tile, in C++ vectors of eight pixels. 1/w < 0 marks a pixel that nothing covers.
_CLEAR = f"""
#ifndef __CUDA_ARCH__
    float* q = scratch.data + (size_t)slot * {SCRATCH};
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

    float* Q = scratch.data + (size_t)slot * {SCRATCH};
    int* N = (int*)(Q + {_PLANE});
    float* U = Q + {2 * _PLANE};
    float* V = Q + {3 * _PLANE};
    const double ox = tx + {TILE // 2}, oy = ty + {TILE // 2};
    const f8 iota = {{0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f}};
    int drawn = 0;

    for (int k = begin; k < end; ++k) {{
        const int t = lists.data[k];
        if (k + 8 < end) {{
            const int* ahead = faces.data + 3 * (size_t)lists.data[k + 8];
            for (int i = 0; i < 3; ++i) __builtin_prefetch(projected.data + ahead[i]);
        }}
        const short* box = (const short*)(bounds.data + t);
        const int x0 = box[0] > tx ? box[0] - tx : 0, x1 = box[2] - tx < {TILE - 1} ? box[2] - tx : {TILE - 1};
        const int y0 = box[1] > ty ? box[1] - ty : 0, y1 = box[3] - ty < {TILE - 1} ? box[3] - ty : {TILE - 1};
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
        const double qa = (a.x + a.y + a.z) * inverse, qb = (b.x + b.y + b.z) * inverse;
        const double qc = (c.x + c.y + c.z) * inverse;
        // A power of two brings the edges into the range of float32 and leaves their signs and ratios exact.
        const unsigned long long exponent = __builtin_bit_cast(unsigned long long, det) & (2047ull << 52);
        const double scale = __builtin_bit_cast(double, (2046ull << 52) - exponent);
        a *= scale; b *= scale; c *= scale;
        a.w = qa; b.w = qb; c.w = qc;
        const f4 A = __builtin_convertvector(a, f4), B = __builtin_convertvector(b, f4);
        const f4 C = __builtin_convertvector(c, f4);
        const f4 most = C + {TILE / 2}f * (__builtin_elementwise_abs(A) + __builtin_elementwise_abs(B));
        if (!(most.x >= 0.0f && most.y >= 0.0f && most.z >= 0.0f)) continue;

        auto pixels = [&](const f4 R, const f8 dx, const int at) {{
            const f8 e0 = __builtin_elementwise_fma((f8)A.x, dx, (f8)R.x);
            const f8 e1 = __builtin_elementwise_fma((f8)A.y, dx, (f8)R.y);
            const f8 e2 = __builtin_elementwise_fma((f8)A.z, dx, (f8)R.z);
            const f8 q = __builtin_elementwise_fma((f8)A.w, dx, (f8)R.w);
            const f8 q_old = *(const f8u*)(Q + at);
            const i8 n_old = *(const i8u*)(N + at);
            i8 pass = (e0 >= 0.0f) & (e1 >= 0.0f) & (e2 >= 0.0f) & (q <= q_near) & (q >= q_far)
                & ((q > q_old) | ((q == q_old) & ((i8)t < n_old)));
            OPAQUE(pass);
            if (__builtin_reduce_or(pass) == 0) return;
            const f8 r = 1.0f / (e0 + e1 + e2);
            f8 u_old = *(const f8u*)(U + at), v_old = *(const f8u*)(V + at);
            OPAQUE(u_old);
            OPAQUE(v_old);
            *(f8u*)(Q + at) = pass < 0 ? q : q_old;
            *(i8u*)(N + at) = pass < 0 ? (i8)t : n_old;
            *(f8u*)(U + at) = pass < 0 ? e1 * r : u_old;
            *(f8u*)(V + at) = pass < 0 ? e2 * r : v_old;
            drawn = 1;
        }};
        float dy = (float)y0 - {TILE // 2 - 0.5}f;
        if (x1 - x0 < 8) {{
            const f8 dx = iota + (float)(x0 - {TILE // 2});
            for (int y = y0; y <= y1; ++y, dy += 1.0f) {{
                pixels(__builtin_elementwise_fma(B, (f4)dy, C), dx, y * {_STRIDE} + x0);
            }}
        }} else {{
            for (int y = y0; y <= y1; ++y, dy += 1.0f) {{
                const f4 R = __builtin_elementwise_fma(B, (f4)dy, C);
                for (int x = x0; x <= x1; x += 8) pixels(R, iota + (float)(x - {TILE // 2}), y * {_STRIDE} + x);
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
    const float* Q = scratch.data + (size_t)slot * {SCRATCH};
    const int* N = (const int*)(Q + {_PLANE});
    const float* U = Q + {2 * _PLANE};
    const float* V = Q + {3 * _PLANE};
    const int across = width - tx < {TILE} ? width - tx : {TILE};
    const int down = height - ty < {TILE} ? height - ty : {TILE};
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
    entries = wp.int32(0)
    shift = wp.int32(0)
    for level in range(LEVELS):
        cell = grid[2 * level] + (ty >> shift) * grid[2 * level + 1] + (tx >> shift)
        entries += starts[cell + 1] - starts[cell]
        shift += 2
    if entries == 0 and dirty[tile] == 0:
        return
    _clear_tile(slot, scratch)
    drawn = wp.int32(0)
    shift = wp.int32(0)
    for level in range(LEVELS):
        cell = grid[2 * level] + (ty >> shift) * grid[2 * level + 1] + (tx >> shift)
        drawn += _draw_tile(
            slot, tx * TILE, ty * TILE, starts[cell], starts[cell + 1],
            lists, bounds, projected, faces, sided, q_near, q_far, scratch,
        )  # fmt: skip
        shift += 2
    if drawn == 0 and dirty[tile] == 0:
        return
    dirty[tile] = drawn
    _store_tile(slot, tx * TILE, ty * TILE, width, height, scratch, triangle, barycentric, depth)
