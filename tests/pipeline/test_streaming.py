"""The sheet of seen charts: the static atlas's texels and picture, its guarantee at every scale, and what it costs."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.kernels.test_atlas import patch
from warp_neumat.kernels.atlas import atlas_leaks, atlas_raster
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.visibility import CameraRaster
from warp_neumat.pipeline.atlas import Atlas, AtlasLayout
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.streaming import LEVELS, StreamingAtlas

SIZE = (320, 180)


class Picture:
    """What an update reads of a camera raster, from arrays."""

    def __init__(self, height, width, device=None):
        self.triangle = wp.full((height, width), -1, dtype=wp.int32, device=device)
        self.barycentric = wp.zeros((height, width, 2), dtype=wp.float32, device=device)

    def show(self, triangle, barycentric):
        self.triangle.assign(np.ascontiguousarray(triangle))
        self.barycentric.assign(np.ascontiguousarray(barycentric))
        return self


def dome(rows, columns):
    """Return points, faces and uv of a sphere without its poles: one chart."""
    v, u = np.meshgrid(np.linspace(0.05, 0.95, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    points = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    down = a + columns + 1
    faces = np.concatenate([np.stack([a, down, a + 1], axis=1), np.stack([a + 1, down, down + 1], axis=1)])
    return points.reshape(-1, 3), faces, np.stack([u, v], axis=-1).reshape(-1, 2)


def field(columns, cell, rows=8, segments=16):
    """Return a square of spheres, one mesh and one chart each, and a layout with ``cell``² texels for each."""
    points, faces, uv = dome(rows, segments)
    count = columns * columns
    x, z = np.meshgrid(np.arange(columns), np.arange(columns))
    centre = 3.0 * (np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1) - (columns - 1) / 2 * np.array([1, 0, 1]))
    sequence = MeshSequence.from_arrays(
        (points + centre[:, None]).reshape(-1, 3),
        (faces + len(points) * np.arange(count)[:, None, None]).reshape(-1, 3),
        np.tile(uv, (count, 1)),
        face_mesh=np.repeat(np.arange(count), len(faces)),
    )
    chart = sequence.face_mesh
    own = (uv - uv.min(axis=0)) / np.ptp(uv, axis=0) * (cell - 5.7) + 2.6  # with two rings of texels, whole tiles
    corners = own[faces][None] + cell * np.stack([x.ravel(), z.ravel()], axis=1)[:, None, None]
    return sequence, AtlasLayout(columns * cell, corners.reshape(-1, 3, 2).astype(np.float32), chart, {}, [])


def static(layout, device=None):
    """Return the owners and weights of the layout's full sheet."""
    side = layout.resolution
    return atlas_raster(layout.corner_uv, layout.chart, side, side, dilation=2, device=device)


def view(sequence, eye, target=(0, -1, 0), size=SIZE, fov=0.7, device=None):
    """Return the camera raster of one look at a still sequence; ``raster.look(eye)`` looks again."""
    raster = CameraRaster(sequence.faces, sequence.vertex_count, *size, device=device)
    points = wp.array(sequence.frame(0).points, dtype=wp.float32, device=device)

    def look(eye, target=target):
        camera = Camera.look_at(eye, target, fov_y=fov, width=size[0], height=size[1], near=0.1, far=200.0)
        raster.run(points, camera.clip())
        return raster

    raster.look = look
    return look(eye)


def gathered(raster, corner_uv, triangle, barycentric, points):
    """Return the picture of a texture that holds a smooth function of the surface, float64 as in ``gather``."""
    corners = points[triangle]
    b = barycentric[..., None]
    texture = np.sin(
        3
        * (
            corners[:, :, 0] * (1 - b[:, :, 0] - b[:, :, 1])
            + corners[:, :, 1] * b[:, :, 0]
            + corners[:, :, 2] * b[:, :, 1]
        )
    )
    f, w = raster.triangle.numpy(), raster.barycentric.numpy()
    uv = corner_uv.reshape(-1, 3, 2)[f]
    w0 = np.float32(1) - w[..., 0] - w[..., 1]
    at = w0[..., None] * uv[..., 0, :] + w[..., :1] * uv[..., 1, :] + w[..., 1:] * uv[..., 2, :] - np.float32(0.5)
    at = np.where(f[..., None] >= 0, at, 0)
    x, y = np.moveaxis(np.floor(at).astype(int), -1, 0)
    u, v = np.moveaxis(at - np.floor(at), -1, 0)[..., None]
    top = (1 - u) * texture[y, x] + u * texture[y, x + 1]
    bottom = (1 - u) * texture[y + 1, x] + u * texture[y + 1, x + 1]
    return np.where(f[..., None] >= 0, (1 - v) * top + v * bottom, 0)


