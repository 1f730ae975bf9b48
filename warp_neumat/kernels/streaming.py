"""Charts on demand: which the picture sees, how fine it sees them, and their raster into a rectangle of a sheet.

A chart's *virtual* corners are those of its layout [texel]. On the sheet it lies at

    sheet = virtual · 2^-level + shift,    shift a whole number of texels,

so at level 0 its texel centres name the same points of the surface as in the static atlas, bit for bit: the raster
works in virtual coordinates, in float64, and only the result is written at the shifted place.

How fine a chart is seen is measured where a pixel, its right and its lower neighbour show the same chart, in every
fourth column and row: with J the steps in virtual texels, ρ = |det J| / max(|Jx|, |Jy|) is about J's least singular
value, the number of texels that a pixel spans along the axis that is minified least. Taking a chart 2^-level as fine
where ρ ≥ 2^level loses nothing that the pixels could show. Counted are half octaves of ρ, not means: a jump of depth
inside a chart gives a few wild values, which a quantile forgets.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels.atlas import FOOTPRINT, box_meets_triangle, closest_on_triangle, cross2, texel_span
from warp_neumat.kernels.dispatch import Job, blocks, launch, module_options
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.worklist import drawn

wp.set_module_options(module_options())

TILE = 8
"""Side of a tile [texel]: rectangles start and end at whole tiles."""

COARSEST, FINEST = -4, 7
"""Half octaves of texels per pixel that are told apart: h holds h/2 ≤ log₂ ρ < (h + 1)/2, the ends all beyond."""

BINS = FINEST - COARSEST + 1

WORDS = 1 + BINS
"""Counters of a chart: its sampled pixels, then how many of them are in each bin."""

_WORDS = wp.constant(WORDS)
_LOW = wp.constant(COARSEST)
_HIGH = wp.constant(FINEST)
_TILE = wp.constant(TILE)
_SPARE = wp.constant(wp.float64(4.0))  # as in atlas_raster: a texel that no footprint needs yields to one that does
_NOBODY = wp.constant(wp.float32(3.0e38))


@wp.func
def virtual_point(corners: wp.array(dtype=wp.float32), f: int, b1: float, b2: float) -> wp.vec2:
    """Return where the point of triangle ``f`` lies in the layout [texel]."""
    at = 6 * f
    b0 = 1.0 - b1 - b2
    return wp.vec2(
        b0 * corners[at] + b1 * corners[at + 2] + b2 * corners[at + 4],
        b0 * corners[at + 1] + b1 * corners[at + 3] + b2 * corners[at + 5],
    )


@wp.func
def density_bin(dx: wp.vec2, dy: wp.vec2) -> int:
    """Return the bin of ρ for the steps of a pixel to the right and down [texel]."""
    det = dx[0] * dy[1] - dx[1] * dy[0]
    rho2 = det * det / wp.max(wp.max(wp.dot(dx, dx), wp.dot(dy, dy)), 1.0e-20)
    # Half octaves of ρ are octaves of ρ²: the exponent of the float.
    return wp.clamp((wp.cast(rho2, wp.int32) >> 23) - 127, _LOW, _HIGH) - _LOW


@wp.kernel
def seen_charts_kernel(
    first: int,
    slot: int,
    pixel_triangle: wp.array(dtype=wp.int32),
    pixel_barycentric: wp.array(dtype=wp.float32),
    width: int,
    height: int,
    columns: int,
    strips: int,
    face_chart: wp.array(dtype=wp.int32),
    corners: wp.array(dtype=wp.float32),
    charts: int,
    # outputs
    seen: wp.array(dtype=wp.uint8),
    samples: wp.array(dtype=wp.int32),
):
    """Mark the charts of four rows of ``columns`` pixels, and count samples of how fine they are seen.

    ``seen`` [chart] may be written by several blocks, which write the same; ``samples`` [worker][chart][:data:`WORDS`]
    is added to: pixels at every fourth column and row, and how many of those are in each bin.
    """
    b = first + wp.tid()
    y0 = 4 * (b // strips)
    x0 = (b % strips) * columns
    x1 = wp.min(x0 + columns, width)
    for y in range(y0, wp.min(y0 + 4, height)):
        row = y * width
        if drawn(pixel_triangle, row + x0, row + x1) != 0:
            for i in range(row + x0, row + x1):
                f = pixel_triangle[i]
                if f >= 0:
                    seen[face_chart[f]] = wp.uint8(1)
            if y == y0:
                for step in range((x1 - x0 + 3) // 4):
                    x = x0 + 4 * step
                    i = row + x
                    f = pixel_triangle[i]
                    if f >= 0:
                        chart = face_chart[f]
                        at = (slot * charts + chart) * _WORDS
                        wp.atomic_add(samples, at, 1)
                        j = wp.where(x + 1 < width, i + 1, i)
                        k = wp.where(y + 1 < height, i + width, i)
                        right = pixel_triangle[j]
                        below = pixel_triangle[k]
                        if wp.min(j, k) > i and wp.min(right, below) >= 0:
                            other = wp.vec2i(face_chart[right], face_chart[below])
                            if other[0] == chart and other[1] == chart:
                                p = virtual_point(corners, f, pixel_barycentric[2 * i], pixel_barycentric[2 * i + 1])
                                q = virtual_point(
                                    corners, right, pixel_barycentric[2 * j], pixel_barycentric[2 * j + 1]
                                )
                                r = virtual_point(
                                    corners, below, pixel_barycentric[2 * k], pixel_barycentric[2 * k + 1]
                                )
                                wp.atomic_add(samples, at + 1 + density_bin(q - p, r - p), 1)


@wp.func
def scaled_corner(corners: wp.array(dtype=wp.float32), index: int, scale: wp.float64, centre: wp.vec2d) -> wp.vec2d:
    """Return a virtual corner at the scale of its chart, relative to a texel centre; exact for a power of two."""
    return wp.vec2d(
        wp.float64(corners[2 * index]) * scale - centre[0], wp.float64(corners[2 * index + 1]) * scale - centre[1]
    )


@wp.func
def tile_span(
    corners: wp.array(dtype=wp.float32), f: int, axis: int, scale: wp.float64, origin: int, reach: float
) -> wp.vec2i:
    """Return the half-open range of a tile's columns (``axis`` 0) or rows with centres within ``reach`` of ``f``."""
    o = wp.float64(origin)
    p = wp.float32(wp.float64(corners[6 * f + axis]) * scale - o)
    q = wp.float32(wp.float64(corners[6 * f + 2 + axis]) * scale - o)
    r = wp.float32(wp.float64(corners[6 * f + 4 + axis]) * scale - o)
    return texel_span(p, q, r, reach, 0, _TILE)


