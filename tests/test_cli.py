"""The command line: one end-to-end render, and what a user reads after a mistake."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from tests.fake_assets import random_neubrdf
from warp_neumat.io.asset import write_asset
from warp_neumat.io.image import read_image


@pytest.fixture
def scene(tmp_path):
    """A folder with a two-frame tetrahedron and a material."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    np.savez(tmp_path / "tetra.npz", points=np.stack([points, points * 1.1]), faces=faces)
    write_asset(tmp_path / "noise.neumat", *random_neubrdf(np.random.default_rng(2), nside=2, bits=3))
    return tmp_path


SMALL = ("--size", "64x48", "--atlas", "64", "--lights", "2")


def test_render_writes_frames_video_and_report(run, scene):
    out = scene / "out"
    code, stdout, stderr = run(
        "render", scene / "tetra.npz", "--material", f"*={scene / 'noise.neumat'}", "-o", out,
        *SMALL, "--reference", "--video", "--exr", "--interval", "1",
    )  # fmt: skip
    assert code == 0, stderr
    assert "2 frames" in stdout
    assert "report.html" in stdout
    report = json.loads((out / "report.json").read_text())
    assert [f["index"] for f in report["frames"]] == [0, 1]
    for frame in report["frames"]:
        assert {"pose", "visibility", "mark", "list", "shade", "gather", "tonemap", "write"} <= set(frame["ms"])
        assert set(frame["texels"]) == {"owned", "facing", "seen", "shaded"}
        assert set(frame["error"]) == {"psnr", "ssim", "flip"}
    assert report["frames"][0]["evaluations"] > 0
    assert report["options"]["interval"] == 1
    assert report["machine"]
    assert report["versions"]["warp"]
    assert report["summary"]["flip"] < 0.1
    display, linear = read_image(out / "frames" / "0001.png")[0], read_image(out / "frames" / "0001.exr")[0]
    assert display.shape == linear.shape == (48, 64, 3)
    assert display.max() > 0.2
    assert (out / "reference" / "0000.png").is_file()
    assert (out / "video.mp4").stat().st_size > 500
    html = (out / "report.html").read_text()
    assert "<svg" in html
    assert "http://" not in html.replace("http://www.w3.org", "")
    assert "https://" not in html


def test_a_second_shot_replaces_the_first_but_a_mistake_does_not(run, scene):
    out, material = scene / "out", f"*={scene / 'noise.neumat'}"
    arguments = ["render", scene / "tetra.npz", "--material", material, "-o", out, *SMALL]
    assert run(*arguments, "--exr")[0] == 0
    (out / "frames" / "mine.txt").write_text("keep")
    assert run(*arguments, "--lights", "none.json")[0] == 1
    assert (out / "frames" / "0001.png").is_file()
    assert run(*arguments, "--frames", "0:1")[0] == 0
    assert sorted(f.name for f in (out / "frames").iterdir()) == ["0000.png", "mine.txt"]


def test_debug_shows_the_traceback_wherever_it_stands(run, scene):
    for arguments in (["--debug", "info", scene / "none.neumat"], ["info", scene / "none.neumat", "--debug"]):
        with pytest.raises(FileNotFoundError):
            run(*arguments)


def test_info_shows_the_asset(run, scene):
    code, stdout, _ = run("info", scene / "noise.neumat")
    assert code == 0
    assert "neubrdf version 2" in stdout
    assert "config.nside: 2" in stdout
    code, stdout, _ = run("info", scene / "noise.neumat", "--json", "-")
    assert json.loads(stdout)["tensors"]["codebook"]["shape"] == [8, 8]


def test_eval_measures_against_the_source(run, scene):
    target, picture = scene / "eval.json", scene / "strip.png"
    code, _, stderr = run(
        "eval",
        scene / "noise.neumat",
        "--against",
        "analytic:lambert?albedo=0.5",
        "--json",
        target,
        "--picture",
        picture,
    )
    assert code == 0, stderr
    record = json.loads(target.read_text())
    assert record["kind"] == "neubrdf"
    assert {"bytes", "mae", "rmse", "mse_raw"} <= set(record)
    assert record["mae"] > 0.01  # noise is no Lambert surface
    assert read_image(picture)[0].shape == (256, 768, 3)


WRITTEN_WRONG = {
    "--budget must be evaluations, as 250k, or milliseconds",
    "budget and target_flip exclude each other",
    "fixed keeps no budget; use the policy",
    "--material must be NAME=FILE",
    "--frames must be A:B",
    "--size must be WxH",
    "interval must be a whole number",
    "policy must be one of every, fixed, staggered, adaptive",
    "no-skip must be among",
    "background must be one value or R,G,B",
    "operator must be one of",
    "exposure must be between",
}
"""Arguments that are not what the help says they look like: exit code 2; what does not exist or fit is 1."""