def check(atlas, layout, material):
    """Assert all that must hold of a sheet after any update."""
    triangle, chart_map = atlas.triangle.numpy(), atlas.chart_map
    held = np.full_like(triangle, -1)
    corner_uv = atlas.corner_uv.numpy().reshape(-1, 3, 2)
    for chart in np.flatnonzero(atlas.levels >= 0):
        x, y, w, h = atlas.rectangle(chart)
        assert x % 8 == y % 8 == w % 8 == h % 8 == 0
        assert 0 <= x <= x + w <= atlas.side
        assert 0 <= y <= y + h <= atlas.side
        assert (held[y : y + h, x : x + w] == -1).all(), "two charts on one texel"
        held[y : y + h, x : x + w] = chart
    owned = triangle >= 0
    np.testing.assert_array_equal(chart_map, np.where(owned, layout.chart[triangle], -1))
    np.testing.assert_array_equal(chart_map[owned], held[owned])  # nothing owned outside the own rectangle
    expected = np.where(owned, material[triangle] + 1, 0)
    np.testing.assert_array_equal(atlas.material.numpy().reshape(triangle.shape), expected)
    # The guarantee: no point of a resident chart has a footprint with a texel of nobody or of another chart.
    resident = atlas.levels[layout.chart] >= 0
    if resident.any():
        faces = np.flatnonzero(resident)
        number = np.full(len(layout.chart) + 1, -1, np.int32)
        number[faces] = np.arange(len(faces))
        leaks = atlas_leaks(corner_uv[faces], layout.chart[faces], number[triangle])
        assert not leaks.any()


