"""Sizes and layouts of NTBC's networks, and look-ups at the borders of their grids, against NumPy in float64."""

import numpy as np
import pytest

from tests.ntbc_models import predict, random_model, random_network
from warp_neumat.kernels.ntbc import ModelShape, ntbc_blocks
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.reference import ntbc as reference


def test_paper_sizes():
    """§3.4: 7 and 8 levels from 16, two features, 3 × 64: 14 and 16 inputs; about 13.4 MB of grids and weights."""
    levels = [tuple((16 << k, 16 << k) for k in range(count)) for count in (7, 8)]
    endpoint, texel = NetworkShape(levels[0], 24), NetworkShape(levels[1], 12)
    assert (endpoint.inputs, texel.inputs) == (14, 16)
    assert endpoint.rows == (16, 64, 64, 64, 24)
    assert endpoint.grid_words == 2 * sum((16 << k) ** 2 for k in range(7))
    assert endpoint.grid_offsets[:3] == (0, 512, 512 + 2048)
    assert endpoint.table()[2].tolist() == [64, 64, 512 + 2048]
    assert texel.weights == 64 + 16 * 64 + 2 * (64 + 64 * 64) + 16 + 64 * 16
    assert texel.offsets[-1] == (texel.weights - 64 * 16 - 16, texel.weights - 64 * 16)
    assert endpoint.flops == 2 * (14 * 64 + 2 * 64 * 64 + 64 * 24)
    total = endpoint.grid_words + texel.grid_words + 2 * (endpoint.weights + texel.weights)
    assert total == pytest.approx(13.37e6 * 1.049, rel=0.02)  # MB of 2^20


@pytest.mark.parametrize("features", [1, 4])
def test_network_matches_float64(features, rng):
    """Levels of one vertex, of one per block, and finer than the texels; odd widths."""
    rows, columns = 6, 5
    texel = NetworkShape(((1, 1), (5, 6), (2, 7), (61, 40)), 1, hidden=(9, 16), features=features)
    shape = ModelShape(NetworkShape(((5, 6),), 2, hidden=(8,), features=features), texel, (("bc4", 1),))
    grids, net = random_network(texel, rng)
    _, shown = ntbc_blocks(
        shape, rows, columns, *random_network(shape.endpoint, rng), grids, net, predicted=True, device="cpu"
    )
    expected = reference.network(*reference.unpack(texel, grids, net), reference.positions(rows, columns, True))
    assert abs(shown.reshape(-1, 1) - expected).max() < 1e-5
    assert expected.std() > 0.02


def test_one_or_two_outputs_past_whole_registers_match_float64(rng):
    """9 and 18 outputs: the last ones are dot products."""
    planes = (("bc1", 3), ("bc1", 3), ("bc4", 1), ("bc4", 1), ("bc4", 1))
    shape = ModelShape(NetworkShape(((3, 3),), 18, hidden=(16,)), NetworkShape(((9, 7),), 9, hidden=(12,)), planes)
    arrays = random_model(shape, rng)
    _, shown = ntbc_blocks(shape, 3, 7, *arrays, predicted=True, device="cpu")
    assert abs(shown - predict(shape, arrays, 3, 7)[1]).max() < 1e-5


def test_level_as_fine_as_the_blocks_gives_each_its_own_vertex(rng):
    grid = rng.standard_normal((6, 5, 2))
    found = reference.look_up(grid, reference.positions(6, 5, False))
    np.testing.assert_allclose(found.reshape(6, 5, 2), grid, atol=1e-13)


def test_look_ups_wrap_around(rng):
    grid = rng.standard_normal((4, 8, 2))
    place = rng.random((30, 2))
    np.testing.assert_allclose(reference.look_up(grid, place + [1, -2]), reference.look_up(grid, place), atol=1e-12)
    corner = reference.look_up(grid, np.zeros((1, 2)))[0]
    np.testing.assert_allclose(corner, (grid[0, 0] + grid[0, -1] + grid[-1, 0] + grid[-1, -1]) / 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((), 3), "levels must be"),
        ((((4, 0),), 3), "levels must be"),
        ((((4, 4),), 0), "at least 1 unit"),
        ((((4, 4),), 3, ()), "at least 1 unit"),
        ((((4, 4),), 3, (8,), 3), "features must be 1, 2, 4 or 8, got 3"),
    ],
)
def test_wrong_sizes_are_explained(arguments, message):
    with pytest.raises(ValueError, match=message):
        NetworkShape(*arguments)
