"""`neumat eval`, `info`, `decode` and `export` of a bcf, from its file to tables, pictures and an engine's files."""

import hashlib
import json

import numpy as np
import pytest

from tests.fake_assets import fake_bcf, random_neubrdf
from tests.tiny_maps import tiny_maps
from warp_neumat import load, read_dds, read_ktx2
from warp_neumat.io.asset import read_asset, write_asset
from warp_neumat.io.image import read_image
from warp_neumat.io.texture_set import open_texture_set


@pytest.fixture
def asset(tmp_path):
    fake_bcf(tmp_path / "noise.neumat", size=32, features=(16, 8, 8, 4), channels=6)
    return tmp_path / "noise.neumat"


@pytest.fixture
def matched(asset, tmp_path):
    """A bcf with the channels of tiny maps, as if it had been fitted to a crop of them with overrides."""
    maps = tiny_maps(tmp_path / "maps", 40, 36)
    opening = {"crop": [3, 2, 30, 20], "size": [24, 16], "overrides": {"normal": {"orientation": "dx"}}}
    opened = open_texture_set(maps, **opening)
    tensors, header = read_asset(asset)
    channels = [
        {"map": c.map, "component": c.component, "encoding": c.encoding, "range": list(c.range)}
        for c in opened.channels
    ]
    header["config"] |= {"width": 24, "height": 16, "channels": channels, "constants": {}}
    header["source"] = {"spec": str(maps), "name": "maps", "opening": opening}
    write_asset(asset, tensors, header)
    return asset, maps


# --- eval -------------------------------------------------------------------------------------------------------------


