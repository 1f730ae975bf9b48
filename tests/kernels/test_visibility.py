"""Camera raster: equality with the float64 reference, with rays, and with itself; holes, sides, planes, odd sizes."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.visibility import CameraRaster, depth_range, pixel_matrix
from warp_neumat.reference.visibility import rasterize

wp.set_module_options(dispatch.module_options())


def perspective(width, height, fov=0.9, near=0.1, far=100.0):
    """Camera at the origin looking down −z; docs/conventions.md."""
    f = 1.0 / np.tan(fov / 2)
    return np.array(
        [
            [f * height / width, 0, 0, 0],
            [0, f, 0, 0],
            [0, 0, far / (near - far), near * far / (near - far)],
            [0, 0, -1, 0],
        ],
        np.float32,
    )


def soup(rng, kind, n):
    """Random triangles in front of :func:`perspective`, three vertices each, of one difficult kind."""
    centre = rng.uniform(-1, 1, (n, 1, 3)) * [2.5, 2.0, 2.0] + [0, 0, -5.0]
    shape = rng.normal(size=(n, 3, 3))
    if kind == "small":
        points = centre + 0.05 * shape
    elif kind == "large":
        points = centre + [20.0, 20.0, 1.0] * shape
    elif kind == "crossing":
        points = [0, 0, -1.0] + 3.0 * shape  # about half the vertices are behind the near plane, many behind the eye
    elif kind == "slivers":
        along = rng.normal(size=(n, 1, 3))
        points = centre + along * rng.uniform(-2, 2, (n, 3, 1)) + 2e-3 * shape
    elif kind == "far outside":
        points = centre * rng.choice([1.0, 1e4, 1e8], (n, 3, 1)) + shape
    elif kind == "degenerate":
        points = centre + shape
        points[0::5, 2] = points[0::5, 1]
        points[1::5, 2] = 0.5 * (points[1::5, 0] + points[1::5, 1])
        points[2::5, 1, 1] = np.nan
        points[3::5, 0, 0] = np.inf
        points[::15] = points[::15, :1]
    else:
        points = centre + 0.8 * shape
    return points.reshape(-1, 3).astype(np.float32), np.arange(3 * n, dtype=np.int32).reshape(n, 3)


def draw(points, faces, clip, width, height, **options):
    raster = CameraRaster(faces, len(points), width, height, **{"device": "cpu", **options})
    raster.run(points, clip)
    return raster.triangle.numpy().copy(), raster.barycentric.numpy().copy(), raster.depth.numpy().copy()


KINDS = ["plain", "small", "large", "crossing", "slivers", "far outside", "degenerate"]


@pytest.mark.parametrize("tiled", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_raster_matches_reference(rng, kind, tiled):
    width, height = 157, 93
    points, faces = soup(rng, kind, 120)
    sided = rng.integers(0, 2, len(faces))
    clip = perspective(width, height)
    triangle, barycentric, depth = draw(points, faces, clip, width, height, double_sided=sided, tiled=tiled)
    want = rasterize(points, faces, clip, width, height, double_sided=sided, edge=2e-5, tie=4e-6)
    assert (want.triangle >= 0).mean() > (0.005 if kind in ("slivers", "small") else 0.05)
    assert want.decided.mean() > 0.99
    bad = want.decided & (triangle != want.triangle)
    assert not bad.any(), f"{bad.sum()} pixels differ, the first at {np.argwhere(bad)[0]}"
    seen = (triangle == want.triangle) & (triangle >= 0)
    # Worst seen on CPU, 2026-11: 4.5e-6 px, 3.2e-7 of depth (5e-6 for triangles that reach 1e8 px); margin 2.
    error = np.abs(barycentric[seen] - want.barycentric[seen]).max(-1)
    assert (error <= 9e-6 * want.slope[seen] + 3e-7).all(), (error / want.slope[seen]).max()
    relative = np.abs(depth[seen] / want.depth[seen] - 1.0).max()
    assert relative < (1e-5 if kind == "far outside" else 1e-6), relative
    assert (barycentric >= 0.0).all()
    assert (barycentric.sum(-1) <= 1.0 + 2e-7).all()
    empty = triangle < 0
    assert np.isinf(depth[empty]).all()
    assert (barycentric[empty] == 0.0).all()


def icosphere(levels):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.icosphere(subdivisions=levels)
    return np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32)


@pytest.mark.parametrize("tiled", [True, False])
@pytest.mark.parametrize("levels", [0, 3, 5])
def test_closed_mesh_has_no_holes(rng, levels, tiled):
    points, faces = icosphere(levels)
    for _ in range(3):  # from inside, so every pixel sees the mesh, and a hole would show the background
        moved = (points * rng.uniform(0.9, 1.1, (len(points), 1)) + rng.uniform(-0.3, 0.3, 3)).astype(np.float32)
        triangle, _, depth = draw(
            moved, faces[:, ::-1], perspective(300, 211, fov=2.0, near=1e-3), 300, 211, tiled=tiled
        )
        assert (triangle >= 0).all()
        assert np.isfinite(depth).all()
    triangle, _, _ = draw(points, faces, perspective(300, 211, fov=2.0, near=1e-3), 300, 211, tiled=tiled)
    assert (triangle < 0).all()  # the same from behind


def test_edges_through_pixel_centres_leave_no_holes_and_ties_go_to_the_lower_id():
    width = height = 96
    clip = perspective(width, height, fov=np.pi / 2)
    centres = (np.arange(0, width, 5) + 0.5) / width * 2 - 1
    x, y = np.meshgrid(centres, -centres)
    points = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3).astype(np.float32)  # every vertex on a pixel centre
    n = len(centres)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.concatenate([i + [0, n, 1], i + [1, n, n + 1]]).astype(np.int32)
    once, _, _ = draw(points, faces, clip, width, height)
    inner = once[1:91, 1:91]
    assert (inner >= 0).all()
    twice, _, _ = draw(points, np.concatenate([faces, faces]), clip, width, height)
    np.testing.assert_array_equal(twice, once)


def test_depth_ties_between_levels_of_the_grid_go_to_the_lower_id():
    width = height = 256
    clip = perspective(width, height, fov=np.pi / 2)
    # One plane at constant depth: a triangle over the whole picture and a small one, in both orders.
    big, small = [[-9, -9, -2], [9, -9, -2], [0, 9, -2]], [[-0.1, -0.1, -2], [0.1, -0.1, -2], [0, 0.1, -2]]
    points = np.array(big + small, np.float32)
    first, _, depth = draw(points, np.array([[0, 1, 2], [3, 4, 5]], np.int32), clip, width, height)
    second, _, _ = draw(points, np.array([[3, 4, 5], [0, 1, 2]], np.int32), clip, width, height)
    ties = depth == 2.0
    assert (first[ties] == 0).all()
    assert (second[ties & (first == 0)] == 0).sum() > 50


@pytest.mark.parametrize("size", [(1, 1), (1, 70), (65, 1), (64, 64), (17, 33), (129, 191)])
def test_sizes_off_the_tile_grid_match_reference(rng, size):
    width, height = size
    points, faces = soup(rng, "large", 12)
    clip = perspective(width, height)
    sided = np.ones(len(faces), np.uint8)
    triangle, _, _ = draw(points, faces, clip, width, height, double_sided=sided)
    want = rasterize(points, faces, clip, width, height, double_sided=sided)
    np.testing.assert_array_equal(triangle[want.decided], want.triangle[want.decided])
    assert want.decided.mean() > 0.9
    assert (triangle >= 0).any()


def test_back_faces_show_only_where_double_sided():
    points = np.array([[-1, -1, -2], [1, -1, -2], [0, 1, -2]], np.float32)
    clip = perspective(40, 40)
    for face, sided, seen in [([0, 1, 2], 0, True), ([0, 2, 1], 0, False), ([0, 2, 1], 1, True), ([0, 1, 2], 1, True)]:
        triangle, _, _ = draw(points, np.array([face]), clip, 40, 40, double_sided=np.array([sided]))
        assert (triangle >= 0).any() == seen, (face, sided)


def test_frames_replay_and_clear_what_moved_away(rng):
    width, height = 200, 150
    clip = perspective(width, height)
    points, faces = soup(rng, "small", 40)
    raster = CameraRaster(faces, len(points), width, height, device="cpu")
    outputs = raster.triangle.ptr, raster.barycentric.ptr, raster.depth.ptr
    for shift in ([0, 0, 0], [1.5, 0, 0], [0, -1, 1], [0, 0, 50], [0, 0, -2]):
        moved = (points + np.array(shift)).astype(np.float32)
        raster.run(wp.array(moved, dtype=wp.vec3, device="cpu"), clip)
        want = draw(moved, faces, clip, width, height)
        for got, expected in zip((raster.triangle, raster.barycentric, raster.depth), want, strict=True):
            np.testing.assert_array_equal(got.numpy(), expected)
    assert outputs == (raster.triangle.ptr, raster.barycentric.ptr, raster.depth.ptr)


@pytest.mark.parametrize("kind", ["plain", "crossing", "small"])
def test_result_does_not_depend_on_workers(rng, kind):
    points, faces = soup(rng, kind, 5000)
    clip = perspective(500, 400)
    results = []
    try:
        for workers in (1, 2, 3):
            dispatch.set_worker_count(workers)
            results.append(draw(points, faces, clip, 500, 400))
        dispatch.set_worker_count(1)
        raster = CameraRaster(faces, len(points), 500, 400, device="cpu")
        dispatch.set_worker_count(3)  # more workers than when the scratch was made
        raster.run(points, clip)
        results.append((raster.triangle.numpy(), raster.barycentric.numpy(), raster.depth.numpy()))
    finally:
        dispatch.set_worker_count(None)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


@wp.kernel
def _ray_kernel(mesh: wp.uint64, inverse: wp.mat33d, width: int, hit: wp.array(dtype=wp.int32)):
    i = wp.tid()
    x = wp.float64(i % width) + wp.float64(0.5)
    y = wp.float64(i // width) + wp.float64(0.5)
    d = wp.vec3(inverse * wp.vec3d(x, y, wp.float64(1.0)))
    query = wp.mesh_query_ray(mesh, wp.vec3(0.0), wp.normalize(d), 1.0e6)
    hit[i] = wp.where(query.result, query.face, -1)


def test_raster_sees_what_rays_hit(data):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(data / "meshes" / "bunny_low.ply", process=False)
    points, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32)
    low, high = points.min(0), points.max(0)
    points = ((points - (low + high) / 2) / (high - low)[1] + [0, 0, -1.8]).astype(np.float32)
    width, height = 320, 240
    clip = perspective(width, height)
    triangle, barycentric, depth = draw(points, faces, clip, width, height, double_sided=np.ones(len(faces)))
    inverse = np.linalg.inv(pixel_matrix(clip, width, height)[[0, 1, 3]][:, :3])
    mesh = wp.Mesh(wp.array(points, dtype=wp.vec3, device="cpu"), wp.array(faces.ravel(), dtype=wp.int32, device="cpu"))
    hit = wp.empty(width * height, dtype=wp.int32, device="cpu")
    wp.launch(_ray_kernel, width * height, [mesh.id, wp.mat33d(inverse), width], [hit], device="cpu")
    rays = hit.numpy().reshape(height, width)
    assert (rays >= 0).mean() > 0.15
    # The file holds 31 faces twice, which count as one; apart from that, no pixel of 76,800 differed in 2026-11.
    alike = np.append(np.unique(np.sort(faces, 1), axis=0, return_inverse=True)[1], -1)
    assert (alike[rays] != alike[triangle]).mean() < 1e-4
    seen = triangle >= 0
    p = points[faces[triangle[seen]]].astype(np.float64)
    b = barycentric[seen].astype(np.float64)
    at = p[:, 0] * (1 - b.sum(-1, keepdims=True)) + p[:, 1] * b[:, :1] + p[:, 2] * b[:, 1:]
    screen = np.concatenate([at, np.ones((len(at), 1))], 1) @ pixel_matrix(clip, width, height).T
    centres = np.stack(np.nonzero(seen)[::-1], -1) + 0.5
    assert np.abs(screen[:, :2] / screen[:, 3:] - centres).max() < 1e-4  # the weights lead back to the pixel centre
    np.testing.assert_allclose(screen[:, 3], depth[seen], rtol=1e-5)


def test_depth_range_is_what_the_matrix_says():
    near, far = depth_range(perspective(10, 10, near=0.25, far=40.0))
    assert near == pytest.approx(0.25, rel=1e-5)
    assert far == pytest.approx(40.0, rel=1e-4)
    infinite = perspective(10, 10).astype(np.float64)
    infinite[2, 2:] = -1.0, -0.5
    assert depth_range(infinite) == (0.5, np.inf)
    reverse = np.diag([1.0, 1.0, 0.0, 0.0])
    reverse[3, 2], reverse[2, 3] = -1.0, 0.5
    assert depth_range(reverse) == (0.5, np.inf)


def test_nearer_than_near_and_farther_than_far_is_cut():
    clip = perspective(64, 64, near=1.0, far=10.0)
    plane = np.array(
        [[-9, -1, 20], [9, -1, 20], [0, -1, -900]], np.float32
    )  # a floor from behind the eye to beyond far
    _, _, depth = draw(plane, np.array([[0, 1, 2]]), clip, 64, 64)
    drawn = depth[np.isfinite(depth)]
    assert drawn.size > 200
    assert drawn.min() >= 1.0
    assert drawn.max() <= 10.0 * (1 + 1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.zeros((4, 4), np.int32)}, r"faces must have shape \[F, 3\], got \(4, 4\)"),
        ({"faces": np.array([[0, 1, 3]])}, r"faces must index 3 vertices, got indices from 0 to 3"),
        ({"width": 0}, r"width must be in 1..32767, got 0"),
        ({"height": 40000}, r"height must be in 1..32767, got 40000"),
        ({"double_sided": np.zeros(2)}, r"double_sided must have shape \[1\], got \(2,\)"),
    ],
)
def test_bad_meshes_and_sizes_are_named(change, message):
    arguments = {"faces": np.array([[0, 1, 2]]), "vertex_count": 3, "width": 4, "height": 4, "device": "cpu"} | change
    with pytest.raises(ValueError, match=message):
        CameraRaster(**arguments)


def test_bad_frames_are_named():
    raster = CameraRaster(np.array([[0, 1, 2]]), 3, 4, 4, device="cpu")
    with pytest.raises(ValueError, match=r"points must have shape \[3, 3\], got \(4, 3\)"):
        raster.run(np.zeros((4, 3), np.float32), perspective(4, 4))
    with pytest.raises(ValueError, match="last row is constant"):
        raster.run(np.zeros((3, 3), np.float32), np.eye(4, dtype=np.float32))
    with pytest.raises(ValueError, match="clip must be finite"):
        raster.run(np.zeros((3, 3), np.float32), np.full((4, 4), np.nan))


def test_stats_count_what_was_skipped():
    points = np.array([[-1, -1, -9], [1, -1, -9], [0, 1, -9], [0, 0, 5], [np.nan, 0, -9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 1], [0, 1, 4], [3, 3, 3]])  # seen, back, flat, NaN, behind the eye
    raster = CameraRaster(faces, 5, 640, 64, device="cpu")
    raster.run(points, perspective(640, 64))
    stats = raster.stats()
    assert (stats["triangles"], stats["tiles"], stats["tiles_drawn"]) == (5, 10, 2)
    assert 1 <= stats["kept"] <= 2  # the flat one is found out when it is drawn
    raster.run(points + np.float32([0, 0, 20]), perspective(640, 64))
    assert raster.stats() == {"triangles": 5, "tiles": 10, "kept": 0, "entries": 0, "tiles_drawn": 0}


def test_mesh_without_triangles_draws_background():
    triangle, _, depth = draw(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32), perspective(9, 9), 9, 9)
    assert (triangle == -1).all()
    assert np.isinf(depth).all()
