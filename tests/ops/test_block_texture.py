"""Trainable blocks: values and gradients against plain torch in float64, and quantised ones against the decoder."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.kernels import dispatch  # noqa: E402
from warp_neumat.kernels.bc6h import bc6h_decode  # noqa: E402
from warp_neumat.kernels.bc6h_encode_pack import bc6h_unquantise  # noqa: E402
from warp_neumat.kernels.bc6h_tables import MODES, PARTITIONS, WEIGHTS3, WEIGHTS4  # noqa: E402
from warp_neumat.kernels.block_texture import ONE_REGION, SPAN  # noqa: E402
from warp_neumat.models.bcf import BCf, decode_reference  # noqa: E402
from warp_neumat.ops import block_decode  # noqa: E402
from warp_neumat.ops.block_texture import BlockJobs, block_decode_adjoint  # noqa: E402

ONE = {m.number for m in MODES if m.regions == 1}
SIGNS = pytest.mark.parametrize("signed", [False, True], ids=["unsigned", "signed"])


@dataclasses.dataclass
class Config:
    """All of a model's configuration that packing reads."""

    signed: bool


class Blocks(torch.nn.Module):
    """The blocks of a :class:`BCf` without pyramids around them."""

    quantised, blocks, load_blocks = BCf.quantised, BCf.blocks, BCf.load_blocks

    def __init__(self, endpoints, positions, shapes, modes, signed):
        super().__init__()
        self.config = Config(signed)
        for name in ("endpoints", "positions", "shapes", "modes"):
            self.register_buffer(name, torch.as_tensor(locals()[name]))

    def tensors(self):
        return self.endpoints, self.positions, self.shapes, self.modes

    def decode(self):
        return block_decode(*self.tensors(), self.config.signed)


def continuous(rng, signed, each=40) -> Blocks:
    """Blocks of all 33 shapes: values of all octaves, around zero, and in a narrow range."""
    shapes = np.repeat(np.arange(33, dtype=np.int32), each)
    endpoints = rng.uniform(-0.999 if signed else 0.0, 0.999, (len(shapes), 4, 3))
    endpoints[::3] = 0.5 + 0.02 * rng.normal(size=endpoints[::3].shape)
    endpoints[1::3] *= 0.05  # denormal halfs, and their border
    positions = rng.random((len(shapes), 16))
    positions[::5] = positions[::5].round()
    return Blocks(endpoints.astype(np.float32), positions.astype(np.float32), shapes, np.zeros_like(shapes), signed)


def bits_of(blocks: Blocks) -> torch.Tensor:
    """Return y of every texel (B, 16, 3) in float64, as the docstring of the kernel has it."""
    endpoints, positions = blocks.endpoints.double(), blocks.positions.double()
    masks = torch.tensor([*map(int, PARTITIONS), 0])[blocks.shapes.long()]
    region = (masks[:, None] >> torch.arange(16)) & 1
    row = torch.arange(len(masks))[:, None]
    low, high = endpoints[row, 2 * region], endpoints[row, 2 * region + 1]
    return SPAN * (low + (high - low) * positions[:, :, None])


def away_from_octaves(y: torch.Tensor, margin: float) -> torch.Tensor:
    """Return 0 where y lies within ``margin`` of a multiple of 1024, where the slope of Eq. 9 jumps, else 1."""
    return ((y / 1024.0 - (y / 1024.0).round()).abs() * 1024.0 > margin).double()


def check_gradients(got, want, bound=7e-6):
    """Compare per block, as octaves differ in slope: the error over the block's largest. Worst seen 3.5e-6."""
    for mine, exact in zip(got, want, strict=True):
        mine, exact = mine.double().flatten(1), exact.flatten(1)
        worst = ((mine - exact).abs().amax(1) / exact.abs().amax(1).clamp(min=1e-30)).max()
        assert worst < bound


@SIGNS
def test_block_decode_matches_torch(rng, signed):
    blocks = continuous(rng, signed)
    exact = [t.double().requires_grad_() for t in blocks.tensors()[:2]]
    mine = [t.clone().requires_grad_() for t in blocks.tensors()[:2]]
    y = bits_of(blocks)
    want = decode_reference(*exact, blocks.shapes)
    got = block_decode(*mine, blocks.shapes, blocks.modes, signed)
    assert not got[:, 3].any()
    texels = got.detach().double().view(-1, 16, 4)[:, :, :3]
    # In steps between half floats, over the size of what y was added up from: a multiple of 2⁻²⁴. Worst seen 1.5e-7.
    size = SPAN * blocks.endpoints.abs().amax((1, 2)).double()[:, None, None]
    assert ((texels - want.detach()).abs() / ulps(y, 1.0) / (size + 1.0)).max() < 3e-7
    # What the operator's docstring says; below 1/1000 values cancel. Worst seen 3.0e-6.
    assert ((texels - want.detach()).abs() / want.detach().abs().clamp(min=1e-3)).max() < 4e-6
    cotangent = torch.from_numpy(rng.normal(size=want.shape)) * away_from_octaves(y, 0.02)
    cotangent = cotangent.float().double()
    want.backward(cotangent)
    got.backward(torch.cat([cotangent.float().view(-1, 3), torch.ones(len(got), 1)], 1))
    check_gradients([t.grad for t in mine], [t.grad for t in exact])


