"""Features without a codebook: round trips, error bound, straight-through gradient, bytes of the paper's Table 4."""

import pytest

torch = pytest.importorskip("torch")

from warp_neumat.kernels.healpix import hemisphere_point_count  # noqa: E402
from warp_neumat.models import feature_storage as storage  # noqa: E402


@pytest.fixture
def features():
    generator = torch.Generator().manual_seed(3)
    spread = torch.tensor([1e-3, 1.0, 300.0, 0.0, 7.0])
    return torch.randn(501, 5, generator=generator) * spread + torch.tensor([0.0, 5.0, -90.0, 0.3, 0.0])


def test_quantised_error_is_at_most_half_a_level(features):
    low, high = storage.ranges(features)
    assert (low <= features).all()
    assert (high >= features).all()
    assert torch.equal(low, low.half().float())
    assert torch.equal(high, high.half().float())
    found = storage.dequantise4(storage.quantise4(features, low, high), low, high)
    step = (high - low) / 15
    assert ((found - features).abs() <= 0.5001 * step + 1e-6).all()
    assert len(torch.unique(storage.quantise4(features, low, high)[:, 1])) == 16


def test_rounding_again_changes_nothing_and_gradients_pass(features):
    low, high = storage.ranges(features)
    leaf = features.clone().requires_grad_()
    once = storage.rounded4(leaf, low, high)
    torch.testing.assert_close(storage.rounded4(once.detach(), low, high), once.detach())
    weight = torch.linspace(-1, 1, features.numel()).view_as(features)
    (once * weight).sum().backward()
    torch.testing.assert_close(leaf.grad, weight)
    torch.testing.assert_close(storage.rounded4(features), once.detach())


def test_codes_pack_and_unpack(features):
    codes = storage.quantise4(features, *storage.ranges(features))  # 2505: an odd number
    stream = storage.pack4(codes)
    assert stream.dtype == torch.uint8
    assert len(stream) == 1253
    assert torch.equal(storage.unpack4(stream, codes.shape), codes)
    assert storage.pack4(torch.tensor([3, 9, 15])).tolist() == [0x93, 0x0F]
    with pytest.raises(ValueError, match="stream must have 1253 bytes"):
        storage.unpack4(stream[:-1], codes.shape)


def test_bytes_are_those_of_table_4():
    points = hemisphere_point_count(64)
    raw, low, vq = (storage.feature_bytes(points, 16, name) for name in ("raw", "4bit", "vq"))
    assert raw / 2**20 == pytest.approx(1.52, abs=0.01)  # paper: 1.60 MB
    assert low / raw == pytest.approx(0.25, abs=1e-3)
    assert vq == 72547
    assert vq / raw == pytest.approx(0.045, abs=1e-3)
    assert storage.feature_bytes(points, 16, "4bit") == points * 16 + 128
    with pytest.raises(ValueError, match="storage must be raw, 4bit or vq"):
        storage.feature_bytes(points, 16, "8bit")
