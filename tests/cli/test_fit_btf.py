"""`neumat fit`, `eval`, `info` and `render` of bidirectional texture functions, and what users get wrong about them."""

import json

import numpy as np
import pytest

pytest.importorskip("torch")

from tests.fake_assets import fake_bcf, random_btf, random_neubrdf  # noqa: E402
from warp_neumat.io.asset import read_asset, write_asset  # noqa: E402
from warp_neumat.io.image import read_image  # noqa: E402
from warp_neumat.simulation.height_fields import PATTERNS  # noqa: E402

SPEC = "microgeometry:weave?size=16&directions=ubo2003&bounces=0"
TINY = ("--option", "teacher_hidden=32,32", "--option", "epochs=2", "--option", "mips=2", "--option", "batch=256")


@pytest.fixture
def asset(tmp_path):
    """An asset of random contents with the size of the source, as if it had been fitted to it."""
    tensors, header = random_btf(np.random.default_rng(3), width=16, height=16)
    header |= {
        "source": {"spec": SPEC, "name": SPEC, "notes": ["simulated, with love"], "opening": {"spec": SPEC}},
        "training": {"steps": 5, "test_l1": [0.5, 0.25], "teacher": {"file": "t.neumat", "l1": 0.125}},
        "metrics": {"l1": 0.25, "levels": [0.25, 0.5], "weights": 779},
    }
    write_asset(tmp_path / "random.neumat", tensors, header)
    return tmp_path / "random.neumat"


# --- what works -------------------------------------------------------------------------------------------------------


def test_a_weave_is_fitted_measured_and_shown(run, tmp_path):
    out = tmp_path / "weave.neumat"
    code, stdout, stderr = run("fit", SPEC, "-o", out, "--steps", "30", *TINY)
    assert code == 0, stderr
    lines = stdout.splitlines()
    assert lines[0].startswith("note: simulated: 4 rays a texel")
    assert "16×16 texels, 81 lights × 81 views" in lines[1]
    assert "weights 667" in lines[-1]
    header = read_asset(out)[1]
    assert header["training"]["teacher"]["file"].startswith("teacher-")
    code, stdout, stderr = run("eval", out, "--against", SPEC, "--json", "-")
    assert code == 0, stderr
    record = json.loads(stdout)
    assert set(record) == {"kind", "bytes", "weights", "l1", "l1_relative", "levels"}
    assert (record["kind"], record["weights"], len(record["levels"])) == ("btf", 667, 2)
    for name in ("bytes", "l1", "l1_relative"):
        assert record[name] == pytest.approx(header["metrics"][name], rel=1e-6)
    # The teacher is kept: a second student says so, and gives the same file but for that.
    code, stdout, stderr = run("fit", SPEC, "-o", tmp_path / "b.neumat", "--steps", "30", *TINY)
    assert code == 0, stderr
    tensors, second = read_asset(tmp_path / "b.neumat")
    assert second["training"]["teacher"]["file"] == header["training"]["teacher"]["file"]
    for name, tensor in read_asset(out)[0].items():
        np.testing.assert_array_equal(tensors[name], tensor)


def test_options_choose_another_variant(run, tmp_path):
    out = tmp_path / "a.neumat"
    code, stdout, stderr = run(
        "fit", SPEC, "-o", out, "--model", "btf", "--steps", "2", "--features", "half", "--option", "variant=neumip",
        "--option", "mips=1", "--option", "epochs=1", "--preset", "quick",
    )  # fmt: skip
    assert code == 0, stderr
    assert "weights 3278" in stdout
    header = read_asset(out)[1]
    assert header["config"]["coarse"] is None
    assert header["config"]["fine"] == {"channels": 14, "hidden": [25] * 5}
    assert "teacher" not in header["training"]
    code, stdout, _ = run("eval", out, "--against", SPEC, "--json", "-")
    assert "levels" not in json.loads(stdout)  # there is one


def test_eval_prints_levels_and_writes_a_picture(run, asset, tmp_path):
    picture = tmp_path / "sheet.png"
    code, stdout, stderr = run("eval", asset, "--against", SPEC, "--picture", picture)
    assert code == 0, stderr
    lines = stdout.splitlines()
    assert lines[0].startswith(f"{asset}: bytes ")
    assert [line.partition(":")[0] for line in lines[1:]] == ["level 0", "level 1", "level 2"]
    assert read_image(picture)[0].shape == (3 * 16 + 8 + 81, 3 * 81 + 2 * 4, 3)