@wp.kernel
def chart_raster_kernel(
    first: int,
    tiles: wp.array2d(dtype=wp.int32),
    offsets: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    corners: wp.array(dtype=wp.float32),
    face_material: wp.array(dtype=wp.uint8),
    side: int,
    reach: float,
    # outputs
    score: wp.array2d(dtype=wp.float32),
    triangle: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.float32),
    material: wp.array(dtype=wp.uint8),
):
    """Rasterise one tile by the rules of ``atlas_raster``; a tile without members is cleared.

    ``tiles`` [n, 5]: texel column and row on the sheet, the same in the scaled layout, and the level. ``score`` [n, 64]
    is scratch.
    Error: at level 0 none against ``atlas_raster``; held by test_a_far_chart_keeps_its_texels_bit_for_bit.
    """
    t = first + wp.tid()
    scale = wp.float64(1.0) / wp.float64(1 << tiles[t, 4])
    owned = wp.float64(reach)
    needed = wp.min(owned, wp.float64(FOOTPRINT))
    ox = tiles[t, 2]
    oy = tiles[t, 3]
    start = tiles[t, 1] * side + tiles[t, 0]
    for i in range(_TILE * _TILE):
        at = start + (i // _TILE) * side + i % _TILE
        score[t, i] = _NOBODY
        triangle[at] = -1
        barycentric[2 * at] = 0.0
        barycentric[2 * at + 1] = 0.0
        material[at] = wp.uint8(0)
    # Most texels lie in a triangle, which is cheaper to find than the closest point of one that they lie beside.
    left = int(_TILE * _TILE)
    for i in range(offsets[t], offsets[t + 1]):
        f = members[i]
        xs = tile_span(corners, f, 0, scale, ox, 0.0)
        ys = tile_span(corners, f, 1, scale, oy, 0.0)
        for y in range(ys[0], ys[1]):
            for x in range(xs[0], xs[1]):
                if score[t, _TILE * y + x] >= 0.0:  # members ascend: among equals the lowest triangle wins
                    centre = wp.vec2d(wp.float64(ox + x) + wp.float64(0.5), wp.float64(oy + y) + wp.float64(0.5))
                    a = scaled_corner(corners, 3 * f, scale, centre)
                    b = scaled_corner(corners, 3 * f + 1, scale, centre)
                    c = scaled_corner(corners, 3 * f + 2, scale, centre)
                    area = cross2(b - a, c - a)
                    ua = cross2(b, c)
                    ub = cross2(c, a)
                    uc = cross2(a, b)
                    low = wp.min(wp.min(ua, ub), uc)
                    high = wp.max(wp.max(ua, ub), uc)
                    if wp.where(area < wp.float64(0.0), -high, low) >= wp.float64(0.0):
                        score[t, _TILE * y + x] = -1.0
                        at = start + y * side + x
                        triangle[at] = f
                        barycentric[2 * at] = wp.float32(ub / area)
                        barycentric[2 * at + 1] = wp.float32(uc / area)
                        material[at] = face_material[f]
                        left -= 1
    if left > 0:
        for i in range(offsets[t], offsets[t + 1]):
            f = members[i]
            xs = tile_span(corners, f, 0, scale, ox, reach)
            ys = tile_span(corners, f, 1, scale, oy, reach)
            for y in range(ys[0], ys[1]):
                for x in range(xs[0], xs[1]):
                    if score[t, _TILE * y + x] >= 0.0:
                        centre = wp.vec2d(wp.float64(ox + x) + wp.float64(0.5), wp.float64(oy + y) + wp.float64(0.5))
                        a = scaled_corner(corners, 3 * f, scale, centre)
                        b = scaled_corner(corners, 3 * f + 1, scale, centre)
                        c = scaled_corner(corners, 3 * f + 2, scale, centre)
                        if box_meets_triangle(a, b, c, owned):
                            near = closest_on_triangle(a, b, c)
                            s = near[0]
                            if not box_meets_triangle(a, b, c, needed):
                                s = s + _SPARE
                            if wp.float32(s) < score[t, _TILE * y + x]:
                                score[t, _TILE * y + x] = wp.float32(s)
                                at = start + y * side + x
                                triangle[at] = f
                                barycentric[2 * at] = wp.float32(near[1])
                                barycentric[2 * at + 1] = wp.float32(near[2])
                                material[at] = face_material[f]


@wp.kernel
def place_kernel(
    first: int,
    faces: wp.array(dtype=wp.int32),
    which: wp.array(dtype=wp.int32),
    count: int,
    per_block: int,
    places: wp.array2d(dtype=wp.int32),
    corners: wp.array(dtype=wp.float32),
    base_lod: wp.array(dtype=wp.float32),
    # outputs
    corner_uv: wp.array(dtype=wp.float32),
    least_lod: wp.array(dtype=wp.float32),
):
    """Write the corners on the sheet, and the mip level of an atlas texel, of each listed face.

    ``which`` is the row of ``places`` [n, 3], the chart's shift in columns and rows and its level, that a face obeys.
    """
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, count)):
        f = faces[i]
        k = which[i]
        scale = wp.float64(1.0) / wp.float64(1 << places[k, 2])
        for j in range(3):
            for d in range(2):
                at = 6 * f + 2 * j + d
                corner_uv[at] = wp.float32(wp.float64(corners[at]) * scale + wp.float64(places[k, d]))
        lod = base_lod[f]
        if lod > NO_LOD:  # else a point, at any scale
            lod = wp.min(lod + float(places[k, 2]), -NO_LOD)
        least_lod[f] = lod


