"""One training step: loss and every gradient against plain torch in float64, and the same bits for the same seed."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.mipmaps import mip_sizes  # noqa: E402
from warp_neumat.kernels import dispatch  # noqa: E402
from warp_neumat.kernels.patches import draw_patches, pad_reference  # noqa: E402
from warp_neumat.models.bcf import BCf, BCfConfig, _images, _trilinear, reference_loss  # noqa: E402
from warp_neumat.ops import Step, bcf_loss  # noqa: E402
from warp_neumat.ops import bcf as bcf_ops  # noqa: E402
from warp_neumat.ops.bcf import _sizes  # noqa: E402

SQUARE = {"size": (64, 64), "features": ((32, 32), (16, 16), (8, 8), (4, 4))}
ODD = {"size": (48, 20), "features": ((24, 12), (12, 8), (8, 4), (4, 4))}
TINY = {"size": (3, 1), "features": ((8, 4), (4, 4), (4, 4), (4, 4))}
MANY = {"size": (40, 40), "features": ((20, 20),), "hidden": 5, "channels": 11}
FEW = {"size": (16, 64), "features": ((8, 32), (4, 16)), "hidden": 8, "channels": 1}


class Problem:
    """A model, a random reference whose values float16 holds, and patches that meet every case."""

    def __init__(self, rng, *, size, features, wrap="repeat", hidden=16, channels=9, smallest_mip=1, **drawn):
        names = [
            {"map": f"m{c}", "component": "value", "encoding": "linear", "range": [0.0, 1.0]} for c in range(channels)
        ]
        self.config = BCfConfig(
            features, *size, tuple(names), {}, wrap=wrap, hidden=hidden, smallest_mip=smallest_mip
        )  # fmt: skip
        self.pyramids, self.shape = self.config.pyramids, self.config.shape
        self.mips = [rng.random((h, w, channels)).astype(np.float16).astype(np.float32) for w, h in mip_sizes(*size)]
        self.model = BCf(self.config, np.full(channels, 0.5, np.float32), 3)
        self.texels, self.net = self.model.texels, self.model.net
        self.texels[:, :3] += 0.3 * torch.from_numpy(rng.normal(size=(len(self.texels), 3)))
        self.net += 0.05 * torch.from_numpy(rng.normal(size=len(self.net)))
        wrap = "repeat" if self.pyramids.repeat else "clamp"
        self.reference = torch.from_numpy(pad_reference(self.mips, self.shape.stride, wrap))
        self.patches = self.drawn(**drawn)

    def drawn(self, count=12, aligned=0.5):
        """Patches of a step, then some at the ends of the scales, on whole ones, and over the border."""
        patches = draw_patches(1, 2, count, self.pyramids, aligned=aligned)
        top = len(self.pyramids.reference) - 1
        edges = [(0, 1.5, 0, 0, 1, 1, 0, 0), (top, 0.5, 0, 0, 1, 1, 0, 0), (top / 2, 2, 0.25, 0, 0.75, 1, 0, 0)]
        edges.append((min(1, top), 1, 0, 0, 1, 1, *self.pyramids.reference[min(1, top)]))
        if self.pyramids.repeat:
            edges += [
                (min(0.5, top), 1, 0.97, 0.999, 0.2, 0.5, 0, 0),
                (0, 1, 0.9, 0.9, 1, 1, *self.pyramids.reference[0]),
            ]
        return torch.from_numpy(np.concatenate([patches, np.array(edges, np.float32)]))

    def loss(self, texels=None, net=None, **options):
        texels, net = self.texels if texels is None else texels, self.net if net is None else net
        shape = {"channels": self.shape.channels, "hidden": self.shape.hidden}
        return bcf_loss(texels, net, self.reference, self.patches, self.pyramids, **shape, **options)

    def step(self, parts=1, channel_weight=None):
        step = Step(
            self.pyramids, self.shape, self.texels, self.net, self.reference, len(self.patches), parts, channel_weight
        )  # fmt: skip
        return step

    def exact(self, samples, channel_weight=None):
        """Return loss and gradients of plain torch in float64 at these samples."""
        texels, net = (t.double().requires_grad_() for t in (self.texels, self.net))
        pictures = [torch.from_numpy(m).double().permute(2, 0, 1)[None] for m in self.mips]
        weight = torch.ones(self.shape.channels) if channel_weight is None else channel_weight
        loss = reference_loss(self.model, texels, net, pictures, self.patches, samples.double(), weight.double())
        loss.backward()
        return loss.detach(), texels.grad, net.grad


def relative(got, want) -> float:
    """Return the largest error over the largest value."""
    return float((got.double() - want).abs().max() / want.abs().max())


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        (SQUARE, {}),
        (SQUARE, {"wrap": "clamp"}),
        (SQUARE, {"aligned": 1.0}),
        (SQUARE, {"aligned": 0.0, "wrap": "clamp", "smallest_mip": 4}),
        (ODD, {}),
        (ODD, {"wrap": "clamp"}),
        (TINY, {}),
        (TINY, {"wrap": "clamp"}),
        (MANY, {}),
        (FEW, {"wrap": "clamp"}),
    ],
    ids=lambda v: "x".join(map(str, v["size"])) if "size" in v else ",".join(f"{k}={w}" for k, w in v.items()) or "-",
)
def test_step_matches_torch(rng, shape, options):
    problem = Problem(rng, **shape, **options)
    texels, net = problem.texels.clone().requires_grad_(), problem.net.clone().requires_grad_()
    loss, samples = problem.loss(texels, net, key=7)
    (3.0 * loss).backward()
    want, of_texels, of_net = problem.exact(samples)
    assert loss.item() == pytest.approx(float(want), rel=1e-5)
    # Worst seen 1.1e-5 where every sample adds to the same few texels with either sign, else 2.1e-6.
    assert relative(texels.grad / 3.0, of_texels) < (3e-5 if shape is TINY else 1e-5)
    assert relative(net.grad / 3.0, of_net) < 1e-5
    touched = of_texels[:, :3].abs().sum(1) > 0
    assert touched.sum() > (4 if shape is TINY else 0.1 * len(touched))
    assert not texels.grad[:, 3].any()


def test_channel_weights_and_losses_match_torch(rng):
    problem = Problem(rng, **ODD)
    weight = torch.from_numpy(rng.uniform(0.1, 3.0, 9).astype(np.float32))
    step = problem.step(2, weight)
    step.run(problem.patches, 5)
    loss, of_texels, of_net = problem.exact(step.samples, weight)
    assert relative(step.texel_gradient.sum(0), of_texels) < 1e-5
    assert relative(step.weight_gradient.sum(0), of_net) < 1e-5
    # Losses are told without the channels' weights.
    assert float((step.losses * weight).mean()) == pytest.approx(float(loss), rel=1e-5)


def test_same_key_same_bits_other_key_other_samples(rng):
    problem = Problem(rng, **SQUARE)
    for parts in (1, 3):
        results = []
        for key in (1, 1, 2):
            step = problem.step(parts)
            step.run(problem.patches, 99)  # what a step leaves behind does not matter
            step.run(problem.patches, key)
            results.append([t.clone() for t in (step.texel_gradient, step.weight_gradient, step.losses, step.samples)])
        assert all(torch.equal(a, b) for a, b in zip(results[0], results[1], strict=True))
        assert not torch.equal(results[0][3], results[2][3])


def test_parts_agree_to_rounding(rng):
    problem = Problem(rng, **SQUARE)
    whole = problem.step(1)
    whole.run(problem.patches, 3)
    for parts in (2, 5, 40):
        split = problem.step(parts)
        split.run(problem.patches, 3)
        assert torch.equal(split.losses, whole.losses)
        assert torch.equal(split.samples, whole.samples)
        for name in ("texel_gradient", "weight_gradient"):
            mine, other = (getattr(s, name).sum(0) for s in (split, whole))
            assert (mine - other).abs().max() < 2e-6 * other.abs().max()
        assert split.weight_gradient[1].any()


def test_samples_lie_where_their_patch_says(rng):
    problem = Problem(rng, **SQUARE)
    step = problem.step()
    step.run(problem.patches, 3)
    for patch, samples in zip(problem.patches.numpy().astype(np.float64), step.samples.double().numpy(), strict=True):
        assert (samples >= 0).all()
        assert (samples < 1).all()
        cell = np.stack(np.meshgrid(np.arange(16), np.arange(16)), 2).reshape(-1, 2)
        low, size = patch[2:4] + patch[4:6] * cell / 16, patch[4:6] / 16
        if patch[6]:
            centre = samples * patch[6:8] - 0.5
            np.testing.assert_allclose(centre, centre.round(), atol=1e-4)
            low, size = low - 0.5 / patch[6:8], size + 1.0 / patch[6:8]
        inside = (samples - low + 1e-6) % 1.0
        assert (inside <= size + 2e-6).all()
        if not patch[6]:
            assert 0.45 < (inside / size).mean() < 0.55


def outputs(problem, texels, s: float, uv) -> torch.Tensor:
    """Return the network's outputs (n, C) at ``uv`` and scale ``s``, in plain torch."""
    offsets = [row[0] for row in problem.pyramids.feature_offsets] + [problem.pyramids.texel_count]
    inputs = []
    for t, (mips, bias) in enumerate(zip(problem.config.mips, problem.pyramids.biases, strict=True)):
        pictures = _images(texels[offsets[t] : offsets[t + 1]], mips)
        level = min(max(s + bias, 0.0), len(mips) - 1.0)
        inputs.append(_trilinear(pictures, uv, level, "bilinear", problem.pyramids.repeat))
    w0, b0, w1, b1 = problem.model.layers(problem.net.double())
    return torch.relu(torch.cat(inputs, 1) @ w0 + b0) @ w1 + b1