def test_info_shows_networks_and_textures(run, asset):
    code, stdout, _ = run("info", asset)
    assert code == 0
    tensors = read_asset(asset)[0]
    size = sum(t.nbytes for t in tensors.values())
    lines = stdout.splitlines()
    assert lines[0] == f"{asset}: btf version 1, {size} bytes"
    assert lines[1] == f"  material: 16×16, 3 mips, {8 * size / 256:.4g} bit/texel"
    features = sum(t.nbytes for name, t in tensors.items() if name.startswith("coarse.mip"))
    assert lines[2].startswith("  coarse: 23→8→8→8→8, 408 weights, 816 bytes; 14 features a texel, half, ")
    assert lines[2].endswith(f"{features} bytes")
    assert lines[3].startswith("  fine: 24→8→8→8→3, 371 weights, 742 bytes; 16 features a texel, half, ")
    assert lines[4] == f"  source: {SPEC}"
    assert "  teacher: file t.neumat, l1 0.125" in lines
    assert "  test l1: 0.5 → 0.25 [1/sr] in 2 epochs" in lines
    assert "  metrics.levels: 0.25, 0.5" in lines
    assert lines[-1] == "  note: simulated, with love"
    record = json.loads(run("info", asset, "--json", "-")[1])
    assert record["tensors"]["fine.mip0"] == {"dtype": "float16", "shape": [16, 16, 16], "bytes": 8192}


@pytest.mark.parametrize(
    ("shape", "networks"),
    [
        ({"coarse": None, "fine": 14, "hidden": (25,) * 5, "mips": 1}, ["fine: 23→25→25→25→25→25→3, 3278 weights"]),
        (
            {"features": "bc6h", "half_vector": False},
            ["coarse: 20→8→8→8→8, 384 weights, 768 bytes; 14 features a texel, bc6h", "fine: 24→8→8→8→3, 371 weights"],
        ),
    ],
)
def test_info_of_other_shapes(run, tmp_path, shape, networks):
    tensors, header = random_btf(np.random.default_rng(3), **shape)
    write_asset(tmp_path / "a.neumat", tensors, header)
    lines = run("info", tmp_path / "a.neumat")[1].splitlines()[2:]
    assert len(lines) == len(networks)
    assert all(line.strip().startswith(start) for line, start in zip(lines, networks, strict=True))
    stored = sum(int(line.rsplit(", ", 1)[1].split()[0]) for line in lines)
    assert stored == sum(t.nbytes for name, t in tensors.items() if ".mip" in name)


def test_a_mesh_is_rendered_with_a_btf(run, asset, tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]], np.float32)
    np.savez(tmp_path / "tetra.npz", points=points[None], faces=faces, uv=uv)
    shot = ("-m", f"*={asset}", "-o", tmp_path / "out", "--size", "64x48", "--atlas", "64", "--lights", "1")
    code, stdout, stderr = run("render", tmp_path / "tetra.npz", *shot, "--reference")
    assert code == 0, stderr
    assert read_image(tmp_path / "out" / "frames" / "0000.png")[0].max() > 0.2
    np.savez(tmp_path / "bare.npz", points=points[None], faces=faces)
    code, _, stderr = run("render", tmp_path / "bare.npz", *shot)
    assert code == 1
    assert "has no texture coordinates" in stderr
    assert len(stderr.strip().splitlines()) == 1


def test_help_names_the_patterns_and_files(run):
    code, stdout, _ = run("fit", "--help")
    assert code == 0
    text = " ".join(stdout.split())
    for name in (*PATTERNS, "UBO2014 .btf", "UBO2003 .zip", "microgeometry:", "bcf, ntbc, neubrdf or btf"):
        assert name in text, name


# --- mistakes ---------------------------------------------------------------------------------------------------------