@SIGNS
def test_values_out_of_range_are_clamped(signed):
    endpoints = torch.tensor([2.0, -3.0, 1.0, 0.5]).view(1, 4, 1).expand(1, 4, 3).contiguous()
    positions = torch.tensor([-1.0, 0.0, 1.0, 5.0] * 4)[None]
    decoded = block_decode(
        endpoints, positions, torch.tensor([ONE_REGION], dtype=torch.int32), torch.zeros(1).int(), signed
    )
    low = -65504.0 if signed else 0.0
    assert decoded[:4, 0].tolist() == [65504.0, 65504.0, low, low]


# --- quantised ---


def quantised(rng, mode, signed, count=3000) -> Blocks:
    """Blocks of one mode: endpoints near each other and out of the differences' reach, the ends of the range, zero."""
    endpoints = rng.uniform(-1.0 if signed else 0.0, 1.0, (count, 4, 3))
    reach = 2.0 ** (min(MODES[mode - 1].delta) - MODES[mode - 1].precision)
    near = rng.random(count) < 0.6
    endpoints[near] = endpoints[near, :1] + reach * rng.uniform(-0.4, 0.4, (near.sum(), 4, 3))
    extreme = (rng.random((count, 4, 3)) < 0.1) & (rng.random((count, 1, 1)) < 0.4)
    ends = np.array([-1.0, -0.0, 1.0, 1e-7, -1e-7, 0.9999999, 1 / 65536, -1 / 32768], np.float32)
    endpoints[extreme] = rng.choice(ends, extreme.sum())
    positions = rng.random((count, 16)).astype(np.float32)
    steps = 15 if mode in ONE else 7
    fixed = rng.random((count, 16)) < 0.3
    # Borders between indices, and the floats beside them: every side has to round alike.
    border = ((rng.integers(1, steps + 1, fixed.sum()) - 0.5) / steps).astype(np.float32)
    positions[fixed] = np.nextafter(border, rng.choice([0, 1], len(border)).astype(np.float32))
    again = rng.random((count, 16)) < 0.1
    positions[again] = rng.choice(np.float32([0, 1]), again.sum())
    shapes = np.full(count, ONE_REGION) if mode in ONE else np.arange(count) % 32
    low = -1.0 if signed else 0.0
    return Blocks(
        endpoints.clip(low, 1.0).astype(np.float32), positions, shapes.astype(np.int32),
        np.full(count, mode, np.int32), signed,
    )  # fmt: skip


@SIGNS
@pytest.mark.parametrize("mode", range(1, 15))
def test_quantised_blocks_decode_exactly(rng, mode, signed):
    blocks = quantised(rng, mode, signed)
    texels = blocks.decode()
    packed = blocks.blocks()
    decoded = bc6h_decode(packed, signed).astype(np.float32).reshape(-1, 3)
    np.testing.assert_array_equal(texels[:, :3].numpy().view(np.uint32), (decoded + np.float32(0)).view(np.uint32))
    # The test is worth something only where anchors had to change places, and differences to be cut.
    codes, indices, shapes, _ = blocks.quantised()
    half = 8 if mode in ONE else 4
    assert (indices[:, 0] >= half).mean() > 0.2
    if MODES[mode - 1].transformed:
        free = blocks.endpoints.numpy() * 2.0 ** (MODES[mode - 1].precision - signed)
        used = slice(0, 2 if mode in ONE else 4)
        cut = np.abs(free - codes)[:, used].max((1, 2)) > 1.5
        assert 0.2 < cut.mean() < 0.9


@SIGNS
@pytest.mark.parametrize("mode", [1, 2, 6, 10, 11, 14])
def test_loaded_blocks_pack_to_the_same_bits(rng, mode, signed):
    packed = quantised(rng, mode, signed).blocks()
    other = quantised(rng, mode, signed)
    other.load_blocks(packed)
    np.testing.assert_array_equal(other.blocks(), packed)
    decoded = bc6h_decode(packed, signed).astype(np.float32).reshape(-1, 3)
    np.testing.assert_array_equal(other.decode()[:, :3].numpy(), decoded)


