"""The work list against a plain count, and what counts as facing."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import MASK_SHIFT, ROW_SHIFT
from warp_neumat.kernels.worklist import drawn, facing_kernel, list_kernel


def _expected(seen, material, done):
    """Return {material: {(column, row): mask}} and the texels seen and listed, by looping over texels."""
    found, wanted = {}, (seen > 0) & (material > 0) & (done == 0)
    for y, x in np.argwhere(wanted):
        quads = found.setdefault(int(material[y, x]) - 1, {})
        quad = (int(x) // 2, int(y) // 2)
        quads[quad] = quads.get(quad, 0) | 1 << (2 * (int(y) % 2) + int(x) % 2)
    return found, int((seen > 0).sum()), int(wanted.sum())


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (7, 5), (64, 48), (129, 33), (30, 31)])
def test_list_matches_a_plain_loop(rng, device, size):
    width, height = size
    material = rng.integers(0, 4, (height, width)).astype(np.uint8)
    seen = ((rng.random((height, width)) < 0.4) * rng.integers(1, 4, (height, width))).astype(np.uint8)
    seen[:, width // 3 : 2 * width // 3] = 0  # a run of empty quads, which is passed over eight texels at a time
    done = (rng.random((height, width)) < 0.3).astype(np.uint8)
    rows, columns = -(-height // 2), -(-width // 2)
    found, seen_texels, listed_texels = _expected(seen, material, done)

    def array(values, dtype):
        return wp.array(np.asarray(values).ravel(), dtype=dtype, device=device)

    marks, cursor = array(done, wp.uint8), array(np.zeros(3 * rows), wp.int32)
    seen_count, shaded_count = array(np.zeros(rows), wp.int32), array(np.zeros(rows), wp.int32)
    quads = array(np.full(3 * rows * columns, -1), wp.int32)
    common = [array(seen, wp.uint8), array(material, wp.uint8), width, height, rows]
    outputs = [marks, cursor, seen_count, shaded_count, quads]
    dispatch.launch(list_kernel, rows, inputs=[*common, 0], outputs=outputs, device=device)
    assert seen_count.numpy().sum() == seen_texels
    assert shaded_count.numpy().sum() == listed_texels
    assert np.array_equal(marks.numpy().reshape(height, width), done)
    counts = cursor.numpy().copy()
    starts = np.cumsum(counts) - counts
    cursor.assign(starts.astype(np.int32))
    dispatch.launch(list_kernel, rows, inputs=[*common, 1], outputs=outputs, device=device)
    listed = quads.numpy()
    for m in range(3):
        segment = listed[starts[m * rows] : starts[m * rows] + counts[m * rows : (m + 1) * rows].sum()]
        words = {(int(w) & 0x1FFF, int(w) >> ROW_SHIFT & 0x1FFF): int(w) >> MASK_SHIFT for w in segment}
        assert len(words) == len(segment)
        assert words == found.get(m, {})
    expected_done = (done > 0) | ((seen > 0) & (material > 0))
    assert np.array_equal(marks.numpy().reshape(height, width) > 0, expected_done)


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


def test_facing_knows_front_back_and_both_sides(device):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 2, 1], [0, 1, 1]], np.int32)  # front, back, back of two-sided, no area
    double = np.array([0, 0, 1, 1], np.uint8)
    side = wp.zeros(4, dtype=wp.int8, device=device)
    inputs = [wp.array(faces.ravel(), device=device), 4, wp.array(double, device=device)]
    inputs += [wp.array(points.ravel(), device=device), wp.vec3(0.2, 0.2, 3.0), 2]
    dispatch.launch(facing_kernel, 2, inputs=inputs, outputs=[side], device=device)
    assert side.numpy().tolist() == [1, 0, -1, 0]
