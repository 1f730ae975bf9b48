"""Picture files: what goes in comes out, files are whole or absent, and complaints name the file."""

import os
import struct

import numpy as np
import pytest

from warp_neumat.io import image


@pytest.fixture
def picture(rng):
    return rng.random((37, 53, 3), dtype=np.float32)


def chunks(file):
    """Name → content of a PNG's chunks."""
    data, found, at = file.read_bytes(), {}, 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found[data[at + 4 : at + 8].decode()] = data[at + 8 : at + 8 + length]
        at += 12 + length
    return found


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_keeps_every_byte(tmp_path, rng, channels):
    stored = rng.integers(0, 256, (37, 53, channels), dtype=np.uint8)
    file = tmp_path / "a.png"
    image.write_png(file, stored)
    read, info = image.read_image(file)
    np.testing.assert_array_equal(np.round(read * 255), stored)
    assert (info.width, info.height, len(info.channels), info.dtype) == (53, 37, channels, "uint8")
    assert os.listdir(tmp_path) == ["a.png"]


def test_png_of_floats_rounds_clips_and_takes_nan_as_black(tmp_path):
    values = np.float32([-1, 0, 0.499 / 255, 0.501 / 255, 0.5, 1, 2, np.inf, np.nan])
    image.write_png(tmp_path / "a.png", np.repeat(values[None, :, None], 3, axis=2))
    read, _ = image.read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(np.round(read[0, :, 0] * 255), [0, 0, 0, 1, 128, 255, 255, 255, 0])


def test_png_says_that_it_is_srgb(tmp_path, picture):
    image.write_png(tmp_path / "a.png", picture)
    found = chunks(tmp_path / "a.png")
    assert "sRGB" in found or struct.unpack(">I", found["gAMA"]) == (45455,)
    assert "srgb" in image.read_image(tmp_path / "a.png")[1].color_space.lower()


@pytest.mark.parametrize(("half", "bound"), [(True, 2.0**-11), (False, 0.0)])
def test_exr_keeps_linear_values(tmp_path, picture, half, bound):
    linear = 100 * picture - 20
    image.write_exr(tmp_path / "a.exr", linear, half=half)
    read, info = image.read_image(tmp_path / "a.exr")
    assert (np.abs(read - linear) <= bound * np.abs(linear)).all()
    assert info.dtype == ("half" if half else "float")
    assert info.channels == ("R", "G", "B")
    assert os.listdir(tmp_path) == ["a.exr"]


def test_exr_carries_rec709_chromaticities(tmp_path, picture):
    import OpenImageIO as oiio

    image.write_exr(tmp_path / "a.exr", picture)
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    expected = [0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329]
    np.testing.assert_allclose(spec.getattribute("chromaticities"), expected, atol=1e-6)


def test_strided_and_double_pictures_go_in(tmp_path, picture):
    image.write_exr(tmp_path / "a.exr", picture.astype(np.float64)[::-1, ::2], half=False)
    np.testing.assert_array_equal(image.read_image(tmp_path / "a.exr")[0], picture[::-1, ::2])


def test_a_missing_folder_is_named_in_one_line(tmp_path, picture):
    for write, name in ((image.write_png, "a.png"), (image.write_exr, "a.exr")):
        with pytest.raises(OSError, match=rf"none/{name}: cannot be written, there is no folder") as caught:
            write(tmp_path / "none" / name, picture)
        assert "\n" not in str(caught.value)


def test_a_read_only_folder_is_named(tmp_path, picture, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(PermissionError, match=r"a.png: cannot be written, the folder .* is read-only"):
        image.write_png(tmp_path / "a.png", picture)
    assert os.listdir(tmp_path) == []


def test_a_failed_write_leaves_what_was_there(tmp_path, picture, monkeypatch):
    file = tmp_path / "a.png"
    image.write_png(file, picture)
    before = file.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        image.write_png(file, 1 - picture)
    assert file.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.png"]


def test_a_damaged_file_is_named(tmp_path, picture):
    file = tmp_path / "a.png"
    file.write_bytes(b"not a picture")
    with pytest.raises(OSError, match=r"a.png: cannot be read as a picture: \S+") as caught:
        image.read_image(file)
    assert "\n" not in str(caught.value)
    image.write_exr(tmp_path / "b.exr", picture)
    (tmp_path / "b.exr").write_bytes((tmp_path / "b.exr").read_bytes()[:2000])
    with pytest.raises(OSError, match=r"b.exr: "):
        image.read_image(tmp_path / "b.exr")
    with pytest.raises(FileNotFoundError, match=r"none.png: no such file"):
        image.read_image(tmp_path / "none.png")


def test_bad_pictures_are_refused(tmp_path, picture):
    with pytest.raises(ValueError, match=r"picture must have shape .* got \(37, 53, 2\)"):
        image.write_png(tmp_path / "a.png", picture[..., :2])
    with pytest.raises(TypeError, match="picture must be uint8 or floating point"):
        image.write_png(tmp_path / "a.png", picture.astype(np.int32))
    with pytest.raises(TypeError, match="picture must be floating point, linear, got uint8"):
        image.write_exr(tmp_path / "a.exr", picture.astype(np.uint8))
    with pytest.raises(ValueError, match=r"a.jpg: must end in .png"):
        image.write_png(tmp_path / "a.jpg", picture)
    assert os.listdir(tmp_path) == []
