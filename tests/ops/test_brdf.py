"""The fused training step of a reflectance network against plain torch in float64."""

import pytest

torch = pytest.importorskip("torch")

from warp_neumat.kernels.brdf_train import PATCH, StepShape  # noqa: E402
from warp_neumat.ops.brdf import BRDFStep  # noqa: E402

SHARPNESS, SOFTNESS = 12.0, 2e-3
SHAPES = {
    "paper": StepShape(((16, 4), (16, 4)), (64, 64)),
    "odd": StepShape(((6, 4), (6, 4), (3, 8)), (24, 16, 8)),  # widths that fill no register, a third group
    "shallow": StepShape(((4, 4), (4, 4)), (8,)),
}


def problem(shape, batch, seed=0):
    draw = torch.Generator().manual_seed(seed)
    rows, width = 97, shape.groups[0][0]
    offsets, words = [0, 0], rows * width
    if len(shape.groups) > 2:
        offsets.append(words)
        words += rows * shape.groups[2][0]
    table, net = torch.randn(words, generator=draw), 0.3 * torch.randn(shape.weights, generator=draw)
    net[shape.offsets[-1][0] : shape.offsets[-1][1]] = torch.tensor([0.5, -1.0, 1.0])  # dark and bright outputs
    corner = torch.randint(0, rows, (batch, shape.taps), generator=draw, dtype=torch.int32)
    weight = torch.rand(batch, shape.taps, generator=draw) / 4
    cosine, target = torch.rand(batch, 1, generator=draw), 3 * torch.rand(batch, 3, generator=draw)
    return table, offsets, net, (corner, weight, cosine, target)


def plain(shape, table, offsets, net, samples):
    """The same in plain torch: (loss, errors of the samples)."""
    corner, weight, cosine, target = samples
    inputs, tap = [], 0
    for (width, taps), offset in zip(shape.groups, offsets, strict=True):
        rows = table[offset : offset + 97 * width].view(97, width)
        inputs.append((rows[corner[:, tap : tap + taps].long()] * weight[:, tap : tap + taps, None]).sum(1))
        tap += taps
    x = torch.cat(inputs, 1)
    for n, width in enumerate(shape.hidden):
        bias, at = shape.offsets[n]
        matrix = net[at : at + shape.rows[n] * width].view(-1, width)[: x.shape[1]]
        x = torch.relu(x @ matrix + net[bias : bias + width])
    bias, at = shape.offsets[-1]
    y = x @ net[at:].view(3, -1).T + net[bias : bias + 3]
    scaled = SHARPNESS * torch.expm1(y.clamp_max(11.0)) * cosine
    residual = torch.log1p(scaled.clamp_min(0.0)) + scaled.clamp_max(0.0) - target
    return torch.sqrt(residual**2 + SOFTNESS**2).mean(), (residual**2).sum(1)


def make_step(shape, table, offsets, net, batch, parts=2):
    return BRDFStep(shape, table, offsets, net, batch=batch, parts=parts, sharpness=SHARPNESS, softness=SOFTNESS)


@pytest.mark.parametrize("name", SHAPES)
def test_step_matches_torch(name):
    shape, batch = SHAPES[name], 6 * PATCH
    table, offsets, net, samples = problem(shape, batch)
    step = make_step(shape, table, offsets, net, batch)
    step.run(*samples)
    wide = [t.double().requires_grad_() for t in (table, net)]
    loss, errors = plain(
        shape, wide[0], offsets, wide[1], [s.double() if s.is_floating_point() else s for s in samples]
    )
    loss.backward()
    assert float(step.losses.double().mean()) == pytest.approx(loss.item(), rel=2e-6)
    torch.testing.assert_close(step.errors.double(), errors.detach(), rtol=1e-4, atol=1e-5)
    # Worst seen 2e-6 of the largest gradient; a unit at 0 that rounding switches would show as 1e-4.
    for got, expected in ((step.table_gradient, wide[0].grad), (step.weight_gradient, wide[1].grad)):
        assert (got - expected).abs().max() < 2e-5 * expected.abs().max()
        assert expected.abs().max() > 1e-4


def test_forward_alone_leaves_gradients_and_gives_the_same_loss():
    shape, batch = SHAPES["odd"], 2 * PATCH
    table, offsets, net, samples = problem(shape, batch)
    step = make_step(shape, table, offsets, net, batch)
    step.run(*samples)
    losses, gradient = step.losses.clone(), step.weight_gradient.clone()
    step.losses.zero_()
    step.run(*problem(shape, batch, seed=1)[3], backward=False)
    assert not torch.equal(step.losses, losses)
    step.run(*samples, backward=False)
    assert torch.equal(step.losses, losses)
    assert torch.equal(step.weight_gradient, gradient)


def test_same_parts_same_bits_other_parts_nearly():
    shape, batch = SHAPES["odd"], 8 * PATCH
    table, offsets, net, samples = problem(shape, batch)
    found = []
    for parts in (2, 2, 3):
        step = make_step(shape, table, offsets, net, batch, parts)
        step.run(*samples)
        found.append(step.weight_gradient.clone())
    assert torch.equal(found[0], found[1])
    torch.testing.assert_close(found[0], found[2], rtol=1e-3, atol=1e-6)


def test_extreme_outputs_stay_finite():
    shape, batch = SHAPES["shallow"], PATCH
    table, offsets, net, samples = problem(shape, batch)
    for bias in (-200.0, 50.0):  # f near −1, and beyond the clamp at exp(11)
        net[shape.offsets[-1][0] : shape.offsets[-1][1]] = bias
        step = make_step(shape, table, offsets, net, batch)
        step.run(*samples)
        for tensor in (step.losses, step.errors, step.table_gradient, step.weight_gradient):
            assert torch.isfinite(tensor).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch": 100}, "batch must be a multiple of 64, got 100"),
        ({"offsets": [0]}, "offsets must name 2 groups, got 1"),
        ({"net": torch.zeros(3)}, r"net must be contiguous float32 of shape \(99,\)"),
    ],
)
def test_wrong_arguments_are_explained(change, message):
    shape = SHAPES["shallow"]
    table, offsets, net, _ = problem(shape, PATCH)
    given = {"table": table, "offsets": offsets, "net": net, "batch": PATCH, **change}
    with pytest.raises(ValueError, match=message):
        BRDFStep(shape, **given, parts=1, sharpness=SHARPNESS, softness=SOFTNESS)
