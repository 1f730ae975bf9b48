"""Fits of what varies over a surface: sampler, defaults, the lit patch, and `fit` and `eval` from end to end."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.tiny_maps import tiny_maps  # noqa: E402
from warp_neumat.io.asset import read_asset  # noqa: E402
from warp_neumat.io.image import read_image  # noqa: E402
from warp_neumat.io.svbrdf import SVBRDF, open_svbrdf  # noqa: E402
from warp_neumat.materials import load  # noqa: E402
from warp_neumat.models import neubrdf  # noqa: E402
from warp_neumat.training import plane, spatial  # noqa: E402
from warp_neumat.training.evaluate import brdf_metrics  # noqa: E402
from warp_neumat.training.fit import BRDFData, default_model, fit  # noqa: E402
from warp_neumat.training.loop import Plan  # noqa: E402

TINY = {"nside": 4, "bits": 6, "features": 8, "hidden": (32, 32)}
STEPS = 500


@pytest.fixture(scope="module", autouse=True)
def small_numbers():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plan, "batch", 1024)
        patch.setattr(plane, "SAMPLES", 2048)
        yield


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return f"svbrdf:{tiny_maps(tmp_path_factory.mktemp('maps'))}"


@pytest.fixture(scope="module")
def source(spec):
    return open_svbrdf(spec)


@pytest.fixture(scope="module")
def fitted(spec, tmp_path_factory, small_numbers):
    out = tmp_path_factory.mktemp("fit") / "tiny.neumat"
    said = []
    header = fit(spec, out, steps=STEPS, announce=said.append, **TINY)
    return out, header, said


def up(count):
    return np.tile(np.array([0, 0, 1], np.float32), (count, 1))


def lambert(colours):
    """A source of single-coloured diffuse texels (h, w), red only."""
    height, width = np.shape(colours)
    columns = np.zeros((10, height * width), np.float32)
    columns[2] = columns[3] = 1.0
    columns[4] = np.ravel(colours)
    return SVBRDF("lambert", width, height, columns)


# --- sampler and defaults ---------------------------------------------------------------------------------------------


def test_samples_are_the_sources_values_at_its_own_levels(source):
    sampler = spatial.SpatialSampler(source, np.random.default_rng(3), (8, 8, 4))
    batch = sampler.draw(4096)
    assert {name: array.shape for name, array in batch.items()} == {
        "wi": (4096, 3), "wo": (4096, 3), "value": (4096, 3), "uv": (4096, 2), "lod": (4096,),
    }  # fmt: skip
    assert {array.dtype for array in batch.values()} == {np.dtype(np.float32)}
    assert sampler.shift == 2.0  # texels of 8×8 are four of 32×32 wide
    again = source.eval(batch["uv"], batch["lod"] + 2.0, batch["wi"], batch["wo"])
    np.testing.assert_array_equal(batch["value"], again)
    same = spatial.SpatialSampler(source, np.random.default_rng(3), (8, 8, 4)).draw(4096)
    assert all(np.array_equal(batch[name], same[name]) for name in batch)


def test_levels_cover_all_mips_and_lean_to_the_finest():
    sampler = spatial.SpatialSampler(lambert(np.ones((64, 64))), np.random.default_rng(0), (64, 64, 4))
    lod = sampler.draw(1 << 16)["lod"]
    assert lod.min() == 0.0
    assert lod.max() <= 6.0
    assert 0.2 < (lod == 0).mean() < 0.35
    share = np.histogram(lod[lod > 0], bins=6, range=(0, 6))[0] / len(lod)
    assert share.min() > 0.04
    assert (np.diff(share) < 0).all()
    fixed = spatial.SpatialSampler(lambert(np.ones((64, 64))), np.random.default_rng(0), (64, 64, 4), (0.0, 0.0))
    assert not fixed.draw(512)["lod"].any()


@pytest.mark.parametrize(
    ("size", "texture"),
    [((32, 32), (16, 16, 8)), ((1024, 512), (256, 128, 8)), ((2048, 2048), (256, 256, 8)), ((1, 3), (1, 2, 8))],
)
def test_the_texture_has_half_the_sources_texels(size, texture):
    class Source:
        width, height = size

    assert spatial.configured(Source, {})["texture"] == texture
    assert spatial.configured(Source, {"texture": "none"})["texture"] is None
    assert spatial.configured(Source, {"texture": (4, 4, 2), "nside": 8}) == {
        "frame": "half", "nside": 8, "bits": 9, "texture": (4, 4, 2),
    }  # fmt: skip


def test_levels_shift_between_source_and_asset():
    source = lambert(np.ones((64, 128)))
    assert spatial.lod_shift(source, {"width": 32, "height": 32}) == 2.0
    assert spatial.lod_shift(source, None) == 0.0
    assert spatial.bits_per_texel(source, 1024) == 1.0
    seen = []
    evaluate = spatial.on_source_levels(source, (64, 32, 4), lambda wi, wo, uv, lod: seen.append(lod))
    evaluate(None, np.array([0.0, 3.5]), None, None)
    np.testing.assert_array_equal(seen[0], [-1.0, 2.5])


# --- the lit patch ----------------------------------------------------------------------------------------------------


def test_the_patch_is_filled_by_the_texture_and_seen_upright():
    mask, point = plane.plane_pixels(192)
    assert mask.shape == (144, 192)
    assert 0.3 < mask.mean() < 0.9
    rows, columns = np.nonzero(mask)
    assert min(rows.min(), columns.min()) > 0
    assert rows.max() < 143
    assert columns.max() < 191
    assert np.abs(point).max() > 0.98  # up to the edges
    assert point[0, 1] > 0.95 > -0.95 > point[-1, 1]  # far, with v = 0, on top
    assert (np.diff(point[rows == rows[len(rows) // 2], 0]) > 0).all()  # u runs to the right
    top_left = lambert([[5.0, 1.0], [1.0, 1.0]])
    red = plane.render_plane(top_left.eval, 0.0)[..., 0] / plane.render_plane(lambert([[1.0]]).eval, 0.0)[..., 0].clip(
        1e-9
    )
    row, column = np.unravel_index(np.argmax(red), red.shape)
    assert row < 72
    assert column < 96


def test_the_lit_patch_is_lamberts_law():
    image = plane.render_plane(lambert([[0.25]]).eval, 3.0, lights=(((0.0, 0.0, 1.0), (2.0, 2.0, 2.0)),))
    mask, point = plane.plane_pixels(192)
    cosine = 1.0 / np.sqrt(1.0 + (point**2).sum(1))
    np.testing.assert_allclose(image[mask][:, 0], 0.5 * cosine, rtol=1e-3)  # a rough surface still shines a little
    assert not image[~mask].any()
    assert image[..., 1:].max() < 1e-3


def test_metrics_are_0_for_the_source_itself_and_name_the_level_that_is_off():
    source = lambert(np.random.default_rng(0).random((16, 16)) / np.pi)
    perfect = brdf_metrics(source, source.refined().eval, size=64)
    assert [mip["lod"] for mip in perfect["mips"]] == [0, 1, 2]
    assert perfect["mae"] == perfect["rmse"] == perfect["mse_raw"] == perfect["mse_log"] == 0.0
    assert perfect["ssim"] == 1.0

    def off(uv, lod, wi, wo):
        return source.refined().eval(uv, lod, wi, wo) + 0.1 * (lod == 2)[:, None]

    found = brdf_metrics(source, off, size=64)
    assert [mip["mae"] > 0 for mip in found["mips"]] == [False, False, True]
    assert found["mips"][2]["mse_raw"] == pytest.approx(0.01, rel=1e-3)
    assert found["mse_raw"] == pytest.approx(0.01 / 3, rel=1e-3)


# --- fits -------------------------------------------------------------------------------------------------------------


def test_a_tiny_fit_beats_a_constant_and_a_model_without_texture(fitted, spec, source, tmp_path):
    _, header, said = fitted
    assert header["config"]["texture"] == {"width": 16, "height": 16, "channels": 8, "mips": 5}
    assert any("32×32 texels; neural texture: 16×16×8" in text for text in said)
    assert header["metrics"]["bits_per_texel"] == pytest.approx(header["metrics"]["bytes"] * 8 / 1024)
    assert len(header["metrics"]["mips"]) == 4
    mean = source.eval(np.full((1, 2), 0.5), 5.0, up(1), up(1))
    constant = brdf_metrics(source, lambda uv, lod, wi, wo: np.repeat(mean, len(wi), 0))
    plain = fit(spec, tmp_path / "plain.neumat", steps=STEPS, texture=None, **TINY)["metrics"]
    # Seen: MAE 0.057 with the texture, 0.094 without, 0.093 for the constant.
    for name, share in (("mae", 0.75), ("rmse", 0.8), ("mse_log", 0.95)):
        assert header["metrics"][name] < share * constant[name]
        assert header["metrics"][name] < share * plain[name]
    assert all(a["mae"] < b["mae"] for a, b in zip(header["metrics"]["mips"], plain["mips"], strict=True))


def test_the_material_evaluates_what_was_fitted(fitted, rng):
    out, header, _ = fitted
    tensors, stored = read_asset(out)
    model, material = neubrdf.from_asset(tensors, stored["config"]), load(out, device="cpu")
    count = 3000
    wi, wo = (rng.normal(size=(2, count, 3)) / 4 + (0, 0, 0.7)).astype(np.float32)
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (wi, wo))
    uv, lod = (3 * rng.random((count, 2)) - 1).astype(np.float32), (6 * rng.random(count) - 1).astype(np.float32)
    value = material.eval(uv, wi, wo, lod)
    with torch.no_grad():
        wanted = model(*(torch.from_numpy(a) for a in (wi, wo, uv, lod))).numpy() * np.maximum(wi[:, 2:], 0)
    np.testing.assert_allclose(value, wanted, rtol=2e-3, atol=2e-4)
    assert wanted.std(0).max() > 0.01


def test_same_seed_same_tensors(source):
    shape = neubrdf.configure(source, spatial.configured(source, TINY))
    runs = []
    for seed in (0, 0, 1):
        trainer = BRDFData.trainer(neubrdf, source, shape, Plan(40, 512, seed), torch.device("cpu"))
        trainer.run()
        runs.append(trainer.model.to_asset()[0])
    assert all(np.array_equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert not np.array_equal(runs[0]["texture.mip0"], runs[2]["texture.mip0"])


def test_eval_on_the_command_line(fitted, spec, tmp_path, run):
    out, header, _ = fitted
    code, shown, err = run(
        "eval", out, "--against", spec, "--json", tmp_path / "a.json", "--picture", tmp_path / "a.png"
    )
    assert code == 0, err
    record = json.loads((tmp_path / "a.json").read_text())
    assert record["mae"] == pytest.approx(header["metrics"]["mae"], rel=1e-2)
    assert record["bits_per_texel"] == pytest.approx(header["metrics"]["bits_per_texel"])
    assert shown.count("level ") == 4
    picture, _ = read_image(tmp_path / "a.png")
    assert picture.shape[:2] == (4 * 144, 3 * 192)
    code, _, err = run("eval", out, "--against", "analytic:ggx?roughness=0.5")
    assert code != 0
    assert "varies over a surface; --against must be svbrdf:FOLDER" in err


def test_the_header_opens_the_same_source(tmp_path):
    folder = tiny_maps(tmp_path / "maps")
    header = fit(
        f"svbrdf:{folder}", tmp_path / "a.neumat", steps=5, crop=(0, 0, 16, 8), overrides={"metallic": 1.0}, **TINY
    )
    assert header["source"]["opening"] == {"crop": [0, 0, 16, 8], "overrides": {"metallic": 1.0}}
    assert header["config"]["texture"]["width"] == 8
    assert header["config"]["texture"]["height"] == 4


def test_the_model_follows_the_source():
    assert default_model("svbrdf:bricks") == default_model("svbrdf:bricks.json") == "neubrdf"


@pytest.mark.parametrize(
    ("source", "options", "error", "message"),
    [
        ("svbrdf:nowhere", {}, FileNotFoundError, "nowhere: no such folder"),
        ("analytic:ggx?roughness=0.5", {"size": 8}, ValueError, "size is for maps: svbrdf:FOLDER, or model bcf"),
        ("analytic:ggx?roughness=0.5", {"texture": (4, 4, 4)}, ValueError, "texture is for what varies over a surface"),
    ],
)
def test_wrong_arguments_are_explained(source, options, error, message, tmp_path):
    with pytest.raises(error, match=message):
        fit(source, tmp_path / "a.neumat", **options)


def test_a_texture_of_the_wrong_form_is_explained(spec, tmp_path):
    with pytest.raises(ValueError, match="texture must be WIDTH,HEIGHT,CHANNELS"):
        fit(spec, tmp_path / "a.neumat", texture=(4, 4))
