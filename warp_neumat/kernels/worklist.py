"""What has to be shaded: facing triangles, seen texels, and the compacted list of 2×2 quads.

Seen means read: a texel is marked when the bilinear footprint of a visible pixel covers it, so the list holds exactly
what the gather is about to read. ``done`` remembers what the epoch has shaded already; it is left out, which is both
the reuse over frames and the repair of what comes into view in between.
"""

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import MASK_SHIFT, RATE_SHIFT, ROW_SHIFT
from warp_neumat.kernels.tiles import TILE_SHIFT, anchors

wp.set_module_options(dispatch.module_options())


# All of -1 is background, so the complement's bits are zero exactly where nothing is drawn.
_DRAWN = """
    int bits = 0;
    for (int i = begin; i < end; ++i) bits |= ~pixel_triangle.data[i];
    return bits;
"""


@wp.func_native(_DRAWN)
def drawn(pixel_triangle: wp.array(dtype=wp.int32), begin: int, end: int) -> int:
    """Return 0 where the pixels ``begin`` … ``end`` − 1 are all background, at the speed memory is read."""
    ...


@wp.kernel
def facing_kernel(
    first: int,
    faces: wp.array(dtype=wp.int32),
    face_count: int,
    double_sided: wp.array(dtype=wp.uint8),
    points: wp.array(dtype=wp.float32),
    eye: wp.vec3,
    clip: wp.mat44,
    per_block: int,
    # outputs
    side: wp.array(dtype=wp.int8),
    on_screen: wp.array(dtype=wp.uint8),
):
    """Which side of each triangle the eye sees, 1 front, −1 back of a double-sided one, 0 neither; and is it in view.

    ``on_screen`` is 0 where all three corners lie beyond one side of the view volume of ``clip`` (far plane excepted).
    """
    b = first + wp.tid()
    for f in range(b * per_block, wp.min((b + 1) * per_block, face_count)):
        i0 = 3 * faces[3 * f]
        i1 = 3 * faces[3 * f + 1]
        i2 = 3 * faces[3 * f + 2]
        p = wp.vec3(points[i0], points[i0 + 1], points[i0 + 2])
        u = wp.vec3(points[i1], points[i1 + 1], points[i1 + 2]) - p
        v = wp.vec3(points[i2], points[i2 + 1], points[i2 + 2]) - p
        d = wp.dot(wp.cross(u, v), eye - p)
        s = int(0)
        if d > 0.0:
            s = 1
        elif d < 0.0 and double_sided[f] != wp.uint8(0):
            s = -1
        side[f] = wp.int8(s)
        c0 = clip * wp.vec4(p[0], p[1], p[2], 1.0)
        c1 = clip * wp.vec4(p[0] + u[0], p[1] + u[1], p[2] + u[2], 1.0)
        c2 = clip * wp.vec4(p[0] + v[0], p[1] + v[1], p[2] + v[2], 1.0)
        out = c0[2] < 0.0 and c1[2] < 0.0 and c2[2] < 0.0
        for k in range(2):
            out = out or (c0[k] < -c0[3] and c1[k] < -c1[3] and c2[k] < -c2[3])
            out = out or (c0[k] > c0[3] and c1[k] > c1[3] and c2[k] > c2[3])
        on_screen[f] = wp.where(out, wp.uint8(0), wp.uint8(1))


@wp.kernel
def mark_facing_kernel(
    first: int,
    triangle: wp.array(dtype=wp.int32),
    texel_material: wp.array(dtype=wp.uint8),
    side: wp.array(dtype=wp.int8),
    on_screen: wp.array(dtype=wp.uint8),
    backfacing_too: int,
    offscreen_too: int,
    width: int,
    texel_count: int,
    rate: wp.array(dtype=wp.uint8),
    columns: int,
    per_block: int,
    # outputs
    seen: wp.array(dtype=wp.uint8),
):
    """Mark every anchor whose triangle faces the eye and is in view, and at will those that do not or are not."""
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, texel_count)):
        f = wp.max(triangle[i], 0)
        wanted = backfacing_too != 0 or side[f] != wp.int8(0)
        wanted = wanted and (offscreen_too != 0 or on_screen[f] != wp.uint8(0))
        if wanted and texel_material[i] != wp.uint8(0):
            x = i % width
            y = i // width
            step = 1 << int(rate[(y >> TILE_SHIFT) * columns + (x >> TILE_SHIFT)])
            if ((x | y) & (step - 1)) == 0:
                seen[i] = wp.uint8(1)