def test_probes_average_to_the_diagonal_of_jtj(rng):
    problem = Problem(rng, size=(16, 16), features=((8, 8), (4, 4)), hidden=8, channels=1)
    # One sample in every texel of a mip of 16 x 16, so that no key moves it.
    problem.patches = torch.tensor([[0.0, 1.5, 0.0, 0.0, 1.0, 1.0, 16.0, 16.0]])
    weight = torch.tensor([2.0])
    step = problem.step(1, weight)
    step.run(problem.patches, 0)
    losses, samples = step.losses.clone(), step.samples.clone()
    probes, total = 3000, torch.zeros(problem.texels.shape, dtype=torch.float64)
    for key in range(probes):
        step.run(problem.patches, 977 * key, probe=True)
        total += step.texel_gradient[0].double() ** 2 / probes
    assert torch.equal(step.losses, losses)
    assert torch.equal(step.samples, samples)
    texels = problem.texels.double()
    jacobian = torch.func.jacrev(lambda t: outputs(problem, t, 0.0, samples[0].double()).flatten())(texels)
    exact = 1.5 * 2.0 * (jacobian**2).sum(0)
    assert (exact > 0).sum() > 100
    # Each mean of squares has a spread of √(2/3000) of itself; the kernel's ε has mean zero and no correlation.
    known = exact > 1e-6 * exact.max()
    ratio = total[known] / exact[known]
    assert (ratio - 1).abs().max() < 6 * (2 / probes) ** 0.5
    assert (ratio - 1).abs().mean() < 1.5 * (2 / probes) ** 0.5


