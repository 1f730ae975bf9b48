"""Patterns of micro-geometry: periodic, seeded, within their ranges, and different from one another."""

import dataclasses

import numpy as np
import pytest

from warp_neumat.simulation.height_fields import PATTERNS, MicroGeometry, make_pattern
from warp_neumat.simulation.periodic_noise import band_noise, cells, grid


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pattern_repeats(name):
    """Across the border neighbours differ no more than within."""
    m = make_pattern(name, size=96)
    for axis in (0, 1):
        for values in (m.height, m.albedo[..., 0]):
            step = np.abs(np.diff(values, axis=axis))
            border = np.abs(values.take(0, axis) - values.take(-1, axis))
            assert border.mean() < 2.5 * step.mean(axis=axis).mean() + 1e-3
            assert border.max() <= 1.5 * step.max() + 1e-3


@pytest.mark.parametrize("name", PATTERNS)
def test_the_seed_decides(name):
    one, same, other = (make_pattern(name, size=48, seed=s) for s in (1, 1, 2))
    for field in dataclasses.fields(one)[1:]:
        assert np.array_equal(getattr(one, field.name), getattr(same, field.name))
    assert not np.array_equal(one.height, other.height)


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pattern_scales_with_its_size(name):
    """Slopes stay: heights in texels grow with the number of texels."""
    small, large = (np.ptp(np.percentile(make_pattern(name, size=s).height, [5, 95])) for s in (64, 192))
    assert 1.8 < large / small < 4.5


def test_a_weave_has_two_colours_over_and_under():
    m = make_pattern("weave", size=128, threads=4, fuzz=0.0)
    blue = m.albedo[..., 2] > m.albedo[..., 0]
    assert 0.3 < blue.mean() < 0.7
    assert blue[16, 16] != blue[16, 48]
    assert blue[16, 16] == blue[48, 48]
    # Over and under: a yarn is higher where it is seen than a yarn's side where it dives.
    assert m.height[16, 16] > np.percentile(m.height, 60)
    twill = make_pattern("weave", size=128, threads=4, twill=1, fuzz=0.0)
    colour = twill.albedo[..., 2] > twill.albedo[..., 0]
    rows = [[bool(colour[16 + 32 * j, 16 + 32 * i]) for i in range(4)] for j in range(4)]
    assert all(sum(row) == 2 for row in rows)
    assert rows[1] in ([*rows[0][1:], rows[0][0]], [rows[0][-1], *rows[0][:-1]])  # each row moves on by one


def test_geometry_is_checked():
    flat = np.zeros((4, 4))
    good = {
        "height": flat,
        "albedo": np.zeros((4, 4, 3)),
        "roughness": flat + 0.5,
        "f0": flat,
        "anisotropy": flat,
        "fibre": flat,
    }
    assert MicroGeometry("x", **good).alpha == pytest.approx(0.25)
    for name, value in (
        ("albedo", flat),
        ("f0", flat + 2),
        ("roughness", flat),
        ("height", flat[0]),
        ("fibre", flat * np.nan),
    ):
        with pytest.raises(ValueError, match=f"x: {name} must"):
            MicroGeometry("x", **(good | {name: value}))


def test_noise_is_what_it_says(rng):
    noise = band_noise(rng, 64, 4)
    assert (noise.mean(), noise.std()) == (pytest.approx(0, abs=1e-12), pytest.approx(1))
    u, v = np.broadcast_arrays(*grid(64))
    d1, d2, number = cells(rng, u, v, 8)
    assert (d1 <= d2).all()
    assert set(np.unique(number)) <= set(range(64))
    state = np.random.default_rng(1)
    again = np.random.default_rng(1)
    assert cells(state, u, v, 8)[0] == pytest.approx(cells(again, u + 1, v - 2, 8)[0], abs=1e-9)
