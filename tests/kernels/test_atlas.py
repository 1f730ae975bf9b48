"""The triangle-ID raster against its float64 reference, and what it promises about footprints and overlaps."""

import numpy as np
import pytest

from warp_neumat.kernels.atlas import FOOTPRINT, atlas_folds, atlas_leaks, atlas_raster
from warp_neumat.kernels.dispatch import set_worker_count
from warp_neumat.reference import atlas as reference


def patch(columns, rows, step, origin, rng=None, jitter=0.0):
    """Return corners [2 · columns · rows, 3, 2] of a grid of quads cut into triangles, inner vertices shaken."""
    x, y = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1))
    vertices = np.stack([x, y], axis=-1) * float(step) + origin
    if rng is not None:
        vertices = vertices + rng.uniform(-jitter, jitter, vertices.shape)
    a, b, c, d = vertices[:-1, :-1], vertices[:-1, 1:], vertices[1:, 1:], vertices[1:, :-1]
    return np.concatenate([np.stack(t, axis=-2).reshape(-1, 3, 2) for t in ((a, b, c), (a, c, d))]).astype(np.float32)


def scene(name, rng):
    """Return ``(corners, chart)`` on a sheet of 48 × 40 texels."""
    if name == "vertices on texel centres":  # every tie there is
        corners = patch(6, 5, 4, 3.5)
        return corners, np.zeros(len(corners), np.int32)
    if name == "two shaken charts":
        first, second = patch(7, 5, 2.7, 3.3, rng, 0.9), patch(4, 9, 2.9, (28.1, 4.2), rng, 0.9)
        return np.concatenate([first, second]), np.repeat([0, 1], [len(first), len(second)]).astype(np.int32)
    if name == "needles":
        start, angle = rng.uniform(8, 32, (30, 2)), rng.uniform(0, 2 * np.pi, 30)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        side = direction[:, ::-1] * [1, -1] * rng.uniform(0.001, 0.3, (30, 1))
        corners = np.stack([start, start + 7 * direction, start + side], axis=1)
        return corners.astype(np.float32), np.arange(30, dtype=np.int32)
    corners = rng.uniform(-6, 52, (60, 1, 2)) + rng.uniform(-6, 6, (60, 3, 2))  # partly off the sheet, overlapping
    return corners.astype(np.float32), np.arange(60, dtype=np.int32)


SCENES = ["vertices on texel centres", "two shaken charts", "needles", "anywhere"]


def owner_distance(corners, triangle, barycentric):
    """Return the distance [texel] between each owned texel's centre and the point that its weights name."""
    y, x = np.nonzero(triangle >= 0)
    a, b, c = np.moveaxis(corners[triangle[y, x]].astype(np.float64), 1, 0)
    w = barycentric[y, x].astype(np.float64)
    point = a + w[:, :1] * (b - a) + w[:, 1:] * (c - a)
    return y, x, np.hypot(*(point - np.stack([x + 0.5, y + 0.5], axis=1)).T)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dilation", [0, 1, 2, 4])
def test_raster_matches_reference(device, rng, name, dilation):
    corners, chart = scene(name, rng)
    triangle, barycentric = atlas_raster(corners, chart, 48, 40, dilation=dilation, device=device)
    wanted, weights, distance, rank = reference.atlas_raster(corners, chart, 48, 40, dilation=dilation)
    inside = rank == 0
    assert inside.any()
    np.testing.assert_array_equal(triangle[inside], wanted[inside])
    np.testing.assert_array_equal(triangle >= 0, wanted >= 0)
    # Worst 3e-8 (CPU): float32 rounding of the stored weights.
    np.testing.assert_allclose(barycentric[inside], weights[inside], atol=1e-7)
    # Outside, two triangles with a common vertex are equally near: the distance is what is unique. Worst 5e-7.
    y, x, ours = owner_distance(corners, triangle, barycentric)
    np.testing.assert_allclose(ours, distance[y, x], atol=2e-6)
    assert (barycentric >= 0).all()
    assert (barycentric.sum(axis=-1) <= 1 + 2e-7).all()


def test_every_touched_texel_is_owned_by_its_chart(device, rng):
    assert reference.FOOTPRINT == FOOTPRINT
    corners, chart = scene("two shaken charts", rng)
    triangle, _ = atlas_raster(corners, chart, 48, 40, dilation=1, device=device)
    centres = reference.texel_centres(48, 40)
    owner = np.where(triangle >= 0, chart[triangle], -1)
    for f, abc in enumerate(corners.astype(np.float64)):
        for half in (0.5, FOOTPRINT):  # the texels it touches; those that its bilinear footprints read
            assert (owner[reference.box_meets_triangle(centres, abc, half)] == chart[f]).all()