@SIGNS
@pytest.mark.parametrize("mode", [1, 6, 10, 11, 14])
def test_straight_through_gradient_is_that_of_the_quantised_values(rng, mode, signed):
    blocks = quantised(rng, mode, signed, 400)
    codes, indices, shapes, modes = blocks.quantised()
    wide = bc6h_unquantise(codes, modes, signed) / (32768.0 if signed else 65536.0)
    weights = np.array(WEIGHTS4 if mode in ONE else WEIGHTS3)[indices] / 64.0
    exact = [torch.from_numpy(np.asarray(a, np.float64)).requires_grad_() for a in (wide, weights)]
    mine = [t.clone().requires_grad_() for t in blocks.tensors()[:2]]
    want = decode_reference(*exact, blocks.shapes)
    got = block_decode(*mine, blocks.shapes, blocks.modes, signed)
    at = Blocks(exact[0].detach().float(), exact[1].detach().float(), blocks.shapes, blocks.modes, signed)
    y = bits_of(at)
    keep = away_from_octaves(y, 0.6)
    assert keep.mean() > 0.8
    cotangent = (torch.from_numpy(rng.normal(size=want.shape)) * keep).float()
    want.backward(cotangent.double())
    got.backward(torch.cat([cotangent.view(-1, 3), torch.zeros(len(got), 1)], 1))
    check_gradients([t.grad for t in mine], [t.grad for t in exact])
    # The texels of the integer decoder lie within the truncation of 31/64 and the rounding of the blend.
    assert ((got.detach().double().view(-1, 16, 4)[:, :, :3] - want.detach()).abs() <= ulps(y, 1.5)).all()


def ulps(y: torch.Tensor, count: float) -> torch.Tensor:
    """Return ``count`` steps between half floats near bits y."""
    return count * torch.exp2((y.abs() / 1024.0 + 0.01).floor().clamp(min=1.0) - 25.0)


# --- operators ---


def test_block_operators_pass_opcheck(rng):
    blocks = continuous(rng, True, 1)
    tensors = [t.clone().requires_grad_() if t.is_floating_point() else t for t in blocks.tensors()]
    torch.library.opcheck(torch.ops.neumat.block_decode, (*tensors, True))
    gradient = torch.from_numpy(rng.normal(size=(16 * 33, 4)).astype(np.float32))
    torch.library.opcheck(torch.ops.neumat.block_decode_adjoint, (gradient, *blocks.tensors(), True))


def test_block_jobs_equal_the_operators_and_sum_the_parts(rng):
    blocks = quantised(rng, 1, False, 300)
    blocks.modes[::2] = 0
    texels = torch.full((16 * 300, 4), float("nan"))
    gradients = torch.from_numpy(rng.normal(size=(3, 16 * 300, 4)).astype(np.float32))
    jobs = BlockJobs(*blocks.tensors(), texels, gradients, False)
    for _ in range(2):
        blocks.endpoints.mul_(0.9)  # a job reads what the tensors hold when it runs
        jobs.decode()
        jobs.adjoint()
        assert torch.equal(texels, blocks.decode())
        summed = (gradients[0] + gradients[1]) + gradients[2]
        expected = block_decode_adjoint(summed, *blocks.tensors(), False)
        assert torch.equal(jobs.endpoint_gradient, expected[0])
        assert torch.equal(jobs.position_gradient, expected[1])


def test_blocks_are_the_same_on_any_number_of_cores(rng):
    blocks = quantised(rng, 4, True, 1000)
    results = []
    try:
        for count in (1, 3):
            dispatch.set_worker_count(count)
            texels = blocks.decode()
            results.append((texels, *block_decode_adjoint(texels, *blocks.tensors(), True)))
    finally:
        dispatch.set_worker_count(None)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_wrong_blocks_are_named(rng):
    e, p, s, m = continuous(rng, False, 1).tensors()
    with pytest.raises(ValueError, match=r"endpoints must be torch.float32 of shape \(33, 4, 3\), got torch.float64"):
        block_decode(e.double(), p, s, m)
    with pytest.raises(ValueError, match=r"positions must be torch.float32 of shape \(33, 16\), got .* \(32, 16\)"):
        block_decode(e, p[1:], s, m)
    with pytest.raises(ValueError, match=r"shapes must be torch.int32 of shape \(33,\), got torch.int64"):
        block_decode(e, p, s.long(), m)
    with pytest.raises(ValueError, match=r"modes must be torch.int32"):
        block_decode(e, p, s, m.float())
