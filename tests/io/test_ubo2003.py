"""UBO2003 archives written here, picture by picture, and read back."""

import zipfile

import numpy as np
import OpenImageIO as oiio
import pytest

from warp_neumat.io import ubo2003
from warp_neumat.io.asset import FormatError
from warp_neumat.io.btf_directions import UBO2003_RINGS, ubo2003_directions
from warp_neumat.io.btf_source import is_btf
from warp_neumat.io.image import read_image, write_png
from warp_neumat.io.ubo2003 import open_ubo2003

LIGHTS, VIEWS = [(0, 0), (15, 60), (75, 345)], [(0, 0), (30, 90)]
WIDTH, HEIGHT = 6, 4


def name_of(light, view, pattern="00001 tl{:03} pl{:03} tv{:03} pv{:03}.png"):
    return pattern.format(*light, *view)


def pictures(rng, lights=LIGHTS, views=VIEWS):
    """{(light, view): bytes that an archive holds}, each pair its own."""
    return {
        (light, view): rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for light in lights for view in views
    }


def write_jpeg(path, pixels):
    height, width, channels = pixels.shape
    file, spec = oiio.ImageOutput.create("jpeg"), oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute("Compression", "jpeg:100")
    assert file.open(str(path), spec)
    assert file.write_image(pixels)
    assert file.close()


def folder_of(tmp_path, stored, pattern="00001 tl{:03} pl{:03} tv{:03} pv{:03}.png"):
    root = tmp_path / "UBO_TEST"
    for (light, view), pixels in stored.items():
        path = root / "tv{:03}_pv{:03}".format(*view) / name_of(light, view, pattern)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            write_png(path, pixels)
        else:
            write_jpeg(path, pixels)
    return root


def zip_of(tmp_path, root, extra=(), method=zipfile.ZIP_STORED):
    path = tmp_path / "UBO_TEST.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for file in sorted(root.rglob("*")):
            archive.write(file, f"UBO_TEST/{file.relative_to(root)}")
        for name, data in extra:
            archive.writestr(name, data)
    return path


def all_pairs(lights=LIGHTS, views=VIEWS):
    return np.stack(np.meshgrid(range(len(lights)), range(len(views)), indexing="ij"), -1).reshape(-1, 2)


def expected(stored, transfer="srgb", scale=1 / np.pi):
    values = np.array([stored[light, view] for light in LIGHTS for view in VIEWS]) / 255.0
    if transfer == "srgb":  # IEC 61966-2-1
        values = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return scale * values


@pytest.mark.parametrize("options", [{}, {"transfer": "linear", "scale": 0.5}])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "pattern", ["00001 tl{:03} pl{:03} tv{:03} pv{:03}.png", "tl{:03}_pl{:03}_tv{:03}_pv{:03}.png"]
)
def test_slices_are_the_pictures(tmp_path, rng, pattern, packed, options):
    stored = pictures(rng)
    path = folder_of(tmp_path, stored, pattern)
    source = open_ubo2003(zip_of(tmp_path, path) if packed else path, **options)
    assert is_btf(source)
    assert (source.name, source.width, source.height) == ("UBO_TEST", WIDTH, HEIGHT)
    got, truth = source.slices(all_pairs()), expected(stored, **options)
    assert got.dtype == np.float32
    assert (np.abs(got - truth) / np.maximum(truth, 1e-9)).max() < 2e-6  # worst seen: 5e-7
    order = np.array([[2, 1], [0, 0], [2, 1]])
    np.testing.assert_array_equal(source.slices(order), got[[5, 0, 5]])
    again = open_ubo2003(**source.opening)
    np.testing.assert_array_equal(again.slices(all_pairs()), got)
    assert "cosine in the data" in source.notes[-1]


def test_directions(tmp_path, rng):
    root = folder_of(tmp_path, pictures(rng))
    source = open_ubo2003(root)
    theta, phi = np.radians(75), np.radians(345)
    turned = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    np.testing.assert_allclose(source.lights[2], turned, atol=1e-6)
    np.testing.assert_allclose(source.views, [(0, 0, 1), (0, 0.5, np.sqrt(0.75))], atol=1e-6)
    mirrored = open_ubo2003(root, azimuth="clockwise")
    np.testing.assert_array_equal(mirrored.lights, source.lights * np.float32([1, -1, 1]))
    assert "3 lights and 2 views, not the 81 directions of UBO2003" in source.notes


def test_the_database_s_directions_are_recognised_in_its_order(tmp_path, rng):
    ring = [(t, round(first + 360 * k / n)) for t, n, first in UBO2003_RINGS for k in range(n)]
    root = folder_of(tmp_path, pictures(rng, ring, [(0, 0)]))
    source = open_ubo2003(root)
    np.testing.assert_allclose(source.lights, ubo2003_directions(), atol=1e-2)
    assert "81 lights and 1 views" in source.notes[0]


def test_jpeg_pictures(tmp_path, rng):
    flat = {key: np.full((16, 16, 3), 20 + 25 * k, np.uint8) for k, key in enumerate(pictures(rng))}
    source = open_ubo2003(folder_of(tmp_path, flat, "00008 tl{:03} pl{:03} tv{:03} pv{:03}.JPG"), transfer="linear")
    got = source.slices(all_pairs())
    truth = np.array([flat[light, view] for light in LIGHTS for view in VIEWS]) / (255 * np.pi)
    np.testing.assert_allclose(got, truth, atol=1.5 / (255 * np.pi))


