"""The loss: its value by hand, and a gradient everywhere."""

import pytest

torch = pytest.importorskip("torch")

from warp_neumat.training.losses import LogCosine  # noqa: E402


def test_residual_by_hand():
    loss = LogCosine(sharpness=10.0)
    samples = {"wi": torch.tensor([[0.6, 0.0, 0.8]]), "value": torch.tensor([[0.1, 1.0, 500.0]])}
    residual = loss.residual(torch.tensor([[0.2, 1.0, 250.0]]), loss.target(samples))
    expected = torch.tensor([[2.6 / 1.8, 1.0, 2001.0 / 4001.0]]).log()
    torch.testing.assert_close(residual, expected)


def test_gradient_survives_negative_values():
    loss = LogCosine()
    batch = loss.target({"wi": torch.tensor([[0.0, 0.0, 1.0]]), "value": torch.full((1, 3), 0.1)})
    value = torch.tensor([[-0.9, 0.0, 1e5]], requires_grad=True)
    loss(value, batch).backward()
    assert torch.isfinite(value.grad).all()
    assert (value.grad[0, :2] < 0).all()
    assert value.grad[0, 2] > 0
