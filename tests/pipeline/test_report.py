"""The report: numbers that add up, JSON that any parser reads, one HTML file that needs nothing else.

The render in here is invented: :func:`fake_report` is test data and no measurement.
"""

import base64
import html.parser
import json
import math
import re

import numpy as np
import pytest

from warp_neumat.io.image import read_image, write_exr, write_png
from warp_neumat.pipeline import report_plots
from warp_neumat.pipeline.report import data_uri, plain, spread, stages, summarise, write_report

COUNT = 48


def fake_report(count=COUNT, interval=4, error=True):
    """TEST DATA: a render with a slow first frame, and shading in every fifth frame."""
    rng = np.random.default_rng(7)
    frames = []
    for k in range(count):
        fresh = k % (interval + 1) == 0
        seen = int(210_000 + 30_000 * math.sin(k / 7))
        shaded = seen if fresh else int(0.06 * seen)
        ms = {
            "shade": shaded * 1.1e-4 * rng.uniform(0.95, 1.1),
            "write": rng.uniform(14, 17),
            "tonemap": rng.uniform(4, 5),
            "gather": rng.uniform(6, 7.5),
            "list": rng.uniform(0.8, 1.2),
            "visibility": rng.uniform(5, 6.5),
            "pose": rng.uniform(3, 4),
        }
        if k == 0:
            ms["shade"] += 900.0
        entry = {"index": k + 10, "ms": ms, "evaluations": np.int64(3 * shaded)}
        entry["texels"] = {"owned": 820_000, "facing": 430_000 + 2000 * k, "seen": seen, "shaded": shaded}
        if error:
            entry["ms"]["reference"] = rng.uniform(250, 300)
            flip = 0.0 if fresh else 0.004 * (k % (interval + 1)) + rng.uniform(0, 1e-3)
            psnr = math.inf if fresh else -20 * math.log10(flip)
            entry["error"] = {"psnr": psnr, "ssim": 1 - flip / 2, "flip": np.float32(flip)}
        frames.append(entry)
    return {
        "options": {
            "sequence": "TEST DATA <invented>",
            "atlas": 1200,
            "interval": interval,
            "size": [1280, 720],
            "lights": 3,
        },
        "machine": {"cpu": "Invented CPU", "cores": 2, "memory_gib": 24, "simd": ["FMA3", "AVX2"], "platform": "Linux"},
        "versions": {"warp_neumat": "0.1.0", "warp": "1.19.0", "numpy": "2.4.6"},
        "frames": frames,
        "summary": {"note": "test data"},
    }


def fake_pictures(count=COUNT, height=360, width=640):
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    for k in range(count):
        ball = np.hypot(x - width * (0.3 + 0.4 * k / count), y - height / 2) < height / 4
        yield np.where(ball[..., None], np.float32([0.8, 0.5, 0.2]), np.float32(0.12)).astype(np.float32)


