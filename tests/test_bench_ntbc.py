"""The NTBC bench around the fit: crops, caps, ratios, means, files used again; its torch beside the plain one."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("quicktex")
pytest.importorskip("skimage")

from bench import _ntbc_lab as lab  # noqa: E402
from bench import _ntbc_peers as peers  # noqa: E402
from bench import ntbc  # noqa: E402
from bench._bcf_lab import synthetic_set  # noqa: E402
from tests.ntbc_plain import losses, problem  # noqa: E402
from tests.ntbc_plain import network as plain_network  # noqa: E402
from tests.ntbc_plain import places as plain_places  # noqa: E402
from warp_neumat.io.texture_set import Channel  # noqa: E402
from warp_neumat.kernels.bc1 import bc1_decode  # noqa: E402
from warp_neumat.kernels.bc4 import bc4_decode  # noqa: E402
from warp_neumat.kernels.ntbc_network import NetworkShape  # noqa: E402
from warp_neumat.kernels.ntbc_train import StepShape  # noqa: E402
from warp_neumat.models.ntbc import layers  # noqa: E402

GREYS = (Channel("a", "value", "linear"), Channel("b", "value", "linear"))


# --- crops ---


def test_crop_is_the_one_with_detail(rng):
    pixels = np.full((128, 160, 2), 0.5, np.float32)
    pixels[64:96, 96:128] += 0.1 * rng.random((32, 32, 2), np.float32)
    assert lab.most_detailed(pixels, 32) == (96, 64)
    assert lab.most_detailed(pixels, 64) == (64, 32)  # the first of those that hold all of it, row by row


def test_detail_all_over_is_worth_more_than_an_edge(rng):
    pixels = np.zeros((64, 128, 1), np.float32)
    pixels[:, :30] = 1.0  # an edge within a column of blocks: of larger variance
    pixels[:, 64:] = 0.3 * rng.random((64, 64, 1), np.float32)
    assert lab.most_detailed(pixels, 64)[0] == 64


def test_flat_sets_are_cropped_at_the_corner_and_odd_sizes_to_the_edge(rng):
    assert lab.most_detailed(np.zeros((70, 90, 3), np.float32), 32) == (0, 0)
    pixels = np.zeros((70, 90, 1), np.float32)
    pixels[60:68, 80:88] = rng.random((8, 8, 1), np.float32)
    x, y = lab.most_detailed(pixels, 32)
    assert (x % 4, y % 4) == (0, 0)
    assert 88 <= x + 32 <= 90
    assert 68 <= y + 32 <= 70
    with pytest.raises(ValueError, match="crop must be at most 70 for a set of 90x70, got 80"):
        lab.most_detailed(pixels, 80)


# --- figures ---


def test_exact_maps_count_as_rounded_to_bytes(rng):
    values = rng.random(1 << 16)
    rounding = np.square(np.rint(255 * values) / 255 - values).mean()
    assert pytest.approx(-10 * np.log10(rounding), abs=0.05) == lab.CAP
    assert lab.capped(0.0) == lab.CAP
    assert lab.capped(1e-9) == lab.CAP
    assert lab.capped([1e-3, 3e-3]) == pytest.approx(-10 * np.log10(2e-3))


def test_figures_are_means_of_decibels_at_mip_0(rng):
    mips = [rng.random((n, n, 2)).astype(np.float32) for n in (16, 8)]
    levels = [mip + np.array([0.1, 0.0], np.float32) for mip in mips]
    levels[1] = levels[1] + np.array([0.1, 0.0], np.float32)
    found = lab.figures(GREYS, mips, levels)
    assert found["psnr_maps"] == {"a": pytest.approx(20, abs=1e-4), "b": lab.CAP}
    assert found["psnr"] == pytest.approx((20 + lab.CAP) / 2, abs=1e-4)
    assert found["psnr_mips"] == pytest.approx(-10 * np.log10((0.01 + 0 + 0.04 + 0) / 4), abs=1e-4)
    assert found["ssim_maps"]["b"] == pytest.approx(1, abs=1e-6)
    assert found["ssim_maps"]["a"] < 0.999
    assert found["ssim"] == pytest.approx(np.mean(list(found["ssim_maps"].values())))


def test_ratios_and_means():
    references = {
        "bc": {"bytes": 400, "bytes_mip0": 300, "psnr": 40.0, "ssim": 0.8},
        "bc ours": {"bytes": 400, "bytes_mip0": 300, "psnr": 50.0, "ssim": 1.0},
    }
    row = {"bytes": 100, "psnr": 30.0, "ssim": 0.4, "maps": "text"}
    expected = {"share": 0.25, "share_mip0": 1 / 3, "psnr_ratio": 0.75, "ssim_ratio": 0.5}
    expected |= {"psnr_ratio_ours": 0.6, "ssim_ratio_ours": 0.4}
    assert lab.against(row, references) == pytest.approx(expected)
    assert lab.mean([row, {**row, "bytes": 300, "psnr": 40.0}]) == {"bytes": 400, "psnr": 35.0, "ssim": 0.4}
    # Ratios over sets are those of the means, not the mean of ratios.
    sets = [{**references, "m": row}, {**references, "m": row}]
    sets[1] = {name: {**each, "psnr": 2 * each["psnr"], "bytes": 3 * each["bytes"]} for name, each in sets[0].items()}
    assert ntbc._means(sets)["m"]["psnr_ratio"] == pytest.approx(45 / 60)
    assert ntbc._means(sets)["m"]["share"] == pytest.approx(400 / 1600)


def test_colour_errors_tell_chroma_from_luminance():
    channels = tuple(Channel("base_color", c, "srgb") for c in "rgb") + GREYS
    grey = np.full((4, 4, 5), 0.5, np.float32)
    brighter, redder = grey + np.float32(0.1), grey.copy()
    redder[..., 0] += 0.1
    assert lab.colour_errors(channels, grey, brighter)["delta_ab"] == pytest.approx(0, abs=1e-2)
    assert lab.colour_errors(channels, grey, brighter)["delta_e"] == pytest.approx(9.9, abs=0.5)  # of L* alone
    red = lab.colour_errors(channels, grey, redder)
    assert 5 < red["delta_ab"] < red["delta_e"]
    assert lab.colour_errors(GREYS, grey[..., :2], grey[..., :2]) == {"delta_e": None, "delta_ab": None}


@pytest.mark.parametrize("kind", lab.REFERENCES)
@pytest.mark.parametrize(("format", "components"), [("bc1", 3), ("bc4", 1), ("bc7", 3)])
def test_references_keep_their_channels(kind, format, components, rng):
    ramp = np.linspace(0.1, 0.6, 20, dtype=np.float32)
    texels = np.stack([ramp[:, None] + 0.02 * ramp + 0.1 * k for k in range(components)], axis=-1)[:, :18]
    assert np.abs(lab.ROUND_TRIPS[kind](format, texels) - texels).max() < 0.04


# --- the tables ---


@pytest.fixture
def fits(monkeypatch):
    """Replace fit and asset by grey maps whose size says how often it was fitted; the list holds what was asked for."""
    asked = []

    def fit(source, out, *, model, steps, seed, device, resume=False, crop=None, **options):
        asked.append({"model": model, "crop": crop, "steps": steps, **options})
        out.write_text(str(len(asked)))
        return {"training": {"seconds": 1.5 * steps}}

    def load(path, device):
        grey = np.full(6, 0.5, np.float32)
        return SimpleNamespace(bytes=int(path.read_text()), encoded=lambda uv, lod: np.tile(grey, (len(uv), 1)))

    monkeypatch.setattr("warp_neumat.training.fit.fit", fit)
    monkeypatch.setattr("warp_neumat.materials.load", load)
    return asked


def test_tables_come_from_few_fits(tmp_path, fits):
    source = str(synthetic_set(tmp_path / "maps", 48))
    choice = {
        "sets": (source,),
        "methods": ("naive aggressive", "ntbc conservative"),
        "rates": ("ntbc 45 %",),
        "lengths": (7, 9),
        "crop": 32,
        "steps": 7,
        "only": ("table2", "figure4", "figure6"),
        "out": tmp_path / "out",
    }
    rows = list(ntbc.rows(device="cpu", quick=False, **choice))
    json.dumps(rows, allow_nan=False)
    timed = [request for request in fits if request["steps"] > 1]
    # Figure 4 adds a rate to the table's two, figure 6 four points of which one is there. First a step for each method.
    assert len(timed) == 3 + 3
    assert [request["steps"] for request in fits] == [1, 7, 1, 7, 1, 7, 9, 1, 7, 9]
    x, y, *size = timed[0]["crop"]
    assert size == [32, 32]
    assert {x, y} <= {0, 8, 16}
    assert timed[0] == {"model": "ntbc", "crop": (x, y, 32, 32), "steps": 7, "mode": "aggressive", "variant": "naive"}
    table = {(row["set"], row["method"]): row for row in rows if row["table"] == "table2"}
    assert table["maps", "bc"]["psnr_ratio"] == table["mean", "bc"]["share"] == 1
    assert table["maps", "bc"]["bytes"] == (64 + 16 + 4 + 1 + 1 + 1) * (8 + 16 + 8)
    assert table["maps", "bc"]["share_mip0"] == 87 / 64
    assert table["maps", "bc"]["psnr"] > table["maps", "ntbc conservative"]["psnr"]
    assert table["maps", "ntbc conservative"]["share"] == 4 / table["maps", "bc"]["bytes"]
    assert {"base_color", "normal", "roughness"} == set(table["maps", "bc"]["psnr_maps"])
    curve = [row for row in rows if row["table"] == "figure6"]
    assert [(row["method"], row["steps"], row["seconds"]) for row in curve] == [
        (f"ntbc {mode}", steps, 1.5 * steps) for mode in ("conservative", "aggressive") for steps in (7, 9)
    ]
    assert {"figure4.png", "figure6.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
    again = list(ntbc.rows(device="cpu", quick=False, **choice))
    assert len(fits) == 10
    assert again == rows  # seconds too, which are kept beside the file


def test_unknown_choices_are_named(tmp_path, capsys):
    with pytest.raises(ValueError, match="only must be among table2, .*, got 'table9'"):
        list(ntbc.rows(device="cpu", quick=False, only=("table9",), out=tmp_path))
    with pytest.raises(ValueError, match="crop must be at least 16, or 0 for the whole set, got 8"):
        list(ntbc.rows(device="cpu", quick=False, crop=8, out=tmp_path))
    with pytest.raises(ValueError, match="device must be cpu"):
        list(ntbc.rows(device="cuda:0", quick=True))
    assert ntbc.main(["--only", "table9", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("bench: only must be among")


def test_methods_and_options_are_the_fits(tmp_path):
    from warp_neumat.io.texture_set import open_texture_set
    from warp_neumat.models.ntbc_config import configure

    opened = open_texture_set(synthetic_set(tmp_path / "maps", 256))
    for options in (*lab.METHODS.values(), *lab.RATES.values(), *ntbc.OPTIONS.values()):
        configure(opened, {**options, "hidden": (8,)})


# --- torch ---

SHAPE = StepShape(NetworkShape(((4, 3), (9, 8)), 10), NetworkShape(((4, 3), (30, 40)), 5), ((4, 3), (8, 1), (8, 1)))


@pytest.mark.parametrize("spelling", peers.SPELLINGS)
def test_torch_step_has_the_gradients_of_the_plain_one(spelling):
    made = problem(SHAPE, 5, 6)
    values = [made[name].double() for name in ("endpoint_grid", "endpoint_net", "texel_grid", "texel_net")]
    blocks, weights = torch.tensor([0, 7, 29, 7, 12, 3, 28, 11]), torch.tensor([1.0, 0.7, 0.9, 0.8, 0.6])
    reference = made["colours"], made["endpoints"]
    step = peers.Step(SHAPE, 5, 6, *reference, values, weights.tolist(), spelling, torch.float64)
    got = step.gradients(blocks)
    leaves = [v.clone().requires_grad_() for v in values]
    said = plain_network(SHAPE.endpoint, *leaves[:2], plain_places(5, 6, blocks, False))
    x = plain_network(SHAPE.texel, *leaves[2:], plain_places(5, 6, blocks, True))
    colours, ends = made["colours"][blocks].double(), made["endpoints"][blocks].double()
    metric = torch.eye(4).expand(len(SHAPE.planes), 4, 4)
    (losses(SHAPE, said, x, ends, colours, metric) @ weights.double()).backward()
    for network, grid in ((0, 0), (1, 2)):
        torch.testing.assert_close(got[grid], leaves[grid].grad, rtol=1e-9, atol=1e-12)
        shape = (SHAPE.endpoint, SHAPE.texel)[network]
        packed = torch.cat([p.reshape(-1) for layer in layers(shape, leaves[grid + 1].grad) for p in layer])
        torch.testing.assert_close(got[grid + 1], packed, rtol=1e-9, atol=1e-12)
        assert packed.abs().max() > 1e-4


def test_torch_writes_bc1(rng):
    """Palettes' own colours come back, in both orders of endpoints and in flat blocks."""
    ends = torch.from_numpy(rng.random((64, 6)).astype(np.float32))
    ends[0, 3:] = ends[0, :3]
    ends[1] = 0
    ends[2] = 1
    weights = torch.from_numpy(rng.integers(0, 4, (64, 16)) / 3).float()
    codes = torch.tensor([31.0, 63.0, 31.0] * 2)
    exact = (ends * codes + 0.5).floor() / codes
    colours = torch.lerp(exact[:, None, :3], exact[:, None, 3:], weights[..., None])
    blocks = peers.write_bc1(ends, colours).numpy()
    words = blocks.view("<u2")
    assert (words[:, 0] > words[:, 1]).all()
    decoded = bc1_decode(blocks).reshape(64, 16, 4)[..., :3] / 255
    assert np.abs(decoded - colours.numpy()).max() < 1.1 / 255


@pytest.mark.parametrize("entries", [8, 6])
def test_torch_writes_both_palettes_of_bc4(entries, rng):
    low, high = np.sort(rng.integers(0, 256, (64, 2)), axis=1).T[:, :, None]
    index, last = rng.integers(0, entries, (64, 16)), entries - 1
    values = ((last - index) * low + index * high) // last
    if entries == 6:
        values[:, 0], values[:, 1] = 0, 255
    ends = torch.from_numpy(np.concatenate([high, low], axis=1)).float() / 255
    blocks = peers.write_bc4(ends, torch.from_numpy(values)[..., None].float() / 255).numpy()
    np.testing.assert_array_equal(bc4_decode(blocks).reshape(64, 16), values)
