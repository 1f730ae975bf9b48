"""The torch operators: shape functions, and the same answers as the kernels they call."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat import ops  # noqa: E402
from warp_neumat.kernels import dispatch  # noqa: E402
from warp_neumat.reference import healpix  # noqa: E402


@pytest.fixture
def directions(rng):
    d = rng.normal(size=(1000, 3))
    d[:, 2] = np.abs(d[:, 2])
    return torch.from_numpy((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32))


def test_healpix_corners_interpolate_like_the_reference(directions, rng):
    table = rng.uniform(-1, 1, healpix.corner_point_count(16))
    index, weight = ops.healpix_corners(16, directions)
    assert index.dtype == torch.int32
    assert weight.dtype == torch.float32
    expected_index, expected_weight = healpix.corners(16, directions.numpy())
    expected = (table[expected_index] * expected_weight).sum(1)
    # 3.4e-7 nside is the kernel's own stated error.
    np.testing.assert_allclose((table[index.numpy()] * weight.numpy()).sum(1), expected, atol=3.4e-7 * 16)


def test_healpix_corners_passes_opcheck(directions):
    torch.library.opcheck(torch.ops.neumat.healpix_corners, (8, directions))


def test_healpix_corners_takes_strided_input_and_carries_no_gradient(directions):
    wide = torch.cat([directions, directions], 1).requires_grad_()
    index, weight = ops.healpix_corners(8, wide[:, 3:])
    assert not weight.requires_grad
    assert torch.equal(index, ops.healpix_corners(8, directions)[0])


def test_healpix_corners_names_a_wrong_shape():
    with pytest.raises(ValueError, match="shape"):
        ops.healpix_corners(8, torch.zeros(5, 2))


@pytest.fixture
def bags(rng):
    """(table, corner, weight, cotangent): 3001 bags of four rows out of 50, some drawn very often."""
    corner = np.minimum(rng.integers(0, 50, (3001, 4)), rng.integers(0, 50, (3001, 4))).astype(np.int32)
    arrays = (rng.normal(size=(50, 12)), corner, rng.random((3001, 4)), rng.normal(size=(3001, 12)))
    return [torch.from_numpy(a.astype(np.float32) if a.dtype != np.int32 else a) for a in arrays]


def test_grid_gather_matches_float64(bags):
    table, corner, weight, cotangent = bags
    table.requires_grad_()
    out = ops.grid_gather(table, corner, weight)
    out.backward(cotangent)
    exact = table.detach().double().requires_grad_()
    expected = (exact[corner.long()] * weight.double()[..., None]).sum(1)
    expected.backward(cotangent.double())
    torch.testing.assert_close(out.double(), expected, rtol=0, atol=2e-6)
    scale = ops.grid_scatter(cotangent.abs(), corner, weight, 50)
    # Worst seen 1.1e-7 of the sum of magnitudes; x 4.
    assert ((table.grad - exact.grad).abs() / scale).max() < 4.4e-7


def test_grid_gather_is_the_same_on_any_number_of_cores(bags):
    _, corner, weight, cotangent = bags
    results = []
    try:
        for count in (1, 2, 3):
            dispatch.set_worker_count(count)
            results.append(ops.grid_scatter(cotangent, corner, weight, 50))
    finally:
        dispatch.set_worker_count(None)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_grid_operators_pass_opcheck(bags):
    table, corner, weight, cotangent = bags
    torch.library.opcheck(torch.ops.neumat.grid_gather, (table.requires_grad_(), corner, weight))
    torch.library.opcheck(torch.ops.neumat.grid_scatter, (cotangent, corner, weight, 50))
