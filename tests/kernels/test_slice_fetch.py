"""What a quad looks up in mip-mapped slices, against float64."""

import numpy as np
import pytest

from warp_neumat.kernels.slice_fetch import fetch_quads
from warp_neumat.reference.bcf import bilinear

CORNERS = np.array([(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)])


def expected(stack, sizes, number, place):
    """The same in float64, quad by quad."""
    out, starts = np.empty((len(place), 4, 3)), np.cumsum([0, *(w * h for w, h in sizes)])
    for q, (u, v, distance, level) in enumerate(place.astype(np.float64)):
        w, h = sizes[int(level)]
        picture = stack[number[q], starts[int(level)] : starts[int(level)] + w * h].reshape(h, w, 3).astype(np.float64)
        at = CORNERS * distance / (w, h) + (u, v)
        out[q] = bilinear(picture, *at.T, "repeat")
    return out.reshape(-1, 12)


@pytest.mark.parametrize("sizes", [[(16, 8), (8, 4), (4, 2)], [(7, 5), (3, 2), (1, 1)], [(1, 3)], [(64, 1)]])
def test_quads_match_float64(rng, sizes):
    """Worst seen: 6e-7 of the largest value, of what float32 makes of uv (Zen 3)."""
    count = 1003  # no multiple of what a block takes
    stack = rng.random((9, sum(w * h for w, h in sizes), 3)).astype(np.float16)
    number = rng.integers(0, 9, count).astype(np.int32)
    place = rng.uniform(-0.5, 1.5, (count, 4)).astype(np.float32)
    place[:, 2] = rng.uniform(0, 3, count)
    place[:, 3] = rng.integers(0, len(sizes), count)
    got = fetch_quads(stack, sizes, number, place)
    assert got.dtype == np.float32
    assert np.abs(got - expected(stack, sizes, number, place)).max() < 4e-6


def test_texel_centres_are_texels_and_the_texture_repeats(rng):
    stack = rng.random((2, 15, 3)).astype(np.float16)
    pictures = stack.reshape(2, 3, 5, 3)
    # A distance of 0 puts all four onto the centre; one of a texel from a corner onto its neighbours.
    place = np.array(
        [[2.5 / 5, 1.5 / 3, 0, 0], [1 / 5, 1 / 3, 1, 0], [0, 0, 1, 0], [1, 1, 1, 0], [-1 + 1 / 5, 1 / 3 - 2, 1, 0]],
        np.float32,
    )
    got = fetch_quads(stack, [(5, 3)], np.array([1, 0, 1, 1, 0], np.int32), place).reshape(-1, 4, 3)
    np.testing.assert_allclose(got[0], np.broadcast_to(pictures[1, 1, 2], (4, 3)), atol=1e-6)
    np.testing.assert_allclose(got[1], pictures[0, :2, :2].reshape(4, 3), atol=1e-6)
    wrapped = pictures[1][[-1, -1, 0, 0], [-1, 0, -1, 0]]
    np.testing.assert_allclose(got[2], wrapped, atol=1e-6)
    np.testing.assert_allclose(got[3], wrapped, atol=1e-6)
    np.testing.assert_allclose(got[4], got[1], atol=2e-6)


def test_no_quads_give_no_values():
    found = fetch_quads(np.zeros((1, 4, 3), np.float16), [(2, 2)], np.zeros(0, np.int32), np.zeros((0, 4), np.float32))
    assert found.shape == (0, 12)
