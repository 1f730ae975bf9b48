"""Evaluation of maps: figures by hand, the reference's own filters as upper bound, records fit for JSON, pictures."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("skimage")
pytest.importorskip("flip_evaluator")

from warp_neumat import metrics  # noqa: E402
from warp_neumat.training import evaluate_maps  # noqa: E402
from warp_neumat.training.evaluate_maps import (  # noqa: E402
    check_match,
    compare,
    contact_sheet,
    eval_record,
    format_table,
    map_channels,
    map_metrics,
    sample_grid,
)

LAYOUT = [
    *(("base_color", c, "srgb", (0.0, 1.0)) for c in "rgb"),
    *(("normal", c, "normal", (0.0, 1.0)) for c in "xy"),
    ("roughness", "value", "linear", (0.0, 1.0)),
    ("displacement", "value", "linear", (0.25, 0.75)),
]


class Waves:
    """A texture set whose maps are known at every point; a mip is its value at that mip's texel centres."""

    def __init__(self, width=32, height=32, layout=LAYOUT):
        self.name, self.width, self.height = "waves", width, height
        self.channels = tuple(SimpleNamespace(map=m, component=c, encoding=e, range=r) for m, c, e, r in layout)
        self.constants = {"metallic": (0.0,)}

    def encoded(self, uv, lod):
        k = np.arange(len(self.channels))
        phase = 2 * math.pi * (uv[:, :1] * (1 + k % 3) + uv[:, 1:] * (1 + k % 2)) + k
        return (0.5 + 0.3 * np.sin(phase)).astype(np.float32)

    def mips(self):
        sizes = [(self.height, self.width)]
        while max(sizes[-1]) > 1:
            sizes.append(tuple(max(1, n // 2) for n in sizes[-1]))
        return [sample_grid(self.encoded, h, w, len(self.channels), m) for m, (h, w) in enumerate(sizes)]


def material(source, encoded=None, *, size=1000):
    """A material that answers like ``source``, or as ``encoded`` says."""
    channels = [{k: getattr(c, k) for k in ("map", "component", "encoding", "range")} for c in source.channels]
    config = {"width": source.width, "height": source.height, "wrap": "repeat"}
    return SimpleNamespace(
        kind="bcf", bytes=size, channels=channels, header={"config": config}, encoded=encoded or source.encoded
    )


def test_samples_lie_at_texel_centres_whatever_the_chunks(monkeypatch):
    seen = []

    def encoded(uv, lod):
        seen.append((len(uv), lod))
        assert uv.dtype == np.float32
        return uv * 8

    monkeypatch.setattr(evaluate_maps, "_CHUNK", 20)
    grid = sample_grid(encoded, 4, 8, 2, 1.5)
    assert seen == [(16, 1.5), (16, 1.5)]
    np.testing.assert_allclose(grid[..., 0], np.broadcast_to(np.arange(8) + 0.5, (4, 8)))
    np.testing.assert_allclose(grid[..., 1], np.broadcast_to((2 * np.arange(4) + 1)[:, None], (4, 8)))
    with pytest.raises(ValueError, match=r"encoded_fn must return shape \(16, 3\), got \(16, 2\)"):
        sample_grid(encoded, 4, 8, 3, 0.0)


def test_psnr_averages_errors_over_mips_and_channels():
    source = Waves(16, 16)
    offset = np.array([0.1, 0, 0, 0, 0, 0.2, 0], np.float32)
    record = map_metrics(source, lambda uv, lod: source.encoded(uv, lod) + offset * (lod == 0))
    squares = offset.astype(float) ** 2
    assert record["psnr_mip0"] == pytest.approx(-10 * math.log10(squares.mean()), abs=1e-4)
    assert record["psnr"] == pytest.approx(-10 * math.log10(squares.mean() / 5), abs=1e-4)  # 16, 8, 4, 2, 1
    texels = 256 + 64 + 16 + 4 + 1
    assert record["psnr_texels"] == pytest.approx(-10 * math.log10(squares.mean() * 256 / texels), abs=1e-4)
    assert [m["psnr"] is None for m in record["mips"]] == [False, True, True, True, True]
    assert record["maps"]["base_color"]["psnr"] == pytest.approx(-10 * math.log10(0.01 / 15), abs=1e-4)
    assert record["maps"]["roughness"]["mips"][0]["psnr"] == pytest.approx(-20 * math.log10(0.2), abs=1e-4)
    assert record["maps"]["normal"]["psnr"] is None
    assert record["maps"]["normal"]["flip"] == 0
    assert list(record["maps"]) == ["base_color", "normal", "roughness", "displacement"]


def test_aggregates_are_means_of_what_exists():
    source = Waves(32, 24)
    noise = np.random.default_rng(2)
    record = map_metrics(source, lambda uv, lod: source.encoded(uv, lod) + noise.normal(0, 0.02, (len(uv), 7)))
    entries = record["maps"].values()
    for entry in entries:
        rows = entry["mips"]
        assert [(r["width"], r["height"]) for r in rows] == [(32, 24), (16, 12), (8, 6), (4, 3), (2, 1), (1, 1)]
        assert [r["ssim"] is None for r in rows] == [False, False, True, True, True, True]
        assert entry["ssim"] == pytest.approx((rows[0]["ssim"] + rows[1]["ssim"]) / 2)
        assert entry["flip"] == pytest.approx(sum(r["flip"] for r in rows) / 6)
        assert 0.3 < entry["ssim"] < 1
    assert record["ssim"] == pytest.approx(sum(e["ssim"] for e in entries) / 4)
    assert record["flip"] == pytest.approx(sum(e["flip"] for e in entries) / 4)


def test_flip_sees_normals_as_blue_pictures_and_values_as_grey():
    source = Waves(16, 16)
    each = {m.name: m for m in map_channels(source.channels)}
    flat = np.full((2, 2, 2), 0.5, np.float32)
    np.testing.assert_allclose(each["normal"].picture(flat), np.broadcast_to([0.5, 0.5, 1.0], (2, 2, 3)))
    np.testing.assert_array_equal(each["roughness"].picture(flat[..., :1]), np.full((2, 2, 3), 0.5))
    shifted = map_metrics(source, lambda uv, lod: np.clip(source.encoded(uv, lod) + 0.05, 0, 1), mips=1)
    reference = source.mips()[0]
    grey = [np.repeat(np.clip(reference[..., 5:6] + s, 0, 1), 3, axis=2) for s in (0.0, 0.05)]
    assert shifted["maps"]["roughness"]["flip"] == pytest.approx(metrics.flip(*grey)[0], abs=1e-6)
    assert len(shifted["mips"]) == 1


def test_angles_of_normals_by_hand():
    """Straight up against a tilt of 10 degrees in x, on one texel of four 30 degrees."""
    channels = Waves().channels[3:5]
    up = np.full((2, 2, 2), 0.5, np.float32)
    tilted = up.copy()
    tilted[..., 0] += 0.5 * np.sin(np.radians(10))
    tilted[0, 0, 0] = 0.5 + 0.5 * np.sin(np.radians(30))
    found = compare(channels, [up], [tilted])["maps"]["normal"]["angle"]
    assert found["mean"] == pytest.approx(15, abs=1e-3)
    assert found["p95"] == pytest.approx(27, abs=1e-3)  # linear between the two largest of four


def test_normals_obey_their_range_and_stay_unit_beyond_the_circle():
    wide = map_channels([SimpleNamespace(map="normal", encoding="normal", range=(0.25, 0.75))] * 2)[0]
    np.testing.assert_allclose(wide.normals(np.float32([1.0, 0.5])), [0.5, 0, np.sqrt(0.75)], atol=1e-6)
    outside = map_channels(Waves().channels)[1].normals(np.float32([1.0, 1.0]))
    np.testing.assert_allclose(outside, [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-6)


def test_record_is_plain_json_and_beats_or_loses_as_it_should():
    for package in ("quicktex", "etcpak", "astc_encoder", "texture2ddecoder"):
        pytest.importorskip(package)
    source = Waves(32, 32)
    said = []
    record = eval_record(source, material(source), progress=lambda fraction, text: said.append((fraction, text)))
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert record["kind"] == "bcf"
    assert record["psnr"] is None  # it answers exactly as the reference does
    assert record["bits_per_texel_per_channel"] == pytest.approx(8 * 1000 / (32 * 32 * 7))
    assert list(record["baselines"]) == ["bc_full", "bc_half", "bc7_full", "bc7_half", "astc12"]
    psnr = {name: entry["psnr"] for name, entry in record["baselines"].items()}
    assert psnr["bc7_full"] > psnr["bc_full"] > psnr["bc_half"] > 15
    assert record["baselines"]["bc_half"]["bytes"] < record["baselines"]["bc_full"]["bytes"] / 2
    assert record["baselines"]["astc12"]["quality"] == 98
    fractions = [fraction for fraction, _ in said]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1)
    table = format_table(record)
    assert max(map(len, table.splitlines())) <= 120
    assert "exact" in table
    assert all(title in table for title in ("this file", "BC half", "ASTC 12x12", "base_color", "angle", "1 kB"))


def test_record_without_baselines_needs_no_encoder(monkeypatch):
    monkeypatch.setattr(evaluate_maps, "Baseline", None)
    source = Waves(4, 3)
    record = eval_record(source, material(source), baselines=False)
    assert record["baselines"] == {}
    assert record["ssim"] is None
    assert "–" in format_table(record)


def test_wrong_source_is_named():
    source = Waves(32, 32)
    with pytest.raises(ValueError, match="waves: is 16x32, and the asset was fitted to 32x32; open .* size and crop"):
        check_match(Waves(16, 32), material(source))
    with pytest.raises(ValueError, match=r"its channels are base_color.r, .*, and the asset's are normal.x, normal.y"):
        check_match(source, material(Waves(32, 32, LAYOUT[3:5])))
    changed = [*LAYOUT[:-1], ("displacement", "value", "linear", (0.0, 1.0))]
    with pytest.raises(
        ValueError, match=r"displacement linear \[0.25, 0.75\], and the asset's are disp.* \[0.0, 1.0\]"
    ):
        eval_record(source, material(Waves(32, 32, changed)), baselines=False)


def test_contact_sheet_shows_reference_decoded_difference_and_baseline():
    pytest.importorskip("quicktex")
    source = Waves(32, 24)
    sheet = contact_sheet(source, material(source, lambda uv, lod: source.encoded(uv, lod) + np.float32(0.02)))
    assert sheet.shape == (4 * 28, 5 * 36, 3)
    assert sheet.dtype == np.float32
    assert 0 <= sheet.min() <= sheet.max() <= 1
    tiles = sheet.reshape(4, 28, 5, 36, 3)[:, 2:-2, :, 2:-2].transpose(0, 2, 1, 3, 4)
    reference = source.mips()[0]
    np.testing.assert_array_equal(tiles[0, 0], reference[..., :3])
    np.testing.assert_allclose(tiles[0, 1], reference[..., :3] + 0.02, atol=1e-6)
    np.testing.assert_allclose(tiles[2, 2], 0.2, atol=1e-5)  # ten times
    np.testing.assert_allclose(tiles[2, 4], np.minimum(10 * np.abs(tiles[2, 3] - tiles[2, 0]), 1), atol=1e-6)
    cropped = contact_sheet(source, material(source), baseline=None, tile=16)
    assert cropped.shape == (4 * 20, 3 * 20, 3)
    np.testing.assert_array_equal(cropped[2:18, 2:18], reference[4:20, 8:24, :3])
