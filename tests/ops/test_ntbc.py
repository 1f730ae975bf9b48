"""NTBC's network as a torch operator, against plain torch in float64; what the training step refuses."""

import pytest

torch = pytest.importorskip("torch")

from tests.ntbc_plain import network, problem  # noqa: E402
from warp_neumat.kernels.ntbc_network import NetworkShape  # noqa: E402
from warp_neumat.kernels.ntbc_train import StepShape  # noqa: E402
from warp_neumat.ops.ntbc import NTBCStep, ntbc_network  # noqa: E402

SHAPE = NetworkShape(((4, 3), (9, 8), (40, 70)), 5, hidden=(24, 20, 8))
STEP = StepShape(NetworkShape(((4, 3),), 2, hidden=(8,)), NetworkShape(((4, 3),), 1, hidden=(8,)), ((8, 1),))


def tensors(seed: int = 0):
    both = problem(StepShape(NetworkShape(((1, 1),), 10), SHAPE, ((8, 1),) * 5), 2, 2, seed)
    return both["texel_grid"], both["texel_net"]


@pytest.mark.parametrize("count", [1, 128, 300])
def test_network_matches_torch(count):
    draw = torch.Generator().manual_seed(5)
    positions = 3 * torch.rand(count, 2, generator=draw) - 1  # outside [0, 1), too
    positions[0] = torch.tensor([0.0, 1.0])
    chosen = torch.randn(count, 5, generator=draw)
    leaves = [t.requires_grad_() for t in tensors()]
    outputs = ntbc_network(positions, *leaves, SHAPE)
    (outputs * chosen).sum().backward()
    wide = [t.detach().double().requires_grad_() for t in leaves]
    expected = network(SHAPE, *wide, positions.double())
    (expected * chosen).sum().backward()
    # Worst seen: outputs 2e-7, gradients 2e-6 of the largest.
    torch.testing.assert_close(outputs.double(), expected, rtol=0, atol=1e-6)
    for got, wanted in zip(leaves, wide, strict=True):
        assert (got.grad - wanted.grad).abs().max() < 1e-5 * wanted.grad.abs().max()
        assert wanted.grad.abs().max() > 1e-2


def test_gradient_is_the_finite_difference():
    draw = torch.Generator().manual_seed(6)
    positions = torch.rand(200, 2, generator=draw)
    grids, net = (t.requires_grad_() for t in tensors())
    ntbc_network(positions, grids, net, SHAPE).sum().backward()
    for leaf in (grids, net):
        direction = torch.randn(leaf.shape, generator=draw)
        h, ends = 1e-3, []
        for sign in (1, -1):
            moved = [t.detach() + sign * h * direction if t is leaf else t.detach() for t in (grids, net)]
            ends.append(ntbc_network(positions, *moved, SHAPE).double().sum())
        slope = (ends[0] - ends[1]) / (2 * h)
        assert float((leaf.grad * direction).sum()) == pytest.approx(float(slope), rel=1e-2)


def test_operator_is_sound():
    positions = torch.rand(20, 2, generator=torch.Generator().manual_seed(7))
    leaves = [t.requires_grad_() for t in tensors()]
    sizes = [side for size in SHAPE.levels for side in size]
    arguments = (positions, *leaves, sizes, SHAPE.outputs, list(SHAPE.hidden), SHAPE.features)
    torch.library.opcheck(torch.ops.neumat.ntbc_network.default, arguments)
    assert ntbc_network(torch.zeros(0, 2), *leaves, SHAPE).shape == (0, 5)


def test_wrong_tensors_are_explained():
    grids, net = tensors()
    with pytest.raises(ValueError, match=r"grids must be contiguous torch.float32 of shape \(\d+,\)"):
        ntbc_network(torch.zeros(3, 2), grids[1:], net, SHAPE)
    with pytest.raises(ValueError, match=r"positions must be contiguous torch.float32 of shape \(3, 2\)"):
        ntbc_network(torch.zeros(3, 4), grids, net, SHAPE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch": 12}, "batch must be a multiple of 8, got 12"),
        ({"parts": 0}, "parts must be at least 1, got 0"),
        ({"temperature": 0.0}, "temperature must be above 0, got 0.0"),
        ({"colours": torch.zeros(4, 1, 16)}, r"colours must be contiguous torch.float32 of shape \(6, 1, 16\)"),
        ({"texel_net": torch.zeros(3)}, r"texel_net must be contiguous torch.float32"),
        ({"metric": torch.eye(3)[None]}, r"metric must be contiguous torch.float32 of shape \(1, 4, 4\)"),
    ],
)
def test_wrong_arguments_of_the_step_are_explained(change, message):
    made = problem(STEP, 2, 3)
    with pytest.raises(ValueError, match=message):
        NTBCStep(STEP, 2, 3, **{**made, "batch": 8, "parts": 1, **change})


def test_wrong_blocks_are_explained():
    step = NTBCStep(STEP, 2, 3, **problem(STEP, 2, 3), batch=8, parts=1)
    with pytest.raises(ValueError, match=r"blocks must be in \[0, 6\), got 0 to 6"):
        step.run(torch.tensor([0, 1, 2, 3, 4, 5, 6, 0]))
    with pytest.raises(ValueError, match=r"blocks must have shape \(8,\), got \(7,\)"):
        step.run(torch.zeros(7, dtype=torch.int32))
