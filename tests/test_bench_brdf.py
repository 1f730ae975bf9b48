"""The BRDF bench around the fit: means, misses, cache, pictures and grids; our fit itself is replaced."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("skimage")

from bench import _brdf_lab, _brdf_pixelations, brdf  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.kernels.pixelations import PIXELATIONS  # noqa: E402
from warp_neumat.training.samplers import measured_directions  # noqa: E402
from warp_neumat.training.sphere import render_sphere, sphere_error  # noqa: E402

GGX = "analytic:ggx?roughness=0.4&diffuse=0.2"
GREY = "analytic:lambert?albedo=0.3"


@pytest.fixture
def fits(monkeypatch):
    """Replace our fit by the source itself, brighter for wide networks and without a file for plain features."""
    asked = []

    def fit(source, out, *, model, steps, seed, device, **options):
        asked.append({"source": source, "steps": steps, "seed": seed, **options})
        if options.get("storage", "codebook") == "codebook":
            out.write_text(json.dumps({"source": source, "gain": 1.0 if "hidden" in options else 1.5}))
        metrics = {"mae": 0.001, "rmse": 0.002, "ssim": 0.999, "mse_raw": 0.25, "mse_log": 0.1, "bytes": 7}
        return {"config": {"frame": options.get("frame")}, "metrics": metrics, "training": {"seconds": 1.5}}

    def load(path, device):
        facts = json.loads(path.read_text())
        source = open_brdf(facts["source"])
        return SimpleNamespace(bytes=1000, brdf=lambda wi, wo: facts["gain"] * source.eval(wi, wo))

    def metrics(source, evaluate, *, size):
        """Return the figures of the sphere and, of the rest, what a few directions say."""
        error = sphere_error(render_sphere(evaluate, size), render_sphere(source.eval, size))
        wi, wo = measured_directions(2000, np.random.default_rng(0))
        found, true = evaluate(wi, wo), source.eval(wi, wo)
        raw = float(((found - true) ** 2).mean())
        return {**error, "mse_raw": raw, "mse_log": raw, "albedo_max": float(found.mean())}

    monkeypatch.setattr("warp_neumat.training.fit.fit", fit)  # first: its module takes the true metrics
    monkeypatch.setattr("warp_neumat.training.evaluate.brdf_metrics", metrics)
    monkeypatch.setattr("warp_neumat.materials.load", load)
    return asked


def rows(**choices):
    small = {"materials": (GGX, GREY), "methods": ("ggx", "absolute"), "steps": 5, "baseline_steps": 60, "size": 32}
    return list(brdf.rows(device="cpu", quick=False, **{**small, **choices}))


def test_table3_has_materials_means_and_misses(fits):
    found = rows(only=("table3",))
    json.dumps(found, allow_nan=False)
    assert [f["frame"] for f in fits] == ["absolute", "absolute"]
    table = {(row["material"], row["method"]): row for row in found if row["table"] == "table3"}
    mean = table["mean of 2", "absolute"]
    assert mean["mae"] == pytest.approx(np.mean([table[m, "absolute"]["mae"] for m in (GGX, GREY)]))
    assert mean["missed"] == [GGX, GREY]
    assert mean["misses"] == 2
    assert [row["material"] for row in found if row["table"] == "missed"] == [GGX, GREY]
    assert GREY not in table["mean of 2", "ggx"]["missed"]
    assert table[GGX, "absolute"]["mse_raw"] > 0.2 > table[GREY, "absolute"]["mse_raw"] > 1e-3
    assert table[GGX, "ggx"]["bytes"] == 28


def test_cache_goes_on_where_it_stopped(fits, tmp_path):
    cache = tmp_path / "deep" / "records.jsonl"
    first = rows(only=("table3",), cache=cache)
    assert len(fits) == 2
    lines = cache.read_text().splitlines()
    assert len(lines) == 4
    cache.write_text("\n".join(lines[:3]) + "\n" + lines[3][:40])  # killed while it wrote the fourth
    again = rows(only=("table3",), cache=cache)
    assert len(fits) == 3
    drop = [{k: v for k, v in row.items() if k != "seconds"} for row in first]
    assert [{k: v for k, v in row.items() if k != "seconds"} for row in again] == drop
    assert len(cache.read_text().splitlines()) == 4
    rows(only=("table3",), cache=cache, steps=6)  # another plan is another record
    assert len(fits) == 5
    cache.write_text("not one\n")
    with pytest.raises(ValueError, match="records.jsonl: line 1 is no record; delete the line or the file"):
        rows(only=("table3",), cache=cache)


def test_table4_and_figure8_from_few_fits(fits):
    found = rows(only=("table4", "figure8"), materials=(GREY,), frame="absolute")
    table = {row["method"]: row for row in found}
    assert table["codebook"]["bytes_factor"] == pytest.approx(0.0454, abs=1e-4)
    assert table["4 bit"]["bytes_factor"] == pytest.approx(0.25, abs=1e-3)
    assert table["plain features"]["mse_raw_factor"] == 1.0
    assert table["plain features"]["mse_raw"] == 0.25  # told by the fit: there is no file
    assert {row["axis"] for row in found if row["table"] == "figure8"} == set(brdf.AXES)
    assert table["width 64x64"]["mae"] < 1e-6 < table["bits 9"]["mae"]
    assert {f["frame"] for f in fits} == {"absolute", "half", "half-isotropic", "isotropic"}  # the last three: the axis
    assert len({json.dumps(f, sort_keys=True) for f in fits}) == len(fits)  # nothing twice


def test_picture_is_drawn_also_from_a_full_cache(fits, tmp_path):
    from warp_neumat.io.image import read_image

    choice = {"only": ("table3",), "cache": tmp_path / "c.jsonl", "baseline_steps": 3}
    rows(**choice)
    rows(**choice, picture=tmp_path / "sheet.png")
    assert len(fits) == 4
    drawn, _ = read_image(tmp_path / "sheet.png")
    assert drawn.shape[1] > 4 * 160
    assert drawn[..., :3].std() > 0.1
    with pytest.raises(ValueError, match="picture needs one of our methods"):
        rows(only=("table3",), methods=("ggx",), picture=tmp_path / "sheet.png")


def test_grids_differ_as_the_paper_says():
    found = {row["method"]: row for row in _brdf_pixelations.rows(device="cpu", pixels=4096, rounds=1, nside=32)}
    assert found["healpix"]["area_ratio"] < 1.5
    assert found["fibonacci"]["area_ratio"] < 1.5
    assert found["lonlat"]["area_ratio"] > 20
    assert 4 < found["sukharev"]["area_ratio"] < 6.5  # 3√3 for a cube seen from its centre
    assert [name for name, row in found.items() if row["hierarchy"]] == ["healpix", "lonlat", "sukharev"]
    assert [name for name, row in found.items() if row["iso_latitude"]] == ["healpix", "lonlat"]
    assert found["lonlat"]["spacing_ratio"] > 10 > 2 > found["fibonacci"]["spacing_ratio"]
    assert all(row["points"] == PIXELATIONS[name].points(32) for name, row in found.items())


def test_all_names_every_material_of_the_set(data, monkeypatch):
    monkeypatch.setenv("NEUMAT_DATA", str(data))
    for name, count in (("merl80", 80), ("rgl51", 51)):
        lab = _brdf_lab.Lab(_brdf_lab.Choice(set=name, materials=("all",)), "cpu")
        assert len(lab.materials) == count
        assert set(_brdf_lab.MATERIALS[name]) <= set(lab.materials)


def test_mistakes_are_one_line(capsys, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="only must be among table1, .*, got 'table2'"):
        rows(only=("table2",))
    assert brdf.main(["--set", "merl100"]) == 1
    assert capsys.readouterr().err == "bench: set must be one of merl80, rgl51, got 'merl100'\n"
    monkeypatch.setenv("NEUMAT_DATA", str(tmp_path))
    assert brdf.main(["--only", "table3", "--materials", "chrome"]) == 1
    assert "no such file; set NEUMAT_DATA" in capsys.readouterr().err