def test_eval_opens_the_source_as_the_fit_did(run, matched, tmp_path):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    asset, maps = matched
    target = tmp_path / "e.json"
    code, stdout, stderr = run("eval", asset, "--against", maps, "--json", target, "--no-baselines")
    assert code == 0, stderr
    record = json.loads(target.read_text())
    assert record["kind"] == "bcf"
    assert record["baselines"] == {}
    assert {"bytes", "psnr", "ssim", "flip", "maps", "bits_per_texel_per_channel"} <= set(record)
    assert (record["mips"][0]["width"], record["mips"][0]["height"]) == (24, 16)
    assert set(record["maps"]) == {"base_color", "normal", "roughness"}
    assert len(record["maps"]["normal"]["mips"]) == 5
    # What the table shows is the error of this asset against the maps, opened equally by hand.
    opened = open_texture_set(maps, crop=(3, 2, 30, 20), size=(24, 16), overrides={"normal": {"orientation": "dx"}})
    u, v = np.meshgrid((np.arange(24) + 0.5) / 24, (np.arange(16) + 0.5) / 16)
    decoded = load(asset).encoded(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.0)
    error = np.square(decoded.astype(np.float64) - opened.pixels.reshape(-1, 6)).mean()
    assert record["psnr_mip0"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
    assert f"{record['psnr']:.2f}" in stdout
    assert "PSNR [dB] of this file by mip" in stdout


def test_eval_puts_baselines_beside_and_a_picture(run, matched, tmp_path):
    for module in ("quicktex", "texture2ddecoder", "skimage", "flip_evaluator"):
        pytest.importorskip(module)
    asset, maps = matched
    target, picture = tmp_path / "e.json", tmp_path / "sheet.png"
    code, stdout, stderr = run(
        "eval", asset, "--against", maps, "--json", target, "--picture", picture, "--baselines", "bc_full,bc_half"
    )
    assert code == 0, stderr
    record = json.loads(target.read_text())
    assert list(record["baselines"]) == ["bc_full", "bc_half"]
    assert record["baselines"]["bc_full"]["psnr"] > record["psnr"]
    assert "BC half" in stdout
    assert read_image(picture)[0].shape == (3 * (16 + 4), 5 * (24 + 4), 3)


def test_eval_without_encoders_says_so_and_goes_on(run, matched, monkeypatch):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    from warp_neumat.training import evaluate_maps

    def missing(*_, **__):
        raise ImportError("quicktex is not installed")

    monkeypatch.setattr(evaluate_maps, "Baseline", missing)
    asset, maps = matched
    code, stdout, stderr = run("eval", asset, "--against", maps)
    assert code == 0
    assert stderr == "note: no baselines: quicktex is not installed\n"
    assert "this file" in stdout
    code, _, stderr = run("eval", asset, "--against", maps, "--baselines", "bc_full")
    assert (code, stderr) == (1, "neumat: quicktex is not installed\n")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--baselines", "bc_ful"), 2, "--baselines must be one of bc_same, bc_full, bc_half"),
        (("--baselines", "bc_full", "--no-baselines"), 2, "give one of them"),
        (("--picture", "x.jpg"), 2, "--picture must end in .png"),
        (("--against", "none"), 1, "none: no such folder or manifest"),
        (("--json", "none/e.json", "--no-baselines"), 1, "there is no folder"),
    ],
)
def test_eval_mistakes_are_one_line(run, matched, monkeypatch, tmp_path, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    asset, maps = matched
    found, _, stderr = run("eval", asset, "--against", maps, *arguments)
    assert found == code
    assert message in stderr
    assert len(stderr.splitlines()) == 1


def test_eval_of_another_set_says_what_differs(run, asset, tmp_path):
    maps = tiny_maps(tmp_path / "maps", 40, 36)
    code, _, stderr = run("eval", asset, "--against", maps, "--no-baselines")
    assert code == 1
    assert "is 40x36, and the asset was fitted to 32x32" in stderr
    maps = tiny_maps(tmp_path / "others", 32, 32)
    fake_bcf(asset, size=32, features=(16, 8, 8, 4), channels=5)
    code, _, stderr = run("eval", asset, "--against", maps, "--no-baselines")
    assert code == 1
    assert "the asset's are" in stderr


def test_eval_of_a_brdf_has_no_baselines(run, tmp_path, rng):
    write_asset(tmp_path / "a.neumat", *random_neubrdf(rng))
    code, _, stderr = run("eval", tmp_path / "a.neumat", "--against", "analytic:lambert?albedo=0.5", "--no-baselines")
    assert code == 2
    assert "--baselines are for a bcf" in stderr


# --- info -------------------------------------------------------------------------------------------------------------


def test_info_shows_textures_network_and_channels(run, asset):
    code, stdout, _ = run("info", asset)
    assert code == 0
    size = sum(t.nbytes for t in read_asset(asset)[0].values())
    assert stdout.splitlines()[0] == f"{asset}: bcf version 1, {size} bytes"
    assert f"material: 32×32, 6 channels, wrap repeat, {8 * size / 32 / 32 / 6:.3g} bit/texel/channel" in stdout
    assert "texture0: bc6h_uf16 16×16, 5 mips, 368 bytes, sharp from mip 1 of the material on" in stdout
    assert "network: 12→16→6, float16, 620 bytes" in stdout
    assert "base_color: r g b (srgb)" in stdout
    assert "specular: constant 0.5" in stdout
    record = json.loads(run("info", asset, "--json", "-")[1])
    assert record["config"]["hidden"] == 16
    assert record["tensors"]["texture0.mip0"] == {"dtype": "uint8", "shape": [4, 4, 16], "bytes": 256}


def test_info_repeats_the_notes_of_the_fit(run, asset):
    tensors, header = read_asset(asset)
    header["maps"] = {"files": {"normal": "n.png"}, "notes": ["normal: orientation not named"]}
    header["training"] = {"steps": 5, "budget_seconds": None}
    write_asset(asset, tensors, header)
    lines = run("info", asset)[1].splitlines()
    assert lines[-2:] == ["  maps.normal: n.png", "  note: normal: orientation not named"]
    assert "  training.steps: 5" in lines
    assert not any("budget_seconds" in line for line in lines)


# --- decode -----------------------------------------------------------------------------------------------------------


def test_decode_writes_maps(run, asset, tmp_path):
    code, stdout, stderr = run("decode", asset, "-o", tmp_path / "d", "--size", "12x10", "--lod", "0.5", "--bits", "16")
    assert code == 0, stderr
    assert {line.rsplit("/", 1)[1] for line in stdout.splitlines()} == {f.name for f in (tmp_path / "d").iterdir()}
    picture, facts = read_image(tmp_path / "d" / "roughness.png")
    assert picture.shape == (10, 12, 1)
    assert facts.dtype == "uint16"
    u, v = np.meshgrid((np.arange(12) + 0.5) / 12, (np.arange(10) + 0.5) / 10)
    expected = load(asset).maps(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.5)["roughness"]
    np.testing.assert_allclose(picture.reshape(-1, 1), expected, atol=0.6 / 65535)
    code, _, _ = run("decode", asset, "-o", tmp_path / "e", "--lod", "2")
    assert read_image(tmp_path / "e" / "roughness.png")[0].shape == (8, 8, 1)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--size", "12"), 2, "--size must be WxH"),
        (("--lod", "-1"), 2, "--lod"),
        (("--lod", "40"), 2, "--lod"),
        (("--bits", "12"), 2, "--bits must be 8 or 16"),
        ((), 0, ""),
    ],
)
def test_decode_mistakes_are_one_line(run, asset, tmp_path, arguments, code, message):
    found, _, stderr = run("decode", asset, "-o", tmp_path / "d", *arguments)
    assert found == code
    assert message in stderr
    assert len(stderr.splitlines()) == (code != 0)
    assert (tmp_path / "d").exists() == (code == 0)


