"""One fused training step of NTBC against plain torch and NumPy in float64."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.ntbc_plain import losses, network, places, problem  # noqa: E402
from warp_neumat.kernels.ntbc_network import NetworkShape  # noqa: E402
from warp_neumat.kernels.ntbc_train import LOSSES, PATCH, StepShape  # noqa: E402
from warp_neumat.ops.ntbc import NTBCStep  # noqa: E402
from warp_neumat.reference import ntbc as reference  # noqa: E402

ROWS, COLUMNS, BATCH = 6, 9, 4 * PATCH
# Widths that fill no register, levels that are not square, finer than the texels and coarser than the blocks.
PLANES = ((4, 3), (8, 1), (16, 4), (4, 3))
ENDPOINT = NetworkShape(((3, 2), (9, 6)), 22, hidden=(24, 20))
TEXEL = NetworkShape(((4, 4), (7, 9), (50, 12)), 11, hidden=(32, 24, 8))
SHAPE = StepShape(ENDPOINT, TEXEL, PLANES)
NAIVE = StepShape(ENDPOINT, dataclasses.replace(TEXEL, outputs=4), PLANES, naive=True)
TENSORS = ("endpoint_grid", "endpoint_net", "texel_grid", "texel_net")
BLOCKS = torch.randint(0, ROWS * COLUMNS, (BATCH,), generator=torch.Generator().manual_seed(1))


def make_step(shape, made, parts=2, **options):
    given = {name: made[name] for name in ("colours", "endpoints", *TENSORS)}
    return NTBCStep(shape, ROWS, COLUMNS, **given, batch=BATCH, parts=parts, metric=made["metric"], **options)


def gradients(step) -> list[torch.Tensor]:
    return [getattr(step, f"{name}_gradient").clone() for name in TENSORS]


def plain(shape, made, weights, blocks=BLOCKS, temperature=0.01, quantised=False):
    """The five losses in float64 torch, and the gradients of their weighed sum."""
    wide = {name: tensor.double() for name, tensor in made.items()}
    leaves = [wide[name].requires_grad_() for name in TENSORS]
    said = network(shape.endpoint, *leaves[:2], places(ROWS, COLUMNS, blocks, False))
    x = network(shape.texel, *leaves[2:], places(ROWS, COLUMNS, blocks, True))
    values = losses(
        shape, said, x, wide["endpoints"][blocks], wide["colours"][blocks], wide["metric"], temperature, quantised
    )
    found = torch.autograd.grad((values * torch.tensor(weights)).sum(), leaves, allow_unused=True)
    return values.detach(), [torch.zeros_like(t) if g is None else g for t, g in zip(leaves, found, strict=True)]


MIXES = {
    "all": (1.0, 0.5, 2.0, 0.7, 0.3),
    **{name: tuple(float(n == k) for k in range(5)) for n, name in enumerate(LOSSES)},
}


def compare(step, expected, limit=2e-5):
    for got, wanted, name in zip(gradients(step), expected, TENSORS, strict=True):
        assert (got - wanted).abs().max() <= limit * wanted.abs().max(), name


@pytest.mark.parametrize("mix", MIXES)
def test_step_matches_torch(mix):
    made = problem(SHAPE, ROWS, COLUMNS)
    step = make_step(SHAPE, made)
    step.weights.copy_(torch.tensor(MIXES[mix]))
    step.run(BLOCKS)
    values, expected = plain(SHAPE, made, MIXES[mix])
    # Worst seen: losses 2e-7, gradients 4e-6 of the largest.
    torch.testing.assert_close(step.losses.double().mean(0), values, rtol=2e-6, atol=1e-8)
    assert (values > 1e-4).all()
    compare(step, expected)
    assert max(wanted.abs().max() for wanted in expected) > 1e-4


@pytest.mark.parametrize("quantised", [False, True])
def test_naive_step_matches_torch(quantised):
    made = problem(NAIVE, ROWS, COLUMNS)
    step = make_step(NAIVE, made)
    step.weights.copy_(torch.tensor(MIXES["all"]))
    step.run(BLOCKS, quantised=quantised)
    values, expected = plain(NAIVE, made, MIXES["all"], quantised=quantised)
    torch.testing.assert_close(step.losses.double().mean(0), values, rtol=2e-6, atol=1e-8)
    compare(step, expected)
    assert (expected[3].abs().max() > 1e-4) == (not quantised)


def test_losses_match_the_numpy_twin():
    for shape in (SHAPE, NAIVE):
        made = problem(shape, ROWS, COLUMNS, seed=4)
        step = make_step(shape, made)
        step.run(BLOCKS)
        outputs = []
        for name, sizes in (("endpoint", shape.endpoint), ("texel", shape.texel)):
            grids, layers = reference.unpack(sizes, made[f"{name}_grid"].numpy(), made[f"{name}_net"].numpy())
            outputs.append(reference.network(grids, layers, reference.positions(ROWS, COLUMNS, name == "texel")))
        blocks = BLOCKS.numpy()
        x = outputs[1].reshape(ROWS * COLUMNS, 16, -1).swapaxes(1, 2)
        ends, colours = (made[name].numpy()[blocks] for name in ("endpoints", "colours"))
        metric = made["metric"].numpy()
        expected = reference.losses(
            shape.planes, outputs[0][blocks], x[blocks], ends, colours, metric, naive=shape.naive
        )
        np.testing.assert_allclose(step.losses.double().mean(0), expected, rtol=2e-6, atol=1e-8)


@pytest.mark.parametrize("entries", [4, 8, 16])
def test_slope_of_the_expected_weight_is_eq_30(entries):
    """Eq. 30 with n the weight n / 3 or n / 7 is the finite difference of the softmax expectation; with n it is not."""
    rng = np.random.default_rng(2)
    d, temperature, h = -0.05 * rng.random((50, entries)), 0.01, 1e-7
    slope = reference.expected_weight_slope(d, temperature)
    step = np.eye(entries) * h
    finite = np.stack(
        [
            (reference.expected_weight(d + e, temperature) - reference.expected_weight(d - e, temperature)) / (2 * h)
            for e in step
        ],
        -1,
    )
    np.testing.assert_allclose(slope, finite, rtol=1e-5, atol=1e-6 * abs(finite).max())
    share = np.exp(d / temperature) / np.exp(d / temperature).sum(-1, keepdims=True)
    mean = reference.expected_weight(d, temperature)[:, None]
    literal = share * (np.arange(entries) - mean) / temperature
    assert abs(literal - finite).max() > 0.1 * abs(finite).max()


def test_kernel_gradient_is_the_finite_difference_of_the_expectation():
    """The colour network's decoding loss, moved by its output biases, as if indices were the softmax expectation."""
    made, temperature = problem(SHAPE, ROWS, COLUMNS, seed=3), 0.2  # warm, so that the expectation is smooth
    step = make_step(SHAPE, made, temperature=temperature)
    step.weights.copy_(torch.tensor(MIXES["decoded_colour"]))
    step.run(BLOCKS)
    bias = TEXEL.offsets[-1][0]
    got = gradients(step)[3][bias : bias + TEXEL.outputs].double().numpy()
    wide = {name: tensor.double().numpy() for name, tensor in made.items()}
    blocks = BLOCKS.numpy()
    place = reference.positions(ROWS, COLUMNS, True)
    ends, colours = wide["endpoints"][blocks], wide["colours"][blocks]

    def weights_of(net):
        x = reference.network(*reference.unpack(TEXEL, wide["texel_grid"], net), place)
        x = x.reshape(ROWS * COLUMNS, 16, -1)[blocks]
        at = 0
        for plane, (entries, k) in enumerate(PLANES):
            e0, e1 = np.split(ends[:, 2 * at : 2 * at + 2 * k], 2, axis=1)
            yield reference.distances(x[..., at : at + k], e0, e1, entries, wide["metric"][plane]), (at, k, e0, e1)
            at += k

    # dL/dw at the index that is taken, times the difference of the expectation.
    slopes = []
    for plane, (d, (at, k, e0, e1)) in enumerate(weights_of(wide["texel_net"])):
        metric = wide["metric"][plane][:k, :k]
        decoded = reference.decode(d.argmax(-1) / (d.shape[-1] - 1), e0, e1)
        off = decoded - colours[:, at : at + k].swapaxes(1, 2)
        slopes.append(2 * np.einsum("btk,kj,bj->bt", off, metric, e1 - e0) / (BATCH * 16 * SHAPE.channels))
    for channel in range(TEXEL.outputs):
        h, total = 1e-5, 0.0
        for sign in (1, -1):
            net = wide["texel_net"].copy()
            net[bias + channel] += sign * h
            for slope, (d, _) in zip(slopes, weights_of(net), strict=True):
                total += sign * (slope * reference.expected_weight(d, temperature)).sum() / (2 * h)
        assert got[channel] == pytest.approx(total, rel=1e-4, abs=1e-5 * abs(got).max())
    assert abs(got).max() > 1e-5