def _bad(scene, **change):
    """Return the arguments of a render with something changed."""
    parts = {
        "sequence": scene / "tetra.npz",
        "material": f"*={scene / 'noise.neumat'}",
        "out": scene / "bad",
        "more": (),
    } | change
    return ["render", parts["sequence"], "--material", parts["material"], "-o", parts["out"], *SMALL, *parts["more"]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {"sequence": s / "none.glb"}, "none.glb: no such file"),
        (lambda s: {"sequence": s / "noise.neumat"}, "unknown suffix .neumat"),
        (lambda s: {"material": f"*={s / 'none.neumat'}"}, "none.neumat: no such file"),
        (lambda s: {"material": f"wheel={s / 'noise.neumat'}"}, "no mesh or material matches 'wheel'"),
        (lambda s: {"material": "nothing"}, "--material must be NAME=FILE"),
        (lambda s: {"material": f"*={s / 'tetra.npz'}"}, "tetra.npz: file: truncated or no safetensors file"),
        (lambda s: {"more": ("--frames", "4:2")}, "--frames must be A:B"),
        (lambda s: {"more": ("--frames", "0:9")}, "frame 8 does not exist, there are 2"),
        (lambda s: {"more": ("--size", "big")}, "--size must be WxH"),
        (lambda s: {"more": ("--atlas", "63")}, "resolution must be even"),
        (lambda s: {"more": ("--atlas", "16384000")}, "resolution must be even and in 16"),
        (lambda s: {"more": ("--interval", "-1")}, "interval must be a whole number"),
        (lambda s: {"more": ("--policy", "sometimes")}, "policy must be one of every, fixed, staggered, adaptive"),
        (lambda s: {"more": ("--budget", "much")}, "--budget must be evaluations, as 250k, or milliseconds"),
        (lambda s: {"more": ("--budget", "9k", "--target-flip", "0.1")}, "budget and target_flip exclude each other"),
        (lambda s: {"more": ("--policy", "fixed", "--budget", "9k")}, "fixed keeps no budget; use the policy"),
        (lambda s: {"more": ("--share", "0.1")}, "share takes two eyes"),
        (lambda s: {"more": ("--resident", "100")}, "resident must be a multiple of 8"),
        (lambda s: {"more": ("--policy", "fixed", "--carry")}, "carry goes with every, staggered and adaptive"),
        (lambda s: {"more": ("--lights", "99")}, "lights must be 1 to 16"),
        (lambda s: {"more": ("--lights", s / "none.json")}, "none.json"),
        (lambda s: {"more": ("--camera", s / "none.json")}, "none.json"),
        (lambda s: {"more": ("--no-skip", "hidden")}, "no-skip must be among"),
        (lambda s: {"more": ("--background", "red")}, "background must be one value or R,G,B"),
        (lambda s: {"more": ("--animation", "Run")}, "no animation named 'Run'"),
        (lambda s: {"more": ("--device", "abacus")}, "abacus"),
        (lambda s: {"more": ("--tonemap", "rainbow")}, "operator must be one of"),
        (lambda s: {"more": ("--exposure", "nan")}, "exposure must be between"),
        (lambda s: {"more": ("--size", "8x8", "--reference")}, "at least 11x11 pixels"),
        (lambda s: {"out": s / "tetra.npz"}, "tetra.npz"),
    ],
)
def test_a_mistake_is_one_line(run, scene, change, message):
    code, stdout, stderr = run(*_bad(scene, **change(scene)))
    assert code == (2 if message in WRITTEN_WRONG else 1)
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert stderr.startswith("neumat: ")
    assert not list(scene.glob("bad/**/*.png")), "nothing may be rendered before every option is understood"


def test_bad_meshes_are_one_line(run, scene):
    points = np.zeros((1, 4, 3), np.float32)
    points[0, 1:] = np.eye(3)
    for name, broken, message in (
        ("index", {"points": points, "faces": [[0, 1, 9]]}, "9"),
        ("nan", {"points": np.where(points == 1, np.nan, points), "faces": [[0, 1, 2]]}, "NaN or Inf vertices"),
        ("empty", {"points": points, "faces": np.zeros((0, 3), int)}, ""),
    ):
        np.savez(scene / f"{name}.npz", **broken)
        code, _, stderr = run(*_bad(scene, sequence=scene / f"{name}.npz"))
        assert code == 1, name
        assert f"{name}.npz" in stderr
        assert message in stderr
        assert len(stderr.strip().splitlines()) == 1


def test_a_wrong_option_is_exit_code_2(run):
    for arguments in (["render", "--no-such-option"], ["paint"], ["render", "x.glb"], ["info"]):
        code, _, stderr = run(*arguments)
        assert code == 2, arguments
        assert len(stderr.strip().splitlines()) == 1, stderr
        assert "see neumat --help" in stderr


def test_unwritable_folder_is_one_line(run, scene):
    (scene / "shut").mkdir()
    (scene / "shut").chmod(0o500)
    if os.access(scene / "shut", os.W_OK):  # root may write anywhere: use a folder below a file instead
        target = scene / "tetra.npz" / "out"
    else:
        target = scene / "shut" / "out"
    code, _, stderr = run(*_bad(scene, out=target))
    assert code == 1
    assert len(stderr.strip().splitlines()) == 1


def test_help_is_quick_and_names_the_commands():
    done = subprocess.run([sys.executable, "-m", "warp_neumat", "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    for command in ("decode", "demo", "eval", "export", "fit", "info", "render"):
        assert command in done.stdout
