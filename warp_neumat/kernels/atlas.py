"""Triangle-ID atlas: which triangle every texel of a texture-space sheet shades, and where on it. [mobilevr], Sec. 4.2.

Corners are in texel units: texel (i, j) is centred at (i + 0.5, j + 0.5), x to the right, y down. A *chart* is a set
of triangles that are continuous on the sheet. Distances between texel centre and triangle are Chebyshev (a box of
half-size r around the centre meets the triangle) where they decide who owns a texel, because a texel and a bilinear
footprint are boxes, and Euclidean where they decide which point of the surface the texel stands for.

Everything runs in float64 once per sequence. The sheet is cut into square tiles; a host pass lists the triangles of
each tile in ascending order, and one thread owns one tile: no atomics, and the same result for any number of workers.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels.arrays import kind_of, take
from warp_neumat.kernels.dispatch import launch, module_options

wp.set_module_options(module_options())

FOOTPRINT = 1.0 + 1.0 / 64.0
"""Half-size [texel] of the box around a texel centre from which a bilinear fetch reads the texel.

One texel in exact arithmetic; the rest covers sample positions that float32 interpolation moves over a texel border.
"""

_RIM = wp.constant(wp.float32(FOOTPRINT - 0.5))  # a point this far from the edge has its footprint on the sheet
_SPARE = wp.constant(wp.float64(4.0))  # on the score of spare texels: more than any needed one scores, 2 · FOOTPRINT²
_NOBODY = wp.constant(wp.float32(3.0e38))


@wp.func
def cross2(a: wp.vec2d, b: wp.vec2d) -> wp.float64:
    """Return the z component of a × b: twice the signed area of the triangle (0, a, b)."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def corner(corners: wp.array(dtype=wp.vec2), index: int, centre: wp.vec2d) -> wp.vec2d:
    """Return corner ``index`` relative to a texel centre."""
    p = corners[index]
    return wp.vec2d(wp.float64(p[0]) - centre[0], wp.float64(p[1]) - centre[1])


@wp.func
def edge_reaches(p: wp.vec2d, q: wp.vec2d, winding: wp.float64, r: wp.float64) -> bool:
    """Return whether the box of half-size ``r`` around the origin meets the inner half-plane of edge pq."""
    return winding * cross2(p, q) + r * (wp.abs(q[0] - p[0]) + wp.abs(q[1] - p[1])) >= wp.float64(0.0)


@wp.func
def box_meets_triangle(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, r: wp.float64) -> bool:
    """Return whether the closed box of half-size ``r`` around the origin meets triangle abc, also one without area."""
    if wp.min(wp.min(a[0], b[0]), c[0]) > r or wp.max(wp.max(a[0], b[0]), c[0]) < -r:
        return False
    if wp.min(wp.min(a[1], b[1]), c[1]) > r or wp.max(wp.max(a[1], b[1]), c[1]) < -r:
        return False
    winding = wp.where(cross2(b - a, c - a) < wp.float64(0.0), wp.float64(-1.0), wp.float64(1.0))
    return edge_reaches(a, b, winding, r) and edge_reaches(b, c, winding, r) and edge_reaches(c, a, winding, r)


@wp.func
def closest_on_edge(p: wp.vec2d, q: wp.vec2d) -> wp.vec2d:
    """Return (squared distance to the origin, parameter in [0, 1]) of the closest point p + t (q − p)."""
    d = q - p
    t = wp.clamp(-wp.dot(p, d) / wp.max(wp.dot(d, d), wp.float64(1.0e-300)), wp.float64(0.0), wp.float64(1.0))
    x = p + t * d
    return wp.vec2d(wp.dot(x, x), t)