def seen_charts_job(triangle, barycentric, face_chart, corners, charts: int, seen, samples) -> Job:
    """Return the recorded launch of :func:`seen_charts_kernel` for the arrays of a camera raster.

    Args:
        triangle, barycentric: Of the raster, shapes (H, W) and (H, W, 2), on the device.
        face_chart: Chart of each face, int32, flat.
        corners: Virtual corners, 6 per face, float32, flat.
        charts: Number of charts.
        seen: uint8, one per chart; samples: int32, :data:`WORDS` per chart and worker, flat. The caller clears both.
    """
    device = triangle.device
    height, width = triangle.shape
    columns = width if device.is_cpu else 16
    strips = blocks(width, columns)
    inputs = [triangle.flatten(), barycentric.flatten(), width, height, columns, strips, face_chart, corners, charts]
    count = strips * blocks(height, 4)
    return Job(seen_charts_kernel, count, inputs=inputs, outputs=[seen, samples], device=device, grain=2)


def tile_members(low, high, which, first_tile, grid, reach: float):
    """Return ``(offsets, members)``: for every tile of some rectangles, the rows of ``low`` whose boxes may own in it.

    Args:
        low, high: Boxes in texels of the own rectangle, shape [n, 2].
        which: Rectangle of each box, shape [n].
        first_tile: Number of the first tile of each rectangle; tiles are numbered row by row, shape [rectangles + 1].
        grid: Columns and rows of tiles of each rectangle, shape [rectangles, 2].
        reach: How far beyond its box a triangle owns texels [texel].
    """
    last = grid[which] - 1
    start = np.clip(np.floor((low - reach - 1.0) / TILE), 0, last).astype(np.int64)
    span = np.clip(np.floor((high + reach + 1.0) / TILE), 0, last).astype(np.int64) - start + 1
    count = span[:, 0] * span[:, 1]
    entry = np.repeat(np.arange(len(low)), count)
    within = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
    column = start[entry, 0] + within % span[entry, 0]
    row = start[entry, 1] + within // span[entry, 0]
    tile = first_tile[which[entry]] + row * grid[which[entry], 0] + column
    offsets = np.concatenate([[0], np.cumsum(np.bincount(tile, minlength=first_tile[-1]))]).astype(np.int32)
    return offsets, entry[np.argsort(tile, kind="stable")]


