"""Training samples of a BTF: means over mips, where quads lie, and what stands for directions at the horizon."""

import dataclasses

import numpy as np
import pytest

from warp_neumat.io.btf_directions import ubo2003_directions
from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.training.btf_slices import SliceSampler, _lower, pyramids

DIRECTIONS = ubo2003_directions()


@dataclasses.dataclass
class Waves:
    """A source of smooth values that tell light, view and place apart."""

    width: int = 16
    height: int = 12
    lights: np.ndarray = dataclasses.field(default_factory=lambda: DIRECTIONS)
    views: np.ndarray = dataclasses.field(default_factory=lambda: DIRECTIONS[::3])

    def slices(self, pairs):
        light, view = np.asarray(pairs).T[:, :, None, None]
        y, x = np.mgrid[: self.height, : self.width]
        channels = 1 + light / 64 + 0 * x, 1 + view / 64 + 0 * x, 1 + (x + 2 * y) / 64 + 0 * light
        return np.stack(np.broadcast_arrays(*channels), -1).astype(np.float32)


# --- mips -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(16, 8), (13, 10), (5, 7), (1, 9)])
def test_pyramids_conserve_the_mean(rng, size):
    width, height = size
    slices = rng.random((3, height, width, 3)).astype(np.float32)
    sizes = mip_sizes(width, height)
    stack = pyramids(slices, len(sizes))
    assert stack.shape == (3, sum(w * h for w, h in sizes), 3)
    np.testing.assert_array_equal(stack[:, : width * height], slices.reshape(3, -1, 3).astype(np.float16))
    at = 0
    for w, h in sizes:
        level = stack[:, at : at + w * h].astype(np.float64)
        np.testing.assert_allclose(level.mean(1), slices.astype(np.float64).mean((1, 2)), rtol=2e-3)
        at += w * h


def test_a_level_of_an_even_size_is_the_mean_of_four_texels(rng):
    slices = rng.random((2, 8, 8, 3)).astype(np.float32)
    expected, at = slices.astype(np.float64), 64
    stack = pyramids(slices, 3)
    for side in (4, 2):
        expected = expected.reshape(2, side, 2, side, 2, 3).mean((2, 4))
        np.testing.assert_allclose(stack[:, at : at + side * side], expected.reshape(2, -1, 3), rtol=1e-3)
        at += side * side


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e5])
def test_values_that_float16_does_not_hold_are_an_error(value):
    slices = np.ones((1, 4, 4, 3), np.float32)
    slices[0, 2, 1, 0] = value
    with pytest.raises(ValueError, match="not finite or beyond 65504"):
        pyramids(slices, 1)


# --- places -----------------------------------------------------------------------------------------------------------