@wp.func
def closest_on_triangle(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> wp.vec3d:
    """Return (score, weight of b, weight of c) of the point of abc closest to the origin.

    The score is the squared distance, or −1 where the origin lies in the triangle, its edges included.
    """
    area = cross2(b - a, c - a)
    wa = cross2(b, c) / area
    wb = cross2(c, a) / area
    wc = cross2(a, b) / area
    if wa >= wp.float64(0.0) and wb >= wp.float64(0.0) and wc >= wp.float64(0.0):
        return wp.vec3d(wp.float64(-1.0), wb, wc)
    ab = closest_on_edge(a, b)
    bc = closest_on_edge(b, c)
    ca = closest_on_edge(c, a)
    best = wp.vec3d(ab[0], ab[1], wp.float64(0.0))
    if bc[0] < best[0]:
        best = wp.vec3d(bc[0], wp.float64(1.0) - bc[1], bc[1])
    if ca[0] < best[0]:
        best = wp.vec3d(ca[0], wp.float64(0.0), wp.float64(1.0) - ca[1])
    return best


@wp.func
def texel_span(p: float, q: float, r: float, reach: float, first: int, count: int) -> wp.vec2i:
    """Return the half-open range of texels in ``[first, first + count)`` with centres within ``reach`` of [p, r]."""
    low = wp.clamp(wp.floor(wp.min(wp.min(p, q), r) - reach - 0.5), float(first), float(first + count))
    high = wp.clamp(wp.ceil(wp.max(wp.max(p, q), r) + reach + 0.5), float(first), float(first + count))
    return wp.vec2i(int(low), int(high))


@wp.kernel
def atlas_raster_kernel(
    first: int,
    corners: wp.array(dtype=wp.vec2),
    offsets: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    tile: int,
    columns: int,
    width: int,
    height: int,
    reach: float,
    # outputs
    score: wp.array2d(dtype=wp.float32),
    triangle: wp.array2d(dtype=wp.int32),
    barycentric: wp.array2d(dtype=wp.vec2),
):
    t = first + wp.tid()
    x0 = (t % columns) * tile
    y0 = (t // columns) * tile
    tile_width = wp.min(tile, width - x0)
    tile_height = wp.min(tile, height - y0)
    for y in range(y0, y0 + tile_height):
        for x in range(x0, x0 + tile_width):
            score[y, x] = _NOBODY
            triangle[y, x] = -1
            barycentric[y, x] = wp.vec2(0.0, 0.0)
    owned = wp.float64(reach)
    needed = wp.min(owned, wp.float64(FOOTPRINT))
    for i in range(offsets[t], offsets[t + 1]):
        f = members[i]
        p = corners[3 * f]
        q = corners[3 * f + 1]
        r = corners[3 * f + 2]
        xs = texel_span(p[0], q[0], r[0], reach, x0, tile_width)
        ys = texel_span(p[1], q[1], r[1], reach, y0, tile_height)
        for y in range(ys[0], ys[1]):
            for x in range(xs[0], xs[1]):
                centre = wp.vec2d(wp.float64(x) + wp.float64(0.5), wp.float64(y) + wp.float64(0.5))
                a = corner(corners, 3 * f, centre)
                b = corner(corners, 3 * f + 1, centre)
                c = corner(corners, 3 * f + 2, centre)
                if box_meets_triangle(a, b, c, owned):
                    near = closest_on_triangle(a, b, c)
                    s = near[0]
                    if s >= wp.float64(0.0) and not box_meets_triangle(a, b, c, needed):
                        s = s + _SPARE
                    # Members ascend and only a smaller score replaces: among equals the lowest triangle wins.
                    if wp.float32(s) < score[y, x]:
                        score[y, x] = wp.float32(s)
                        triangle[y, x] = f
                        barycentric[y, x] = wp.vec2(wp.float32(near[1]), wp.float32(near[2]))


@wp.kernel
def atlas_folds_kernel(
    first: int,
    corners: wp.array(dtype=wp.vec2),
    chart: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    tile: int,
    columns: int,
    width: int,
    height: int,
    # outputs
    last: wp.array2d(dtype=wp.int32),
    folded: wp.array(dtype=wp.uint8),
):
    t = first + wp.tid()
    x0 = (t % columns) * tile
    y0 = (t // columns) * tile
    tile_width = wp.min(tile, width - x0)
    tile_height = wp.min(tile, height - y0)
    for y in range(y0, y0 + tile_height):
        for x in range(x0, x0 + tile_width):
            last[y, x] = -1
    for i in range(offsets[t], offsets[t + 1]):
        f = members[i]
        p = corners[3 * f]
        q = corners[3 * f + 1]
        r = corners[3 * f + 2]
        xs = texel_span(p[0], q[0], r[0], 0.0, x0, tile_width)
        ys = texel_span(p[1], q[1], r[1], 0.0, y0, tile_height)
        for y in range(ys[0], ys[1]):
            for x in range(xs[0], xs[1]):
                centre = wp.vec2d(wp.float64(x) + wp.float64(0.5), wp.float64(y) + wp.float64(0.5))
                a = corner(corners, 3 * f, centre)
                b = corner(corners, 3 * f + 1, centre)
                c = corner(corners, 3 * f + 2, centre)
                # A centre nearer to an edge than 1/256 texel may lie in both neighbours by rounding: it is in neither.
                winding = wp.where(cross2(b - a, c - a) < wp.float64(0.0), wp.float64(-1.0), wp.float64(1.0))
                slack = wp.float64(1.0 / 256.0)
                if (
                    winding * cross2(a, b) > slack * wp.length(b - a)
                    and winding * cross2(b, c) > slack * wp.length(c - b)
                    and winding * cross2(c, a) > slack * wp.length(a - c)
                ):
                    # Members come chart by chart, so the chart seen last is enough to tell a fold from a neighbour.
                    if last[y, x] == chart[f]:
                        folded[f] = wp.uint8(1)
                    last[y, x] = chart[f]


@wp.kernel
def atlas_leaks_kernel(
    first: int,
    corners: wp.array(dtype=wp.vec2),
    chart: wp.array(dtype=wp.int32),
    width: int,
    height: int,
    triangle: wp.array2d(dtype=wp.int32),
    # outputs
    leaks: wp.array(dtype=wp.uint8),
):
    f = first + wp.tid()
    p = corners[3 * f]
    q = corners[3 * f + 1]
    r = corners[3 * f + 2]
    low = wp.min(wp.min(p, q), r)
    high = wp.max(wp.max(p, q), r)
    # Written so that NaN fails: a footprint that a comparison cannot place is outside.
    inside = low[0] > _RIM and low[1] > _RIM and high[0] < float(width) - _RIM and high[1] < float(height) - _RIM
    leak = not inside
    if inside:
        xs = texel_span(p[0], q[0], r[0], 1.0, 0, width)
        ys = texel_span(p[1], q[1], r[1], 1.0, 0, height)
        for y in range(ys[0], ys[1]):
            for x in range(xs[0], xs[1]):
                centre = wp.vec2d(wp.float64(x) + wp.float64(0.5), wp.float64(y) + wp.float64(0.5))
                a = corner(corners, 3 * f, centre)
                b = corner(corners, 3 * f + 1, centre)
                c = corner(corners, 3 * f + 2, centre)
                if box_meets_triangle(a, b, c, wp.float64(FOOTPRINT)):
                    owner = triangle[y, x]
                    if owner < 0 or chart[wp.max(owner, 0)] != chart[f]:
                        leak = True
    leaks[f] = wp.uint8(wp.where(leak, 1, 0))


def _tile_size(device) -> int:
    return 32 if device.is_cpu else 8  # a GPU wants many threads, a core few list entries


def _tile_lists(corners, keep, order, reach: float, tile: int, width: int, height: int):
    """Return ``(offsets, members)``: per tile the triangles whose box, grown by ``reach``, meets it, in ``order``."""
    faces = order[keep[order]]
    columns, rows = -(-width // tile), -(-height // tile)
    box = corners[faces].astype(np.float64)
    low = np.floor((box.min(axis=1) - reach - 1.0) / tile)
    high = np.floor((box.max(axis=1) + reach + 1.0) / tile)
    on_sheet = (high >= 0).all(axis=1) & (low[:, 0] < columns) & (low[:, 1] < rows)
    faces = faces[on_sheet]
    last = np.array([columns - 1, rows - 1])
    low = np.clip(low[on_sheet], 0, last).astype(np.int64)
    span = np.clip(high[on_sheet], 0, last).astype(np.int64) - low + 1
    count = span[:, 0] * span[:, 1]
    if count.sum() >= 2**31:
        raise ValueError(f"{len(faces)} triangles cover {count.sum()} tiles of the atlas in total; 2^31 is the limit")
    entry = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
    column = low[entry, 0] + within % span[entry, 0]
    row = low[entry, 1] + within // span[entry, 0]
    number = row * columns + column
    members = faces[entry[np.argsort(number, kind="stable")]].astype(np.int32)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=columns * rows))]).astype(np.int32)
    return offsets, members