@wp.func
def footprint(corner_uv: wp.array(dtype=wp.float32), f: int, b1: float, b2: float, width: int, height: int):
    """Return (x, y, u, v): upper left texel of the bilinear footprint of a point of triangle ``f``, and its fractions.

    Texel i is centred at i + 0.5. The footprint is kept inside the texture.
    """
    at = 6 * f
    b0 = 1.0 - b1 - b2
    s = b0 * corner_uv[at] + b1 * corner_uv[at + 2] + b2 * corner_uv[at + 4] - 0.5
    t = b0 * corner_uv[at + 1] + b1 * corner_uv[at + 3] + b2 * corner_uv[at + 5] - 0.5
    s = wp.clamp(s, 0.0, float(width) - 1.001)
    t = wp.clamp(t, 0.0, float(height) - 1.001)
    x = int(wp.floor(s))
    y = int(wp.floor(t))
    return x, y, s - float(x), t - float(y)


@wp.kernel
def mark_seen_kernel(
    first: int,
    slot: int,
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_barycentric: wp.array(dtype=wp.float32),
    pixel_count: int,
    per_block: int,
    corner_uv: wp.array(dtype=wp.float32),
    width: int,
    height: int,
    rate: wp.array(dtype=wp.uint8),
    columns: int,
    tiles: int,
    # outputs
    seen: wp.array(dtype=wp.uint8),
    pixels: wp.array(dtype=wp.int32),
):
    """Mark the texels that the visible pixels will read, and count the pixels of each tile.

    Blocks may write the same 1 to the same texel. ``pixels`` is [slot][tile], since counts are not atomic over workers.
    """
    b = first + wp.tid()
    end = wp.min((b + 1) * per_block, pixel_count)
    if drawn(pixel_triangle, b * per_block, end) == 0:
        return
    for i in range(b * per_block, end):
        f = pixel_triangle[i]
        if f >= 0:
            x, y, u, v = footprint(corner_uv, f, pixel_barycentric[2 * i], pixel_barycentric[2 * i + 1], width, height)
            tile = (y >> TILE_SHIFT) * columns + (x >> TILE_SHIFT)
            r = int(rate[tile])
            x0, y0, _, _ = anchors(x, y, u, v, r)
            wp.atomic_add(pixels, slot * tiles + tile, 1)
            at = y0 * width + x0
            right = 1 << r
            below = width << r
            seen[at] = wp.uint8(1)
            seen[at + right] = wp.uint8(1)
            seen[at + below] = wp.uint8(1)
            seen[at + below + right] = wp.uint8(1)


@wp.kernel
def pixel_material_kernel(
    first: int,
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_count: int,
    per_block: int,
    face_material: wp.array(dtype=wp.int32),
    # outputs
    texel_material: wp.array(dtype=wp.uint8),
):
    """Write material + 1 of each covered pixel, 0 of the others."""
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, pixel_count)):
        f = pixel_triangle[i]
        m = int(0)
        if f >= 0:
            m = face_material[f] + 1
        texel_material[i] = wp.uint8(m)