def test_same_parts_same_bits_other_parts_nearly():
    made = problem(SHAPE, ROWS, COLUMNS)
    found = []
    for parts in (2, 2, 3):
        step = make_step(SHAPE, made, parts)
        step.run(BLOCKS)
        step.run(BLOCKS)  # nothing is left of the run before
        found.append(gradients(step))
    for first, again, other in zip(*found, strict=True):
        assert torch.equal(first, again)
        torch.testing.assert_close(first, other, rtol=1e-3, atol=1e-6 * float(first.abs().max()))


def test_work_of_weight_zero_is_left_out_without_a_trace():
    """Losses add up: gradients of a sum are the sums of those of single losses, and no loss changes with its weight."""
    made = problem(SHAPE, ROWS, COLUMNS)
    step = make_step(SHAPE, made, parts=1)
    step.run(BLOCKS)
    whole, values = gradients(step), step.losses.clone()
    sums = [torch.zeros_like(g) for g in whole]
    for name in LOSSES:
        step.weights.copy_(torch.tensor(MIXES[name]))
        step.run(BLOCKS)
        assert torch.equal(step.losses, values)
        for total, gradient in zip(sums, gradients(step), strict=True):
            total += gradient
        reached = [bool(g.any()) for g in gradients(step)]
        assert (
            reached
            == [name in ("endpoint", "decoded_endpoint", "joint")] * 2
            + [name in ("colour", "decoded_colour", "joint")] * 2
        )
    for total, wanted in zip(sums, whole, strict=True):
        assert (total - wanted).abs().max() < 1e-5 * wanted.abs().max()


