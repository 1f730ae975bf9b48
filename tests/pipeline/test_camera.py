"""Cameras: conventions of clip space and rays, orbit framing, key interpolation, and readable complaints."""

import json
import math

import numpy as np
import pytest

from warp_neumat.pipeline.camera import Camera, load_camera, orbit

LO, HI = np.array([-1.0, 0.0, -2.0]), np.array([1.0, 3.0, 2.0])
SIZE = {"width": 320, "height": 180}


def project(camera, points):
    clip = np.c_[points, np.ones(len(points))] @ camera.clip().astype(np.float64).T
    return clip[:, :3] / clip[:, 3:], clip[:, 3]


@pytest.fixture
def camera():
    return Camera.look_at([3, 2, 5], [0.5, 1, -1], [0, 1, 0], fov_y=0.7, **SIZE, near=0.5, far=40.0)


def test_view_is_rigid_and_looks_down_minus_z(camera):
    rotation = camera.view[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(camera.eye, [3, 2, 5], atol=1e-14)
    target = camera.view @ [0.5, 1, -1, 1]
    np.testing.assert_allclose(target, [0, 0, -np.linalg.norm([2.5, 1, 6]), 1], atol=1e-14)
    assert (camera.view @ [0, 1, 0, 0])[1] > 0  # up stays up


def test_clip_is_right_up_and_depth_runs_from_0_at_near_to_1_at_far():
    camera = Camera.look_at([0, 0, 0], [0, 0, -1], fov_y=math.pi / 2, **SIZE, near=0.5, far=40.0)
    half = 320 / 180
    ndc, w = project(camera, [[0, 0, -0.5], [0, 0, -40], [half, 1, -1], [-2 * half, -2, -2]])
    np.testing.assert_allclose(ndc[:, 2][:2], [0, 1], atol=1e-6)
    np.testing.assert_allclose(ndc[2:, :2], [[1, 1], [-1, -1]], atol=1e-6)
    np.testing.assert_allclose(w, [0.5, 40, 1, 2], rtol=1e-6)
    assert camera.clip().dtype == np.float32


def test_rays_pass_through_the_picture_points_that_clip_gives(camera, rng):
    x, y = rng.uniform(0, 320, 200), rng.uniform(0, 180, 200)
    origin, direction = camera.ray(x, y)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, rtol=1e-14)
    ndc, w = project(camera, origin + direction * rng.uniform(1, 20, (200, 1)))
    # The worst seen is 2e-5 px: the matrix is float32.
    np.testing.assert_allclose((ndc[:, 0] + 1) * 160, x, atol=2e-4)
    np.testing.assert_allclose((1 - ndc[:, 1]) * 90, y, atol=2e-4)
    assert (w > 0).all()