def raster_charts(tiles, offsets, members, corners, face_material, side: int, dilation: int, outputs) -> None:
    """Launch :func:`chart_raster_kernel` over numpy ``tiles``, ``offsets`` and ``members``."""
    device = corners.device
    host = [
        wp.array(np.ascontiguousarray(v, np.int32), dtype=wp.int32, device=device) for v in (tiles, offsets, members)
    ]
    inputs = [*host, corners, face_material, side, dilation + 0.5]
    score = wp.empty((len(tiles), TILE * TILE), dtype=wp.float32, device=device)
    launch(chart_raster_kernel, len(tiles), inputs=inputs, outputs=[score, *outputs], device=device, grain=8)


def place_charts(faces, which, places, corners, base_lod, corner_uv, least_lod) -> None:
    """Launch :func:`place_kernel` over numpy ``faces``, ``which`` and ``places``."""
    device = corners.device
    per_block = 1024 if device.is_cpu else 1
    faces, which, places = (
        wp.array(np.ascontiguousarray(v, np.int32), dtype=wp.int32, device=device) for v in (faces, which, places)
    )
    launch(
        place_kernel,
        blocks(len(faces), per_block),
        inputs=[faces, which, len(faces), per_block, places, corners, base_lod],
        outputs=[corner_uv, least_lod],
        device=device,
    )
