"""`neumat fit`, `eval`, `info`, `decode`, `export` and `render` of an ntbc: block-compressed textures in a third."""

import json

import numpy as np
import pytest

from tests.block_textures import assert_same
from tests.fake_assets import fake_ntbc
from tests.tiny_maps import tiny_maps
from warp_neumat import load, read_dds, read_ktx2
from warp_neumat.io.asset import read_asset, write_asset
from warp_neumat.io.image import read_image
from warp_neumat.io.texture_set import open_texture_set


@pytest.fixture
def asset(tmp_path):
    fake_ntbc(tmp_path / "stone.neumat")
    return tmp_path / "stone.neumat"


# --- fit --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def fitted(monkeypatch):
    """Arguments of the fit that the command line asks for, which is not done."""
    pytest.importorskip("torch")
    from warp_neumat.training import fit

    found = {}
    monkeypatch.setattr(fit, "fit", lambda source, out, **options: found.update(options) or {"metrics": {"psnr": 1.0}})
    return found


def test_fit_passes_mode_and_options_on(run, fitted, tmp_path):
    maps = tiny_maps(tmp_path / "maps")
    code, _, stderr = run(
        "fit", maps, "-o", tmp_path / "a.neumat", "--model", "ntbc", "--mode", "aggressive", "--size", "24x16",
        "--crop", "4,0,28,16", "--override", "metallic=0", "--bytes", "20000", "--option", "rate=0.45",
        "--option", "normals=bc1", "--option", "endpoints=fitted",
    )  # fmt: skip
    assert code == 0, stderr
    assert fitted["model"] == "ntbc"
    wanted = {
        "mode": "aggressive", "size": (24, 16), "crop": (4, 0, 28, 16), "overrides": {"metallic": [0.0]},
        "bytes": 20000, "rate": 0.45, "normals": "bc1", "endpoints": "fitted",
    }  # fmt: skip
    assert {name: fitted[name] for name in wanted} == wanted


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--mode", "aggressive"), "--mode is for model ntbc, not bcf"),
        (("--model", "ntbc", "--mode", "agressive"), "--mode must be one of conservative, aggressive, got 'agressive'"),
        (("--model", "ntbc", "--option", "mode=aggressive"), "--option mode: has an option of its own"),
        (("--model", "ntbc", "--features", "16,8"), "--features is for models bcf, neubrdf and btf"),
        (("--model", "ntbc", "--reciprocal"), "--reciprocal is for model neubrdf, not ntbc"),
        (("--model", "neubrdf", "--bytes", "100"), "--bytes is for model bcf or ntbc, not neubrdf"),
    ],
)
def test_fit_mistakes_are_one_line(run, fitted, tmp_path, arguments, message):
    maps = tiny_maps(tmp_path / "maps")
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *arguments)
    assert code == 2
    assert message in stderr
    assert len(stderr.splitlines()) == 1
    assert not fitted


# --- what is done with a file -----------------------------------------------------------------------------------------


