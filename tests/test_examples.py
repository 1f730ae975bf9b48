"""Every example runs and shows what it says."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import warp_neumat as nm
from warp_neumat.pipeline import demo
from warp_neumat.training import furnace

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


def _sphere_by_quadrature(example, material, size, inner=5, across=12):
    """The example's scene without Mitsuba: rays through ``inner``² places of a pixel, ``across``² of the light."""
    half = np.tan(np.radians(example.CAMERA["fov"] / 2))
    axis = ((np.arange(size * inner) + 0.5) / (size * inner) * 2 - 1) * half
    x, y = np.meshgrid(axis, -axis)
    ray = np.stack([x, y, -np.ones_like(x)], -1).reshape(-1, 3)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    origin = np.array([0, 0, example.CAMERA["distance"]])
    along = -ray @ origin
    root = along**2 - (origin @ origin - 1)
    hit = root > 0
    normal = origin + (along - np.sqrt(np.maximum(root, 0)))[:, None] * ray
    normal, view = normal[hit], -ray[hit]
    tangent = np.cross([0.0, 1.0, 0.0], normal)  # the material is isotropic: any will do
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], 1)

    wo = np.einsum("nij,nj->ni", frame, view).astype(np.float32)
    angles = np.radians(np.linspace(0, 89.9, 80))
    table = furnace.albedo(material.brdf, angles)
    theta = np.arccos(np.clip(wo[:, 2], 0, 1))
    colour = example.SKY * np.stack([np.interp(theta, angles, column) for column in table.T], 1)

    centre, side = np.array(example.LIGHT["centre"]), example.LIGHT["half"]
    facing = -centre / np.linalg.norm(centre)
    left = np.cross([0.0, 1.0, 0.0], facing)
    left /= np.linalg.norm(left)
    up = np.cross(facing, left)
    cell = (2 * side / across) ** 2
    for a in (np.arange(across) + 0.5) / across * 2 - 1:
        for b in (np.arange(across) + 0.5) / across * 2 - 1:
            to_light = centre + side * (a * left + b * up) - normal
            square = (to_light**2).sum(1)
            to_light /= np.sqrt(square)[:, None]
            solid = cell * np.maximum(-to_light @ facing, 0) / square
            wi = np.einsum("nij,nj->ni", frame, to_light).astype(np.float32)
            # The light hides the sky behind it.
            colour += (example.LIGHT["radiance"] - example.SKY) * solid[:, None] * material.eval(None, wi, wo)
    picture = np.full((len(ray), 3), example.SKY)
    picture[hit] = colour
    return picture.reshape(size, inner, size, inner, 3).mean((1, 3))


def test_mitsuba_bsdf_renders_what_quadrature_gives(tmp_path, capsys):
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    example, size, runs = _load("mitsuba_bsdf"), 10, 8
    asset = demo.material_paths()["knot"]
    first = example.main([str(asset), "--size", "8", "--spp", "1", "--out", str(tmp_path / "sphere.png")])
    assert first.shape == (8, 8, 3)
    assert (tmp_path / "sphere.png").stat().st_size > 100
    assert "mean radiance" in capsys.readouterr().out

    variant = example.best_variant()
    pictures = [example.render(asset, size=size, spp=6, seed=1 + n, variant=variant) for n in range(runs)]
    want = _sphere_by_quadrature(example, nm.load(asset), size)
    sky = np.isclose(want, example.SKY, atol=1e-6).all(-1)
    mean, error = np.mean(pictures, 0), np.std(pictures, 0, ddof=1) / np.sqrt(runs)
    assert (~sky).sum() > 50
    # 1 % is the quadrature's own error, at the sphere's edge. Student's t of 7 degrees of freedom: median 0.71.
    deviations = np.abs(mean - want) / np.hypot(error, 0.01 * want)
    assert deviations.max() < 8
    assert np.median(deviations[~sky]) < 1.0
    assert mean[~sky].mean(0) == pytest.approx(want[~sky].mean(0), rel=0.03)


def test_every_example_is_tested():
    tested = {"render_sequence", "evaluate_material", "fit_textures", "mitsuba_bsdf"}
    assert {f.stem for f in FOLDER.glob("*.py")} == tested
