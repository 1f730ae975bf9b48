"""`neumat fit` of a folder of maps, and what users feed it: odd files, odd sizes, a power cut."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("torch")

from tests.tiny_maps import tiny_maps, tiny_values  # noqa: E402
from warp_neumat import load  # noqa: E402
from warp_neumat.io.asset import read_asset  # noqa: E402
from warp_neumat.io.image import read_image, write_exr, write_png  # noqa: E402
from warp_neumat.io.texture_set import open_texture_set  # noqa: E402

QUICK = ("--steps", "60", "--option", "batch=512")


@pytest.fixture
def maps(tmp_path):
    return tiny_maps(tmp_path / "maps")


@pytest.fixture
def fit(run, maps, tmp_path):
    """``fit(*arguments)`` fits the folder and returns (header, what was printed)."""

    def call(*arguments):
        code, stdout, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK, *arguments)
        assert code == 0, stderr
        return read_asset(tmp_path / "a.neumat")[1], stdout

    return call


def png16(path, picture):
    import OpenImageIO as oiio

    stored = np.rint(np.atleast_3d(picture) * 65535).astype(np.uint16)
    assert oiio.ImageBuf(np.ascontiguousarray(stored)).write(str(path), oiio.UINT16)


def test_a_folder_becomes_a_material_and_the_table_comes_first(fit, maps, tmp_path):
    header, stdout = fit("--steps", "300")
    lines = stdout.splitlines()
    assert lines[0] == "maps: 32×32, 6 channels to learn"
    assert any(line.split()[:2] == ["normal", "tiny_normal_gl.png"] for line in lines)
    assert lines[-2] == "feature textures: 16×16, 8×8, 4×4, 4×4"  # preset 1k
    assert lines[-1].startswith(f"{tmp_path / 'a.neumat'}: psnr ")
    assert header["kind"] == "bcf"
    assert header["source"] == {"spec": str(maps), "name": "maps"}
    assert header["maps"]["files"]["roughness"] == "tiny_roughness.png"
    # The asset gives the maps back, much closer than the mean colour would be.
    opened = open_texture_set(maps)
    grid = (np.stack(np.meshgrid(np.arange(32), np.arange(32)), axis=-1).reshape(-1, 2) + 0.5) / 32
    decoded = load(tmp_path / "a.neumat").encoded(grid.astype(np.float32), 0.0)
    error = np.square(decoded - opened.pixels.reshape(-1, 6)).mean()
    assert error < 0.25 * opened.pixels.reshape(-1, 6).var(axis=0).mean()


def test_options_reach_the_model(fit):
    header, _ = fit(
        "--model", "bcf", "--features", "16,8,8,4", "--seed", "3", "--option", "wrap=mirror",
        "--option", "modes=single", "--option", "mip_decay=0", "--option", "feature_range=0.5,2",
    )  # fmt: skip
    config, training = header["config"], header["training"]
    assert [t["width"] for t in config["textures"]] == [16, 8, 8, 4]
    assert config["wrap"] == "mirror"
    assert training["seed"] == 3
    used = np.flatnonzero(training["block_modes"])
    assert used.tolist() == [9]  # mode 10


def test_preset_names_sizes(fit):
    header, _ = fit("--preset", "2k++")
    assert [t["width"] for t in header["config"]["textures"]] == [32, 32, 8, 4]


def test_size_crop_and_overrides_are_remembered(fit):
    header, stdout = fit(
        "--size", "24x16", "--crop", "4,0,28,16", "--override", "normal.orientation=dx", "--override", "occlusion=0.5",
    )  # fmt: skip
    assert (header["config"]["width"], header["config"]["height"]) == (24, 16)
    assert header["config"]["constants"] == {"occlusion": [0.5]}
    assert header["source"]["opening"] == {
        "size": [24, 16],
        "crop": [4, 0, 28, 16],
        "overrides": {"normal": {"orientation": "dx"}, "occlusion": [0.5]},
    }
    assert "note: normal: DirectX orientation: green flipped" in stdout


def test_a_manifest_is_a_source(run, maps, tmp_path):
    manifest = maps / "set.json"
    manifest.write_text(json.dumps(open_texture_set(maps, crop=(0, 0, 16, 32)).manifest(maps)))
    code, stdout, stderr = run("fit", manifest, "-o", tmp_path / "a.neumat", *QUICK)
    assert code == 0, stderr
    assert "16×32, 6 channels" in stdout
    assert read_asset(tmp_path / "a.neumat")[1]["source"]["opening"] == {"crop": [0, 0, 16, 32]}


# --- what users feed it -----------------------------------------------------------------------------------------------


def test_sixteen_bit_and_float_maps(fit, maps):
    values = tiny_values()
    png16(maps / "tiny_base_color.png", values["base_color"])
    (maps / "tiny_roughness.png").unlink()
    write_exr(maps / "tiny_roughness.exr", values["roughness"])
    header, stdout = fit()
    assert "uint16" in stdout
    assert "half" in stdout
    assert header["metrics"]["psnr"] > 20


def test_nan_in_a_map_names_file_and_way_out(run, fit, maps, tmp_path):
    values = tiny_values()["roughness"]
    values[3, 5] = np.nan
    (maps / "tiny_roughness.png").unlink()
    write_exr(maps / "tiny_roughness.exr", values)
    code, stdout, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK)
    assert (code, stdout) == (1, "")
    assert "tiny_roughness.exr" in stderr
    assert "replace_nan" in stderr
    assert len(stderr.splitlines()) == 1
    header, _ = fit("--override", "roughness.replace_nan=0.5")
    assert header["metrics"]["psnr"] > 20


def test_a_map_of_one_pixel_is_a_constant(fit, maps):
    write_png(maps / "tiny_metallic.png", np.full((1, 1), 0.2))
    header, _ = fit()
    assert header["config"]["constants"]["metallic"] == pytest.approx([0.2])
    assert (header["config"]["width"], header["config"]["height"]) == (32, 32)


def test_maps_three_pixels_wide(run, tmp_path):
    maps = tiny_maps(tmp_path / "narrow", 3, 37)
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK)
    assert code == 0, stderr
    config = read_asset(tmp_path / "a.neumat")[1]["config"]
    assert (config["width"], config["height"]) == (3, 37)
    assert config["textures"][0] == {"width": 4, "height": 20, "mips": 5}
    found = load(tmp_path / "a.neumat").maps(np.array([[0.5, 0.5]], np.float32), 0.0)
    assert all(np.isfinite(v).all() for v in found.values())


def test_alpha_becomes_opacity(fit, maps):
    values = tiny_values()
    (maps / "tiny_roughness.png").unlink()
    rgba = np.concatenate([values["base_color"], values["roughness"][..., None]], axis=-1)
    write_png(maps / "tiny_base_color.png", rgba)
    header, stdout = fit()
    assert [c["map"] for c in header["config"]["channels"]].count("opacity") == 1
    assert "note: opacity: the alpha channel of the base colour" in stdout


@pytest.mark.parametrize(("letters", "dropped"), [("rg", ["base_color", "roughness"]), ("rgba", ["base_color"])])
def test_maps_of_two_and_four_channels_go_all_the_way(run, fit, maps, tmp_path, letters, dropped):
    values = np.concatenate([tiny_values()["base_color"], tiny_values()["roughness"][..., None]], axis=-1)
    write_png(maps / "tiny_layers.png", values)
    drop = [part for name in dropped for part in ("--override", f"{name}=none")]
    header, _ = fit("--override", "layers.file=tiny_layers.png", "--override", f"layers.channel={letters}", *drop)
    assert [c["component"] for c in header["config"]["channels"] if c["map"] == "layers"] == list(letters)
    for command in ("decode", "export"):
        code, _, stderr = run(command, tmp_path / "a.neumat", "-o", tmp_path / command)
        assert code == 0, stderr
    decoded = load(tmp_path / "a.neumat").maps(np.array([[0.5 / 32, 0.5 / 32]], np.float32), 0.0)["layers"]
    written = read_image(tmp_path / "decode" / "layers.png")[0][0, 0]
    np.testing.assert_allclose(written[: len(letters)], decoded[0], atol=0.51 / 255)
    kind = f"vec{len(letters)}"
    assert f"{kind} layers;" in (tmp_path / "export" / "a.glsl").read_text()


def test_a_map_of_many_channels_is_one_line(run, maps, tmp_path):
    import OpenImageIO as oiio

    many = np.random.default_rng(0).random((8, 8, 6)).astype(np.float32)
    assert oiio.ImageBuf(many).write(str(maps / "tiny_layers.exr"))
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK)
    assert code == 1
    assert "has 6 channels, a map holds at most 4; choose them with" in stderr


def test_all_maps_constant_is_one_line(run, tmp_path):
    folder = tmp_path / "flat"
    folder.mkdir()
    write_png(folder / "flat_base_color.png", np.full((8, 8, 3), 0.25))
    write_png(folder / "flat_roughness.png", np.full((1, 1), 0.5))
    code, stdout, stderr = run("fit", folder, "-o", tmp_path / "a.neumat", *QUICK)
    assert (code, stdout) == (1, "")
    assert "every map is constant, so there is nothing to learn" in stderr


def test_two_files_that_claim_a_map(run, fit, maps, tmp_path):
    write_png(maps / "tiny_roughness_v2.png", tiny_values()["roughness"])
    os.rename(maps / "tiny_roughness_v2.png", maps / "other_roughness.png")
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK)
    assert code == 1
    assert "both claim the map roughness" in stderr
    assert len(stderr.splitlines()) == 1
    header, _ = fit("--override", "roughness.file=other_roughness.png")
    assert header["maps"]["files"]["roughness"] == "other_roughness.png"


@pytest.mark.parametrize("keep", [0, 40, 0.7], ids=["empty", "header only", "cut"])
def test_a_broken_picture_is_one_line(run, maps, tmp_path, keep):
    broken = maps / "tiny_base_color.png"
    content = broken.read_bytes()
    broken.write_bytes(content[: int(keep * len(content)) if keep < 1 else keep])
    code, stdout, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK)
    assert (code, stdout) == (1, "")
    assert "tiny_base_color.png" in stderr
    assert len(stderr.splitlines()) == 1
    assert not (tmp_path / "a.neumat").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--preset", "3k"), 2, "--preset must be one of 0.5k, 1k, 2k, 2k++, quick, standard, fine, got '3k'"),
        (("--model", "nbrdf"), 2, "--model must be one of neubrdf, bcf, btf, ntbc, got 'nbrdf'; nearest: neubrdf"),
        (("--features", "16,x"), 2, "--features must be whole numbers"),
        (("--features", "16,8", "--preset", "1k"), 1, "give a preset, features or bytes, not two of them"),
        (("--size", "0x4"), 2, "--size must be WxH or the longer side"),
        (("--crop", "1,2,3"), 2, "--crop must be X,Y,W,H"),
        (("--crop", "0,0,64,64"), 1, "must lie within the set's 32×32 pixels"),
        (("--override", "normal"), 2, "--override must be MAP.FIELD=VALUE"),
        (("--override", "normal.orientatoin=dx"), 2, "unknown field 'orientatoin'; nearest: orientation"),
        (("--override", "normal.orientation=up"), 1, "orientation must be gl or dx, got 'up'"),
        (("--override", "rougness.invert=true"), 1, "nearest: roughness"),
        (("--override", "roughness.invert=yes"), 2, "--override roughness.invert must be true or false"),
        (("--override", "roughness=rough"), 2, "--override roughness must be a number"),
        (("--override", "roughness=0", "--override", "roughness.invert=true"), 2, "roughness is already overridden"),
        (("--option", "wrpa=clamp"), 1, "no option 'wrpa' of bcf; nearest: wrap"),
        (("--option", "wrap=3"), 1, "wrap must be repeat, clamp or mirror, got 3"),
        (("--option", "aligned=much"), 1, "an option is of the wrong type: aligned='much'"),
        (("--option", "wrap"), 2, "--option must be NAME=VALUE"),
        (("--option", "steps=5"), 2, "--option steps: has an option of its own"),
        (("--option", "batch=100"), 1, "batch must be a multiple of 256"),
        (("--steps", "0"), 1, "steps must be a whole number of at least 1"),
        (("--steps", "many"), 2, "valid integer"),
        (("--model", "neubrdf"), 1, "maps"),
        (("--model", "neubrdf", "--size", "8"), 2, "--size is for model bcf or ntbc, not neubrdf"),
        (("--device", "abacus"), 1, "abacus"),
        (("-o", "a.png"), 2, "-o must end in .neumat, got 'a.png'"),
    ],
)
def test_a_mistake_is_one_line_before_any_training(run, maps, tmp_path, arguments, code, message):
    found, stdout, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *QUICK, *arguments)
    assert (found, stdout) == (code, "")
    assert message in stderr
    assert len(stderr.splitlines()) == 1
    assert stderr.startswith("neumat: ")
    assert not list(tmp_path.glob("a.neumat*"))


def test_a_missing_folder_is_named_as_one(run, tmp_path):
    code, _, stderr = run("fit", tmp_path / "none", "-o", tmp_path / "a.neumat")
    assert (code, stderr) == (1, f"neumat: {tmp_path / 'none'}: no such folder or manifest\n")


# --- interruptions ----------------------------------------------------------------------------------------------------


def test_a_killed_fit_resumes_to_the_same_file(run, maps, tmp_path):
    whole, cut = tmp_path / "whole.neumat", tmp_path / "cut.neumat"
    plan = ("--steps", "600", "--option", "batch=512", "--option", "checkpoint_seconds=0.05")
    assert run("fit", maps, "-o", whole, *plan)[0] == 0
    command = [sys.executable, "-m", "warp_neumat", "fit", maps, "-o", cut, *plan]
    checkpoint = tmp_path / "cut.neumat.checkpoint"
    kills = 0
    for number in range(2):  # once in the middle of the first stages, once later
        process = subprocess.Popen(command + ["--resume"] * number, stdout=subprocess.DEVNULL)
        written = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
        deadline = time.monotonic() + 120
        while process.poll() is None and time.monotonic() < deadline:
            if checkpoint.exists() and checkpoint.stat().st_mtime_ns != written:
                os.kill(process.pid, signal.SIGKILL)
                break
            time.sleep(0.002)
        kills += process.wait() == -signal.SIGKILL
        assert not cut.exists()
    assert kills == 2
    assert run("fit", maps, "-o", cut, *plan, "--resume")[0] == 0
    assert cut.read_bytes() == whole.read_bytes()
    assert not checkpoint.exists()


def test_ctrl_c_says_interrupted(run, maps, tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warp_neumat.training.fit.fit", stop)
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat")
    assert (code, stderr) == (130, "neumat: interrupted\n")


def test_nothing_to_resume_is_said(fit):
    _, stdout = fit("--resume")
    assert "a.neumat.checkpoint: no such checkpoint to resume; starting anew" in stdout


def test_a_resumed_fit_refuses_other_settings(run, maps, tmp_path, monkeypatch):
    from warp_neumat.training import block_loop

    def stop(self):
        raise KeyboardInterrupt

    plan = ("--steps", "20", "--option", "batch=512", "--option", "checkpoint_seconds=0")
    with monkeypatch.context() as patched:
        patched.setattr(block_loop.BlockTrainer, "_bound", lambda self, values: stop(self) if self._step > 2 else None)
        assert run("fit", maps, "-o", tmp_path / "a.neumat", *plan)[0] == 130
    assert (tmp_path / "a.neumat.checkpoint").is_file()
    code, _, stderr = run("fit", maps, "-o", tmp_path / "a.neumat", *plan, "--resume", "--crop", "0,0,16,16")
    assert code == 1
    assert "use the same settings, or fit again without --resume" in stderr
    assert len(stderr.splitlines()) == 1