@pytest.mark.parametrize("dilation", [1, 3])
def test_dilation_adds_rings_of_texels(device, dilation):
    corners = np.array([[[20.2, 18.3], [27.9, 20.6], [22.4, 25.1]]], np.float32)
    touched = reference.box_meets_triangle(reference.texel_centres(48, 40), corners[0].astype(np.float64), 0.5)
    grown = touched.copy()
    for y, x in np.argwhere(touched):
        grown[y - dilation : y + dilation + 1, x - dilation : x + dilation + 1] = True
    triangle, _ = atlas_raster(corners, [0], 48, 40, dilation=dilation, device=device)
    np.testing.assert_array_equal(triangle == 0, grown)


def test_weights_reproduce_texel_centres(device, rng):
    corners = patch(100, 100, 11.9, 4.0, rng, 4.0)
    triangle, barycentric = atlas_raster(corners, np.zeros(len(corners)), 1200, 1200, device=device)
    assert (triangle[20:1180, 20:1180] >= 0).all()
    y, x, distance = owner_distance(corners, triangle, barycentric)
    well_inside = (np.abs(x - 600) < 570) & (np.abs(y - 600) < 570)
    assert distance[well_inside].max() < 2e-6  # worst 1e-6: weights of 6e-8 times triangles of 12 texels


def test_result_does_not_depend_on_workers(rng):
    corners, chart = patch(60, 60, 6.1, 9.0, rng, 3.0), np.arange(7200) // 900
    try:
        results = []
        for workers in (1, 2):
            set_worker_count(workers)
            raster = atlas_raster(corners, chart, 400, 388)
            results.append((*raster, atlas_folds(corners, chart, 400, 388), atlas_leaks(corners, chart, raster[0])))
    finally:
        set_worker_count(None)
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


def test_triangles_without_area_own_nothing(device):
    flat = [[5, 5], [9, 9], [7, 7]]
    point = [[3, 3], [3, 3], [3, 3]]
    broken = [[1, 1], [np.nan, 8], [8, 1]]
    endless = [[1, 1], [np.inf, 8], [8, 1]]
    off_chart = [[1, 1], [9, 1], [1, 9]]
    corners = np.array([flat, point, broken, endless, off_chart], np.float32)
    triangle, barycentric = atlas_raster(corners, [0, 0, 0, 0, -1], 16, 16, device=device)
    assert (triangle == -1).all()
    assert (barycentric == 0).all()


def test_folds_are_told_from_shared_edges_and_other_charts(device, rng):
    sheet = patch(8, 8, 6, 5.0, rng, 2.0)
    assert not atlas_folds(sheet, np.zeros(len(sheet)), 64, 64, device=device).any()
    twice = np.concatenate([sheet, sheet[:4, ::-1]])
    folded = atlas_folds(twice, np.zeros(len(twice)), 64, 64, device=device)
    assert set(np.flatnonzero(folded)) == set(range(len(sheet), len(twice)))
    for over in (0, 2):  # on another chart, whichever of the two comes first
        assert not atlas_folds(twice, np.repeat([1, over], [len(sheet), 4]), 64, 64, device=device).any()


@pytest.mark.parametrize(
    ("gap", "leaks"),
    [(2.2, False), (1.2, True), (0.0, True)],
    ids=["apart", "footprints share texels", "charts touch"],
)
def test_leaks_finds_charts_that_lie_too_close(device, gap, leaks):
    left, right = patch(2, 2, 5, 4.3), patch(2, 2, 5, (14.3 + gap, 4.3))
    corners, chart = np.concatenate([left, right]), np.repeat([0, 1], 8)
    triangle, _ = atlas_raster(corners, chart, 40, 40, dilation=1, device=device)
    assert atlas_leaks(corners, chart, triangle, device=device).any() == leaks


@pytest.mark.parametrize(("x", "leaks"), [(0.53, False), (0.5, True), (-30.0, True), (1e30, True), (np.nan, True)])
def test_leaks_finds_footprints_off_the_sheet(device, x, leaks):
    corners = np.array([[[x, 8], [max(x, 4.0), 4], [max(x, 4.0), 12]]], np.float32)
    triangle, _ = atlas_raster(corners, [0], 16, 16, device=device)
    assert atlas_leaks(corners, [0], triangle, device=device)[0] == leaks


def test_leaks_needs_a_ring_of_dilation(device):
    corners = patch(2, 2, 4, 4.3)
    chart = np.zeros(len(corners), np.int32)
    bare, _ = atlas_raster(corners, chart, 24, 24, dilation=0, device=device)
    assert atlas_leaks(corners, chart, bare, device=device).any()


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"corner_uv must have shape \[faces, 3, 2\], got \(4, 2\)"):
        atlas_raster(np.zeros((4, 2)), np.zeros(4), 16, 16)
    with pytest.raises(ValueError, match=r"chart must have shape \[2\], got \(3,\)"):
        atlas_raster(np.zeros((2, 3, 2)), np.zeros(3), 16, 16)
    with pytest.raises(ValueError, match="width and height must be in 1 … 16384, got 0 × 16"):
        atlas_raster(np.zeros((2, 3, 2)), np.zeros(2), 0, 16)
    with pytest.raises(ValueError, match="dilation must be at least 0"):
        atlas_raster(np.zeros((2, 3, 2)), np.zeros(2), 16, 16, dilation=-1)
