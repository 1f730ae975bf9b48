"""DDS: what goes in comes out, others read it, and what is broken is refused with a reason."""

import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from tests.block_oracles import bcdec, bcdec_half
from tests.block_textures import assert_same, damage, damaged, random_texture
from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import FORMATS, from_blocks
from warp_neumat.io.dds import read_dds, write_dds


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(("size", "mips", "layers"), [((8, 8), 1, 1), ((13, 7), 4, 1), ((1, 5), 3, 3)])
def test_round_trip(tmp_path, format, size, mips, layers):
    texture = random_texture(format, *size, mips, layers)
    write_dds(tmp_path / "a.dds", texture)
    assert_same(read_dds(tmp_path / "a.dds"), texture)
    assert (tmp_path / "a.dds").stat().st_size == 148 + texture.nbytes
    write_dds(tmp_path / "b.dds", texture)
    assert (tmp_path / "a.dds").read_bytes() == (tmp_path / "b.dds").read_bytes()
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.dds", "b.dds"]


def test_header(tmp_path):
    # Offsets from Microsoft's DDS_HEADER and DDS_HEADER_DXT10.
    write_dds(tmp_path / "a.dds", random_texture("bc6h_uf16", 409, 204, 9, 2))
    data = (tmp_path / "a.dds").read_bytes()
    assert data[:4] == b"DDS "
    words = struct.unpack_from("<36I", data, 4)
    assert words[:2] == (124, 0x1 | 0x2 | 0x4 | 0x1000 | 0x20000 | 0x80000)
    assert words[2:7] == (204, 409, 51 * 103 * 16, 1, 9)
    assert words[7:18] == (0,) * 11
    assert words[18:20] == (32, 4)
    assert data[84:88] == b"DX10"
    assert words[26:30] == (0x401008, 0, 0, 0)
    assert words[31:36] == (95, 3, 0, 2, 0)
    write_dds(tmp_path / "b.dds", random_texture("bc1_srgb", 4, 4))
    words = struct.unpack_from("<36I", (tmp_path / "b.dds").read_bytes(), 4)
    assert words[1] & 0x20000 == 0
    assert words[26] == 0x1000
    assert words[31:36] == (72, 3, 0, 1, 0)


@pytest.mark.parametrize(
    "format", ["bc1_unorm", "bc3_unorm", "bc4_unorm", "bc5_unorm", "bc6h_uf16", "bc6h_sf16", "bc7_unorm"]
)
def test_openimageio_reads_what_we_write(tmp_path, format):
    oiio = pytest.importorskip("OpenImageIO")
    texture = random_texture(format, 29, 13, 5)
    # BC6H and BC7 are exact; the others it interpolates with an older bcdec, which rounds them otherwise.
    exact = FORMATS[format].family in ("bc6h", "bc7")
    write_dds(tmp_path / "a.dds", texture)
    as_stored = oiio.ImageSpec()
    as_stored["oiio:UnassociatedAlpha"] = 1
    file = oiio.ImageInput.open(str(tmp_path / "a.dds"), as_stored)
    assert file is not None, oiio.geterror()
    for mip, blocks in enumerate(texture.levels[0]):
        assert file.seek_subimage(0, mip)
        width, height = texture.size(mip)
        assert (file.spec().width, file.spec().height) == (width, height)
        picture = file.read_image(0, mip, 0, file.spec().nchannels, file.spec().format)
        rows = blocks.reshape(-1, blocks.shape[-1])
        if FORMATS[format].family == "bc6h":
            want = bcdec_half(rows, FORMATS[format].signed)
        else:
            want = bcdec(FORMATS[format].family, rows)
        want = from_blocks(want, width, height)
        picture = np.asarray(picture).reshape(want.shape)
        if exact:
            np.testing.assert_array_equal(picture, want)
        else:
            assert np.abs(picture.astype(np.int16) - want).max() <= 1
    assert not file.seek_subimage(0, texture.mips)


@pytest.mark.parametrize(
    ("name", "format", "size", "mips"),
    [
        ("BC1Unorm", "bc1_unorm", (256, 256), 9),
        ("BC4Unorm", "bc4_unorm", (256, 256), 9),
        ("BC5Unorm", "bc5_unorm", (256, 256), 9),
        ("BC6HU16", "bc6h_uf16", (409, 204), 9),
        ("BC7Unorm", "bc7_unorm", (256, 256), 9),
        ("kodim23_bc1", "bc1_unorm", (768, 512), 1),
    ],
)
def test_files_of_others(data, tmp_path, name, format, size, mips):
    path = data / "bc" / f"{name}.dds"
    texture = read_dds(path)
    assert (texture.format, texture.size(), texture.mips, texture.layers) == (format, size, mips, 1)
    header = 148 if path.read_bytes()[84:88] == b"DX10" else 128
    assert path.read_bytes()[header : header + texture.nbytes] == b"".join(b.tobytes() for b in texture.levels[0])
    write_dds(tmp_path / "a.dds", texture)
    assert_same(read_dds(tmp_path / "a.dds"), texture)