def test_bcf_loss_passes_opcheck(rng):
    problem = Problem(rng, size=(8, 8), features=((4, 4), (4, 4)), hidden=8, channels=1, count=1)
    inputs = [problem.texels.requires_grad_(), problem.net.requires_grad_(), problem.reference, problem.patches]
    shape = [_sizes(problem.pyramids), 1, 8, 3, True, 2]
    torch.library.opcheck(torch.ops.neumat.bcf_loss, (*inputs, *shape))


def test_wrong_arguments_of_a_step_are_named(rng):
    problem = Problem(rng, **FEW)
    with pytest.raises(ValueError, match=r"texels must be torch.float32 of shape \(\d+, 4\), got .* \(\d+, 4\)"):
        problem.loss(problem.texels[16:])
    with pytest.raises(ValueError, match="reference must"):
        bcf_loss(
            problem.texels, problem.net, problem.reference[8:], problem.patches, problem.pyramids, channels=1, hidden=8
        )
    with pytest.raises(ValueError, match="texels must be torch.float32"):
        problem.loss(problem.texels.double())
    with pytest.raises(ValueError, match="channel_weight must"):
        problem.step(1, torch.ones(2))
    with pytest.raises(ValueError, match="patches must"):
        problem.step(1).run(problem.patches[1:], 0)


@pytest.mark.parametrize("probe", [False, True])
@pytest.mark.parametrize("case", [{**SQUARE}, {**ODD, "wrap": "clamp"}], ids=["square", "odd"])
def test_the_cuda_step_equals_the_cpu_step(rng, monkeypatch, case, probe):
    """CUDA's source, one sample a thread, compiled for the CPU and run on one worker, where its additions are safe."""
    problem = Problem(rng, **case)
    weight = torch.from_numpy(rng.uniform(0.5, 2.0, problem.shape.channels).astype(np.float32))
    expected = problem.step(channel_weight=weight)
    expected.run(problem.patches, 41, probe=probe)
    monkeypatch.setattr(bcf_ops, "lanes", lambda device: 1)
    with pytest.raises(ValueError, match="parts must be 1 on cpu"):
        problem.step(parts=2)
    scalar = problem.step(channel_weight=weight)
    dispatch.set_worker_count(1)
    try:
        scalar.run(problem.patches, 41, probe=probe)
    finally:
        dispatch.set_worker_count(None)
    for name in ("texel_gradient", "weight_gradient", "losses", "samples"):
        mine, wanted = getattr(scalar, name), getattr(expected, name)
        assert (mine - wanted).abs().max() <= 1e-5 * wanted.abs().max(), name
