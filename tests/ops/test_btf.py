"""The fused training step of BTF networks against plain torch in float64: values, loss and every gradient."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.kernels.test_btf import directions  # noqa: E402
from warp_neumat.models import btf as models  # noqa: E402
from warp_neumat.models.btf import BTF  # noqa: E402
from warp_neumat.models.btf_config import configure  # noqa: E402
from warp_neumat.ops.btf import TRAIN  # noqa: E402

# Worst seen: 3e-7 for values, 6e-7 for gradients, of the largest (AVX2).
TOLERANCE = 2e-5
QUADS = 80  # five patches: two threads get unequal shares


class Size:
    """What a config asks of a source; odd, so that mips are no exact halves."""

    width, height = 13, 10


def make(name, taught, dtype=torch.float32, **options):
    """Return a model with random weights; its teacher has two hidden layers of 32 units, and is float32."""
    options |= {"variant": name, "sigma": 0.3, "lambda1": 0.2, "lambda2": 0.4}
    teacher = None
    if taught:
        teacher = BTF(configure(Size, {"variant": "teacher", "hidden": (32, 32)}), 1, scale=0.7)
    model = BTF(configure(Size, options), 2, 0.9, teacher)
    with torch.no_grad():  # features of a trained size, so that they matter
        model.texels.mul_(5.0)
        if taught:
            teacher.texels.mul_(5.0)
    return model.to(dtype)


def batch_of(model, rng, quads=QUADS):
    """Return a prepared batch: places about the seams of the texture too, all mips, all distances."""
    place = np.concatenate([rng.uniform(-0.2, 1.2, (quads, 2)), rng.uniform(0, 2, (quads, 2))], 1)
    place[:, 3] = rng.integers(0, model.config.mips, quads)
    samples = {
        "wi": directions(rng, quads), "wo": directions(rng, quads), "place": place, "value": rng.random((quads, 12)),
    }  # fmt: skip
    return model.prepare({k: torch.from_numpy(v.astype(np.float32)) for k, v in samples.items()})


def smooth_batch(model, exact, rng, monkeypatch):
    """Return a batch without quads at a kink of an activation or of |·|, whose side float32 cannot tell."""
    batch, clear = batch_of(model, rng, 2 * QUADS), torch.ones(2 * QUADS, dtype=torch.bool)

    def near(values, kinks):
        rows = torch.stack([(values.detach() - k).abs() for k in kinks]).amin(0).reshape(2 * QUADS, -1)
        clear.logical_and_(rows.amin(1) > 1e-5)

    def watched(function, kinks):
        return lambda x: (near(x, kinks), function(x))[1]

    with monkeypatch.context() as patch:
        for name, kinks in (("relu", (0.0,)), ("hardswish", (-3.0, 3.0))):
            patch.setitem(models.ACTIVATIONS, name, watched(models.ACTIVATIONS[name], kinks))
        y = exact(batch["angles"].double(), batch["place"].double())
    for aim in {"target", "teacher"} & set(batch):
        near(y - batch[aim], (0.0,))
    kept = clear.nonzero()[:QUADS, 0]
    assert len(kept) == QUADS
    return {k: v.view(2 * QUADS, -1)[kept].contiguous() for k, v in batch.items()}


def apart(got, expected) -> float:
    """Return the largest difference as a share of the largest value."""
    return float((got.detach().double() - expected.detach()).abs().max() / expected.detach().abs().max())


CASES = [
    ("coarse-to-fine", True, {}),
    ("coarse-to-fine", False, {}),
    ("coarse-to-fine", True, {"activation": "relu", "half_vector": False}),
    ("single-level", True, {}),
    ("neumip", False, {}),
]


@pytest.mark.parametrize(("name", "taught", "options"), CASES)
def test_step_matches_torch(rng, monkeypatch, name, taught, options):
    model, exact = make(name, taught, **options), make(name, taught, torch.float64, **options)
    assert model.config.mips == 3
    batch = smooth_batch(model, exact, rng, monkeypatch)
    wide = {k: v.double() for k, v in batch.items()}
    y, z1, z2 = exact(wide["angles"], wide["place"], latents=True)
    got, got1, got2 = model.predict(batch["angles"], batch["place"], export=True)
    assert float(y.detach().std()) > 0.01
    assert apart(got, y) < TOLERANCE
    for part, whole in ((got1, z1), (got2, z2)):
        part = part.view(*whole.shape[:-1], -1) if whole.shape[0] == QUADS else part.view(len(whole), -1)
        assert apart(part[..., : whole.shape[-1]], whole) < TOLERANCE
        assert not part[..., whole.shape[-1] :].any()
    loss, exact_loss = model.gradients(batch, None), exact._loss(wide)
    exact_loss.backward()
    assert float(loss) == pytest.approx(float(exact_loss.detach()), rel=TOLERANCE)
    names = {"texels", "net", "map1", "map2"} if taught else {"texels", "net"}
    found = {n: p.grad for n, p in model.named_parameters()}
    assert set(found) == names
    for parameter, gradient in exact.named_parameters():
        assert float(gradient.grad.abs().max()) > 1e-5
        assert apart(found[parameter], gradient.grad) < TOLERANCE, parameter


def test_every_mip_gets_a_gradient(rng):
    model = make("coarse-to-fine", False)
    batch = batch_of(model, rng, 320)
    model.gradients(batch, None)
    for number, (at, w, h) in enumerate(model.levels):
        channels = 16 if number < model.config.mips else 14
        assert model.texels.grad[at : at + w * h * channels].any(), number
    batch["place"][:, 3] = 1.0
    model.gradients(batch, None)
    for number, (at, w, h) in enumerate(model.levels):
        channels = 16 if number < model.config.mips else 14
        assert bool(model.texels.grad[at : at + w * h * channels].any()) == (number % model.config.mips == 1), number


def test_parts_agree_and_the_same_number_gives_the_same_bits(rng):
    model = make("coarse-to-fine", True)
    batch = batch_of(model, rng)
    hints = [torch.rand(QUADS, n) for n in (8, 32)]
    found = []
    for parts in (1, 2, 2, 3):
        step = model._step(QUADS, parts)
        step.run(batch["angles"], batch["place"], batch["target"], batch["teacher"], *hints, mode=TRAIN)
        found.append([t.clone() for t in (step.output, step.losses, step.table_gradient, step.weight_gradient)])
    one, two, again, three = found
    for a, b, c, d in zip(one, two, again, three, strict=True):
        assert torch.equal(b, c)
        assert apart(b, a.double()) < 1e-6
        assert apart(d, a.double()) < 1e-6


def test_a_batch_that_does_not_fill_patches_is_trained_by_torch(rng):
    model, exact = make("coarse-to-fine", True), make("coarse-to-fine", True, torch.float64)
    batch = batch_of(model, rng, 37)
    model.gradients(batch, None)
    exact._loss({k: v.double() for k, v in batch.items()}).backward()
    assert apart(model.net.grad, exact.net.grad) < TOLERANCE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"quads": 24}, "quads must be a multiple of 16"),
        ({"table": torch.zeros(8, dtype=torch.float64)}, "table must be contiguous float32"),
        ({"net": torch.zeros(3)}, r"net must be contiguous float32 of shape \(\d+,\), got torch.float32 \(3,\)"),
        ({"levels": [(0, 2, 2)]}, "as many mips of the coarse texture as of the fine one"),
    ],
)
def test_wrong_buffers_are_named(change, message):
    from warp_neumat.ops.btf import BTFStep

    model = make("coarse-to-fine", False)
    arguments = {"levels": model.levels, "table": torch.zeros_like(model.texels), "net": torch.zeros_like(model.net)}
    arguments |= {"quads": 16, "parts": 1} | change
    with pytest.raises(ValueError, match=message):
        BTFStep(model.shape, **arguments)
