"""Point lights and spots: default brightness, scaling with the scene, circles, cones, and readable complaints."""

import json
import math

import numpy as np
import pytest

from warp_neumat.pipeline.lights import LightState, PointLights, lights_from
from warp_neumat.reference.shade import punctual

LO, HI = np.array([-1.0, 0.0, -2.0]), np.array([1.0, 3.0, 2.0])
CENTRE, RADIUS = 0.5 * (LO + HI), 0.5 * np.linalg.norm(HI - LO)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def radiance(lights, point, normal):
    """Luminance of a white Lambert surface at ``point``."""
    position, intensity = (a.astype(np.float64) for a in lights.at(0)[:2])
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
    for array, width in zip(lights.at(7), ((3,), (3,), (), (3,), (2,)), strict=True):
        assert array.shape == (5, *width)
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
    position, intensity, *_ = lights.at(2)  # a quarter turn about +y takes +z to +x
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


def falloff(state: LightState, light: int, away: np.ndarray) -> np.ndarray:
    """What the state's numbers leave of a light along ``away``, by the formula that LightState states."""
    distance = np.linalg.norm(away, axis=1)
    scale, offset = state.cones[light].astype(np.float64)
    cosine = away @ state.direction[light] / distance
    window = np.clip(1 - (distance / state.range[light]) ** 4, 0, 1)
    return window * np.clip(scale * cosine + offset, 0, 1) ** 2


def test_range_and_cones_are_those_of_gltf(rng):
    angles = [(0.0, math.pi), (0.0, 0.5 * math.pi), (0.2, 0.6), (0.5, 0.501), (0.01, 0.02)]
    inner, outer = np.array(angles).T
    reach = np.array([np.inf, 1.5, np.inf, 2.0, 5.0])
    axis = rng.normal(size=(5, 3))
    lights = PointLights(
        rng.normal(size=(5, 3)), np.ones((5, 3)), range=reach, direction=axis, inner=inner, outer=outer
    )
    state = lights.at(3)
    away = rng.normal(size=(4000, 3))
    for k in range(5):
        aimed = np.concatenate([away, away * 0.3 * outer[k] + axis[k] / np.linalg.norm(axis[k])])
        expected = punctual(aimed, reach[k], axis[k], inner[k], outer[k])
        # float32 resolves the falloff of the fourth, 5e-4 wide in the cosine, to 2e-4 of its width.
        np.testing.assert_allclose(falloff(state, k, aimed), expected, atol=1e-3)
        assert (expected == 1).any() or np.isfinite(reach[k])
        assert ((expected > 0) & (expected < 1)).any() or k == 0
    assert state.cones[0].tolist() == [0, 1]
    assert (punctual(away, *[reach[0], axis[0], inner[0], outer[0]]) == 1).all()


def test_an_orbiting_spot_turns_with_its_orbit(rng, tmp_path):
    spots = [
        {"position": [0, 1.5, 5], "intensity": 1, "orbit": {"turns": 1}, "spot": {"target": CENTRE.tolist()}},
        {"position": [3, 4, 0], "intensity": 1, "orbit": {"turns": -2}, "spot": {"direction": [0, 0, -2], "outer": 20}},
        {"position": [1, 2, 3], "intensity": 1, "range": 8, "spot": {"direction": [1, -1, 0], "inner": 10}},
    ]
    lights = lights_from(written(tmp_path, {"lights": spots}), LO, HI, frames=8)
    for frame in (0, 1, 2.5, 7):
        state = lights.at(frame)
        toward = CENTRE - state.position[0]
        np.testing.assert_allclose(state.direction[0], toward / np.linalg.norm(toward), atol=1e-6)
        np.testing.assert_array_equal(state.direction[2], np.float32([1, -1, 0] / np.sqrt(2)))
        assert state.range.tolist() == [np.inf, np.inf, 8]
    # A quarter turn backwards about +y, as frame 1 of 8 is of two turns, takes −z to +x and +x to +z.
    np.testing.assert_allclose(lights.at(1).direction[1], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(lights.at(1).position[1], [0, 4, 3], atol=1e-6)
    np.testing.assert_allclose(np.degrees(lights.inner), [0, 0, 10])
    np.testing.assert_allclose(np.degrees(lights.outer), [45, 20, 45])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"range": [0.0]}, "range must be more than 0"),
        ({"range": [np.nan]}, "range must be more than 0"),
        ({"range": [1.0, 2.0]}, r"range must have shape \(1,\), got \(2,\)"),
        ({"direction": [[0, 0, 0]]}, "direction must not be zero"),
        ({"outer": [0.5], "inner": [0.5]}, "inner must be at least 0 and less than outer"),
        ({"outer": [0.5], "inner": [-0.1]}, "inner must be at least 0 and less than outer"),
        ({"outer": [2.0]}, "outer must be at most π/2, or π for a light that is no spot"),
        ({"outer": [np.nan]}, "outer must be finite"),
    ],
)
def test_ranges_and_cones_that_mean_nothing_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        PointLights(np.zeros((1, 3)), np.ones((1, 3)), **values)


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
        ({"lights": [GOOD | {"range": 0}]}, r"lights.json: lights\[0\].range must be more than 0, got 0"),
        ({"lights": [GOOD | {"range": "far"}]}, r"lights\[0\].range must be a finite number"),
        ({"lights": [GOOD | {"spot": 30}]}, r"lights\[0\].spot must be an object"),
        ({"lights": [GOOD | {"spot": {}}]}, r"lights\[0\].spot must have either direction or target"),
        (
            {"lights": [GOOD | {"spot": {"direction": [0, 0, 1], "target": [0, 0, 0]}}]},
            r"lights.json: lights\[0\].spot must have either direction or target",
        ),
        ({"lights": [GOOD | {"spot": {"target": [0, 1, 2]}}]}, r"spot.target must not be the light's own position"),
        ({"lights": [GOOD | {"spot": {"direction": [0, 0, 0]}}]}, r"lights\[0\].spot.direction must not be zero"),
        (
            {"lights": [GOOD | {"spot": {"direction": [0, 0, 1], "outer": 91}}]},
            r"lights\[0\].spot.outer must be more than 0 and at most 90, got 91",
        ),
        (
            {"lights": [GOOD | {"spot": {"direction": [0, 0, 1], "inner": 30, "outer": 30}}]},
            r"lights\[0\].spot.inner must be less than outer, 30 degrees, got 30",
        ),
        ({"lights": [GOOD | {"spot": {"aim": [0, 0, 1]}}]}, r"lights\[0\].spot has an unknown key 'aim'"),
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
