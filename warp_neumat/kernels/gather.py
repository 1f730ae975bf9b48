"""The picture, read bilinearly from the radiance texture (MobileVR §4.2, forward rendering).

The atlas guarantees that the four texels around any point of a chart belong to that chart (``pipeline/atlas.py``), so a
plain bilinear fetch never reads another chart.

``blank`` remembers which blocks of the picture hold nothing but background, so that those which stay empty cost no
writes.
"""

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.tiles import TILE_SHIFT, anchors
from warp_neumat.kernels.worklist import drawn, footprint

wp.set_module_options(dispatch.module_options())


@wp.kernel
def gather_kernel(
    first: int,
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_barycentric: wp.array(dtype=wp.float32),
    pixel_count: int,
    per_block: int,
    corner_uv: wp.array(dtype=wp.float32),
    radiance: wp.array(dtype=wp.float16),
    width: int,
    height: int,
    rate: wp.array(dtype=wp.uint8),
    columns: int,
    background: wp.vec3,
    # outputs
    blank: wp.array(dtype=wp.uint8),
    image: wp.array(dtype=wp.float32),
):
    b = first + wp.tid()
    end = wp.min((b + 1) * per_block, pixel_count)
    empty = wp.where(drawn(pixel_triangle, b * per_block, end) == 0, 1, 0)
    if empty == 1 and blank[b] == wp.uint8(1):
        return
    blank[b] = wp.uint8(empty)
    for i in range(b * per_block, end):
        f = pixel_triangle[i]
        if f >= 0:
            x, y, u, v = footprint(corner_uv, f, pixel_barycentric[2 * i], pixel_barycentric[2 * i + 1], width, height)
            r = int(rate[(y >> TILE_SHIFT) * columns + (x >> TILE_SHIFT)])
            x0, y0, s, t = anchors(x, y, u, v, r)
            at = 4 * (y0 * width + x0)
            right = 4 << r
            below = (4 * width) << r
            for c in range(3):
                top = (1.0 - s) * float(radiance[at + c]) + s * float(radiance[at + right + c])
                bottom = (1.0 - s) * float(radiance[at + below + c]) + s * float(radiance[at + below + right + c])
                image[3 * i + c] = (1.0 - t) * top + t * bottom
        else:
            for c in range(3):
                image[3 * i + c] = background[c]


@wp.kernel
def resolve_kernel(
    first: int,
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_count: int,
    per_block: int,
    radiance: wp.array(dtype=wp.float16),
    background: wp.vec3,
    # outputs
    blank: wp.array(dtype=wp.uint8),
    image: wp.array(dtype=wp.float32),
):
    """The picture from radiance that was shaded per pixel."""
    b = first + wp.tid()
    end = wp.min((b + 1) * per_block, pixel_count)
    empty = wp.where(drawn(pixel_triangle, b * per_block, end) == 0, 1, 0)
    if empty == 1 and blank[b] == wp.uint8(1):
        return
    blank[b] = wp.uint8(empty)
    for i in range(b * per_block, end):
        covered = pixel_triangle[i] >= 0
        for c in range(3):
            image[3 * i + c] = wp.where(covered, float(radiance[4 * i + c]), background[c])
