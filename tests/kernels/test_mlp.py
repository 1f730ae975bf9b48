"""The MLP kernels against NumPy float64."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.mlp import MLPShape, mlp_eval, pack
from warp_neumat.reference.mlp import mlp as reference_mlp

# Odd widths exercise uneven output blocks; 40 inputs the copied tile; a single layer the network without hidden units.
SHAPES = [MLPShape(12, 16, 9), MLPShape(23, 8, 8, 8, 8), MLPShape(40, 64, 64, 3), MLPShape(3, 7, 13, 1), MLPShape(5, 2)]

# Worst difference seen over the shapes below: 4.9e-7 of the largest output (Zen 3, 2026-11-22).
RELATIVE = 4e-6


def _network(shape, rng):
    """Return weights as an asset stores them, float16, with outputs of order one."""
    weights = [(rng.normal(size=(o, i)) * np.sqrt(2 / i)).astype(np.float16) for i, o in shape.layers]
    biases = [rng.normal(scale=0.1, size=o).astype(np.float16) for _, o in shape.layers]
    return weights, biases


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_mlp_matches_float64(shape, rng, device):
    weights, biases = _network(shape, rng)
    x = rng.normal(size=(1000, shape.inputs)).astype(np.float32)  # three full blocks of lanes and a tail
    expected = reference_mlp(x, weights, biases)
    x_device = wp.array(x, device=device)
    got = mlp_eval(shape, x_device, wp.array(pack(weights, biases), device=device)).numpy()
    assert np.abs(got - expected).max() <= RELATIVE * np.abs(expected).max()


def test_mlp_is_the_same_on_one_worker_and_on_all(rng):
    shape = MLPShape(12, 16, 9)
    packed = pack(*_network(shape, rng))
    x = rng.normal(size=(100_003, 12)).astype(np.float32)
    several = mlp_eval(shape, x, packed)
    try:
        dispatch.set_worker_count(1)
        assert np.array_equal(mlp_eval(shape, x, packed), several)
    finally:
        dispatch.set_worker_count(None)


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257])
def test_mlp_writes_every_row_and_no_other(count, rng):
    shape = MLPShape(12, 16, 9)
    weights, biases = _network(shape, rng)
    x = rng.normal(size=(count, 12)).astype(np.float32)
    guarded = wp.array(np.full((count + 300) * 9, 7.0, np.float32))
    out = wp.array(ptr=guarded.ptr, shape=(count, 9), dtype=wp.float32)
    mlp_eval(shape, wp.array(x), wp.array(pack(weights, biases)), out=out)
    values = guarded.numpy().reshape(-1, 9)
    assert np.allclose(values[:count], reference_mlp(x, weights, biases), atol=1e-5)
    assert (values[count:] == 7.0).all()


def test_mlp_keeps_infinities_in_their_own_row(rng):
    shape = MLPShape(12, 16, 9)
    packed = pack(*_network(shape, rng))
    x = rng.normal(size=(300, 12)).astype(np.float32)
    clean = mlp_eval(shape, x, packed)
    x[17] = np.inf
    assert np.array_equal(np.delete(mlp_eval(shape, x, packed), 17, 0), np.delete(clean, 17, 0))


def test_mlp_names_the_wrong_shape(rng):
    shape = MLPShape(12, 16, 9)
    packed = pack(*_network(shape, rng))
    with pytest.raises(ValueError, match=r"x must have shape \[n, 12\], got \(4, 11\)"):
        mlp_eval(shape, np.zeros((4, 11), np.float32), packed)
    with pytest.raises(ValueError, match=r"packed must have shape \[361\]"):
        mlp_eval(shape, np.zeros((4, 12), np.float32), packed[:-1])
    with pytest.raises(ValueError, match=r"weights\[1\] must have shape \[out, 16\]"):
        pack([np.zeros((16, 12)), np.zeros((9, 15))], [np.zeros(16), np.zeros(9)])
    with pytest.raises(ValueError, match="at least two widths"):
        MLPShape(3)


def test_torch_in_gives_torch_out(rng):
    torch = pytest.importorskip("torch")
    shape = MLPShape(5, 2)
    weights, biases = _network(shape, rng)
    x = torch.randn(10, 5)
    got = mlp_eval(shape, x, torch.from_numpy(pack(weights, biases)))
    assert isinstance(got, torch.Tensor)
    assert np.allclose(got.numpy(), reference_mlp(x.numpy(), weights, biases), atol=1e-5)
