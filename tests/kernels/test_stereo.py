"""What two eyes differ in, and how shared tiles are handed over, against float64 and plain numpy."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch, stereo
from warp_neumat.kernels.shade import Surface, assign_lights, make_lights
from warp_neumat.kernels.tiles import tile_count
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.reference import schedule as reference

LIGHTS = PointLights(
    position=[[2, 3, 2], [-2, 1, 1], [0, -2, 1]],
    intensity=[[9, 8, 7], [4, 5, 6], [6, 4, 3]],
    range=[np.inf, 2.5, np.inf],
    direction=[[0, -1, 0], [0, 1, 0], [0, 2, -0.5]],
    inner=[0, 0, 0.1],
    outer=[np.pi, np.pi, 0.5],
)
LIMITS = list(zip(LIGHTS.range, LIGHTS.direction, LIGHTS.inner, LIGHTS.outer, strict=True))
GAIN = 0.7
EYES = (-0.5, 0.25, 3.0), (1.5, 0.25, 3.0)


def _array(values, device, dtype=wp.float32):
    return wp.array(np.ascontiguousarray(values).ravel(), dtype=dtype, device=device)


@pytest.mark.parametrize("count", [2000, 256, 5])
def test_difference_between_the_eyes_matches_float64(rng, device, count):
    faces, texels = 60, 4096
    points = rng.uniform(-1, 1, (faces, 3, 3)).astype(np.float32)
    normals = (rng.normal(size=(faces, 1, 3)) + 0.2 * rng.normal(size=(faces, 3, 3))).astype(np.float32)
    sides = rng.choice([-1, 1, 1], (2, faces))
    sides[:, :5] = 0
    triangle, material = rng.integers(0, faces, texels), rng.integers(1, 4, texels)
    weights = rng.dirichlet((1, 1, 1), texels).astype(np.float32)
    table = np.float32([(0.6, 0.0, 0.0, 1.0), (0.2, 0.3, 0.7, 0.2), (0.0, 0.9, 0.0, 0.04)])
    samples = np.where(rng.random(count) < 0.9, rng.integers(0, texels, count), -1)

    surface, lights, lanes = Surface(), make_lights(3, device), dispatch.lanes(device)
    surface.triangle, surface.barycentric = _array(triangle, device, wp.int32), _array(weights[:, 1:], device)
    surface.faces, surface.side = _array(np.arange(3 * faces), device, wp.int32), _array(sides[0], device, wp.int8)
    surface.points, surface.normals = _array(points, device), _array(normals, device)
    assign_lights(lights, LIGHTS.at(0))
    scratch = wp.zeros(dispatch.worker_count() * stereo.scratch_words(lanes), dtype=wp.float32, device=device)
    got = wp.full(count, -5.0, dtype=wp.float32, device=device)
    inputs = [_array(samples, device, wp.int32), count, _array(material, device, wp.uint8), _array(table, device)]
    inputs += [surface, _array(sides[1], device, wp.int8), lights, *map(wp.vec3, EYES), GAIN, scratch]
    blocks = dispatch.blocks(count, lanes)
    dispatch.launch(stereo.make_difference_kernel(lanes), blocks, inputs=inputs, outputs=[got], device=device, grain=1)

    f = triangle[np.maximum(samples, 0)]
    apart = (samples < 0) | (sides[0][f] != sides[1][f]) | (sides[0][f] == 0)
    got = got.numpy()
    assert (got[apart] == 2.0).all()
    at, f = samples[~apart], f[~apart]
    w = weights[at].astype(np.float64)
    w[:, 0] = 1 - w[:, 1] - w[:, 2]
    p, n = (np.einsum("nk,nkc->nc", w, a[f]) for a in (points, normals))
    roots = [
        reference.root(
            *(table[material[at] - 1], p, n * sides[0][f][:, None], np.array(eye)),
            *(LIGHTS.position, LIGHTS.intensity, GAIN, LIMITS),
        )
        for eye in EYES
    ]
    expected = np.abs(roots[0] - roots[1])
    if count > 1000:
        assert apart.sum() > 100
        assert (expected > 0.02).sum() > 50
    assert np.abs(got[~apart] - expected).max() < 2e-6


@pytest.fixture
def tiles(rng):
    """A cut sheet of tiles, some shared, and what two eyes have seen of it."""
    width, height = 45, 29
    columns, rows = tile_count(width, height)
    shared, rate = rng.integers(0, 2, rows * columns), rng.integers(0, 3, rows * columns)
    seen = (rng.random((2, height, width)) < 0.3) & (rng.random((2, 1, width)) < 0.7)
    tile = (np.arange(height)[:, None] // 8) * columns + np.arange(width) // 8
    return width, height, rows, shared, rate, seen, tile


def test_merging_moves_what_either_eye_sees(rng, device, tiles):
    width, height, rows, shared, rate, seen, tile = tiles
    count, slots = len(shared), 3
    pixels = rng.integers(0, 9, (2, slots, count))
    left, right = (_array(s, device, wp.uint8) for s in seen)
    middle = wp.zeros(width * height, dtype=wp.uint8, device=device)
    counts, middle_pixels = (wp.zeros(n, dtype=wp.int32, device=device) for n in (6 * rows, slots * count))
    left_pixels, right_pixels = (_array(p, device, wp.int32) for p in pixels)
    inputs = [_array(shared, device, wp.uint8), _array(rate, device, wp.uint8), width, height, count, slots]
    outputs = [left, right, middle, left_pixels, right_pixels, middle_pixels, counts]
    dispatch.launch(stereo.merge_kernel, rows, inputs=inputs, outputs=outputs, device=device, grain=1)

    inside = shared[tile] > 0
    assert np.array_equal(middle.numpy().reshape(height, width), (seen[0] | seen[1]) & inside)
    for got, before in ((left, seen[0]), (right, seen[1])):
        assert np.array_equal(got.numpy().reshape(height, width), before & ~inside)
    read = np.zeros(count, bool)
    read[np.unique(tile[(seen[0] | seen[1]) & inside])] = True
    assert 3 < read.sum() < count
    for got, before in ((left_pixels, pixels[0]), (right_pixels, pixels[1])):
        assert np.array_equal(got.numpy().reshape(slots, count), np.where(read, 0, before))
    assert np.array_equal(middle_pixels.numpy().reshape(slots, count).sum(0), np.where(read, pixels.sum((0, 1)), 0))
    between = (1 << 2 * rate[tile]) - 1
    each = [(s & inside) for s in seen]
    expected = [*(s.sum() for s in each), (each[0] & each[1]).sum(), *((s * between).sum() for s in each), read.sum()]
    assert counts.numpy().reshape(rows, 6).sum(0).tolist() == expected


def test_spreading_copies_shared_tiles_that_were_shaded(rng, device, tiles):
    width, height, rows, shared, _, _, tile = tiles
    shaded = rng.integers(0, 3, len(shared))
    source, target = (rng.random((height, width, 4)).astype(np.float16) for _ in range(2))
    got = _array(target, device, wp.float16)
    inputs = [_array(shared, device, wp.uint8), _array(shaded, device, wp.uint8), width, height]
    inputs.append(_array(source, device, wp.float16))
    dispatch.launch(stereo.spread_kernel, rows, inputs=inputs, outputs=[got], device=device, grain=1)
    copied = ((shared > 0) & (shaded > 0))[tile]
    assert 50 < copied.sum() < copied.size - 50
    assert np.array_equal(got.numpy().reshape(height, width, 4), np.where(copied[..., None], source, target))


def test_clearing_takes_listed_tiles_as_never_shaded(rng, device, tiles):
    width, height, rows, shared, _, seen, tile = tiles
    listed = np.flatnonzero(shared)
    radiance = rng.random((height, width, 4)).astype(np.float16)
    done, texture = _array(seen[0], device, wp.uint8), _array(radiance, device, wp.float16)
    inputs = [_array(listed, device, wp.int32), len(listed), 4, width, height]
    blocks, outputs = dispatch.blocks(len(listed), 4), [done, texture]
    dispatch.launch(stereo.clear_kernel, blocks, inputs=inputs, outputs=outputs, device=device)
    cleared = shared[tile] > 0
    assert np.array_equal(done.numpy().reshape(height, width), seen[0] & ~cleared)
    radiance[cleared, 3] = -1
    assert np.array_equal(texture.numpy().reshape(height, width, 4), radiance)