def _take_triangles(corner_uv, chart, kind):
    corners = take(corner_uv, "corner_uv", ("faces", 3, 2), wp.float32, kind)
    charts = take(chart, "chart", (corners.shape[0],), wp.int32, kind)
    flat = wp.array(ptr=corners.ptr, shape=(3 * corners.shape[0],), dtype=wp.vec2, device=kind.device)
    flat._ref = corners  # the view borrows the memory
    return flat, charts, corners.numpy()


def _check_size(width, height) -> None:
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise ValueError(f"width and height must be in 1 … 16384, got {width} × {height}")


def drawable(corner_uv, chart) -> np.ndarray:
    """Return which triangles own texels at all: finite corners, some area, and a chart (numpy, shape [faces], bool)."""
    corners = np.asarray(corner_uv, np.float64)
    with np.errstate(invalid="ignore"):
        p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
        return np.isfinite(corners).all(axis=(1, 2)) & (area != 0) & (np.asarray(chart) >= 0)


def atlas_raster(corner_uv, chart, width: int, height: int, *, dilation: int = 2, device=None):
    """Rasterise charts conservatively into a triangle-ID texture with barycentrics. [mobilevr], Sec. 4.2.

    A texel belongs to the first of these that applies, the lowest triangle among equals:

    1. a triangle that its centre lies in, edges included;
    2. the nearest triangle with a point whose bilinear footprint holds the texel (:data:`FOOTPRINT`); every texel
       that a triangle touches is one of these;
    3. the nearest triangle that touches a texel at most ``dilation`` texels away, diagonals included.

    So every footprint in a chart reads that chart alone where other charts are 2 · ``FOOTPRINT`` texels away and the
    edge of the sheet is one; :func:`atlas_leaks` checks it.

    Args:
        corner_uv: Corners [texel], shape [faces, 3, 2], float32.
        chart: Chart of each triangle, shape [faces], int32; −1 = the triangle owns nothing.
        width, height: Size of the sheet [texel], 1 … 16384.
        dilation: Further rings of texels around the touched ones; the footprint guarantee needs at least 1.
        device: Where numpy input is computed.

    Returns:
        ``(triangle, barycentric)``: int32 [height, width], −1 = unowned, and float32 [height, width, 2], the weights of
        the triangle's second and third corner at the texel centre, or at the closest point of the triangle where the
        centre lies outside. Triangles without area or with non-finite corners own nothing.

    Raises:
        ValueError: On a wrong shape or size.

    Error: owners equal the float64 reference wherever a centre is inside, weights to 3e-8 (CPU); the point they name is
        8e-8 of a triangle's size off. Held by test_raster_matches_reference, test_weights_reproduce_texel_centres.
    """
    _check_size(width, height)
    if dilation < 0:
        raise ValueError(f"dilation must be at least 0, got {dilation}")
    kind = kind_of(corner_uv, device)
    flat, charts, corners = _take_triangles(corner_uv, chart, kind)
    reach, tile = dilation + 0.5, _tile_size(kind.device)
    keep = drawable(corners, charts.numpy())
    offsets, members = _tile_lists(corners, keep, np.arange(len(corners)), reach, tile, width, height)
    place = functools.partial(wp.array, dtype=wp.int32, device=kind.device)
    triangle = kind.empty((height, width), wp.int32)
    barycentric = kind.empty((height, width, 2), wp.float32)
    weights = wp.array(ptr=barycentric.ptr, shape=(height, width), dtype=wp.vec2, device=kind.device)
    columns = -(-width // tile)
    launch(
        atlas_raster_kernel,
        len(offsets) - 1,
        inputs=[flat, place(offsets), place(members), tile, columns, width, height, reach],
        outputs=[wp.empty((height, width), dtype=wp.float32, device=kind.device), triangle, weights],
        device=kind.device,
    )
    return kind.give(triangle), kind.give(barycentric)


def atlas_folds(corner_uv, chart, width: int, height: int, *, device=None):
    """Return which triangles lie on others of their chart (numpy bool, shape [faces]).

    A texel centre is then strictly inside two triangles; shared edges do not count, and of the triangles that hold a
    centre the lowest is not marked. Arguments as for :func:`atlas_raster`; what overlaps between texel centres is not
    seen, so use a sheet of 1024² or more.
    """
    _check_size(width, height)
    kind = kind_of(corner_uv, device)
    flat, charts, corners = _take_triangles(corner_uv, chart, kind)
    host, tile = charts.numpy(), _tile_size(kind.device)
    order = np.argsort(host, kind="stable")
    offsets, members = _tile_lists(corners, drawable(corners, host), order, 0.0, tile, width, height)
    place = functools.partial(wp.array, dtype=wp.int32, device=kind.device)
    folded = wp.zeros(len(corners), dtype=wp.uint8, device=kind.device)
    last = wp.empty((height, width), dtype=wp.int32, device=kind.device)
    launch(
        atlas_folds_kernel,
        len(offsets) - 1,
        inputs=[flat, charts, place(offsets), place(members), tile, -(-width // tile), width, height],
        outputs=[last, folded],
        device=kind.device,
    )
    return folded.numpy().astype(bool)


def atlas_leaks(corner_uv, chart, triangle, *, device=None) -> np.ndarray:
    """Return which triangles have a point whose bilinear footprint leaves their chart (numpy bool, shape [faces]).

    A footprint leaves its chart where one of its texels is unowned, owned by another chart, or outside the sheet.
    Triangles without area count with their line or point; non-finite corners always leak.

    Arguments as for :func:`atlas_raster`, and ``triangle`` as it returns it, shape [height, width].
    """
    kind = kind_of(corner_uv, device)
    flat, charts, corners = _take_triangles(corner_uv, chart, kind)
    owner = take(triangle, "triangle", ("height", "width"), wp.int32, kind)
    leaks = wp.empty(len(corners), dtype=wp.uint8, device=kind.device)
    height, width = owner.shape
    launch(
        atlas_leaks_kernel,
        len(corners),
        inputs=[flat, charts, width, height, owner],
        outputs=[leaks],
        device=kind.device,
        grain=256,
    )
    return leaks.numpy().astype(bool)
