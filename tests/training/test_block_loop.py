"""Training of blocks on a small procedural material: learning, every option, interruption, and what must fail."""

import functools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.asset import FormatError  # noqa: E402
from warp_neumat.io.mipmaps import mip_sizes  # noqa: E402
from warp_neumat.kernels.bc6h import bc6h_decode  # noqa: E402
from warp_neumat.models.bcf import BCf, BCfConfig  # noqa: E402
from warp_neumat.training.block_loop import BlockTrainer, channel_weights, stages  # noqa: E402
from warp_neumat.training.loop import Plan  # noqa: E402

FEATURES = ((16, 16), (8, 8), (4, 4), (4, 4))


def picture(side=32, channels=9) -> np.ndarray:
    """Smooth waves, a hard-edged disc and a checker, (side, side, C) in [0, 1]."""
    y, x = np.meshgrid(*[(np.arange(side) + 0.5) / side] * 2, indexing="ij")
    waves = [0.5 + 0.4 * np.sin(2 * np.pi * ((c % 3) * x + (c // 3) * y + 0.1 * c)) for c in range(channels)]
    disc = (np.hypot(x - 0.5, y - 0.5) < 0.3) * 0.5
    checker = ((np.floor(8 * x) + np.floor(8 * y)) % 2) * 0.3
    return (0.5 * np.stack(waves, 2) + (disc + checker)[:, :, None] * (np.arange(channels) % 2 == 0)).astype(np.float32)


def mips_of(top: np.ndarray) -> list[np.ndarray]:
    """Halve by the mean down to 1 × 1; sides are powers of two."""
    mips = [top]
    while max(mips[-1].shape[:2]) > 1:
        h, w, c = mips[-1].shape
        mips.append(mips[-1].reshape(h // 2, 2, w // 2, 2, c).mean((1, 3)))
    assert [m.shape[1::-1] for m in mips] == list(mip_sizes(*top.shape[1::-1]))
    return mips


def make(
    path=None, *, features=FEATURES, channels=9, steps=60, seed=0, batch=1024, identity=None, save=20.0, **options
):
    names = tuple(
        {"map": f"m{c}", "component": "value", "encoding": "linear", "range": [0.0, 1.0]} for c in range(channels)
    )
    mips = mips_of(picture(32, channels))
    config = BCfConfig(features, 32, 32, names, {}, **options)
    model = BCf(config, mips[0].mean((0, 1)), seed)
    plan = Plan(steps=steps, batch=batch, seed=seed, checkpoint_seconds=save)
    return BlockTrainer(model, mips, plan, checkpoint_path=path, identity=identity)


def results(trainer) -> list[np.ndarray]:
    return [trainer.packed, trainer.model.net.numpy(), trainer.model.texels.numpy()]


@pytest.fixture(scope="module")
def trained():
    trainer = make(steps=400)
    losses = []
    trainer.watch = lambda name, step: losses.append((name, float(trainer.step.losses.mean())))
    return trainer, trainer.run(), losses


def test_training_learns(trained):
    trainer, facts, _ = trained
    variance = np.mean([m.var((0, 1)).mean() for m in trainer.mips])
    assert facts["loss"] < 0.15 * variance
    assert 390 <= facts["steps"] <= 410
    assert facts["seconds"] > 0
    assert {"batch", "seed", "threads", "budget_seconds"} <= facts.keys()


def test_trained_blocks_decode_to_the_trained_features(trained):
    trainer, _, _ = trained
    decoded = bc6h_decode(trainer.packed).astype(np.float32).reshape(-1, 3)
    np.testing.assert_array_equal(decoded, trainer.model.texels[:, :3].numpy())
    np.testing.assert_array_equal(trainer.model.blocks(), trainer.packed)
    half = trainer.model.net.half().float()
    assert torch.equal(half, trainer.model.net)
    tensors, _ = trainer.model.to_asset(trainer.packed)
    stored = np.concatenate([tensors[f"texture{t}.mip{m}"].reshape(-1, 16) for t in range(4) for m in range(9)
                             if f"texture{t}.mip{m}" in tensors])  # fmt: skip
    np.testing.assert_array_equal(stored, trainer.packed)


def test_same_seed_same_result_other_seed_another():
    runs = []
    for seed in (0, 0, 1):
        trainer = make(seed=seed)
        trainer.run()
        runs.append(results(trainer))
    assert all(np.array_equal(a, b) for a, b in zip(runs[0], runs[1], strict=True))
    assert not np.array_equal(runs[0][0], runs[2][0])


@pytest.mark.parametrize("at_begin", [False, True], ids=["within", "at_begin"])
@pytest.mark.parametrize(
    "options", [{}, {"quantisation": "straight-through", "repartition": 1}], ids=["default", "other"]
)
def test_resumed_training_equals_an_uninterrupted_one(tmp_path, at_begin, options):
    """Stopped in every stage in turn, just after it began and in the middle of it."""
    make_one = functools.partial(make, steps=80, **options)
    whole = make_one()
    expected_facts = whole.run()
    path = tmp_path / "c"
    count, stopped = len(whole.stages), 0
    for number in range(count):
        trainer = make_one(path, save=0.0)
        if number:
            assert trainer.resume()
        save = trainer._save_if_due

        def save_then_stop(*arguments, trainer=trainer, save=save, number=number):
            save(*arguments)
            if trainer._stage == number and (at_begin or trainer._step > 0):
                raise KeyboardInterrupt

        trainer._save_if_due = save_then_stop
        with pytest.raises(KeyboardInterrupt):
            trainer.run()
        stopped += 1
    last = make_one(path, save=0.0)
    assert last.resume()
    facts = last.run()
    assert stopped == count
    del facts["seconds"], expected_facts["seconds"]
    assert facts == expected_facts  # the asset's header holds them, and holds no NaN
    for mine, expected in zip(results(last), results(whole), strict=True):
        np.testing.assert_array_equal(mine, expected)


def test_checkpoint_of_other_settings_is_refused(tmp_path):
    path = tmp_path / "c"
    assert not make(path).resume()
    make(path, save=0.0, steps=20, identity={"source": "a"}).run()
    with pytest.raises(FormatError, match=r"c: plan: was .*'seed': 0.* now .*'seed': 7.*; use the same settings"):
        make(path, save=0.0, steps=20, seed=7, identity={"source": "a"}).resume()
    with pytest.raises(FormatError, match="c: source: was 'a' when it was saved, now 'b'"):
        make(path, save=0.0, steps=20, identity={"source": "b"}).resume()


@pytest.mark.parametrize(
    "options",
    [
        {"warmup": False},
        {"quantisation": "straight-through"},
        {"quantisation": "once"},
        {"warmup": False, "quantisation": "once"},
        {"modes": "single"},
        {"modes": "single", "quantisation": "straight-through"},
        {"repartition": 2},
        {"sensitivity": False},
        {"signed": True, "feature_range": (0.01, 8.0)},
        {"wrap": "clamp", "smallest_mip": 4},
        {"wrap": "mirror"},
        {"channel_weights": "variance", "mip_decay": 0.0, "aligned": 0.0},
        {"features": ((16, 8), (8, 4), (4, 4)), "hidden": 8, "channels": 1},
        {"steps": 1},
    ],
    ids=lambda o: ",".join(f"{k}={v}" for k, v in o.items() if k != "features"),
)
def test_options_train_to_blocks_that_decode_exactly(options):
    trainer = make(**options)
    before = trainer.model.net.clone()
    facts = trainer.run()  # raises unless the blocks decode to the features
    assert np.isfinite(facts["loss"])
    assert not torch.equal(trainer.model.net, before)
    assert trainer.packed.shape == (len(trainer.model.shapes), 16)
    modes = set(trainer.model.modes.tolist())
    if options.get("modes") == "single":
        assert modes == {10} | (modes & {11})  # the one mode of two regions; flat blocks may take one
    assert 0 not in modes
    header = trainer.model.to_asset(trainer.packed)[1]
    assert header["config"]["wrap"] == options.get("wrap", "repeat")


@pytest.mark.parametrize("warmup", [True, False])
@pytest.mark.parametrize("repartition", [0, 2])
@pytest.mark.parametrize("quantisation", ["sequential", "straight-through", "once"])
def test_shares_of_the_stages_sum_to_one(quantisation, repartition, warmup):
    plan = stages(make(quantisation=quantisation, repartition=repartition, warmup=warmup).config)
    assert sum(s.share for s in plan) == pytest.approx(1.0)
    assert plan[-1].begin == "freeze"
    assert all(s.share > 0 for s in plan)


def test_progress_rises_to_its_end():
    seen = []
    trainer = make(steps=120)
    trainer.progress = lambda fraction, text: seen.append((fraction, text))
    trainer.run()
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert 0.5 < fractions[-1] <= 1.0
    assert any("dB" in text for _, text in seen)


def test_divergence_is_an_error():
    trainer = make()
    trainer.model.net.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="the fit diverged in stage"):
        trainer.run()


def test_channel_weights():
    pixels = np.zeros((8, 8, 3), np.float32)
    pixels[..., 0] = np.linspace(0, 1, 64).reshape(8, 8)
    pixels[..., 1] = 0.1 * pixels[..., 0]
    assert channel_weights(pixels, "uniform").tolist() == [1, 1, 1]
    weight = channel_weights(pixels, "variance")
    assert weight.dtype == np.float32
    assert weight.mean() == pytest.approx(1)
    assert weight[2] > weight[1] > weight[0]
    assert weight[2] <= 16 * weight[0] * 1.001
