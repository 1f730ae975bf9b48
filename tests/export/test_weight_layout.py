"""The weights file: every number where the layout says, rows padded with zeros."""

import numpy as np
import pytest

from warp_neumat.export.weight_layout import ROW_HALVES, layout, pack_weights, unpack_weights


def network(rng, inputs, hidden, outputs):
    shapes = {"weight0": (hidden, inputs), "bias0": (hidden,), "weight1": (outputs, hidden), "bias1": (outputs,)}
    return {name: rng.normal(size=shape).astype(np.float16) for name, shape in shapes.items()}


@pytest.mark.parametrize("shape", [(12, 16, 9), (3, 1, 1), (9, 13, 16), (12, 64, 8)])
def test_round_trip(rng, shape):
    tensors = network(rng, *shape)
    rows = pack_weights(tensors)
    assert rows.dtype == np.dtype("<f2")
    assert rows.shape == (sum(block.rows for block in layout(*shape).values()), ROW_HALVES)
    back = unpack_weights(rows, *shape)
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(back[name], tensor)
    assert np.count_nonzero(rows) == sum(np.count_nonzero(tensor) for tensor in tensors.values())


def test_the_papers_network_takes_54_rows(rng):
    rows = {name: (block.row, block.stride) for name, block in layout(12, 16, 9).items()}
    assert rows == {"weight0": (0, 2), "bias0": (32, 2), "weight1": (34, 2), "bias1": (52, 2)}
    tensors = network(rng, 12, 16, 9)
    file = pack_weights(tensors).tobytes()
    assert len(file) == 16 * 54
    # Input 9 of hidden unit 5: row 2 · 5 + 1, half 1; output 7's bias: row 52, half 7.
    assert np.frombuffer(file, "<f2")[8 * 11 + 1] == tensors["weight0"][5, 9]
    assert np.frombuffer(file, "<f2")[8 * 52 + 7] == tensors["bias1"][7]
