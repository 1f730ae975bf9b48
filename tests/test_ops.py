"""The torch operators: shape functions, and the same answers as the kernels they call."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat import ops  # noqa: E402
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