def test_eval_measures_the_decoded_textures(run, tmp_path):
    pytest.importorskip("skimage")
    pytest.importorskip("flip_evaluator")
    maps = tiny_maps(tmp_path / "maps", 40, 36)
    opened = open_texture_set(maps)
    fake_ntbc(tmp_path / "a.neumat", size=(40, 36), hidden=(16, 16, 16))
    tensors, header = read_asset(tmp_path / "a.neumat")
    channels = [
        {"map": c.map, "component": c.component, "encoding": c.encoding, "range": list(c.range)}
        for c in opened.channels
    ]
    config = header["config"]
    config |= {"channels": channels, "constants": {}, "textures": config["textures"][:3]}
    config["models"][1]["planes"].pop()
    for network, outputs in (("endpoint", 6), ("texel", 3)):
        for part in ("weight3", "bias3"):
            name = f"model1.{network}.{part}"
            tensors[name] = tensors[name][:outputs]
    write_asset(tmp_path / "a.neumat", tensors, header)
    code, stdout, stderr = run(
        "eval", tmp_path / "a.neumat", "--against", maps, "--json", tmp_path / "e.json", "--no-baselines"
    )
    assert code == 0, stderr
    record = json.loads((tmp_path / "e.json").read_text())
    assert record["kind"] == "ntbc"
    assert set(record["maps"]) == {"base_color", "normal", "roughness"}
    u, v = np.meshgrid((np.arange(40) + 0.5) / 40, (np.arange(36) + 0.5) / 36)
    decoded = load(tmp_path / "a.neumat").encoded(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.0)
    error = np.square(decoded.astype(np.float64) - opened.pixels.reshape(-1, 6)).mean()
    assert record["psnr_mip0"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
    assert "PSNR [dB] of this file by mip" in stdout


def test_info_shows_textures_and_networks(run, asset):
    code, stdout, stderr = run("info", asset)
    assert code == 0, stderr
    material = load(asset)
    assert stdout.splitlines()[0] == f"{asset}: ntbc version 1, {material.bytes} bytes"
    share = material.bytes / material.block_bytes
    for line in (
        "  mode conservative, variant ntbc, endpoints network, metric rgb",
        "  texture base_color: bc1_srgb, 7 mips, 2744 bytes (base_color.r, base_color.g, base_color.b)",
        "  texture normal: bc5_unorm, 7 mips, 5488 bytes (normal.x, normal.y)",
        f"  textures: {material.block_bytes} bytes at load, {material.bytes} here: {share:.1%}",
        "  model1: 4 planes (bc4, bc4, bc4, bc4)",
        "    texel: 3 grids 4×4 … 16×16 of 2 features in 8 bits, 672 bytes; 6→16→16→16→4, 1466 bytes",
        "  base_color: r g b (srgb)",
        "  specular: constant 0.5",
    ):
        assert line in stdout.splitlines()


def test_decode_writes_maps(run, asset, tmp_path):
    code, stdout, stderr = run("decode", asset, "-o", tmp_path / "d", "--bits", "16")
    assert code == 0, stderr
    assert {line.rsplit("/", 1)[1] for line in stdout.splitlines()} == {f.name for f in (tmp_path / "d").iterdir()}
    picture, _ = read_image(tmp_path / "d" / "roughness.png")
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    expected = load(asset).maps(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.0)["roughness"]
    np.testing.assert_allclose(picture.reshape(-1, 1), expected, atol=0.6 / 65535)


@pytest.mark.parametrize(("format", "read"), [("dds", read_dds), ("ktx2", read_ktx2)])
def test_export_writes_textures_and_a_manifest(run, asset, tmp_path, format, read):
    code, stdout, stderr = run("export", asset, "-o", tmp_path / "x", "--format", format)
    assert code == 0, stderr
    assert {line.rsplit("/", 1)[1] for line in stdout.splitlines()} == {f.name for f in (tmp_path / "x").iterdir()}
    assert {f.suffix for f in (tmp_path / "x").iterdir()} == {f".{format}", ".json"}
    assert_same(read(tmp_path / "x" / f"stone_normal.{format}"), load(asset).textures[1])
    assert run("export", asset, "-o", tmp_path / "y", "--shader", "none")[0] == 0


def test_export_has_no_decoder(run, asset, tmp_path):
    code, _, stderr = run("export", asset, "-o", tmp_path / "x", "--shader", "wgsl")
    assert code == 2
    assert "is an ntbc, whose textures need no decoder" in stderr
    assert len(stderr.splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_render_takes_it(run, asset, tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]], np.float32)
    np.savez(tmp_path / "tetra.npz", points=points[None], faces=faces, uv=uv)
    shot = ("-m", f"*={asset}", "-o", tmp_path / "out", "--size", "64x48", "--atlas", "64", "--lights", "1")
    code, _, stderr = run("render", tmp_path / "tetra.npz", *shot)
    assert code == 0, stderr
    assert read_image(tmp_path / "out" / "frames" / "0000.png")[0].max() > 0.2