# One row of tiles. Most tiles are empty, so eight bytes of each texel row are tested at once. A texel outside the
# image reads as 0. With `fill`, the cursors are positions in `quads`; without, they count. A tile that is due shades
# all that is seen of it, others what is not done. Anchors of the tile's rate are listed as quads of anchors; texels
# between them, which a neighbour of a finer rate reads, as quads of texels.
_ROW = """
    const int columns = (width + 7) >> 3, y0 = 8 * row, high = height - y0 < 8 ? height - y0 : 8;
    int seen_texels = 0, shaded_texels = 0;
    for (int column = 0; column < columns; ++column) {
        const int tile = row * columns + column, x0 = 8 * column, wide = width - x0 < 8 ? width - x0 : 8;
        if (fill && !tile_shaded.data[tile]) continue;
        unsigned long long marks[8], any = 0;
        for (int j = 0; j < high; ++j) {
            const unsigned char* from = seen.data + (long long)(y0 + j) * width + x0;
            marks[j] = 0;
            if (wide == 8) memcpy(&marks[j], from, 8);
            else memcpy(&marks[j], from, wide);
            any |= marks[j];
        }
        if (!any) {
            if (!fill) tile_seen.data[tile] = tile_shaded.data[tile] = 0;
            continue;
        }
        const bool all = due.data[tile] != 0;
        unsigned char wanted[64] = {0};  // material + 1 of what will be shaded
        int seen_here = 0, shaded_here = 0;
        for (int j = 0; j < high; ++j) {
            if (!marks[j]) continue;
            const long long at = (long long)(y0 + j) * width + x0;
            for (int i = 0; i < wide; ++i) {
                if (!(marks[j] >> 8 * i & 255)) continue;
                ++seen_here;
                if (all || !done.data[at + i]) wanted[8 * j + i] = texel_material.data[at + i];
            }
        }
        if (fill) {
            for (int j = 0; j < high; ++j) {
                unsigned char* d = done.data + (long long)(y0 + j) * width + x0;
                for (int i = 0; i < wide; ++i) d[i] = wanted[8 * j + i] ? 1 : all ? 0 : d[i];
            }
        }
        for (int level = rate.data[tile]; level >= 0; level = level ? 0 : -1) {
            const int across = 4 >> level;
            for (int b = 0; b < across; ++b) for (int a = 0; a < across; ++a) {
                int at[4], m[4];
                for (int q = 0; q < 4; ++q) {
                    at[q] = ((2 * b + (q >> 1)) << level) * 8 + ((2 * a + (q & 1)) << level);
                    m[q] = wanted[at[q]];
                    wanted[at[q]] = 0;
                }
                for (int q = 0; q < 4; ++q) {
                    if (!m[q]) continue;
                    int mask = 0;  // of the texels of this material; listed with the first of them
                    for (int p = 0; p < 4; ++p) mask |= (m[p] == m[q]) << p;
                    ++shaded_here;
                    if (mask & ((1 << q) - 1)) continue;
                    int& next = cursor.data[(m[q] - 1) * rows + row];
                    if (fill) {
                        const unsigned x = (x0 >> (level + 1)) + a, y = (y0 >> (level + 1)) + b;
                        const unsigned where = x | y << ROW_SHIFT;
                        quads.data[next] = (int)(where | (unsigned)mask << MASK_SHIFT | (unsigned)level << RATE_SHIFT);
                    }
                    ++next;
                }
            }
        }
        if (!fill) {
            tile_seen.data[tile] = seen_here;
            tile_shaded.data[tile] = shaded_here;
        }
        seen_texels += seen_here;
        shaded_texels += shaded_here;
    }
    if (!fill) {
        seen_count.data[row] = seen_texels;
        shaded_count.data[row] = shaded_texels;
    }
"""


@wp.func_native(f"enum {{ ROW_SHIFT = {ROW_SHIFT}, MASK_SHIFT = {MASK_SHIFT}, RATE_SHIFT = {RATE_SHIFT} }};" + _ROW)
def _list_row(
    row: int,
    seen: wp.array(dtype=wp.uint8),
    texel_material: wp.array(dtype=wp.uint8),
    rate: wp.array(dtype=wp.uint8),
    due: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    rows: int,
    fill: int,
    done: wp.array(dtype=wp.uint8),
    cursor: wp.array(dtype=wp.int32),
    seen_count: wp.array(dtype=wp.int32),
    shaded_count: wp.array(dtype=wp.int32),
    tile_seen: wp.array(dtype=wp.uint8),
    tile_shaded: wp.array(dtype=wp.uint8),
    quads: wp.array(dtype=wp.int32),
): ...


@wp.kernel
def list_kernel(
    first: int,
    seen: wp.array(dtype=wp.uint8),
    texel_material: wp.array(dtype=wp.uint8),
    rate: wp.array(dtype=wp.uint8),
    due: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    rows: int,
    fill: int,
    # outputs
    done: wp.array(dtype=wp.uint8),
    cursor: wp.array(dtype=wp.int32),
    seen_count: wp.array(dtype=wp.int32),
    shaded_count: wp.array(dtype=wp.int32),
    tile_seen: wp.array(dtype=wp.uint8),
    tile_shaded: wp.array(dtype=wp.uint8),
    quads: wp.array(dtype=wp.int32),
):
    """Count (``fill`` = 0), or write (1), the quads of a row of tiles that have texels to shade; then they are done.

    ``rate`` and ``due`` are per tile. ``cursor`` is [material][row]: counts in the first pass, positions in ``quads``
    in the second. ``seen_count`` and ``shaded_count`` [row], ``tile_seen`` and ``tile_shaded`` [tile] receive the
    texels that are read and those that are listed.
    """
    _list_row(
        first + wp.tid(),
        seen,
        texel_material,
        rate,
        due,
        width,
        height,
        rows,
        fill,
        done,
        cursor,
        seen_count,
        shaded_count,
        tile_seen,
        tile_shaded,
        quads,
    )