class Outside(html.parser.HTMLParser):
    """Collects what a page would fetch, and checks that tags close."""

    VOID = ("meta", "img", "input", "line", "circle", "polyline", "polygon", "br", "link")

    def __init__(self):
        super().__init__()
        self.fetched, self.open, self.tags = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [
            v for k, v in attrs if k in ("src", "href", "xlink:href", "data-src") and not v.startswith("data:")
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    returned = write_report(folder, fake_report(), frames=list(fake_pictures()))
    return folder, returned


def test_json_is_strict_rounded_and_keeps_the_contract(written):
    folder, returned = written
    document = json.loads((folder / "report.json").read_text(), parse_constant=pytest.fail)
    assert document == returned
    assert list(document) == ["options", "machine", "versions", "frames", "summary"]
    first = document["frames"][0]
    assert first["index"] == 10
    assert first["evaluations"] == 3 * first["texels"]["shaded"]
    assert first["error"]["psnr"] is None  # infinite: equal to its reference
    assert first["ms"]["gather"] == float(f"{fake_report()['frames'][0]['ms']['gather']:.6g}")
    assert document["summary"]["note"] == "test data"


def test_summary_adds_up():
    source = fake_report()
    summary = summarise(source["frames"])
    times = [sum(v for k, v in f["ms"].items() if k != "reference") for f in source["frames"]]
    assert summary["ms"] == pytest.approx(np.mean(times))
    assert summary["ms_median"] == pytest.approx(np.median(times))
    assert summary["ms_first"] == pytest.approx(times[0])
    assert summary["shade_ms"] == pytest.approx(np.mean([f["ms"]["shade"] for f in source["frames"]]))
    assert summary["texels"]["owned"] == 820_000
    finite = [f["error"]["psnr"] for f in source["frames"] if math.isfinite(f["error"]["psnr"])]
    assert summary["psnr"] == pytest.approx(np.mean(finite))
    assert summary["flip_worst"] == pytest.approx(max(f["error"]["flip"] for f in source["frames"]))
    assert stages(source["frames"])[:4] == ["pose", "visibility", "list", "shade"]
    assert stages(source["frames"])[-1] == "reference"


def test_html_stands_alone_and_is_well_formed(written):
    text = (written[0] / "report.html").read_text()
    parser = Outside()
    parser.feed(text)
    assert parser.fetched == []
    assert parser.open == []
    assert "http://" not in text
    assert "https://" not in text
    assert parser.tags.count("svg") == 5  # time, FLIP, PSNR, texels, evaluations
    assert "&lt;invented&gt;" in text
    assert "<invented>" not in text


def test_html_shows_every_stage_number_and_frame(written):
    folder, returned = written
    text = (folder / "report.html").read_text()
    for word in (
        "time [ms]",
        "FLIP",
        "PSNR [dB]",
        "texels",
        "evaluations",
        "Invented CPU",
        "warp 1.19.0",
        *stages(returned["frames"]),
    ):
        assert word in text
    assert f"<b>{report_plots.short(returned['summary']['flip'])} " in text
    shots = json.loads(re.search(r'<script id="shots" type="application/json">(.*?)</script>', text, re.DOTALL)[1])
    assert [shot["at"] for shot in shots] == list(range(COUNT))
    assert shots[5]["says"].startswith("frame 15 · ")


def test_one_frame_without_texels_error_or_pictures_is_enough(tmp_path):
    write_report(tmp_path, {"frames": [{"index": 0, "ms": {"shade": 2.0}}]})
    text = (tmp_path / "report.html").read_text()
    assert text.count("<svg") == 1
    assert "FLIP" not in text
    assert "<script" not in text
    parser = Outside()
    parser.feed(text)
    assert parser.open == []


def test_pictures_are_embedded_small_whatever_they_come_as(tmp_path):
    picture = next(fake_pictures(1))
    write_png(tmp_path / "a.png", picture)
    write_exr(tmp_path / "a.exr", np.where(picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4))
    for source in (picture, str(tmp_path / "a.png"), tmp_path / "a.exr", np.round(picture * 255).astype(np.uint8)):
        uri = data_uri(source, 160)
        (tmp_path / "b.jpg").write_bytes(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")))
        small, info = read_image(tmp_path / "b.jpg")
        assert (info.width, info.height) == (160, 90)
        np.testing.assert_allclose(small[45, 48], [0.8, 0.5, 0.2], atol=0.03)
        np.testing.assert_allclose(small[5, 5], 0.12, atol=0.02)


def test_long_renders_embed_an_even_choice():
    chosen = spread(1000, 60)
    assert len(chosen) == len(set(chosen)) == 60
    assert (chosen[0], chosen[-1]) == (0, 999)
    assert {b - a for a, b in zip(chosen, chosen[1:], strict=False)} <= {16, 17}
    assert spread(3, 60) == [0, 1, 2]


def test_a_towering_frame_does_not_flatten_the_plot():
    assert report_plots.ceiling([900.0] + [30.0] * 47) == 45.0
    assert report_plots.ceiling([50.0, 30, 30, 30, 30] * 9) == 50.0  # every fifth frame is no exception
    svg = report_plots.stacked(
        [0, 1, 2] + list(range(3, 20)), [report_plots.Series("a", [900] + [30] * 19, "#000")], "y", "t"
    )
    assert "▲ 900" in svg


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 47), (31.7, 44.2), (0, 1.23e6), (0, 0.0213)])
def test_ticks_are_round_and_inside(low, high):
    found = report_plots.ticks(low, high)
    assert 2 <= len(found) <= 11
    assert low <= found[0]
    assert found[-1] <= high * (1 + 1e-9)
    leading = {f"{b - a:.3e}"[0] for a, b in zip(found, found[1:], strict=False)}
    assert leading <= {"1", "2", "5"}


def test_numbers_read_well():
    shown = [report_plots.short(v) for v in (0.01234, 7.8, 123.4, 9876, 12_345, 1_234_567, None)]
    assert shown == ["0.0123", "7.8", "123", "9876", "12.3k", "1.23M", "–"]


def test_plain_knows_numpy_paths_and_what_json_lacks(tmp_path):
    value = {
        1: np.float32(0.1),
        "a": [np.int64(3), math.nan, -math.inf],
        "b": np.arange(2),
        "c": tmp_path,
        "d": None,
        "e": True,
    }
    assert plain(value) == {"1": 0.1, "a": [3, None, None], "b": [0, 1], "c": str(tmp_path), "d": None, "e": True}


def test_bad_reports_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        write_report(tmp_path, {"frames": []})
    with pytest.raises(ValueError, match="one picture per entry of the report, 48, got 2"):
        write_report(tmp_path, fake_report(), frames=list(fake_pictures(2)))
    with pytest.raises(OSError, match=r"report.json: cannot be written, there is no folder"):
        write_report(tmp_path / "none", fake_report())
    assert list(tmp_path.iterdir()) == []
