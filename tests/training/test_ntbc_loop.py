"""Training of NTBC on a small set: learning, variants, interruption, and that what was trained is what is shipped."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.tiny_maps import tiny_maps  # noqa: E402
from warp_neumat.io.asset import FormatError, unpack_bits  # noqa: E402
from warp_neumat.io.block_formats import from_blocks  # noqa: E402
from warp_neumat.io.texture_set import Channel, open_texture_set  # noqa: E402
from warp_neumat.kernels.bc1 import bc1_decode  # noqa: E402
from warp_neumat.materials import load  # noqa: E402
from warp_neumat.materials.ntbc import NTBC  # noqa: E402
from warp_neumat.models.ntbc import build, configure, layers  # noqa: E402
from warp_neumat.training.block_maps import BlockMapData, reference_endpoints  # noqa: E402
from warp_neumat.training.fit import checkpoint_path, fit  # noqa: E402
from warp_neumat.training.loop import Plan  # noqa: E402
from warp_neumat.training.ntbc_loop import NTBCTrainer, _Blocks  # noqa: E402


@functools.cache
def source(folder):
    return open_texture_set(tiny_maps(folder / "tiny", 64, 64))


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    return source(tmp_path_factory.mktemp("maps"))


def make(maps, path=None, *, steps=60, seed=0, batch=64, save=20.0, fused=None, **options):
    options = {"mode": "aggressive", "rate": "paper", **options}
    pixels = maps.mips()[0]
    plan = Plan(steps=steps, batch=batch, seed=seed, checkpoint_seconds=save)
    model = build(configure(maps, options), seed)
    reference = lambda planes: reference_endpoints(planes, pixels)  # noqa: E731
    return NTBCTrainer(model, pixels, reference, plan, checkpoint_path=path, fused=fused)


def tensors(trainer) -> dict:
    return trainer.model.to_asset()[0]


def error(maps, trainer) -> dict:
    """Mean squared error of the decoded blocks of each map at mip 0."""
    material = NTBC(*trainer.model.to_asset(), device="cpu")
    (height, width), pixels = maps.pixels.shape[:2], maps.pixels
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    got = material.encoded(np.stack([u.ravel(), v.ravel()], 1).astype(np.float32), 0.0).reshape(pixels.shape)
    found = {}
    for k, channel in enumerate(maps.channels):
        found.setdefault(channel.map, []).append(float(np.square(got[..., k] - pixels[..., k]).mean()))
    return {name: np.mean(values) for name, values in found.items()}


@pytest.mark.parametrize(
    "options",
    [
        {"endpoints": "fitted"},
        {"endpoints": "network"},
        {"endpoints": "network", "joint": 0.0, "mode": "conservative"},
        {"endpoints": "network", "metric": "luma", "colours": "bc7", "normals": "bc1"},
        {"variant": "naive", "mode": "conservative"},
    ],
    ids=["fitted", "network", "paper", "luma-bc7", "naive"],
)
def test_blocks_come_near_the_maps(maps, options):
    trainer = make(maps, steps=400, **options)
    facts = trainer.run()
    found = error(maps, trainer)
    # A set of smooth waves; BC itself leaves 1e-5 to 1e-4.
    assert max(found.values()) < (3e-3 if "variant" in options else 1e-3), found
    assert facts["steps"] == 400 * len(trainer.model.pairs)


def test_colours_with_alpha(maps):
    """A map of four channels is BC3, and each channel comes back where it was."""
    alpha = Channel("base_color", "a", "srgb")
    pixels = np.concatenate([maps.pixels[..., :3], 1.0 - maps.pixels[..., 5:]], axis=2)
    names = {"name": "alpha", "width": 64, "height": 64, "constants": {}}
    four = SimpleNamespace(**names, channels=(*maps.channels[:3], alpha), pixels=pixels, mips=lambda: [pixels])
    assert [c.component for c in four.channels] == list("rgba")
    assert configure(four, {"rate": "paper", "colours": "bc7"}).textures[0].format == "bc7_srgb"
    trainer = make(four, steps=300)
    assert trainer.config.textures[0].format == "bc3_srgb"
    trainer.run()
    assert error(four, trainer)["base_color"] < 2e-3


def test_colours_beat_weights(maps):
    found = {}
    for variant in ("ntbc", "naive"):
        trainer = make(maps, steps=400, mode="conservative", variant=variant, endpoints="network")
        trainer.run()
        found[variant] = error(maps, trainer)["base_color"]
    assert found["ntbc"] < found["naive"]


def test_the_joint_stage_pays(maps):
    found = {}
    for joint in (0.0, 0.5):
        trainer = make(maps, steps=400, joint=joint, endpoints="network")
        trainer.run()
        found[joint] = np.mean(list(error(maps, trainer).values()))
    assert found[0.5] < 0.9 * found[0.0]


def test_the_same_seed_gives_the_same_file(maps):
    runs = []
    for seed in (5, 5, 6):
        trainer = make(maps, seed=seed)
        trainer.run()
        runs.append(tensors(trainer))
    assert all(np.array_equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert not all(np.array_equal(runs[0][name], runs[2][name]) for name in runs[0])


@pytest.mark.parametrize("stop", [(0, 20), (0, 30), (1, 31), (1, 58)])
@pytest.mark.parametrize("variant", ["ntbc", "naive"])
def test_a_resumed_fit_equals_an_uninterrupted_one(maps, tmp_path, stop, variant):
    options = {"mode": "conservative", "endpoints": "network", "variant": variant}
    whole = make(maps, **options)
    whole.run()
    path = tmp_path / "c"
    first = make(maps, path, save=0.0, **options)
    save = first._save_if_due

    def save_then_stop(optimisers):
        save(optimisers)
        if (first._number, first._step) == stop:
            raise KeyboardInterrupt

    first._save_if_due = save_then_stop
    with pytest.raises(KeyboardInterrupt):
        first.run()
    second = make(maps, path, save=0.0, **options)
    assert second.resume()
    assert (second._number, second._step) == stop
    second.run()
    for name, value in tensors(whole).items():
        np.testing.assert_array_equal(tensors(second)[name], value, err_msg=name)


@pytest.mark.parametrize("variant", ["ntbc", "naive"])
def test_plain_torch_trains_the_same(maps, variant):
    """What devices without the fused kernels do: the same steps, but for rounding."""
    runs = []
    for fused in (True, False):
        trainer = make(maps, steps=12, mode="conservative", variant=variant, endpoints="network", fused=fused)
        trainer.run()
        runs.append(trainer)
    one, other = (dict(trainer.model.named_buffers()) for trainer in runs)
    start = dict(build(runs[0].config, 0).named_buffers())
    for name, value in one.items():
        way = float((value - start[name]).abs().mean())
        assert float((value - other[name]).abs().mean()) < 0.05 * way, name
    assert runs[0].last_loss == pytest.approx(runs[1].last_loss, rel=0.05)


def test_the_naive_weights_rest_at_the_end(maps, monkeypatch):
    """For the last fifth the endpoint network alone is tuned to rounded weights (NTBC §3.1)."""
    trainer = make(maps, steps=50, mode="conservative", variant="naive")
    pair, kept = trainer.model.pairs[0], {}

    def keep(optimisers):
        if (trainer._number, trainer._step) == (0, 40):
            kept.update({name: value.clone() for name, value in pair.named_buffers()})

    monkeypatch.setattr(trainer, "_save_if_due", keep)
    trainer.run()
    for name, value in pair.named_buffers():
        assert torch.equal(value, kept[name]) == name.startswith("texel"), name


@pytest.mark.parametrize("bits", [4, 5, 7])
def test_what_the_last_step_read_is_what_is_stored(maps, bits, monkeypatch):
    config = configure(maps, {"mode": "aggressive", "rate": "paper", "endpoints": "network"})
    grids = dataclasses.replace(config.models[0].texel, bits=bits)
    config = dataclasses.replace(config, models=(dataclasses.replace(config.models[0], texel=grids),))
    pixels, kept = maps.mips()[0], {}
    trainer = NTBCTrainer(build(config, 0), pixels, lambda planes: reference_endpoints(planes, pixels), Plan(40, 64))
    made = trainer._optimisers
    monkeypatch.setattr(trainer, "_optimisers", lambda pair: kept.update(made(pair)) or kept)
    trainer.run()
    stored, shape = tensors(trainer), trainer.model.pairs[0].shape
    for name, network, depth in (("texel", shape.texel, bits), ("endpoint", shape.endpoint, 8)):
        key, found = f"model0.{name}", []
        for n, size in enumerate(network.grid_sizes):
            codes = unpack_bits(stored[f"{key}.grid{n}"], depth, size).astype(np.float32)
            found.append((codes - np.float32(stored[f"{key}.zero"][n])) * stored[f"{key}.scale"][n])
        np.testing.assert_array_equal(np.concatenate(found), kept[f"{name}_grid"].used.numpy())
        for n, (weight, bias) in enumerate(layers(network, kept[f"{name}_net"].used)):
            np.testing.assert_array_equal(stored[f"{key}.weight{n}"].astype(np.float32), weight.numpy())
            np.testing.assert_array_equal(stored[f"{key}.bias{n}"].astype(np.float32), bias.numpy())


def test_a_checkpoint_of_other_settings_is_refused(maps, tmp_path):
    path = tmp_path / "c"
    trainer = make(maps, path, save=0.0, steps=3)
    trainer.run()
    with pytest.raises(FormatError, match="plan"):
        make(maps, path, steps=4).resume()


def test_budget_ends_in_time(maps):
    trainer = make(maps, steps=1)
    trainer.plan = Plan(steps=1, batch=64, budget_seconds=0.5)
    facts = trainer.run()
    assert facts["steps"] > 1
    assert facts["seconds"] < 20


def test_divergence_is_an_error(maps):
    trainer = make(maps)
    trainer.model.pairs[0].texel_net.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="diverged"):
        trainer.run()


def test_an_epoch_sees_every_block_once():
    draws = _Blocks(3, 0, 40, 16)
    order = torch.cat([draws(step) for step in range(5)]).numpy()
    assert sorted(order[:40]) == sorted(order[40:80]) == list(range(40))
    assert not np.array_equal(order[:40], order[40:80])
    again = _Blocks(3, 0, 40, 16)
    np.testing.assert_array_equal(again(3), order[48:64])  # without the steps before it
    assert len(_Blocks(0, 0, 3, 8)(0)) == 8  # fewer blocks than a batch


# --- through fit ------------------------------------------------------------------------------------------------------


def test_fit_writes_what_load_reads(tmp_path):
    folder, out = tiny_maps(tmp_path / "tiny", 64, 60), tmp_path / "tiny.neumat"
    lines, fractions = [], []
    header = fit(
        folder, out, model="ntbc", mode="aggressive", steps=40,
        announce=lines.append, progress=lambda fraction, text: fractions.append(fraction),
    )  # fmt: skip
    material = load(out)
    assert header["metrics"]["bytes"] == material.bytes == sum(t.nbytes for t in _stored(out).values())
    assert header["metrics"]["block_bytes"] == material.block_bytes
    assert header["metrics"]["psnr"] > 15
    assert "base_color bc1_srgb, normal bc5_unorm, roughness bc4_unorm" in lines[0]
    assert f"file: {material.bytes} bytes" in lines[0]
    assert fractions == sorted(fractions)
    assert not checkpoint_path(out).exists()
    texture = material.textures[0]
    colours = from_blocks(bc1_decode(texture.levels[0][0].reshape(-1, 8)), 64, 60)
    y, x = np.mgrid[:60, :64]
    uv = np.stack([(x.ravel() + 0.5) / 64, (y.ravel() + 0.5) / 60], 1).astype(np.float32)
    np.testing.assert_allclose(material.encoded(uv, 0.0)[:, :3], colours.reshape(-1, 4)[:, :3] / 255.0, atol=1e-5)


def _stored(path) -> dict:
    from warp_neumat.io.asset import read_asset

    return read_asset(path)[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "fast"}, "mode must be conservative or aggressive"),
        ({"preset": "2k"}, "no preset '2k'; nearest"),
        ({"batch": 12}, "batch must be a multiple of 8, got 12"),
        ({"features": (64, 32)}, "no option 'features' of ntbc"),
    ],
)
def test_fit_refuses(tmp_path, arguments, message):
    folder = tiny_maps(tmp_path / "tiny", 64, 64)
    with pytest.raises(ValueError, match=message):
        fit(folder, tmp_path / "x.neumat", model="ntbc", steps=2, **arguments)
    assert not (tmp_path / "x.neumat").exists()


def test_a_batch_sees_every_texture_equally_often():
    sizes = [(128, 128), (256, 256), (512, 512)]
    batches = [BlockMapData.batch(type("Shape", (), {"rows": r, "columns": c})) for r, c in sizes]
    assert batches == [128, 256, 1024]