@pytest.mark.parametrize(
    ("fourcc", "format"),
    [
        (b"DXT1", "bc1_unorm"),
        (b"DXT5", "bc3_unorm"),
        (b"ATI1", "bc4_unorm"),
        (b"BC4U", "bc4_unorm"),
        (b"BC4S", "bc4_snorm"),
        (b"ATI2", "bc5_unorm"),
        (b"BC5U", "bc5_unorm"),
        (b"BC5S", "bc5_snorm"),
    ],
)
def test_fourcc_files(tmp_path, fourcc, format):
    texture = random_texture(format, 7, 6, 3)
    write_dds(tmp_path / "a.dds", texture)
    data = (tmp_path / "a.dds").read_bytes()
    (tmp_path / "b.dds").write_bytes(data[:84] + fourcc + data[88:128] + data[148:] + b"more")
    assert_same(read_dds(tmp_path / "b.dds"), texture)


def _put(data: bytes, at: int, value: int) -> bytes:
    return data[:at] + struct.pack("<I", value) + data[at + 4 :]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:100], r"header: a DDS file has at least 128 bytes, got 100; copy or export it again"),
        (lambda d: d[:140], r"header: the DX10 header is truncated; copy"),
        (lambda d: d[:-1], r"data: 2 layers of 3 mips need \d+ bytes, the file has \d+; copy"),
        (lambda d: b"\x89PNG" + d[4:], r"file: a DDS file starts with b'DDS ', got b'\\x89PNG'; give a DDS file"),
        (lambda d: _put(d, 4, 123), r"header: sizes must be 124 and 32, got 123 and 32"),
        (lambda d: _put(d, 80, 0x40), r"format: the pixels are not block-compressed; convert it to one of BC1 to BC7"),
        (
            lambda d: d[:84] + b"DXT3" + d[88:],
            r"format: FourCC b'DXT3' is none that this release reads; convert it to bc1",
        ),
        (lambda d: _put(d, 128, 28), r"format: DXGI format 28 is none that this release reads"),
        (lambda d: _put(d, 132, 4), r"dimension: it is a cube map, a volume or a 1D texture; export a 2D texture"),
        (lambda d: _put(d, 136, 4), r"dimension: it is a cube map"),
        (lambda d: _put(d, 112, 0x200000), r"dimension: it is a cube map, a volume"),
        (lambda d: _put(d, 12, 0), r"size: both sides must be at least 1 texel and below 2\^31, got 13x0"),
        (
            lambda d: _put(d, 16, 2**32 - 1),
            r"size: both sides must be at least 1 texel and below 2\^31, got 4294967295x7",
        ),
        (lambda d: _put(d, 16, 2**31 - 1), r"data: 2 layers of 3 mips need \d+ bytes"),
        (lambda d: _put(d, 28, 5), r"mips: 13x7 has 1 to 4 mip levels, got 5"),
        (lambda d: _put(d, 140, 0), r"layers: there must be at least 1, got 0"),
        (lambda d: _put(d, 140, 2**32 - 1), r"data: 4294967295 layers of 3 mips need"),
    ],
)
def test_broken_files_are_refused(tmp_path, change, message):
    path = tmp_path / "a.dds"
    write_dds(path, random_texture("bc6h_uf16", 13, 7, 3, 2))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(FormatError, match=message) as caught:
        read_dds(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_no_mip_count_means_one(tmp_path):
    write_dds(tmp_path / "a.dds", random_texture("bc1_unorm", 8, 8))
    (tmp_path / "a.dds").write_bytes(_put((tmp_path / "a.dds").read_bytes(), 28, 0))
    assert read_dds(tmp_path / "a.dds").mips == 1


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.dds: no such file; give the path of a DDS file"):
        read_dds(tmp_path / "a.dds")
    with pytest.raises(FileNotFoundError, match=r"no such file"):
        read_dds(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        write_dds(tmp_path / "no" / "a.dds", random_texture("bc1_unorm", 4, 4))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage(148))
def test_damaged_files_are_read_or_refused(tmp_path, done):
    path = tmp_path / "a.dds"
    write_dds(path, random_texture("bc7_unorm", 21, 9, 3, 2))
    content = damaged(path.read_bytes(), *done)
    path.write_bytes(content)
    try:
        texture = read_dds(path)
    except FormatError:
        return
    assert texture.nbytes <= len(content)