def test_padding_gets_no_gradient():
    made = problem(SHAPE, ROWS, COLUMNS)
    step = make_step(SHAPE, made)
    step.run(BLOCKS)
    for sizes, gradient in ((ENDPOINT, gradients(step)[1]), (TEXEL, gradients(step)[3])):
        widths = (sizes.inputs, *sizes.hidden, sizes.outputs)
        for n, (bias, at) in enumerate(sizes.offsets):
            wide, tall = sizes.rows[n + 1], sizes.rows[n]
            matrix = gradient[at : at + tall * wide].view(tall, wide)
            assert not gradient[bias + widths[n + 1] : bias + wide].any()
            assert not matrix[widths[n] :].any()
            assert not matrix[:, widths[n + 1] :].any()
            assert matrix.any()


def test_equal_endpoints_and_exact_colours_stay_finite():
    made = problem(SHAPE, ROWS, COLUMNS)
    at = 0
    for _, k in PLANES:  # one colour a block, in reference and, by the output biases, in the prediction
        made["endpoints"][:, 2 * at + k : 2 * at + 2 * k] = made["endpoints"][:, 2 * at : 2 * at + k]
        made["colours"][:, at : at + k] = made["endpoints"][:, 2 * at : 2 * at + k, None]
        at += k
    made["endpoint_net"][:] = 0.0
    made["texel_net"][:] = 0.0
    made["texel_net"][TEXEL.offsets[-1][0]] = 200.0  # beyond where e^x overflows
    made["texel_net"][TEXEL.offsets[-1][0] + 1] = -200.0
    step = make_step(SHAPE, made)
    step.run(BLOCKS)
    for tensor in (step.losses, *gradients(step)):
        assert torch.isfinite(tensor).all()
    assert float(step.losses[:, 3].max()) < 1e-12


def test_a_weight_that_is_no_number_shows_in_the_losses():
    made = problem(SHAPE, ROWS, COLUMNS)
    step = make_step(SHAPE, made)
    made["texel_net"][TEXEL.offsets[0][0] + 3] = float("nan")
    step.run(BLOCKS)
    assert torch.isfinite(step.losses[:, :2]).all()
    assert torch.isnan(step.losses[:, 2]).all()


def test_temperature_and_data_are_read_at_each_run():
    made = problem(SHAPE, ROWS, COLUMNS)
    step = make_step(SHAPE, made)
    step.run(BLOCKS)
    made["texel_net"] *= 0.9
    made["metric"][:] = torch.eye(4)
    other = BLOCKS.flip(0) // 2
    step.run(other, temperature=0.05)
    values, expected = plain(SHAPE, made, (1.0,) * 5, other, temperature=0.05)
    torch.testing.assert_close(step.losses.double().mean(0), values, rtol=2e-6, atol=1e-8)
    compare(step, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"planes": ((4, 3), (8, 1))}, "must have 8 and 4 outputs"),
        ({"planes": ((1, 3),)}, "planes must be"),
        ({"naive": True}, "must have 22 and 4 outputs"),
    ],
)
def test_wrong_shapes_are_explained(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SHAPE, **change)