def test_pictures_are_decoded_when_asked_for_and_kept(tmp_path, rng, monkeypatch):
    read = []
    monkeypatch.setattr(ubo2003, "read_image", lambda p, **k: read.append(p.name) or read_image(p, **k))
    monkeypatch.setattr(ubo2003, "KEPT", 2 * WIDTH * HEIGHT * 3)
    source = open_ubo2003(folder_of(tmp_path, pictures(rng)))
    read.clear()
    source.slices(np.array([[1, 1], [1, 1], [2, 0], [1, 1]]))
    assert read == [name_of(LIGHTS[1], VIEWS[1]), name_of(LIGHTS[2], VIEWS[0])]
    source.slices(np.array([[0, 0], [1, 1], [2, 0]]))  # two are kept: (2, 0) is the one that has to go
    assert read[2:] == [name_of(LIGHTS[0], VIEWS[0]), name_of(LIGHTS[2], VIEWS[0])]


def test_foreign_files_are_left_out_and_named(tmp_path, rng):
    stored = pictures(rng)
    inside = [("readme.txt", b"?"), ("__MACOSX/._00001 tl000 pl000 tv000 pv000.png", b"?"), ("UBO_TEST/all.jpg", b"?")]
    source = open_ubo2003(zip_of(tmp_path, folder_of(tmp_path, stored), inside))
    assert "3 file(s) that are no slices are left out: readme.txt" in source.notes[0]
    np.testing.assert_allclose(source.slices(all_pairs()), expected(stored), rtol=2e-6)


def test_incomplete_and_ambiguous_archives_are_refused(tmp_path, rng):
    root = folder_of(tmp_path, pictures(rng))
    gone = root / "tv030_pv090" / name_of(LIGHTS[1], VIEWS[1])
    double = root / "again" / "tl000_pl000_tv030_pv090.png"
    double.parent.mkdir()
    double.write_bytes(gone.read_bytes())
    with pytest.raises(FormatError, match=r"UBO_TEST: tv030_pv090/00001 tl000.*: has the directions of again/tl000_"):
        open_ubo2003(root)
    double.unlink()
    gone.unlink()
    with pytest.raises(FormatError, match=r"1 of 3x2 pairs have no picture, the first is 'tl015 pl060 tv030 pv090'"):
        open_ubo2003(root)
    with pytest.raises(FormatError, match=r"UBO_TEST.zip: UBO_TEST/tl090 .*θ must be below 90°; remove"):
        open_ubo2003(zip_of(tmp_path, root, [("UBO_TEST/tl090 pl000 tv000 pv000.jpg", b"?")]))


def test_files_that_are_no_archives_are_refused(tmp_path):
    path = tmp_path / "empty.zip"
    with zipfile.ZipFile(path, "w"):
        pass
    with pytest.raises(FormatError, match=r"empty.zip: pictures: none of 0 file\(s\) is named like"):
        open_ubo2003(path)
    path.write_bytes(b"no archive")
    with pytest.raises(FormatError, match=r"empty.zip: archive: is no zip file.*; fetch the archive again"):
        open_ubo2003(path)
    with pytest.raises(FormatError, match=r"none of 1 file\(s\)"):
        open_ubo2003(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_ubo2003(tmp_path / "none.zip")


def test_damaged_pictures_are_named(tmp_path, rng):
    stored = pictures(rng)
    root = folder_of(tmp_path, stored)
    bad, pair = root / "tv030_pv090" / name_of(LIGHTS[2], VIEWS[1]), np.array([[2, 1]])
    whole = bad.read_bytes()
    bad.write_bytes(whole[: len(whole) // 2])
    for path in (root, zip_of(tmp_path, root)):
        source = open_ubo2003(path)
        source.slices(all_pairs()[:-1])
        with pytest.raises(FormatError, match=r"tl075 pl345 tv030 pv090.png: cannot be decoded \(.+\); ") as caught:
            source.slices(pair)
        assert "\n" not in str(caught.value)
        assert "/tmp" not in str(caught.value).split(": ", 1)[1]
    write_png(bad, stored[LIGHTS[0], VIEWS[0]][:2])
    with pytest.raises(FormatError, match=r"pv090.png: 6x2 where .*tl000 pl000 tv000 pv000.png is 6x4; "):
        open_ubo2003(root).slices(pair)
    write_png(bad, np.zeros((HEIGHT, WIDTH, 4), np.uint8))
    with pytest.raises(FormatError, match=r"pv090.png: has 4 channel\(s\) of uint8"):
        open_ubo2003(root).slices(pair)


@pytest.mark.parametrize(("method", "what"), [(zipfile.ZIP_STORED, "Bad CRC-32"), (zipfile.ZIP_DEFLATED, "invalid")])
def test_damage_inside_a_zip_is_noticed(tmp_path, rng, method, what):
    path = zip_of(tmp_path, folder_of(tmp_path, pictures(rng)), method=method)
    with zipfile.ZipFile(path) as archive:
        last = archive.infolist()[-1]
        at = last.header_offset + 30 + len(last.filename)
    data = bytearray(path.read_bytes())
    data[at] ^= 0x06  # of a deflated member, the kind of the first block
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"cannot be decoded \(.*{what}"):
        open_ubo2003(path).slices(all_pairs())


@pytest.mark.parametrize("options", [{"transfer": "gamma"}, {"azimuth": "left"}, {"scale": -1.0}])
def test_wrong_options_are_named(tmp_path, rng, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        open_ubo2003(folder_of(tmp_path, pictures(rng)), **options)