def test_every_square_of_texels_gets_its_quads_in_turn(rng):
    """Counts differ by one at most within a level, and half of the quads are at level 0."""
    sampler = SliceSampler(Waves(), 3)
    place = sampler(rng, 4096)["place"]
    shares = []
    for number, (w, h) in enumerate(sampler.sizes):
        mine = place[place[:, 3] == number]
        columns, rows = max(1, w // 2), max(1, h // 2)
        cell = (np.floor(mine[:, 1] * rows) * columns + np.floor(mine[:, 0] * columns)).astype(int)
        counts = np.bincount(cell, minlength=columns * rows)
        assert len(counts) == columns * rows
        assert counts.max() - counts.min() <= 1
        within = mine[:, :2] * (columns, rows) % 1.0  # anywhere in the square
        assert np.abs(within.mean(0) - 0.5).max() < 0.06
        assert np.abs(within.var(0) - 1 / 12).max() < 0.02
        shares.append(len(mine) / len(place))
    np.testing.assert_allclose(shares, [0.5, 0.25, 0.25], atol=0.03)
    assert ((place[:, 2] >= 0) & (place[:, 2] <= 1)).all()
    assert 0.45 < (place[:, 2] == 1).mean() < 0.55


def test_aligned_quads_are_texels(rng):
    source = Waves()
    drawn = SliceSampler(source, 3, beyond=0.0, aligned=True)(rng, 640)
    assert (drawn["place"][:, 2:] == (1, 0)).all()
    corner = drawn["place"][:, :2] * (source.width, source.height) - 1.0
    np.testing.assert_allclose(corner, np.round(corner / 2) * 2, atol=1e-5)  # every second texel, from the first on
    # What is drawn is what the source says under these directions, at these texels.
    for name, known, channel in (("wi", source.lights, 0), ("wo", source.views, 1)):
        index = np.argmax(drawn[name] @ known.T, 1)
        np.testing.assert_array_equal(drawn[name], known[index])
        np.testing.assert_allclose(
            drawn["value"].reshape(-1, 4, 3)[:, :, channel], (1 + index / 64)[:, None].repeat(4, 1), rtol=1e-3
        )
    x, y = np.round(corner).T
    expected = 1 + (x[:, None] + [0, 1, 0, 1] + 2 * (y[:, None] + [0, 0, 1, 1])) / 64
    np.testing.assert_allclose(drawn["value"].reshape(-1, 4, 3)[:, :, 2], expected, rtol=1e-3)


def test_a_draw_is_its_generator(rng):
    sampler = SliceSampler(Waves(), 2)
    one, two, other = (sampler(np.random.default_rng(seed), 256) for seed in (5, 5, 6))
    assert set(one) == {"wi", "wo", "place", "value"}
    for name in one:
        assert one[name].dtype == np.float32
        np.testing.assert_array_equal(one[name], two[name])
        assert not np.array_equal(one[name], other[name])


def test_a_draw_takes_few_slices_and_a_small_source_is_enough(rng):
    asked = []

    class Counting(Waves):
        def slices(self, pairs):
            asked.append(np.array(pairs))
            return super().slices(pairs)

    SliceSampler(Counting(), 2)(rng, 1024)
    SliceSampler(Counting(), 2)(rng, 8)
    SliceSampler(Counting(lights=DIRECTIONS[:2], views=DIRECTIONS[:1]), 1)(rng, 1 << 15)
    SliceSampler(Counting(), 1)(rng, 1 << 15)
    assert [len(pairs) for pairs in asked] == [32, 1, 2, 256]
    assert all(len(np.unique(pairs, axis=0)) == len(pairs) for pairs in asked)


# --- towards the horizon ----------------------------------------------------------------------------------------------


def test_lowest_directions_are_turned_towards_the_horizon(rng):
    directions = DIRECTIONS.copy()
    chosen, u = rng.random(81) < 0.5, rng.random(81)
    lowest = DIRECTIONS[:, 2] < DIRECTIONS[:, 2].min() + 1e-3
    turned = lowest & chosen
    assert 3 < turned.sum() < lowest.sum()
    gain = _lower(directions, DIRECTIONS, chosen, u)
    np.testing.assert_array_equal(directions[~turned], DIRECTIONS[~turned])
    np.testing.assert_array_equal(gain[~turned], 1)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    before, after = (np.arccos(d[turned, 2].astype(np.float64)) for d in (DIRECTIONS, directions))
    np.testing.assert_allclose(after, before + u[turned] * (np.pi / 2 - before), atol=1e-5)
    azimuth = [np.arctan2(d[turned, 1], d[turned, 0]) for d in (DIRECTIONS, directions)]
    np.testing.assert_allclose(*azimuth, atol=1e-5)
    np.testing.assert_allclose(gain[turned], np.cos(after) / np.cos(before), rtol=1e-4)


def test_values_fall_with_the_cosine_of_lights_that_are_lowered():
    """A Lambert surface stays one between the lowest ring and the horizon; views change no value."""

    class Lambert(Waves):
        def slices(self, pairs):
            value = self.lights[np.asarray(pairs)[:, 0], 2] / np.pi
            return np.broadcast_to(value[:, None, None, None], (len(pairs), self.height, self.width, 3)).copy()

    drawn = SliceSampler(Lambert(), 1, beyond=1.0)(np.random.default_rng(3), 4096)
    assert drawn["wi"][:, 2].min() < 0.05 < DIRECTIONS[:, 2].min()
    assert drawn["wo"][:, 2].min() < 0.05
    np.testing.assert_allclose(drawn["value"], (drawn["wi"][:, 2:] / np.pi).repeat(12, 1), rtol=2e-3, atol=1e-6)
