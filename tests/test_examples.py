"""Every example runs and shows what it says."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples"


def _load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "cache"))


def test_render_sequence_writes_pictures(tmp_path, capsys):
    stats = _load("render_sequence").main(["--frames", "3", "--atlas", "128", "--out", str(tmp_path / "out")])
    assert len(list((tmp_path / "out").glob("*.png"))) == 3
    assert stats[0]["evaluations"] > stats[1]["evaluations"] > 0
    assert "frame 2:" in capsys.readouterr().out


def test_evaluate_material_prints_a_metal(capsys):
    values = _load("evaluate_material").main([])
    assert np.isfinite(values).all()
    assert values[0, 0] > values[0, 2] > 0  # bronze: red reflects more than blue
    assert "degrees" in capsys.readouterr().out


def test_fit_textures_fits_and_exports(tmp_path, capsys):
    pytest.importorskip("torch")
    header = _load("fit_textures").main(["--steps", "200", "--out", str(tmp_path / "out")])
    assert header["metrics"]["psnr"] > 18
    assert (tmp_path / "out" / "engine" / "tile_features0.dds").is_file()
    printed = capsys.readouterr().out
    assert "6 channels to learn" in printed
    assert "mip 2.5:" in printed


def test_every_example_is_tested():
    assert {f.stem for f in FOLDER.glob("*.py")} == {"render_sequence", "evaluate_material", "fit_textures"}
