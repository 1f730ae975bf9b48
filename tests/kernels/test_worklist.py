"""The work list against plain loops: what is listed, and at which rate; what is marked; what is in view."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import COLUMN_MASK, MASK_SHIFT, RATE_SHIFT, ROW_SHIFT
from warp_neumat.kernels.tiles import TILE, tile_count
from warp_neumat.kernels.visibility import CameraRaster
from warp_neumat.kernels.worklist import drawn, facing_kernel, list_kernel, mark_facing_kernel, mark_seen_kernel
from warp_neumat.pipeline.camera import Camera

wp.set_module_options(dispatch.module_options())


def _array(values, dtype, device):
    return wp.array(np.ascontiguousarray(values).ravel(), dtype=dtype, device=device)


def _expected(seen, material, rate, due, done):
    """Return what the list holds, {material: {(rate, column, row): mask}}; the texels listed; and ``done`` after it."""
    found, listed, after = {}, np.zeros(seen.shape, bool), done.copy()
    height, width = seen.shape
    for y in range(height):
        for x in range(width):
            tile = (y // TILE, x // TILE)
            box = np.s_[tile[0] * TILE : tile[0] * TILE + TILE, tile[1] * TILE : tile[1] * TILE + TILE]
            if not seen[box].any():
                continue  # nobody looks at it: it keeps what it has
            if due[tile]:
                after[y, x] = 0
            if not seen[y, x] or not material[y, x] or (done[y, x] and not due[tile]):
                continue
            listed[y, x], after[y, x] = True, 1
            r = int(rate[tile])
            if x % (1 << r) or y % (1 << r):
                r = 0  # between the anchors
            key = (r, x >> r + 1, y >> r + 1)
            quads = found.setdefault(int(material[y, x]) - 1, {})
            quads[key] = quads.get(key, 0) | 1 << (2 * (y >> r & 1) + (x >> r & 1))
    return found, listed, after


def _per_tile(texels, columns, rows):
    padded = np.zeros((rows * TILE, columns * TILE), np.int64)
    padded[: texels.shape[0], : texels.shape[1]] = texels
    return padded.reshape(rows, TILE, columns, TILE).sum(axis=(1, 3))


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (7, 5), (64, 48), (129, 33), (30, 31)])
def test_list_matches_a_plain_loop(rng, device, size):
    width, height = size
    columns, rows = tile_count(width, height)
    material = rng.integers(0, 4, (height, width)).astype(np.uint8)
    seen = ((rng.random((height, width)) < 0.4) * rng.integers(1, 4, (height, width))).astype(np.uint8)
    seen[:, width // 3 : 2 * width // 3] = 0  # a run of empty tiles
    done = (rng.random((height, width)) < 0.5).astype(np.uint8)
    rate, due = rng.integers(0, 3, (rows, columns)), rng.integers(0, 2, (rows, columns))
    found, listed, after = _expected(seen, material, rate, due, done)

    marks, cursor = _array(done, wp.uint8, device), _array(np.zeros(3 * rows), wp.int32, device)
    seen_count, shaded_count = (_array(np.full(rows, -1), wp.int32, device) for _ in range(2))
    tile_seen, tile_shaded = (_array(np.full(rows * columns, 99), wp.uint8, device) for _ in range(2))
    quads = _array(np.full(3 * 21 * rows * columns, -1), wp.int32, device)
    common = [_array(a, wp.uint8, device) for a in (seen, material, rate, due)] + [width, height, rows]
    outputs = [marks, cursor, seen_count, shaded_count, tile_seen, tile_shaded, quads]

    dispatch.launch(list_kernel, rows, inputs=[*common, 0], outputs=outputs, device=device)
    for texels, tiles, sums in ((seen > 0, tile_seen, seen_count), (listed, tile_shaded, shaded_count)):
        expected = _per_tile(texels, columns, rows)
        assert np.array_equal(tiles.numpy().reshape(rows, columns), expected)
        assert np.array_equal(sums.numpy(), expected.sum(axis=1))
    assert np.array_equal(marks.numpy().reshape(height, width), done)
    counts = cursor.numpy().copy()
    starts = np.cumsum(counts) - counts
    cursor.assign(starts.astype(np.int32))

    dispatch.launch(list_kernel, rows, inputs=[*common, 1], outputs=outputs, device=device)
    assert np.array_equal(cursor.numpy(), starts + counts)
    for m in range(3):
        segment = quads.numpy()[starts[m * rows] : starts[m * rows] + counts[m * rows : (m + 1) * rows].sum()]
        words = {}
        for w in segment.tolist():
            place = (w >> RATE_SHIFT & 3, w & COLUMN_MASK, w >> ROW_SHIFT & COLUMN_MASK)
            assert place not in words
            words[place] = w >> MASK_SHIFT & 15
        assert words == found.get(m, {})
    assert np.array_equal(marks.numpy().reshape(height, width), after)
    assert counts.sum() <= 3 * 21 * rows * columns


def _marking(rng, side, faces, pixels):
    """Return corners, triangles, weights and rates whose footprints float32 places exactly, and no anchor outside."""
    corners = rng.integers(4, 8 * side - 4, (faces, 3, 2)).astype(np.float32) / 8
    triangle = rng.integers(-1, faces, pixels).astype(np.int32)
    triangle[3 * pixels // 10 : 7 * pixels // 10] = -1  # whole blocks of background
    weights = (rng.multinomial(16, (1 / 3, 1 / 3, 1 / 3), pixels) / 16).astype(np.float32)
    columns, rows = tile_count(side, side)
    rate = rng.integers(0, 3, (rows, columns)).astype(np.uint8)
    rate[-1] = rate[:, -1] = 0
    return corners, triangle, weights, rate


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_marks_and_pixels_per_tile_match_a_plain_loop(rng, device, workers):
    side, pixels, per_block = 53, 4000, 128
    corners, triangle, weights, rate = _marking(rng, side, 60, pixels)
    rows, columns = rate.shape
    expected, counted = np.zeros((side, side), np.uint8), np.zeros((rows, columns), np.int64)
    for f, w in zip(triangle, weights.astype(np.float64), strict=True):
        if f < 0:
            continue
        s, t = np.clip(w @ corners[f] - 0.5, 0, side - 1.001)
        x, y = int(s), int(t)
        tile = (y // TILE, x // TILE)
        step = 1 << int(rate[tile])
        counted[tile] += 1
        for j in (0, 1):
            for i in (0, 1):
                expected[(y // step + j) * step, (x // step + i) * step] = 1
    assert 0.1 < expected.mean() < 0.9
    seen = wp.zeros(side * side, dtype=wp.uint8, device=device)
    counts = wp.zeros(workers * rate.size, dtype=wp.int32, device=device)
    inputs = [_array(triangle, wp.int32, device), _array(weights[:, 1:], wp.float32, device), pixels, per_block]
    inputs += [_array(corners, wp.float32, device), side, side, _array(rate, wp.uint8, device), columns, rate.size]
    blocks = dispatch.blocks(pixels, per_block)
    try:
        dispatch.set_worker_count(workers)
        dispatch.launch(mark_seen_kernel, blocks, inputs=inputs, outputs=[seen, counts], device=device, grain=1)
    finally:
        dispatch.set_worker_count(None)
    assert np.array_equal(seen.numpy().reshape(side, side), expected)
    assert np.array_equal(counts.numpy().reshape(workers, rows, columns).sum(axis=0), counted)
    counts.zero_()
    wp.launch(mark_seen_kernel, blocks, inputs=[0, workers - 1, *inputs], outputs=[seen, counts], device=device)
    assert np.array_equal(counts.numpy().reshape(workers, rows, columns)[-1], counted)  # each worker counts for itself


@pytest.mark.parametrize("too", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_facing_anchors_in_view_are_marked(rng, device, too):
    side, faces = 45, 30
    columns, rows = tile_count(side, side)
    triangle, material = rng.integers(0, faces, (side, side)), rng.integers(0, 3, (side, side))
    triangle[material == 0] = -1
    material[:2, :2], triangle[:2, :2] = 1, -1  # what unowned texels are where they are shaded too
    facing, on_screen = rng.integers(-1, 2, faces), rng.integers(0, 2, faces)
    rate = rng.integers(0, 3, (rows, columns))
    expected = np.zeros((side, side), np.uint8)
    for y in range(side):
        for x in range(side):
            f, step = max(triangle[y, x], 0), 1 << int(rate[y // TILE, x // TILE])
            wanted = (facing[f] != 0 or too[0]) and (on_screen[f] or too[1]) and material[y, x]
            expected[y, x] = bool(wanted and x % step == 0 and y % step == 0)
    seen = wp.zeros(side * side, dtype=wp.uint8, device=device)
    inputs = [_array(triangle, wp.int32, device), _array(material, wp.uint8, device), _array(facing, wp.int8, device)]
    inputs += [_array(on_screen, wp.uint8, device), *too, side, side * side, _array(rate, wp.uint8, device), columns]
    dispatch.launch(mark_facing_kernel, -(-side * side // 100), [*inputs, 100], [seen], device=device)
    assert np.array_equal(seen.numpy().reshape(side, side), expected)


@wp.kernel
def drawn_kernel(pixels: wp.array(dtype=wp.int32), begin: int, end: int, result: wp.array(dtype=wp.int32)):
    result[0] = drawn(pixels, begin, end)


def test_drawn_finds_a_single_pixel(device):
    pixels = np.full(1000, -1, np.int32)
    pixels[777] = 0
    result = wp.zeros(1, dtype=wp.int32, device=device)
    for begin, end, expected in ((0, 777, False), (0, 778, True), (777, 778, True), (778, 1000, False), (5, 5, False)):
        inputs = [wp.array(pixels, device=device), begin, end]
        wp.launch(drawn_kernel, dim=1, inputs=inputs, outputs=[result], device=device)
        assert bool(result.numpy()[0]) == expected


def _facing(points, faces, double, eye, clip, device):
    """Return side and on_screen of each triangle."""
    count = len(faces)
    side, on_screen = wp.zeros(count, dtype=wp.int8, device=device), wp.zeros(count, dtype=wp.uint8, device=device)
    inputs = [_array(faces, wp.int32, device), count, _array(double, wp.uint8, device)]
    inputs += [_array(points, wp.float32, device), wp.vec3(*map(float, eye)), wp.mat44(clip), 7]
    dispatch.launch(facing_kernel, -(-count // 7), inputs=inputs, outputs=[side, on_screen], device=device)
    return side.numpy(), on_screen.numpy()


def test_facing_knows_front_back_and_both_sides(device):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 2, 1], [0, 1, 1]], np.int32)  # front, back, back of two-sided, no area
    side, _ = _facing(points, faces, [0, 0, 1, 1], (0.2, 0.2, 3.0), np.eye(4), device)
    assert side.tolist() == [1, 0, -1, 0]


@pytest.mark.parametrize("size", [0.3, 3.0, 40.0], ids=["small", "middling", "larger than the view"])
def test_what_has_a_pixel_is_on_screen_and_what_is_beside_it_is_not(rng, device, size):
    camera = Camera.look_at((1, 2, 9), (0, 0, 0), fov_y=0.6, width=90, height=60, near=1.0, far=500.0)
    count = 3000
    points = (12 * rng.normal(size=(count, 1, 3)) + size * rng.normal(size=(count, 3, 3))).astype(np.float32)
    faces = np.arange(3 * count, dtype=np.int32).reshape(count, 3)
    double = rng.integers(0, 2, count).astype(bool)
    side, on_screen = _facing(points, faces, double, camera.eye, camera.clip(), device)
    seen = set()
    for part in np.array_split(np.arange(count), 60):  # few at a time, so that they hide little of each other
        raster = CameraRaster(faces[part], 3 * count, 90, 60, double_sided=double[part], device=device)
        raster.run(points.reshape(-1, 3), camera.clip())
        found = np.unique(raster.triangle.numpy())
        seen |= set(part[found[found >= 0]].tolist())
    seen = np.array(sorted(seen))
    assert len(seen) > 100
    assert on_screen[seen].all()
    assert side[seen].all()
    # A triangle whose corners are all beyond one plane by far is out.
    corners = np.concatenate([points, np.ones((count, 3, 1), np.float32)], 2) @ camera.clip().astype(np.float64).T
    xy, w = corners[..., :2], corners[..., 3:]
    beyond = (xy > w).all(1).any(1) | (xy < -w).all(1).any(1) | (corners[..., 2] < 0).all(1)
    assert (on_screen == ~beyond).mean() > 0.999
    assert 0.01 < on_screen.mean() < 0.99
