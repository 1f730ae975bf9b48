"""The BCf bench around the fit: filters, choices, files that are used again, means; the fit itself is replaced."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("quicktex")
pytest.importorskip("skimage")
pytest.importorskip("flip_evaluator")

from bench import _bcf_lab, bcf  # noqa: E402
from warp_neumat.io.texture_set import open_texture_set  # noqa: E402


@pytest.fixture
def fits(monkeypatch):
    """Replace fit and asset by grey maps whose size says how often it was fitted; the list holds what was asked for."""
    asked = []

    def fit(source, out, *, model, preset, steps, seed, resume, device, **config):
        opened = open_texture_set(source)
        asked.append({"size": (opened.width, opened.height), "preset": preset, "steps": steps, **config})
        out.write_text(f"{len(opened.channels)} {len(asked)}")
        return {"training": {"seconds": 1.5}}

    def load(path, device):
        channels, count = map(int, path.read_text().split())
        grey = np.full(channels, 0.5, np.float32)
        return SimpleNamespace(bytes=count, encoded=lambda uv, lod: np.tile(grey, (len(uv), 1)))

    monkeypatch.setattr("warp_neumat.training.fit.fit", fit)
    monkeypatch.setattr("warp_neumat.materials.load", load)
    return asked


@pytest.fixture
def source(tmp_path):
    return str(_bcf_lab.synthetic_set(tmp_path / "maps", 48))


def test_filters_are_trilinear_and_cubic(rng):
    mips = [rng.random((8, 12, 2)).astype(np.float32), rng.random((4, 6, 2)).astype(np.float32)]
    for taps in (bcf.linear_taps, bcf.cubic_taps):
        np.testing.assert_allclose(bcf.filtered(mips, 8, 12, 0.0, taps), mips[0], atol=1e-6)
        np.testing.assert_allclose(bcf.filtered(mips, 4, 6, 1.0, taps), mips[1], atol=1e-6)
        np.testing.assert_allclose(bcf.filtered(mips, 4, 6, 7.0, taps), mips[1], atol=1e-6)
        total = sum(taps(np.linspace(0, 0.99, 9)))
        np.testing.assert_allclose(total, 1, atol=1e-12)
    got = bcf.filtered(mips, 4, 6, 0.25, bcf.linear_taps)
    middle = mips[0].reshape(4, 2, 6, 2, 2).mean(axis=(1, 3))  # a coarse centre lies between four texels
    np.testing.assert_allclose(got, 0.75 * middle + 0.25 * mips[1], atol=1e-6)


def test_cubic_taps_are_torchs(rng):
    torch = pytest.importorskip("torch")
    mip = rng.random((8, 8, 1)).astype(np.float32)
    got = bcf.filtered([mip], 13, 13, 0.0, bcf.cubic_taps)
    grid = torch.nn.functional.pad(torch.from_numpy(mip[None, ..., 0])[None], (8, 8, 8, 8), mode="circular")
    at = (torch.arange(13, dtype=torch.float32) + 0.5) / 13 * 8  # texels of the middle copy
    where = (at + 8) / 24 * 2 - 1
    places = torch.stack(torch.meshgrid(where, where, indexing="xy"), dim=-1)[None]
    expected = torch.nn.functional.grid_sample(grid, places, mode="bicubic", align_corners=False)
    np.testing.assert_allclose(got[..., 0], expected[0, 0].numpy(), atol=2e-5)


def test_all_tables_from_few_fits(tmp_path, source, fits, monkeypatch):
    monkeypatch.setattr(bcf, "OPTIONS", dict(list(bcf.OPTIONS.items())[:2]))
    monkeypatch.setattr(bcf, "QUANTISED", dict(list(bcf.QUANTISED.items())[:1]))
    choice = {
        "sets": (source,),
        "presets": ("BCf-1k", "BCf-2k++"),
        "baselines": ("bc_half", "bc_full"),
        "crop": 32,
        "steps": 7,
        "only": bcf.TABLES,
        "out": tmp_path / "out",
    }
    rows = list(bcf.rows(device="cpu", quick=False, **choice))
    assert {row["table"] for row in rows} == set(bcf.TABLES)
    json.dumps(rows, allow_nan=False)
    first = fits[0]
    assert first == {"size": (32, 32), "preset": "1k", "steps": 7}
    assert fits[1]["preset"] == "2k++"
    # Two presets and the options that differ from the default, nothing twice; quantised ones are not fits.
    assert len(fits) == 2 + len(bcf.OPTIONS) - 1
    assert {"figure8.png", "figure10.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
    table = {(row["set"], row["method"]): row for row in rows if row["table"] == "table2"}
    assert table["mean", "bc_half"]["gain"] == 0
    assert table["maps", "bc_full"]["gain"] > 0 > table["maps", "BCf-1k"]["gain"]
    assert table["mean", "bc_full"]["psnr"] == pytest.approx(table["maps", "bc_full"]["psnr"])
    curve = [row for row in rows if row["table"] == "figure10" and row["method"] == "bc_full"]
    assert [row["scale"] for row in curve] == [0.25 * k for k in range(12)]
    assert curve[0]["psnr"] == pytest.approx(table["maps", "bc_full"]["psnr_mip0"])
    again = list(bcf.rows(device="cpu", quick=False, **{**choice, "only": ("table2",)}))
    assert len(fits) == 2 + len(bcf.OPTIONS) - 1
    assert [row["psnr"] for row in again] == [row["psnr"] for row in rows if row["table"] == "table2"]


def test_options_are_fields_of_the_model(source):
    pytest.importorskip("torch")
    from warp_neumat.models.bcf import configure

    opened = open_texture_set(source)
    defaults = configure(opened, {})
    for name, options in bcf.OPTIONS.items():
        assert (configure(opened, options) == defaults) == (name == "defaults"), name


def test_mean_psnr_is_that_of_the_mean_error():
    assert _bcf_lab._mean("psnr", [20.0, 40.0]) == pytest.approx(-10 * math.log10((1e-2 + 1e-4) / 2))
    assert _bcf_lab._mean("psnr", [None, 20.0]) == pytest.approx(-10 * math.log10(0.5e-2))
    assert _bcf_lab._mean("psnr", [None, None]) is None
    assert _bcf_lab._mean("ssim", [None, 0.5]) == 0.5


def test_unknown_choices_are_named(tmp_path, capsys):
    with pytest.raises(ValueError, match="only must be among table2, .*, got 'table9'"):
        list(bcf.rows(device="cpu", quick=False, only=("table9",), out=tmp_path))
    assert bcf.main(["--only", "table9", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("bench: only must be among")
