"""`neumat fit` of reflectance functions: options, many materials at once, mistakes in one line."""

import json

import numpy as np
import pytest

pytest.importorskip("torch")

from warp_neumat.io.asset import read_asset
from warp_neumat.io.brdf import open_brdf
from warp_neumat.io.brdf_samples import write_samples
from warp_neumat.io.brdf_set import open_brdfs
from warp_neumat.training.samplers import measured_directions

SMALL = ("--option", "nside=4", "--option", "bits=6", "--features", "8", "--option", "hidden=16,16")
TINY = ("--steps", "64", *SMALL)


def test_sparse_samples_become_a_pruned_reciprocal_asset(run, tmp_path):
    source = open_brdf("analytic:ggx?roughness=0.5&f0=0.9&anisotropy=0.5")
    wi, wo = measured_directions(60, np.random.default_rng(0))
    write_samples(tmp_path / "few.csv", wi, wo, source.eval(wi, wo))
    out = tmp_path / "few.neumat"
    code, stdout, stderr = run("fit", tmp_path / "few.csv", "-o", out, "--reciprocal", *TINY)
    assert code == 0, stderr
    assert "mae" in stdout
    tensors, header = read_asset(out)
    assert header["config"]["symmetry"] == "reciprocal"
    assert "live" in tensors
    assert header["training"]["points_live"] < 0.8 * header["training"]["points"]
    code, stdout, stderr = run("eval", out, "--against", tmp_path / "few.csv", "--json", "-")
    assert code == 0, stderr
    record = json.loads(stdout)
    assert record["reciprocity"] < 0.01
    assert record["albedo_max"] > 0
    assert record["albedo_max_source"] > 0


def test_shared_fits_many_and_then_adds_one(run, tmp_path, monkeypatch):
    monkeypatch.setattr("warp_neumat.models.neubrdf.DEFAULT_STEPS", 100)
    folder = tmp_path / "measured"
    folder.mkdir()
    for name, albedo in (("red", "0.8,0.1,0.1"), ("blue", "0.1,0.1,0.8")):
        source = open_brdf(f"analytic:lambert?albedo={albedo}")
        wi, wo = measured_directions(400, np.random.default_rng(0))
        write_samples(folder / f"{name}.csv", wi, wo, source.eval(wi, wo), isotropic=True)
    out = tmp_path / "group"
    code, stdout, stderr = run("fit", folder, "--shared", out, "--preset", "quick", *SMALL)
    assert code == 0, stderr
    assert "note: red: " in stdout
    assert "group-0.neumat: blue, red" in stdout
    assert "red.neumat: group-0.neumat, bytes" in stdout
    header = read_asset(out / "red.neumat")[1]
    assert header["training"]["steps"] == 42  # 100 · 0.3 · √2
    spec = header["source"]["spec"]
    assert spec == str(folder / "red.csv")
    code, stdout, stderr = run("eval", out / "red.neumat", "--against", spec, "--json", "-")
    assert code == 0, stderr
    assert json.loads(stdout)["bytes"] == header["metrics"]["bytes"]
    assert json.loads(stdout)["mae"] == pytest.approx(header["metrics"]["mae"], rel=0.01)
    code, stdout, stderr = run("info", out / "red.neumat")
    assert "group.file: group-0.neumat" in stdout
    code, stdout, stderr = run("fit", "analytic:lambert?albedo=0.5", "--shared", out, "--steps", "64")
    assert code == 0, stderr
    assert "lambert: joins group-0.neumat, as" in stdout
    assert read_asset(out / "lambert.neumat")[1]["metrics"]["sharers"] == 3
    code, stdout, stderr = run("eval", out / "lambert.neumat", "--against", "analytic:lambert", "--json", "-")
    assert code == 0, stderr
    record = json.loads(stdout)
    assert record["bytes"] == record["bytes_own"] + record["bytes_shared"]
    assert record["sharers"] == 3
    code, stdout, stderr = run("fit", "analytic:lambert?albedo=0.4", "--shared", out, "--groups", "2")
    assert code == 1
    assert "lambert.neumat: is there already" in stderr
    code, stdout, stderr = run("fit", "analytic:ggx", "--shared", out, "--groups", "2")
    assert code == 1
    assert stderr.strip().endswith("materials join the groups that are there; leave out groups, or use an empty folder")


def test_a_pattern_names_many_functions(data):
    found = open_brdfs(f"{data}/brdf/merl80_nbrdf.npz:gold*")
    assert set(found) >= {"gold-metallic-paint", "gold-paint"}
    assert all(opened.source.isotropic for opened in found.values())
    assert found["gold-paint"].spec == f"{data}/brdf/merl80_nbrdf.npz:gold-paint"
    assert len(open_brdfs(f"{data}/brdf/merl80_nbrdf.npz")) == 80


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("analytic:ggx",), 2, "give either -o FILE.neumat, or --shared DIR"),
        (("analytic:ggx", "-o", "a.neumat", "--shared", "x"), 2, "give either -o FILE.neumat, or --shared DIR"),
        (("analytic:ggx", "-o", "a.neumat", "--groups", "2"), 2, "--groups is for --shared"),
        (("analytic:ggx", "-o", "a.neumat", "--option", "frame=hlaf"), 1, "frame must be one of absolute"),
        (("analytic:ggx", "-o", "a.neumat", "--reciprocal", "--option", "frame=absolute"), 1, "needs frame half"),
        (("analytic:ggx", "-o", "a.neumat", "--option", "hidden=20,20"), 1, "hidden must be 1 to 4 multiples of 8"),
        (("missing.binary", "-o", "a.neumat", "--model", "neubrdf"), 1, "missing.binary: no such file"),
        (("what.exr", "-o", "a.neumat", "--model", "neubrdf"), 1, "is no BRDF source; use FILE.npz:NAME"),
        ((".", "--shared", "x"), 1, "the folder holds no .binary, .bsdf, .csv file"),
        (("analytic:ggx", "--shared", "file"), 1, "file: is a file; give a folder"),
        (("analytic:ggx", "--shared", "x", "--option", "storage=raw"), 2, "storage=raw is for comparison"),
        (("analytic:ggx", "--shared", "x", "--option", "texture=8,8,4"), 1, "texture is for what varies"),
    ],
)
def test_mistakes_are_one_line(run, tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    got, stdout, stderr = run("fit", *arguments)
    assert got == code
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert not list(tmp_path.glob("*.neumat"))


def test_groups_are_fitted_on_the_cpu(run, tmp_path, monkeypatch):
    monkeypatch.setattr("warp_neumat.cli.assets.start_warp", lambda device: None)  # as if there were such a device
    code, stdout, stderr = run("fit", "analytic:ggx", "--shared", tmp_path / "x", "--device", "cuda:0")
    assert code == 1
    assert "run on the cpu, got device 'cuda:0'" in stderr
    assert not (tmp_path / "x").exists()
