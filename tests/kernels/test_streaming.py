"""What the picture sees of each chart, against NumPy, and a chart's raster against the static atlas's."""

import numpy as np
import pytest
import warp as wp

from tests.kernels.test_atlas import patch
from warp_neumat.kernels import streaming
from warp_neumat.kernels.atlas import atlas_raster
from warp_neumat.kernels.dispatch import worker_count
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.streaming import BINS, COARSEST, FINEST, TILE, WORDS


def _look(triangle, barycentric, chart, corners, device):
    charts = int(chart.max()) + 1
    seen = wp.zeros(charts, dtype=wp.uint8, device=device)
    samples = wp.zeros(worker_count() * charts * WORDS, dtype=wp.int32, device=device)

    def put(values, dtype):
        return wp.array(values, dtype=dtype, device=device)

    arrays = (
        put(triangle, wp.int32),
        put(barycentric, wp.float32),
        put(chart, wp.int32),
        put(corners.ravel(), wp.float32),
    )
    streaming.seen_charts_job(*arrays, charts, seen, samples).run()
    return seen.numpy(), samples.numpy().reshape(-1, charts, WORDS).sum(axis=0)


def test_samples_match_float64(device, rng):
    height, width, faces = 203, 301, 40  # neither a multiple of the sampling step
    chart = rng.integers(0, 7, faces).astype(np.int32)
    chart[-1] = 7  # in no pixel
    corners = rng.uniform(0, 900, (faces, 3, 2)).astype(np.float32)
    triangle = np.repeat(np.repeat(rng.integers(-1, faces - 1, (26, 38)), 8, axis=0), 8, axis=1)[:height, :width]
    triangle[40:48] = -1
    barycentric = rng.uniform(0, 0.5, (height, width, 2)) * 10.0 ** rng.uniform(-3, -0.5, (height, width, 1))
    barycentric = barycentric.astype(np.float32)
    seen, samples = _look(triangle.astype(np.int32), barycentric, chart, corners, device)

    owner = np.where(triangle >= 0, chart[triangle], -1)
    np.testing.assert_array_equal(np.flatnonzero(seen), np.unique(owner[owner >= 0]))
    weights = np.concatenate([1 - barycentric.astype(np.float64).sum(-1, keepdims=True), barycentric], axis=-1)
    at = np.einsum("yxk,yxkd->yxd", weights, corners.astype(np.float64)[triangle])
    y, x = (g.ravel() for g in np.meshgrid(np.arange(0, height - 1, 4), np.arange(0, width - 1, 4), indexing="ij"))
    same = (owner[y, x] >= 0) & (owner[y, x] == owner[y, x + 1]) & (owner[y, x] == owner[y + 1, x])
    y, x = y[same], x[same]
    dx, dy = at[y, x + 1] - at[y, x], at[y + 1, x] - at[y, x]
    det = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
    octave = np.log2(det**2 / np.maximum((dx**2).sum(1), (dy**2).sum(1)))
    expected = np.zeros((8, BINS), int)
    np.add.at(expected, (owner[y, x], np.clip(np.floor(octave), COARSEST, FINEST).astype(int) - COARSEST), 1)
    border = (np.abs(octave - np.round(octave)) < 1e-2).sum()  # float32 may put these in the next bin
    assert (expected.sum(axis=0) > 10).all()
    assert border < 0.05 * expected.sum()
    assert np.abs(samples[:, 1:] - expected).sum() <= 2 * border
    np.testing.assert_array_equal(samples[:, 1:].sum(axis=1), expected.sum(axis=1))
    pixels = owner[::4, ::4]
    np.testing.assert_array_equal(samples[:, 0], np.bincount(pixels[pixels >= 0], minlength=8))


def test_an_empty_picture_sees_nothing(device):
    triangle = np.full((9, 13), -1, np.int32)
    seen, samples = _look(triangle, np.zeros((9, 13, 2)), np.zeros(1, np.int32), np.zeros((1, 3, 2)), device)
    assert not seen.any()
    assert not samples.any()