def test_a_brdf_has_no_maps(run, tmp_path, rng):
    write_asset(tmp_path / "a.neumat", *random_neubrdf(rng))
    for command, message in (("decode", "has no maps to decode"), ("export", "has no textures to export")):
        code, _, stderr = run(command, tmp_path / "a.neumat", "-o", tmp_path / "out")
        assert code == 1
        assert f"kind 'neubrdf' {message}" in stderr.replace("kind: ", "kind ")
        assert len(stderr.splitlines()) == 1
        assert not (tmp_path / "out").exists()


# --- export -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "read"), [("dds", read_dds), ("ktx2", read_ktx2)])
def test_export_writes_the_assets_own_blocks(run, asset, tmp_path, format, read):
    code, stdout, stderr = run("export", asset, "-o", tmp_path / "x", "--format", format, "--shader", "wgsl")
    assert code == 0, stderr
    assert {line.rsplit("/", 1)[1] for line in stdout.splitlines()} == {f.name for f in (tmp_path / "x").iterdir()}
    assert {f.suffix for f in (tmp_path / "x").iterdir()} == {f".{format}", ".bin", ".json", ".wgsl"}
    tensors, _ = read_asset(asset)
    texture = read(tmp_path / "x" / f"noise_features0.{format}")
    for mip, blocks in enumerate(texture.levels[0]):
        np.testing.assert_array_equal(blocks, tensors[f"texture0.mip{mip}"])
    manifest = json.loads((tmp_path / "x" / "noise.json").read_text())
    for entry in manifest["textures"]:
        content = (tmp_path / "x" / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"]


def test_export_takes_all_languages_or_none(run, asset, tmp_path):
    assert run("export", asset, "-o", tmp_path / "all")[0] == 0
    assert {".glsl", ".hlsl", ".wgsl"} <= {f.suffix for f in (tmp_path / "all").iterdir()}
    assert run("export", asset, "-o", tmp_path / "none", "--shader", "none")[0] == 0
    assert {f.suffix for f in (tmp_path / "none").iterdir()} == {".dds", ".bin", ".json"}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--format", "dsd"), 2, "--format must be one of dds, ktx2, got 'dsd'; nearest: dds"),
        (("--shader", "metal"), 2, "--shader must be one of glsl, hlsl, wgsl, none, got 'metal'"),
        (("--shader", "none", "--shader", "glsl"), 2, "--shader none stands alone"),
    ],
)
def test_export_mistakes_are_one_line(run, asset, tmp_path, arguments, code, message):
    found, _, stderr = run("export", asset, "-o", tmp_path / "x", *arguments)
    assert found == code
    assert message in stderr
    assert len(stderr.splitlines()) == 1
    assert not (tmp_path / "x").exists()
