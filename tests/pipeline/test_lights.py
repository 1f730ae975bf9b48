"""Point lights: default brightness, scaling with the scene, circles, and readable complaints."""

import json
import math

import numpy as np
import pytest

from warp_neumat.pipeline.lights import PointLights, lights_from

LO, HI = np.array([-1.0, 0.0, -2.0]), np.array([1.0, 3.0, 2.0])
CENTRE, RADIUS = 0.5 * (LO + HI), 0.5 * np.linalg.norm(HI - LO)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def radiance(lights, point, normal):
    """Luminance of a white Lambert surface at ``point``."""
    position, intensity = (a.astype(np.float64) for a in lights.at(0))
    arm = position - point
    distance = np.linalg.norm(arm, axis=1)
    cosine = np.clip(arm @ normal / distance, 0, None)
    return (intensity * (cosine / distance**2)[:, None]).sum(axis=0) / math.pi @ LUMINANCE


def test_a_white_surface_that_faces_the_key_one_radius_out_has_radiance_0_7():
    key = lights_from(1, LO, HI)
    direction = (key.position[0] - CENTRE) / np.linalg.norm(key.position[0] - CENTRE)
    assert radiance(key, CENTRE + RADIUS * direction, direction) == pytest.approx(0.7, rel=1e-6)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 16])
def test_default_sets_stay_within_what_a_display_shows(count, rng):
    lights = lights_from(count, LO, HI)
    assert len(lights) == count
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = [radiance(lights, CENTRE + RADIUS * n, n) for n in normals]
    assert 0.65 < max(seen) < 1.0


def test_the_key_is_warm_and_the_rim_cool_and_behind():
    key, _, rim = lights_from(3, LO, HI).intensity
    assert key[0] > key[2]
    assert rim[2] > rim[0]
    position = lights_from(3, LO, HI).position - CENTRE
    assert position[0][2] * position[2][2] < 0


def test_radiance_does_not_depend_on_the_scenes_size():
    small, large = lights_from("3", LO, HI), lights_from(3, 100 * LO, 100 * HI)
    np.testing.assert_allclose(large.intensity, 1e4 * small.intensity)
    np.testing.assert_allclose(large.position, 100 * small.position)


def test_at_gives_contiguous_float32_and_lights_at_rest_do_not_move():
    lights = lights_from(5, LO, HI, frames=10)
    assert not lights.animated
    for array in lights.at(7):
        assert array.shape == (5, 3)
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
    np.testing.assert_array_equal(lights.at(7)[0], lights.at(0)[0])


def written(tmp_path, value):
    file = tmp_path / "lights.json"
    file.write_text(value if isinstance(value, str) else json.dumps(value))
    return file


def test_a_file_gives_positions_colours_and_a_right_handed_circle(tmp_path):
    moving = {"position": [0, 1.5, 5], "intensity": 2, "orbit": {"turns": 1, "axis": [0, 3, 0]}}
    still = {"position": [1, 2, 3], "intensity": 10, "color": [1, 0.5, 0]}
    lights = lights_from(written(tmp_path, {"lights": [still, moving]}), LO, HI, frames=8)
    position, intensity = lights.at(2)  # a quarter turn about +y takes +z to +x
    np.testing.assert_allclose(position, [[1, 2, 3], [5, 1.5, 0]], atol=1e-6)
    np.testing.assert_allclose(intensity, [[10, 5, 0], [2, 2, 2]])
    np.testing.assert_allclose(lights.at(8)[0], lights.at(0)[0], atol=1e-6)
    assert lights.animated


def test_a_circle_keeps_distance_and_height(rng):
    axis = rng.normal(size=(4, 3))
    lights = PointLights(rng.normal(size=(4, 3)), np.ones((4, 3)), np.array([1, -2, 0.5, 3]), axis, CENTRE, 24)
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    for frame in (1, 7.5, 23):
        before, after = lights.at(0)[0] - CENTRE, lights.at(frame)[0] - CENTRE
        np.testing.assert_allclose(np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1), rtol=1e-5)
        np.testing.assert_allclose((after * axis).sum(1), (before * axis).sum(1), atol=1e-6)
        assert (np.abs(after - before).max(axis=1) > 0.05).all()


GOOD = {"position": [0, 1, 2], "intensity": 3}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"lamps": []}, r"lights.json has an unknown key 'lamps'; the nearest known one is 'lights'"),
        ({"lights": []}, r"lights.json: lights must be a list .* of at least one"),
        ({"lights": [GOOD, {"position": [0, 0, 0]}]}, r"lights.json: lights\[1\].intensity is missing"),
        ({"lights": [GOOD | {"colour": [1, 1, 1]}]}, r"lights\[0\] has an unknown key 'colour'.*'color'"),
        ({"lights": [GOOD | {"intensity": -1}]}, r"lights.json: lights\[0\].intensity must be at least 0, got -1"),
        ({"lights": [GOOD | {"color": [1, -1, 0]}]}, r"lights\[0\].color must not be negative"),
        ({"lights": [GOOD | {"orbit": {"axis": [0, 0, 0]}}]}, r"lights\[0\].orbit.axis must not be zero"),
        ({"lights": [GOOD | {"orbit": 3}]}, r"lights\[0\].orbit must be an object"),
        ('{"lights": [{"position": [0, 0, Infinity], "intensity": 1}]}', r"lights\[0\].position must be three finite"),
    ],
)
def test_a_bad_file_is_refused_with_file_field_and_rule(tmp_path, value, message):
    with pytest.raises(ValueError, match=message) as caught:
        lights_from(written(tmp_path, value), LO, HI)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [0, -1, 17, "17"])
def test_a_wrong_number_names_the_range(count):
    with pytest.raises(ValueError, match=r"lights must be 1 to 16 default lights or a JSON file, got"):
        lights_from(count, LO, HI)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.json: no such file"):
        lights_from(tmp_path / "none.json", LO, HI)


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match=r"intensity must have shape \(2, 3\), got \(1, 3\)"):
        PointLights(np.zeros((2, 3)), np.ones((1, 3)))