def _place(corners, side, column, row, width, height, origin, level, dilation, device):
    """Rasterise one chart into a rectangle of tiles of an empty sheet, and place its corners."""
    faces = len(corners)
    scale = 0.5**level
    outputs = [
        wp.full(side * side, -7, dtype=wp.int32, device=device),
        wp.zeros(2 * side * side, dtype=wp.float32, device=device),
        wp.zeros(side * side, dtype=wp.uint8, device=device),
    ]
    device_corners = wp.array(corners.ravel(), dtype=wp.float32, device=device)
    material = wp.array(1 + np.arange(faces) % 3, dtype=wp.uint8, device=device)
    box = (corners.min(axis=1) * scale - origin, corners.max(axis=1) * scale - origin)
    grid = np.array([[width, height]])
    offsets, members = streaming.tile_members(
        *box, np.zeros(faces, int), np.array([0, width * height]), grid, dilation + 0.5
    )
    y, x = np.divmod(np.arange(width * height), width)
    inside = TILE * np.stack([x, y], axis=1)
    tiles = np.concatenate(
        [inside + TILE * np.array([column, row]), inside + origin, np.full_like(inside, level)], axis=1
    )
    streaming.raster_charts(tiles[:, :5], offsets, members, device_corners, material, side, dilation, outputs)
    corner_uv, lod = (wp.zeros(n, dtype=wp.float32, device=device) for n in (6 * faces, faces))
    base = wp.array(np.where(np.arange(faces) % 2, 1.25, NO_LOD), dtype=wp.float32, device=device)
    places = np.array([[TILE * column - origin[0], TILE * row - origin[1], level]])
    streaming.place_charts(np.arange(faces), np.zeros(faces), places, device_corners, base, corner_uv, lod)
    triangle, barycentric, material = (a.numpy() for a in outputs)
    shaped = triangle.reshape(side, side), barycentric.reshape(side, side, 2), material.reshape(side, side)
    return *shaped, corner_uv.numpy().reshape(faces, 3, 2), lod.numpy()


@pytest.mark.parametrize("level", [0, 1, 2, 3])
@pytest.mark.parametrize("dilation", [1, 3])
def test_a_chart_is_the_static_raster_scaled_and_moved(device, rng, level, dilation):
    # Corners on 1/64 texel and near the origin, so that scaling and moving them is exact in float32 as well.
    corners = np.round(patch(7, 5, 9.7, (31.3, 45.6), rng, 3.0) * 64).astype(np.float32) / 64
    scale = np.float32(0.5**level)
    origin = np.floor(corners.min(axis=(0, 1)) * scale).astype(int) - dilation
    local = corners * scale - origin.astype(np.float32)
    width, height = np.ceil((local.max(axis=(0, 1)) + dilation + 1) / TILE).astype(int).tolist()
    w, h = TILE * width, TILE * height
    triangle, barycentric, material, corner_uv, lod = _place(
        corners, 128, 2, 1, width, height, origin, level, dilation, device
    )
    owner, weights = atlas_raster(local, np.zeros(len(local), np.int32), w, h, dilation=dilation, device=device)
    inside = (slice(TILE, TILE + h), slice(2 * TILE, 2 * TILE + w))
    np.testing.assert_array_equal(triangle[inside], owner)
    np.testing.assert_array_equal(barycentric[inside], weights)
    np.testing.assert_array_equal(material[inside], np.where(owner >= 0, 1 + owner % 3, 0))
    triangle[inside] = -7
    assert (triangle == -7).all()  # no texel outside was touched
    np.testing.assert_array_equal(corner_uv, local + np.float32([2 * TILE, TILE]))
    np.testing.assert_array_equal(lod, np.where(np.arange(len(local)) % 2, np.float32(1.25 + level), NO_LOD))


def test_a_far_chart_keeps_its_texels_bit_for_bit(device, rng):
    """Moving a corner from 1111.37 to 19.37 rounds it in float32; the texels must not know."""
    corners = patch(6, 4, 5.3, (1111.37, 21.71), rng, 1.5)
    owner, weights = atlas_raster(corners, np.zeros(len(corners), np.int32), 1200, 64, dilation=2, device=device)
    origin = np.floor(corners.min(axis=(0, 1))).astype(int) - 2
    triangle, barycentric, *_ = _place(corners, 64, 1, 2, 6, 5, origin, 0, 2, device)
    there = (slice(origin[1], origin[1] + 40), slice(origin[0], origin[0] + 48))
    assert (owner >= 0).sum() == (owner[there] >= 0).sum() > 400
    np.testing.assert_array_equal(triangle[16:56, 8:56], owner[there])
    np.testing.assert_array_equal(barycentric[16:56, 8:56], weights[there])
