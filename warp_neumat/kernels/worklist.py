"""What has to be shaded: facing triangles, seen texels, and the compacted list of 2×2 quads (DESIGN: skip, then speed up).

Seen means read: a texel is marked when the bilinear footprint of a visible pixel covers it, so the list holds exactly what
the gather is about to read. Each quad remembers the epoch it was last shaded in; quads of the current epoch are left out,
which is both the reuse over frames and the repair of what comes into view in between.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import QUAD_SHIFT

wp.set_module_options(dispatch.module_options())


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
        if texel_material[i] != wp.uint8(0):
            if backfacing_too != 0 or side[wp.max(triangle[i], 0)] != wp.int8(0):
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
    for i in range(b * per_block, wp.min((b + 1) * per_block, pixel_count)):
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


@functools.cache
def make_list_kernel(fill: bool):
    """Return the kernel that counts (``fill=False``) or writes a row of quads, one segment per material."""

    @wp.func
    def texel(image: wp.array(dtype=wp.uint8), x: int, y: int, width: int, height: int) -> int:
        value = int(0)
        if x < width and y < height:
            value = int(image[y * width + x])
        return value

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def list_kernel(
        first: int,
        seen: wp.array(dtype=wp.uint8),
        texel_material: wp.array(dtype=wp.uint8),
        width: int,
        height: int,
        rows: int,
        epoch: int,
        stamp: wp.array(dtype=wp.int32),
        # counts per [material][row] when counting, cursors into ``quads`` when filling
        cursor: wp.array(dtype=wp.int32),
        seen_count: wp.array(dtype=wp.int32),
        shaded_count: wp.array(dtype=wp.int32),
        quads: wp.array(dtype=wp.int32),
    ):
        row = first + wp.tid()
        columns = (width + 1) >> 1
        seen_texels = int(0)
        shaded_texels = int(0)
        for column in range(columns):
            x = 2 * column
            y = 2 * row
            marks = (
                texel(seen, x, y, width, height)
                + texel(seen, x + 1, y, width, height)
                + texel(seen, x, y + 1, width, height)
                + texel(seen, x + 1, y + 1, width, height)
            )
            if marks > 0:
                seen_texels += marks
                if stamp[row * columns + column] < epoch:
                    m0 = texel(texel_material, x, y, width, height)
                    m1 = texel(texel_material, x + 1, y, width, height)
                    m2 = texel(texel_material, x, y + 1, width, height)
                    m3 = texel(texel_material, x + 1, y + 1, width, height)
                    for q in range(4):
                        m = wp.where(q == 0, m0, wp.where(q == 1, m1, wp.where(q == 2, m2, m3)))
                        # A quad on a border between materials is listed once for each.
                        fresh = m > 0
                        if q > 0 and m == m0:
                            fresh = False
                        if q > 1 and m == m1:
                            fresh = False
                        if q > 2 and m == m2:
                            fresh = False
                        if fresh:
                            at = (m - 1) * rows + row
                            if wp.static(fill):
                                quads[cursor[at]] = column | (row << QUAD_SHIFT)
                            cursor[at] = cursor[at] + 1
                        if m > 0:
                            shaded_texels += 1
                    if wp.static(fill):
                        stamp[row * columns + column] = epoch
        if not wp.static(fill):
            seen_count[row] = seen_texels
            shaded_count[row] = shaded_texels

    return list_kernel
