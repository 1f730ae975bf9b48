"""Tiles of real atlases: at its rate, no point of a tile reads an anchor of another chart, and few are held back."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels.dispatch import module_options
from warp_neumat.kernels.tiles import RATE_MAX, TILE, anchors, rate_limits, tile_count
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.sheet import Sheet

wp.set_module_options(module_options())


def _points(atlas, rng, count):
    """Return face, x and y of random points of all triangles, many on their edges, and of their corners."""
    corners = atlas.corner_uv.astype(np.float64)
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    faces = np.concatenate(
        [
            np.arange(len(corners)).repeat(3),
            rng.integers(0, len(corners), count // 2),
            rng.choice(len(corners), count // 2, p=area / area.sum()),
        ]
    )
    weights = rng.dirichlet([0.6, 0.6, 0.6], len(faces))
    edge = rng.random(len(faces)) < 0.3
    weights[edge, rng.integers(0, 3, edge.sum())] = 0.0
    weights[: 3 * len(corners)] = np.tile(np.eye(3), (len(corners), 1))
    weights /= weights.sum(axis=1, keepdims=True)
    return faces, *np.einsum("nk,nkc->nc", weights, corners[faces]).T


def _strangers(atlas, faces, x, y, rate):
    """Return which points read an anchor that their own chart does not own, at ``rate`` each."""
    owner, side = atlas.triangle, atlas.resolution
    step = 1 << np.asarray(rate, np.int64)
    i, j = (np.floor(a - 0.5).astype(np.int64) // step * step for a in (x, y))
    bad = np.zeros(len(faces), bool)
    for dy in (0, 1):
        for dx in (0, 1):
            at = (j + dy * step, i + dx * step)
            inside = (at[0] < side) & (at[1] < side)
            found = np.where(inside, owner[np.minimum(at[0], side - 1), np.minimum(at[1], side - 1)], -1)
            bad |= (found < 0) | (atlas.chart[found] != atlas.chart[faces])
    return bad


@pytest.mark.parametrize(
    ("file", "resolution", "uv", "least"),
    # Share of the tiles in use that may be shaded at every second and at every fourth texel, seen and rounded down.
    [
        ("animation/Fox.glb", 600, "auto", (0.99, 0.76)),
        ("meshes/spot.obj", 500, "auto", (0.99, 0.8)),
        ("animation/Fox.glb", 300, "fallback", (0.42, 0.33)),
    ],
    ids=["Fox", "spot", "fallback"],
)
def test_no_point_reads_a_strangers_anchor(data, rng, file, resolution, uv, least):
    sequence = MeshSequence.load(data / file)
    atlas = Atlas.build(sequence, resolution, uv=uv, cache=False)
    columns, rows = tile_count(resolution, resolution)
    limit = Sheet(atlas, np.zeros(len(atlas.corner_uv), np.int32), None, device="cpu").limit
    assert limit.shape == (rows * columns,)
    faces, x, y = _points(atlas, rng, 600_000)
    tile = np.floor(y - 0.5).astype(int) // TILE * columns + np.floor(x - 0.5).astype(int) // TILE
    for most in range(RATE_MAX + 1):
        strangers = _strangers(atlas, faces, x, y, np.minimum(limit[tile], most))
        assert not strangers.any(), f"{strangers.sum()} points at rates up to {most}"
    used = np.unique(tile)
    for rate in (1, 2):
        spoilt = np.unique(tile[_strangers(atlas, faces, x, y, np.full(len(x), rate))])
        possible, allowed = len(used) - len(spoilt), np.count_nonzero(limit[used] >= rate)
        assert 0.97 * possible <= allowed <= possible
        assert allowed / len(used) >= least[rate - 1]


def _slow_limits(chart, footprint):
    """Return the same by a loop over the points' upper left texels."""
    height, width = chart.shape
    columns, rows = tile_count(width, height)
    limit = np.full((rows, columns), RATE_MAX, np.uint8)
    for y in range(height - 1):
        for x in range(width - 1):
            own = footprint[y, x]
            if own < 0 or (footprint[y : y + 2, x : x + 2] != own).any():
                continue
            for rate in range(1, RATE_MAX + 1):
                step = 1 << rate
                i, j = x // step * step, y // step * step
                good = (
                    i + step < width
                    and j + step < height
                    and (chart[j : j + step + 1 : step, i : i + step + 1 : step] == own).all()
                )
                if not good:
                    limit[y // TILE, x // TILE] = min(limit[y // TILE, x // TILE], rate - 1)
    return limit


@pytest.mark.parametrize("size", [(40, 40), (37, 29), (8, 8), (17, 9)])
def test_limits_match_a_plain_loop(rng, size):
    width, height = size
    for grain in (1, 3, 8, 40):
        coarse = rng.integers(-1, 3, (height // grain + 1, width // grain + 1)).astype(np.int32)
        chart = np.kron(coarse, np.ones((grain, grain), np.int32))[:height, :width]
        footprint = np.where(rng.random((height, width)) < 0.95, chart, -1).astype(np.int32)
        assert np.array_equal(rate_limits(chart, footprint), _slow_limits(chart, footprint))


@wp.kernel
def anchors_kernel(
    x: wp.array(dtype=wp.int32),
    y: wp.array(dtype=wp.int32),
    uv: wp.array(dtype=wp.vec2),
    rate: wp.array(dtype=wp.int32),
    at: wp.array(dtype=wp.vec2),
    fraction: wp.array(dtype=wp.vec2),
):
    k = wp.tid()
    i, j, u, v = anchors(x[k], y[k], uv[k][0], uv[k][1], rate[k])
    at[k] = wp.vec2(float(i), float(j))
    fraction[k] = wp.vec2(u, v)


def test_anchors_surround_their_point(rng, device):
    count = 1000
    x, y, rate = rng.integers(0, 500, count), rng.integers(0, 500, count), rng.integers(0, 3, count)
    uv = rng.random((count, 2)).astype(np.float32)
    at, fraction = (wp.zeros(count, dtype=wp.vec2, device=device) for _ in range(2))
    inputs = [
        wp.array(a, dtype=t, device=device) for a, t in ((x, wp.int32), (y, wp.int32), (uv, wp.vec2), (rate, wp.int32))
    ]
    wp.launch(anchors_kernel, count, inputs=inputs, outputs=[at, fraction], device=device)
    step = (1 << rate)[:, None]
    assert (at.numpy() % step == 0).all()
    assert (fraction.numpy() >= 0).all()
    assert (fraction.numpy() <= 1).all()
    np.testing.assert_allclose(at.numpy() + step * fraction.numpy(), np.stack([x, y], 1) + uv, rtol=1e-6)