def test_pixel_rows_run_down(camera):
    _, (top, bottom) = camera.ray(160, [0.5, 179.5])
    assert top[1] > bottom[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": [3, 2, 5]}, "eye and target must differ"),
        ({"up": [-5, -2, -12]}, "up must not be zero or parallel"),
        ({"up": [0, 0, 0]}, "up must not be zero or parallel"),
        ({"eye": [0, math.nan, 0]}, "eye must be three finite numbers"),
        ({"fov_y": math.pi}, "fov_y must be in"),
        ({"near": 41.0}, "0 < near < far"),
        ({"width": 0}, "at least one pixel"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, message):
    good = {"eye": [3, 2, 5], "target": [0.5, 1, -1], "up": [0, 1, 0], "fov_y": 0.7, **SIZE, "near": 0.5, "far": 40.0}
    with pytest.raises(ValueError, match=message):
        Camera.look_at(**(good | change))


@pytest.mark.parametrize(("width", "height"), [(320, 180), (180, 320), (256, 256)])
def test_orbit_frames_the_box_as_closely_as_it_can(width, height):
    path = orbit(LO, HI, 240, width=width, height=height)
    corners = np.array(np.meshgrid(*zip(LO, HI, strict=True))).reshape(3, 8).T
    extents = []
    for frame in range(240):
        ndc, w = project(path.at(frame), corners)
        extents.append(np.abs(ndc[:, :2]).max())
        assert (w > 0).all()
        assert ndc[:, 2].min() > 0
        assert ndc[:, 2].max() < 1
    assert max(extents) == pytest.approx(0.95, abs=2e-3)  # over all sides, one corner comes that near to the edge


def test_orbit_closes_starts_at_its_azimuth_and_keeps_its_elevation():
    path = orbit(LO, HI, 8, turns=2, azimuth=math.radians(90), elevation=math.radians(30), distance=10, **SIZE)
    np.testing.assert_allclose(path.at(0).view, path.at(8).view, atol=1e-13)
    np.testing.assert_allclose(path.at(0).view, path.at(4).view, atol=1e-13)
    arm = path.at(0).eye - 0.5 * (LO + HI)
    np.testing.assert_allclose(arm, [10 * math.cos(math.pi / 6), 5, 0], atol=1e-13)


@pytest.mark.parametrize(("lo", "hi"), [([0, 0, 0], [0, 0, 0]), ([1, 0, 0], [0, 1, 1]), ([0, 0, 0], [math.inf, 1, 1])])
def test_orbit_refuses_bounds_without_extent(lo, hi):
    with pytest.raises(ValueError, match="bounds must have|three finite numbers"):
        orbit(lo, hi, 8, **SIZE)


def written(tmp_path, value):
    file = tmp_path / "cam.json"
    file.write_text(value if isinstance(value, str) else json.dumps(value))
    return file


def loaded(tmp_path, value, frames=10):
    return load_camera(written(tmp_path, value), LO, HI, frames, **SIZE)


def test_static_file(tmp_path):
    path = loaded(tmp_path, {"eye": [0, 1, 9], "target": [0, 1, 0], "fov_degrees": 30, "near": 1, "far": 99})
    camera = path.at(7)
    assert (camera.fov_y, camera.near, camera.far) == (pytest.approx(math.radians(30)), 1, 99)
    np.testing.assert_allclose(camera.eye, [0, 1, 9], atol=1e-14)


def test_orbit_word_and_orbit_file_agree(tmp_path):
    word = load_camera("orbit", LO, HI, 10, **SIZE)
    file = loaded(tmp_path, {"orbit": {}})
    np.testing.assert_array_equal(word.at(3).clip(), file.at(3).clip())


def test_default_orbit_turns_once_but_calmly():
    assert orbit(LO, HI, 24, **SIZE).turns == pytest.approx(0.1)
    assert orbit(LO, HI, 480, **SIZE).turns == 1.0


KEYS = [{"frame": f, "eye": [x, 1, 9], "target": [x / 2, 1, 0]} for f, x in ((0, 0.0), (4, 4.0), (6, 5.0), (9, 11.0))]


def test_linear_keys_are_hit_and_halved_and_held(tmp_path):
    path = loaded(tmp_path, {"keys": KEYS})
    for frame, x in ((0, 0), (2, 2), (4, 4), (5, 4.5), (9, 11), (50, 11), (-3, 0)):
        np.testing.assert_allclose(path.at(frame).eye, [x, 1, 9], atol=1e-13)


def test_catmull_rom_hits_its_keys_and_has_no_kink(tmp_path):
    path = loaded(tmp_path, {"keys": KEYS, "interpolation": "catmull-rom"})
    for key in KEYS:
        np.testing.assert_allclose(path.at(key["frame"]).eye, key["eye"], atol=1e-13)
    h = 1e-5
    for frame, slope in ((4, 5 / 6), (6, 7 / 5)):  # the chord between the neighbours
        before = (path.at(frame).eye[0] - path.at(frame - h).eye[0]) / h
        after = (path.at(frame + h).eye[0] - path.at(frame).eye[0]) / h
        assert before == pytest.approx(slope, abs=1e-4)
        assert after == pytest.approx(slope, abs=1e-4)


STATIC = {"eye": [0, 1, 9], "target": [0, 1, 0]}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("{", r"cam.json: is not JSON, line 1 column 2"),
        ([1], r"cam.json must be an object"),
        ({"eye": [0, 1, 9]}, r"cam.json: target is missing"),
        (STATIC | {"tagret": [0, 0, 0]}, r"unknown key 'tagret'; the nearest known one is 'target'"),
        (STATIC | {"eye": [0, 1]}, r"cam.json: eye must be three finite numbers .* got \[0, 1\]"),
        ('{"eye": [0, NaN, 1], "target": [0, 0, 0]}', r"cam.json: eye must be three finite numbers"),
        (STATIC | {"fov_degrees": 0}, r"cam.json: fov_degrees must be more than 0 and at most 170, got 0"),
        (STATIC | {"fov_degrees": "wide"}, r"cam.json: fov_degrees must be a finite number, got \"wide\""),
        (STATIC | {"target": [0, 1, 9]}, r"cam.json: frame 0: eye and target must differ"),
        (STATIC | {"up": [0, 0, 1]}, r"cam.json: frame 0: up must not be zero or parallel"),
        (STATIC | {"near": 50, "far": 2}, r"cam.json: frame 0: near and far must hold"),
        ({"keys": []}, r"cam.json: keys must be a list .* of at least one"),
        ({"keys": [KEYS[1], KEYS[0]]}, r"cam.json: keys\[1\].frame must be above the key's before it, got 0"),
        ({"keys": [KEYS[0] | {"fov": 3}]}, r"cam.json: keys\[0\] has an unknown key 'fov'.*'fov_degrees'"),
        ({"keys": KEYS, "interpolation": "cubic"}, r"interpolation must be one of linear, catmull-rom, got \"cubic\""),
        ({"orbit": {"elevation_degrees": 90}}, r"cam.json: orbit.elevation_degrees must be at least -89"),
        ({"orbit": {}, "eye": [0, 0, 0]}, r"cam.json has an unknown key 'eye'"),
        ({"orbit": {"distance": 0}}, r"cam.json: orbit.distance must be more than 0, got 0"),
    ],
)
def test_a_bad_file_is_refused_with_file_field_and_rule(tmp_path, value, message):
    with pytest.raises(ValueError, match=message) as caught:
        loaded(tmp_path, value)
    assert "\n" not in str(caught.value)


def test_keys_whose_way_crosses_the_target_are_refused_before_the_first_frame(tmp_path):
    keys = [{"frame": f, "eye": [0, 0, z], "target": [0, 0, 0]} for f, z in ((0, -1), (8, 1))]
    with pytest.raises(ValueError, match=r"cam.json: frame 4: eye and target must differ"):
        loaded(tmp_path, {"keys": keys})


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.json: no such file"):
        load_camera(tmp_path / "none.json", LO, HI, 4, **SIZE)
