"""What has to be shaded: facing triangles, seen texels, and the compacted list of 2×2 quads.

Seen means read: a texel is marked when the bilinear footprint of a visible pixel covers it, so the list holds exactly
what the gather is about to read. ``done`` remembers what the epoch has shaded already; it is left out, which is both
the reuse over frames and the repair of what comes into view in between.
"""

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import MASK_SHIFT, ROW_SHIFT

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
    per_block: int,
    # outputs
    side: wp.array(dtype=wp.int8),
):
    """Which side of each triangle the eye sees: 1 front, −1 back of a double-sided one, 0 neither."""
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


@wp.kernel
def mark_facing_kernel(
    first: int,
    triangle: wp.array(dtype=wp.int32),
    texel_material: wp.array(dtype=wp.uint8),
    side: wp.array(dtype=wp.int8),
    backfacing_too: int,
    texel_count: int,
    per_block: int,
    # outputs
    seen: wp.array(dtype=wp.uint8),
):
    """Mark every texel whose triangle faces the eye, or every texel with a material."""
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, texel_count)):
        wanted = backfacing_too != 0 or side[wp.max(triangle[i], 0)] != wp.int8(0)
        if wanted and texel_material[i] != wp.uint8(0):
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
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_barycentric: wp.array(dtype=wp.float32),
    pixel_count: int,
    per_block: int,
    corner_uv: wp.array(dtype=wp.float32),
    width: int,
    height: int,
    # outputs
    seen: wp.array(dtype=wp.uint8),
):
    """Mark the texels that the visible pixels will read; blocks may write the same 1 to the same texel."""
    b = first + wp.tid()
    end = wp.min((b + 1) * per_block, pixel_count)
    if drawn(pixel_triangle, b * per_block, end) == 0:
        return
    for i in range(b * per_block, end):
        f = pixel_triangle[i]
        if f >= 0:
            x, y, u, v = footprint(corner_uv, f, pixel_barycentric[2 * i], pixel_barycentric[2 * i + 1], width, height)
            at = y * width + x
            seen[at] = wp.uint8(1)
            seen[at + 1] = wp.uint8(1)
            seen[at + width] = wp.uint8(1)
            seen[at + width + 1] = wp.uint8(1)


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


# One row of quads. Most quads are empty, so eight bytes of either texel row are tested at once. A texel outside an
# image of odd size reads as 0. With `fill`, the cursors are positions in `quads`; without, they count.
_ROW = """
    const int columns = (width + 1) >> 1;
    const int y = 2 * row;
    const long long at0 = (long long)y * width, at1 = at0 + width;
    const unsigned char *s0 = seen.data + at0, *m0 = texel_material.data + at0;
    unsigned char* d0 = done.data + at0;
    const bool two = y + 1 < height;
    const unsigned char *s1 = two ? seen.data + at1 : s0, *m1 = two ? texel_material.data + at1 : m0;
    unsigned char* d1 = two ? done.data + at1 : d0;
    int seen_texels = 0, shaded_texels = 0;
    for (int column = 0; column < columns; ++column) {
        const int x = 2 * column;
        if (x + 8 <= width) {
            unsigned long long a, b;
            memcpy(&a, s0 + x, 8);
            memcpy(&b, s1 + x, 8);
            if (!(a | b)) { column += 3; continue; }
        }
        const bool wide = x + 1 < width;
        const int s[4] = {s0[x] != 0, wide && s0[x + 1], two && s1[x], two && wide && s1[x + 1]};
        const int marks = s[0] + s[1] + s[2] + s[3];
        if (!marks) continue;
        seen_texels += marks;
        int m[4];  // material + 1 of the texels that are wanted: seen, owned, and not shaded yet
        m[0] = s[0] && !d0[x] ? m0[x] : 0;
        m[1] = s[1] && !d0[x + 1] ? m0[x + 1] : 0;
        m[2] = s[2] && !d1[x] ? m1[x] : 0;
        m[3] = s[3] && !d1[x + 1] ? m1[x + 1] : 0;
        for (int q = 0; q < 4; ++q) {
            if (!m[q]) continue;
            int mask = 0;  // of the texels of this material; listed with the first of them
            for (int p = 0; p < 4; ++p) mask |= (m[p] == m[q]) << p;
            ++shaded_texels;
            if (mask & ((1 << q) - 1)) continue;
            int& next = cursor.data[(m[q] - 1) * rows + row];
            if (fill) quads.data[next] = column | row << ROW_SHIFT | mask << MASK_SHIFT;
            ++next;
        }
        if (fill) {
            if (m[0]) d0[x] = 1;
            if (m[1]) d0[x + 1] = 1;
            if (m[2]) d1[x] = 1;
            if (m[3]) d1[x + 1] = 1;
        }
    }
    if (!fill) {
        seen_count.data[row] = seen_texels;
        shaded_count.data[row] = shaded_texels;
    }
"""


@wp.func_native(f"enum {{ ROW_SHIFT = {ROW_SHIFT}, MASK_SHIFT = {MASK_SHIFT} }};" + _ROW)
def _list_row(
    row: int,
    seen: wp.array(dtype=wp.uint8),
    texel_material: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    rows: int,
    fill: int,
    done: wp.array(dtype=wp.uint8),
    cursor: wp.array(dtype=wp.int32),
    seen_count: wp.array(dtype=wp.int32),
    shaded_count: wp.array(dtype=wp.int32),
    quads: wp.array(dtype=wp.int32),
): ...


@wp.kernel
def list_kernel(
    first: int,
    seen: wp.array(dtype=wp.uint8),
    texel_material: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    rows: int,
    fill: int,
    # outputs
    done: wp.array(dtype=wp.uint8),
    cursor: wp.array(dtype=wp.int32),
    seen_count: wp.array(dtype=wp.int32),
    shaded_count: wp.array(dtype=wp.int32),
    quads: wp.array(dtype=wp.int32),
):
    """Count (``fill`` = 0), or write (1), the quads of a row that have texels seen but not done; then they are done.

    ``cursor`` is [material][row]: counts in the first pass, positions in ``quads`` in the second. ``seen_count`` and
    ``shaded_count`` [row] receive the texels that are read and those that are listed.
    """
    _list_row(
        first + wp.tid(),
        seen,
        texel_material,
        width,
        height,
        rows,
        fill,
        done,
        cursor,
        seen_count,
        shaded_count,
        quads,
    )