def test_texels_at_full_scale_are_the_static_ones_bit_for_bit(device):
    sequence, layout = field(4, 120)
    owner, weights = static(layout, device)
    raster = view(
        sequence, (4, 9, 9), (3, 0, 2), size=(960, 540), fov=0.35, device=device
    )  # large in the picture, and not all of them
    atlas = StreamingAtlas(layout, 480, np.zeros(len(sequence.faces)), device=device)
    atlas.update(raster)
    triangle, barycentric = atlas.triangle.numpy(), atlas.barycentric.numpy()
    resident = np.flatnonzero(atlas.levels == 0)
    moved = 0
    assert 4 < len(resident) < 16
    for chart in resident:
        x, y, w, h = atlas.rectangle(chart)
        home = 120 * np.array([chart % 4, chart // 4])
        moved += tuple(home) != (x, y)
        there = (slice(home[1], home[1] + h), slice(home[0], home[0] + w))
        np.testing.assert_array_equal(triangle[y : y + h, x : x + w], owner[there])
        np.testing.assert_array_equal(barycentric[y : y + h, x : x + w], weights[there])
    assert moved > 3


def test_pictures_equal_the_static_atlas(device):
    sequence, layout = field(3, 200)
    owner, weights = static(layout, device)
    points = sequence.frame(0).points[sequence.faces].astype(np.float64)
    material = np.zeros(len(sequence.faces))
    near = view(sequence, (0, 8, 3), (0, 0, 0), size=(960, 540), device=device)
    expected = gathered(near, layout.corner_uv, owner, weights, points)

    atlas = StreamingAtlas(layout, 600, material, device=device)
    atlas.update(near)
    assert (atlas.levels == 0).all()
    arrays = (atlas.triangle.numpy(), atlas.barycentric.numpy())
    # All nine fill the sheet in the layout's own order, so even the rounding of their places is the same.
    np.testing.assert_array_equal(gathered(near, atlas.corner_uv.numpy(), *arrays, points), expected)

    moved = StreamingAtlas(layout, 840, material, device=device)  # other columns: eight charts lie elsewhere
    moved.update(near)
    assert any(moved.rectangle(c)[:2] != atlas.rectangle(c)[:2] for c in range(9))
    arrays = (moved.triangle.numpy(), moved.barycentric.numpy())
    picture = gathered(near, moved.corner_uv.numpy(), *arrays, points)
    assert np.abs(picture - expected).max() < 1e-4  # of values in ±1; worst seen 1.4e-5

    far = view(sequence, (0, 30, 12), (0, 0, 0), size=(320, 180), device=device)
    small = StreamingAtlas(layout, 600, material, device=device)
    small.update(far)
    assert (small.levels > 0).all()
    expected = gathered(far, layout.corner_uv, owner, weights, points)
    picture = gathered(far, small.corner_uv.numpy(), small.triangle.numpy(), small.barycentric.numpy(), points)
    covered = far.triangle.numpy() >= 0
    # Texels as large as pixels, and values that change by up to 0.3 a pixel: bilinear weights smooth them.
    assert np.sqrt(((picture - expected)[covered] ** 2).mean()) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_no_footprint_leaves_its_chart_at_any_scale(device, seed):
    rng = np.random.default_rng(seed)
    corners, chart = [], []
    for c in range(9):  # shaken patches of all sizes, cells of 100 texels; the last ones are smaller than a texel
        columns, rows = rng.integers(1, 7, 2)
        step = rng.uniform(0.05, 0.3) if c > 6 else rng.uniform(1, 84 / max(columns, rows))
        origin = 100 * np.array([c % 3, c // 3]) + rng.uniform(6, 9, 2)
        corners.append(patch(columns, rows, step, origin, rng, 0.4 * step))
        chart.append(np.full(len(corners[-1]), c, np.int32))
    layout = AtlasLayout(300, np.concatenate(corners), np.concatenate(chart), {}, [])
    material = rng.integers(0, 4, len(layout.chart))
    owner, weights = static(layout, device)
    picture = Picture(300, 300, device)
    used = set()
    for k, step in enumerate(
        (1, 2, 2, 1, 4, 8, 8, 2, 16, 4, 12, 1)
    ):  # the layout itself, seen from farther away or nearer
        if k % 2 == 0:
            atlas = StreamingAtlas(layout, 320, material, dilation=int(rng.integers(1, 4)), device=device)
        triangle, barycentric = np.full((300, 300), -1, np.int32), np.zeros((300, 300, 2), np.float32)
        part = owner[::step, ::step]
        triangle[: len(part), : len(part)] = part
        barycentric[: len(part), : len(part)] = weights[::step, ::step]
        hidden = rng.random(9) < 0.3
        triangle[hidden[layout.chart[triangle]]] = -1
        atlas.update(picture.show(triangle, barycentric))
        check(atlas, layout, material)
        used |= set(atlas.levels[atlas.levels >= 0].tolist())
    assert used == set(range(LEVELS))


def test_a_moving_camera_keeps_the_sheet_sound_and_repeats(device):
    sequence, layout = field(6, 96)
    rng = np.random.default_rng(5)
    material = rng.integers(0, 254, len(sequence.faces))
    base = np.where(rng.random(len(material)) < 0.1, NO_LOD, rng.uniform(-3, 3, len(material))).astype(np.float32)
    around = [(9 * np.sin(a), 0.0, 9 * np.cos(a)) for a in np.linspace(0, 5, 16)]
    raster = view(sequence, (0, 4, 0), around[0], size=(640, 360), fov=0.4, device=device)

    def run(observe):
        atlas = StreamingAtlas(layout, 200, material, least_lod=base, device=device)
        log = []
        for target in around:
            before = atlas.triangle.numpy().copy()
            changed = atlas.update(raster.look((0, 4, 0), target))
            log.append((changed, dataclasses.replace(atlas.stats, ms={})))
            if observe:
                check(atlas, layout, material)
                differs = before != atlas.triangle.numpy()
                for x, y, w, h in changed:
                    differs[y : y + h, x : x + w] = False
                assert not differs.any()  # all that changed was announced
                owner = raster.triangle.numpy()
                seen = np.unique(layout.chart[owner[owner >= 0]])
                assert (atlas.levels[seen] >= 0).all()
                assert atlas.stats.seen == len(seen)
                level = np.maximum(atlas.levels[layout.chart], 0)
                lod, resident = atlas.least_lod.numpy(), atlas.levels[layout.chart] >= 0
                expected = np.where(base > NO_LOD, base + level, NO_LOD)[resident]
                np.testing.assert_allclose(lod[resident], expected, atol=1e-6)
        return log

    log = run(True)
    assert log == run(False)
    stats = [s for _, s in log]
    assert sum(s.streamed_out for s in stats) > 3
    assert sum(s.streamed_in for s in stats[1:]) > 3
    assert max(s.coarser for s in stats) > 0
    assert all(s.texels <= 200 * 200 for s in stats)


def test_nothing_streams_while_nothing_changes(device):
    sequence, layout = field(4, 96)
    raster = view(sequence, (0, 4, 12), device=device)
    atlas = StreamingAtlas(layout, 256, np.zeros(len(sequence.faces)), device=device)
    assert atlas.update(raster)
    shown = atlas.stats
    for k in range(4):
        raster.look((0.002 * k, 4 + 0.002 * k, 12))  # and charts on the border of two levels do not flip
        assert atlas.update(raster) == []
        assert (atlas.stats.streamed_in, atlas.stats.streamed_out) == (0, 0)
        assert atlas.stats.texels == shown.texels
        assert atlas.stats.ms["plan"] + atlas.stats.ms["raster"] < 2.0  # measured 0.05


def test_levels_follow_the_distance_with_hysteresis(device):
    sequence, layout = field(1, 1024)
    raster = view(sequence, (0, 0, 3), (0, 0, 0), size=(640, 480), device=device)
    atlas = StreamingAtlas(layout, 1024, np.zeros(len(sequence.faces)), device=device)

    def levels(distances):
        found = []
        for distance in distances:
            atlas.update(raster.look((0, 0, distance)))
            found.append(int(atlas.levels[0]))
        return np.array(found)

    distances = np.geomspace(3, 60, 60)
    away, back = levels(distances), levels(distances[::-1])[::-1]
    assert set(away) == set(back) == {0, 1, 2, 3}
    assert (np.diff(away) >= 0).all()
    assert (np.diff(back) >= 0).all()
    for level in range(1, LEVELS):  # the way back changes nearer than the way out, by half an octave or more
        assert distances[(away >= level).argmax()] > 1.35 * distances[(back >= level).argmax()]


def test_the_longest_unseen_leaves_first(device):
    chart = np.repeat(np.arange(5), 2).astype(np.int32)
    corners = np.concatenate([patch(1, 1, 50, (3 + 60 * c, 3)) for c in range(5)])  # 7 × 7 tiles each
    layout = AtlasLayout(512, corners, chart, {}, [])
    picture, weights = Picture(8, 64, device), np.zeros((8, 64, 2), np.float32)
    weights[..., 0] = np.arange(64) / 64 % 0.2  # texels as large as pixels
    weights[..., 1] = np.arange(8)[:, None] / 64
    atlas = StreamingAtlas(layout, 112, np.zeros(10), device=device)  # four of them

    def show(*charts):
        triangle = np.full((8, 64), -1, np.int32)
        for k, c in enumerate(charts):
            triangle[:, 12 * k : 12 * k + 12] = 2 * c
        return atlas.update(picture.show(triangle, weights))

    show(0, 1)
    show(2, 0)
    show(3)
    assert atlas.levels.tolist() == [0, 0, 0, 0, -1]
    place = atlas.rectangle(1)
    assert show(4) == [place, place]  # 1 was seen longest ago: 4 takes its place, and 1's texels are void
    assert atlas.levels.tolist() == [0, -1, 0, 0, 0]
    assert (atlas.stats.streamed_in, atlas.stats.streamed_out) == (1, 1)
    show(0, 1, 2, 3, 4)  # five of 49 tiles on 196: one level coarser, all of them
    assert atlas.stats.coarser == 4  # two half octaves are a level, two more were to spare
    assert (atlas.levels == 1).all()
    show(0, 1)
    assert atlas.stats.coarser == 0
    assert (atlas.levels[:2] == 0).all()


def test_what_does_not_fit_is_told_and_mended(device):
    chart = np.repeat(np.arange(40), 2).astype(np.int32)
    corners = np.concatenate([patch(1, 1, 70, (3 + 100 * (c % 8), 3 + 100 * (c // 8))) for c in range(40)])
    layout = AtlasLayout(800, corners, chart, {}, [])
    picture, weights = Picture(8, 320, device), np.zeros((8, 320, 2), np.float32)
    atlas = StreamingAtlas(layout, 32, np.zeros(80), device=device)
    triangle = np.repeat(np.repeat(2 * np.arange(40), 8)[None], 8, axis=0).astype(np.int32)
    message = r"the 40 charts in view need 10240 texels at the coarsest scale and do not fit a sheet of 32² = 1024"
    with pytest.raises(ValueError, match=message):
        atlas.update(picture.show(triangle, weights))
    triangle[:, 8:] = -1
    assert atlas.update(picture.show(triangle, weights))
    check(atlas, layout, np.zeros(80, int))
    assert atlas.stats.resident == 1


def test_a_hundred_meshes_cost_what_is_visible(device):
    sequence, layout = field(10, 208)  # 2080² texels
    raster = view(sequence, (0, 1.5, 19), (0, 0, 10), fov=0.35, size=(192, 108), device=device)
    atlas = StreamingAtlas(layout, 880, np.zeros(len(sequence.faces)), device=device)
    full = 17 * 2080**2
    atlas.update(raster)
    assert atlas.stats.seen < 50
    assert atlas.stats.coarser == 0
    assert atlas.bytes < 0.3 * (full + 100 * len(sequence.faces))
    all_seen = StreamingAtlas(layout, 2080, np.zeros(len(sequence.faces)), device=device)
    all_seen.update(view(sequence, (0, 45, 30), (0, 0, 0), device=device))
    assert all_seen.stats.seen == 100
    assert all_seen.stats.texels < 0.1 * 2080**2  # all in view, but far: small rectangles


def test_two_eyes_share_a_sheet(device):
    sequence, layout = field(4, 96)
    left = view(sequence, (-5, 2, 12), (-4, 0, 0), fov=0.3, device=device)
    right = view(sequence, (5, 2, 12), (4, 0, 0), fov=0.3, device=device)
    atlas = StreamingAtlas(layout, 400, np.zeros(len(sequence.faces)), device=device)
    atlas.update(left, right)
    for raster in (left, right):
        owner = raster.triangle.numpy()
        assert (atlas.levels[np.unique(layout.chart[owner[owner >= 0]])] >= 0).all()


def test_a_layout_needs_no_raster(tmp_path):
    points, faces, uv = dome(8, 16)
    sequence = MeshSequence.from_arrays(points, faces, uv)
    layout = Atlas.layout(sequence, 128, cache=tmp_path)
    atlas = Atlas.build(sequence, 128, cache=tmp_path)
    np.testing.assert_array_equal(layout.corner_uv, atlas.corner_uv)
    np.testing.assert_array_equal(layout.chart, atlas.chart)
    assert len(list(tmp_path.iterdir())) == 2  # a layout that nobody checked is not taken for an atlas
    again = Atlas.layout(sequence, 128, cache=tmp_path)
    np.testing.assert_array_equal(again.corner_uv, layout.corner_uv)
    with pytest.raises(ValueError, match="resolution must be even"):
        Atlas.layout(sequence, 7)
    several = MeshSequence.from_arrays(
        np.concatenate([points, points + 3]), np.concatenate([faces, faces + len(points)]), np.concatenate([uv, uv])
    )
    kept = Atlas.layout(several, 128, cache=False)
    assert set(kept.sources.values()) == {"authored"}
    assert kept.chart.max() == 1


def test_mistakes_are_told():
    _, layout = field(1, 64)
    faces = len(layout.chart)
    with pytest.raises(ValueError, match="side must be a multiple of 8 in 16 … 16384 texels, got 100"):
        StreamingAtlas(layout, 100, np.zeros(faces))
    with pytest.raises(ValueError, match=r"face_material must have shape \[256\], got \(3,\)"):
        StreamingAtlas(layout, 64, np.zeros(3))
    with pytest.raises(ValueError, match="face_material must be in 0 … 253, got 0 … 254"):
        StreamingAtlas(layout, 64, np.r_[254, np.zeros(faces - 1)])
    with pytest.raises(ValueError, match="dilation must be in 1 … 64"):
        StreamingAtlas(layout, 64, np.zeros(faces), dilation=0)
    broken = dataclasses.replace(layout, corner_uv=np.full_like(layout.corner_uv, np.nan))
    with pytest.raises(ValueError, match="layout must have finite corners for 256 faces"):
        StreamingAtlas(broken, 64, np.zeros(faces))
