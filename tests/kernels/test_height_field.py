"""Rays and light on a height field against paths traced one by one in float64, and on surfaces with known answers."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.io.btf_directions import ubo2014_directions
from warp_neumat.kernels import height_field as rays
from warp_neumat.kernels import height_field_light as light
from warp_neumat.reference import height_field as reference


def _bumps(rng, size=16, high=1.5):
    return (rng.standard_normal((size, size)) * high).astype(np.float32)


def _tracer(height, fibre, bounces=((0, 0, 1),)):
    flat = np.ones(height.shape)
    return reference.PathTracer(
        height, np.ones((*height.shape, 3)), np.ones((*height.shape, 2)), flat, fibre, 2, bounces
    )


def test_points_have_the_frames_of_the_reference(rng):
    height, fibre = _bumps(rng), rng.uniform(0, 3, (16, 16))
    field = rays.surface(height, fibre, 2)
    position, normal, tangent = reference.frames(height, fibre, 2)
    assert field.level.numpy() == pytest.approx(position[:, 2], abs=1e-6)
    assert field.normal.numpy() == pytest.approx(normal, abs=1e-6)
    assert field.tangent.numpy() == pytest.approx(tangent, abs=1e-6)


def test_rays_see_the_points_of_the_reference(rng, device):
    """Worst of 40 fields: 0 of 3·10⁵ rays differ; a ray may meet the very line between two sub-squares."""
    height, views = _bumps(rng), ubo2014_directions()[::15]
    seen = rays.trace_views(rays.surface(height, 0 * height, 2, device=device), views)
    expected = np.array([_tracer(height, 0 * height).seen(w) for w in views])
    assert (seen != expected).mean() < 2e-4
    assert (expected != np.arange(expected.shape[1])).mean() > 0.5  # the field does shift what is seen


def test_lights_reach_the_points_of_the_reference(rng, device):
    height, lights = _bumps(rng), ubo2014_directions()[::15]
    lit = rays.trace_lights(rays.surface(height, 0 * height, 2, device=device), lights)
    tracer = _tracer(height, 0 * height)
    expected = np.array([tracer.lit(np.arange(len(lit)), w) for w in lights]).T
    assert (lit != expected).mean() < 2e-4
    assert 0.2 < expected.mean() < 0.9


def test_bounces_meet_the_points_of_the_reference(rng):
    height, fibre = _bumps(rng), rng.uniform(0, 3, (16, 16))
    ways = light.cosine_directions(8)
    seen = rays.trace_bounces(rays.surface(height, fibre, 2), ways)
    expected = _tracer(height, fibre, ways).met(np.arange(len(seen)))
    assert (seen != expected).mean() < 2e-4
    assert 0.1 < (expected >= 0).mean() < 0.9


def test_straight_down_and_near_the_horizon(rng):
    height = _bumps(rng)
    field = rays.surface(height, 0 * height, 2)
    low = np.float32([0.01, 0, 0.9999])[[2, 1, 0]]
    assert np.array_equal(rays.trace_views(field, [[0, 0, 1]])[0], np.arange(field.points))
    assert (rays.trace_views(field, [low, [0, 0.99995, 0.01]]) >= 0).all()
    flat = rays.surface(np.zeros((16, 16)), np.zeros((16, 16)), 2)
    assert rays.trace_lights(flat, [low, [0, 0, 1]]).all()
    assert (rays.trace_bounces(flat, light.cosine_directions(16)) == -1).all()


def test_a_ray_sees_past_a_wall():
    """A wall one texel thick hides what lies behind it, over the length its height and the angle give."""
    height = np.zeros((8, 64), np.float32)
    height[:, 32] = 8.0
    field = rays.surface(height, np.zeros((8, 64)), 2)
    lit = rays.trace_lights(field, [[np.sqrt(0.5), 0, np.sqrt(0.5)]]).reshape(8, 64, 2, 2)
    row = lit[4, :, 0, 0]
    assert row[:23].all()
    assert not row[26:32].any()  # behind the wall, seen from the light in +x
    assert row[34:].all()


def test_cosine_directions_are_what_they_say():
    ways = light.cosine_directions(64)
    assert np.linalg.norm(ways, axis=1) == pytest.approx(1.0, abs=1e-6)
    assert ways[:, 2].mean() == pytest.approx(2 / 3, abs=0.01)  # the mean cosine of a cosine distribution
    for mirror in ([-1, 1, 1], [1, -1, 1]):
        assert {tuple(w) for w in (ways * np.float32(mirror)).round(5)} == {tuple(w) for w in ways.round(5)}


def test_a_light_in_a_closed_pit_comes_to_the_series_of_its_bounces(rng):
    """Points that all see points of the same G form a geometric series: one bounce after the other adds ρ k of it."""
    field = rays.surface(np.zeros((16, 16)), np.zeros((16, 16)), 2)
    rho, f0 = 0.6, 0.1
    optics = light.Optics(
        field, np.full((field.points, 3), rho), np.full((field.points, 2), 0.3), np.full(field.points, f0)
    )
    seen = wp.array(rng.integers(0, field.points, field.points * 4).astype(np.int32), dtype=wp.int32)
    wi = np.float32([[0, 0, 1]])
    lit = np.ones((field.points, 1), np.int32)
    keep = (1 - f0) * 20 / 21
    direct = rho / np.pi * (1 - f0)
    for passes in range(4):
        word = optics.light_tables(wi, lit, seen, 4, passes)[0]
        assert (word >> np.uint64(63)).all()
        expected = direct * sum((rho * keep * keep) ** k for k in range(passes + 1))
        for shift in (0, 21, 42):
            level = ((word >> np.uint64(shift)) & np.uint64(2**21 - 1)).astype(np.float64) / (2**21 - 1)
            assert level == pytest.approx(expected, abs=1e-6)


def test_arguments_are_named():
    with pytest.raises(ValueError, match=r"height must be finite numbers of shape \(rows, width\), got \(3,\)"):
        rays.surface(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="height must be finite"):
        rays.surface(np.full((4, 4), np.nan), np.zeros((4, 4)))
    with pytest.raises(ValueError, match="sub must be even and at least 2, got 3"):
        rays.surface(np.zeros((4, 4)), np.zeros((4, 4)), 3)