def option(text):
    return (SPEC, "-o", "a.neumat", "--option", text)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("microgeometry:wave", "-o", "a.neumat"), 1, "no pattern 'wave'; nearest: weave"),
        (("microgeometry:", "-o", "a.neumat"), 1, "no pattern ''; known: carpet, leather, stone, weave, wood"),
        (("microgeometry:weave?sise=16", "-o", "a.neumat"), 1, "weave has no parameter 'sise'; nearest: size"),
        (("microgeometry:weave?size=big", "-o", "a.neumat"), 1, "size must be a number"),
        (("microgeometry:weave?size=4", "-o", "a.neumat"), 1, "size must be a whole number in [16, 1024]"),
        (("microgeometry:wood?directions=ubo", "-o", "a.neumat"), 1, "directions must be one of ubo2014, ubo2003"),
        (("missing.btf", "-o", "a.neumat"), 1, "missing.btf: no such file or folder; a BTF is FILE.btf"),
        (("bad.btf", "-o", "a.neumat"), 1, "bad.btf: signature: "),
        (("bad.btf?gain=2", "-o", "a.neumat"), 1, "no option 'gain' here"),
        (("bad.zip", "-o", "a.neumat"), 1, "bad.zip: archive: is no zip file"),
        (("analytic:ggx", "-o", "a.neumat", "--model", "btf"), 1, "a BTF is FILE.btf (UBO2014), FILE.zip"),
        ((".", "-o", "a.neumat", "--model", "btf"), 1, "not a BTF; known: FILE.btf"),
        ((SPEC, "-o", "a.neumat", "--model", "neubrdf"), 2, "which is for model btf, not neubrdf"),
        ((SPEC, "-o", "a.neumat", "--model", "bcf"), 2, "is a bidirectional texture function, which is for model btf"),
        ((SPEC, "-o", "a.neumat", "--model", "btff"), 2, "--model must be one of neubrdf, bcf, btf"),
        ((SPEC, "--shared", "x"), 2, "which is for model btf, not neubrdf"),
        ((SPEC, "-o", "a.neumat", "--crop", "0,0,4,4"), 2, "--crop is for model bcf or ntbc, not btf"),
        ((SPEC, "-o", "a.neumat", "--bytes", "4000"), 2, "--bytes is for model bcf or ntbc, not btf"),
        ((SPEC, "-o", "a.neumat", "--reciprocal"), 2, "--reciprocal is for model neubrdf, not btf"),
        ((SPEC, "-o", "a.neumat", "--features", "16"), 2, "--features must be one of half, bc6h, got '16'"),
        ((SPEC, "-o", "a.neumat", "--preset", "1k"), 2, "--preset must be one of quick, standard, fine"),
        ((SPEC, "-o", "a.btf"), 2, "-o must end in .neumat"),
        ((SPEC, "-o", "none/a.neumat"), 1, "there is no folder"),
        (option("width=64"), 2, "--option width: a btf has the size of its source"),
        (option("mips=9"), 1, "mips must be a whole number in [0, 5], got 9"),
        (option("channels=many"), 1, "channels must be a whole number in [1, 64], got 'many'"),
        (option("hidden=8.5,8"), 1, "hidden must be 1 to 8 widths from 1 to 256"),
        (option("variant=neumipp"), 1, "variant must be one of coarse-to-fine"),
        (option("lambda3=1"), 1, "btf has no option 'lambda3'; nearest: lambda2"),
        (option("sigma=much"), 1, "sigma must be a number of at least 0"),
        (option("schedule=linear"), 1, "schedule must be one of cosine, plateau"),
        (option("half_vector=maybe"), 1, "half_vector must be true or false"),
        (option("batch=100"), 1, "batch must be a multiple of 64"),
        (option("lr=fast"), 1, "lr"),
        (option("teacher=missing.neumat"), 1, "missing.neumat: no such file"),
        (option("teacher=bad.btf"), 1, "bad.btf: file: truncated or no safetensors file"),
        (option("teacher=metal.neumat"), 1, "a teacher must be of kind btf, got neubrdf"),
    ],
)
def test_mistakes_of_a_fit_are_one_line(run, tmp_path, monkeypatch, rng, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    for name in ("bad.btf", "bad.zip"):
        (tmp_path / name).write_text("x")
    write_asset(tmp_path / "metal.neumat", *random_neubrdf(rng))
    found, _, stderr = run("fit", *arguments, "--steps", "1")
    assert message in stderr
    assert found == code
    assert stderr.startswith("neumat: ")
    assert len(stderr.strip().splitlines()) == 1
    assert not (tmp_path / "a.neumat").exists()


def test_resume_without_a_checkpoint_says_so_and_begins(run, tmp_path):
    code, stdout, stderr = run(
        "fit", SPEC, "-o", tmp_path / "a.neumat", "--steps", "1", "--resume", "--option", "variant=neumip",
        "--option", "epochs=1", "--option", "mips=1",
    )  # fmt: skip
    assert code == 0, stderr
    assert "a.neumat.checkpoint: no such checkpoint to resume; starting anew" in stdout


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("eval", "random.neumat", "--against", "analytic:ggx"), 1, "a BTF is FILE.btf"),
        (("eval", "random.neumat", "--against", "microgeometry:wool"), 1, "no pattern 'wool'"),
        (
            ("eval", "random.neumat", "--against", "microgeometry:weave?size=24"),
            1,
            "24×24 texels, and random was fitted",
        ),
        (("eval", "random.neumat", "--against", SPEC, "--no-baselines"), 2, "--baselines are for a bcf"),
        (("eval", "random.neumat", "--against", SPEC, "--picture", "a.jpg"), 2, "--picture must end in .png"),
        (("eval", "metal.neumat", "--against", SPEC), 2, "is a bidirectional texture function, and metal.neumat"),
        (("eval", "maps.neumat", "--against", SPEC), 2, "is of kind bcf"),
        (("eval", "missing.neumat", "--against", SPEC), 1, "missing.neumat: no such file"),
        (("decode", "random.neumat", "-o", "maps"), 1, "kind 'btf' has no maps to decode"),
        (("export", "random.neumat", "-o", "engine"), 1, "'btf' has no textures to export"),
        (("render", "none.glb", "-m", "*=random.neumat", "-o", "out"), 1, "none.glb: no such file"),
    ],
)
def test_mistakes_with_an_asset_are_one_line(run, asset, tmp_path, monkeypatch, rng, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    write_asset(tmp_path / "metal.neumat", *random_neubrdf(rng))
    fake_bcf(tmp_path / "maps.neumat", size=16, features=(8, 4, 4, 4))
    before = set(tmp_path.iterdir())
    found, _, stderr = run(*arguments)
    assert message in stderr
    assert found == code
    assert len(stderr.strip().splitlines()) == 1
    assert set(tmp_path.iterdir()) - before <= {tmp_path / "cache"}
