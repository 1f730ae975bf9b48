"""KTX2: laid out as Khronos says, read back whole, and refused with a reason where it is broken."""

import struct

import pytest
from hypothesis import HealthCheck, given, settings

from tests.block_textures import assert_same, damage, damaged, random_texture
from warp_neumat import __version__
from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import FORMATS
from warp_neumat.io.ktx2 import read_ktx2, write_ktx2


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize(("size", "mips", "layers"), [((8, 8), 1, 1), ((13, 7), 4, 1), ((1, 5), 3, 3)])
def test_round_trip(tmp_path, format, size, mips, layers):
    texture = random_texture(format, *size, mips, layers)
    write_ktx2(tmp_path / "a.ktx2", texture)
    assert_same(read_ktx2(tmp_path / "a.ktx2"), texture)
    write_ktx2(tmp_path / "b.ktx2", texture)
    assert (tmp_path / "a.ktx2").read_bytes() == (tmp_path / "b.ktx2").read_bytes()


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("layers", [1, 2])
def test_layout(tmp_path, format, layers):
    # An independent parse, field by field after the tables of the KTX 2.0 specification.
    texture = random_texture(format, 22, 9, 5, layers)
    write_ktx2(tmp_path / "a.ktx2", texture)
    data = (tmp_path / "a.ktx2").read_bytes()
    assert data[:12] == bytes([0xAB, 0x4B, 0x54, 0x58, 0x20, 0x32, 0x30, 0xBB, 0x0D, 0x0A, 0x1A, 0x0A])
    assert struct.unpack_from("<9I", data, 12) == (FORMATS[format].vk, 1, 22, 9, 0, 0 if layers == 1 else 2, 1, 5, 0)
    dfd_at, dfd_bytes, kvd_at, kvd_bytes, sgd_at, sgd_bytes = struct.unpack_from("<4I2Q", data, 48)
    assert (sgd_at, sgd_bytes) == (0, 0)
    assert dfd_at == 80 + 5 * 24
    assert kvd_at == dfd_at + dfd_bytes
    assert kvd_at % 4 == 0
    assert struct.unpack_from("<I", data, dfd_at)[0] == dfd_bytes

    at, entries = kvd_at, []
    while at < kvd_at + kvd_bytes:
        (count,) = struct.unpack_from("<I", data, at)
        entries.append(data[at + 4 : at + 4 + count])
        at += 4 + count
        assert not any(data[at : at + -at % 4])
        at += -at % 4
    assert at == kvd_at + kvd_bytes
    assert entries == [b"KTXorientation\0rd\0", f"KTXwriter\0warp_neumat {__version__}\0".encode()]

    size = FORMATS[format].block_bytes
    end = kvd_at + kvd_bytes
    for mip in reversed(range(5)):  # smallest first, aligned to lcm(block bytes, 4), nothing between but zeros
        offset, count, plain = struct.unpack_from("<3Q", data, 80 + 24 * mip)
        assert offset % size == 0
        assert 0 <= offset - end < size
        assert not any(data[end:offset])
        assert count == plain
        assert data[offset : offset + count] == b"".join(layer[mip].tobytes() for layer in texture.levels)
        end = offset + count
    assert end == len(data)


# Format → (colour model, transfer function, samples), after section 5.6 and the BC tables of the Khronos Data Format
# Specification; a sample is (bit offset, bits, channel, qualifiers, lower, upper).
_UNORM, _SNORM = (0, 0, 0xFFFFFFFF), (0x40, 0x80000000, 0x7FFFFFFF)
_DESCRIPTORS = {
    "bc1_unorm": (128, 1, [(0, 64, 1, *_UNORM)]),
    "bc1_srgb": (128, 2, [(0, 64, 1, *_UNORM)]),
    "bc3_unorm": (130, 1, [(0, 64, 15, *_UNORM), (64, 64, 0, *_UNORM)]),
    "bc3_srgb": (130, 2, [(0, 64, 15, 0x10, 0, 0xFFFFFFFF), (64, 64, 0, *_UNORM)]),
    "bc4_unorm": (131, 1, [(0, 64, 0, *_UNORM)]),
    "bc4_snorm": (131, 1, [(0, 64, 0, *_SNORM)]),
    "bc5_unorm": (132, 1, [(0, 64, 0, *_UNORM), (64, 64, 1, *_UNORM)]),
    "bc5_snorm": (132, 1, [(0, 64, 0, *_SNORM), (64, 64, 1, *_SNORM)]),
    "bc6h_uf16": (133, 1, [(0, 128, 0, 0x80, 0, 0x3F800000)]),
    "bc6h_sf16": (133, 1, [(0, 128, 0, 0xC0, 0xBF800000, 0x3F800000)]),
    "bc7_unorm": (134, 1, [(0, 128, 0, *_UNORM)]),
    "bc7_srgb": (134, 2, [(0, 128, 0, *_UNORM)]),
}


@pytest.mark.parametrize("format", FORMATS)
def test_data_format_descriptor(tmp_path, format):
    write_ktx2(tmp_path / "a.ktx2", random_texture(format, 4, 4))
    data = (tmp_path / "a.ktx2").read_bytes()
    at, count = struct.unpack_from("<2I", data, 48)
    words = struct.unpack_from(f"<{count // 4}I", data, at)
    model, transfer, samples = _DESCRIPTORS[format]
    assert words[0] == count
    assert words[1] == 0  # Khronos, basic descriptor block
    assert words[2] == 2 | (count - 4) << 16  # version 1.3, bytes of the block
    assert words[3] == model | 1 << 8 | transfer << 16  # BT.709, straight alpha
    assert words[4] == 3 | 3 << 8  # 4 x 4 x 1 x 1 texels
    assert words[5:7] == (FORMATS[format].block_bytes, 0)
    assert len(words) == 7 + 4 * len(samples)
    for k, (offset, bits, channel, qualifiers, lower, upper) in enumerate(samples):
        head = offset | (bits - 1) << 16 | (channel | qualifiers) << 24
        assert words[7 + 4 * k : 11 + 4 * k] == (head, 0, lower, upper)


def _put(data: bytes, at: int, value: int, code: str = "<I") -> bytes:
    return data[:at] + struct.pack(code, value) + data[at + struct.calcsize(code) :]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d[:79], r"header: a KTX2 file has at least 80 bytes, got 79; copy or export it again"),
        (lambda d: d[:100], r"header: the level index or the key/value data is truncated; copy"),
        (lambda d: d[:-1], r"level 0: ends at byte \d+, the file has \d+; copy"),
        (lambda d: d[:5] + b"1" + d[6:], r"file: a KTX2 file starts with .*; give a KTX2 file"),
        (lambda d: _put(d, 12, 37), r"format: VkFormat 37 is none that this release reads; convert it to bc1_unorm"),
        (lambda d: _put(d, 44, 2), r"supercompression: it is supercompressed with Zstandard; write it without"),
        (lambda d: _put(d, 44, 77), r"supercompression: it is supercompressed with scheme 77;"),
        (lambda d: _put(d, 36, 6), r"dimension: it is a cube map, a volume or a 1D texture; export a 2D texture"),
        (lambda d: _put(d, 28, 4), r"dimension: it is a cube map, a volume"),
        (lambda d: _put(d, 24, 0), r"dimension: .* a 1D texture"),
        (lambda d: _put(d, 20, 0), r"size: both sides must be at least 1 texel and below 2\^31, got 0x7"),
        (lambda d: _put(d, 20, 2**31 - 1), r"level 0: must have \d+ bytes, got 256"),
        (lambda d: _put(d, 32, 2**32 - 1), r"level 0: must have \d+ bytes, got 256"),
        (lambda d: _put(d, 40, 9), r"mips: 13x7 has 1 to 4 mip levels, got 9"),
        (lambda d: _put(d, 80, 2**64 - 1, "<Q"), r"level 0: ends at byte 18446744073709551871, the file has"),
        (lambda d: _put(d, 88, 2**63, "<Q"), r"level 0: must have 256 bytes, got 9223372036854775808"),
        (lambda d: _put(d, 60, 2**32 - 1), r"header: the level index or the key/value data is truncated"),
        (lambda d: _put(d, struct.unpack_from("<I", d, 56)[0], 5000), r"key/value data: the entry at byte 0 is broken"),
        (lambda d: d.replace(b"rd\0", b"ru\0"), r"KTXorientation: must be 'rd' \(right, down\), got 'ru'; flip"),
    ],
)
def test_broken_files_are_refused(tmp_path, change, message):
    path = tmp_path / "a.ktx2"
    write_ktx2(path, random_texture("bc6h_uf16", 13, 7, 3, 2))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(FormatError, match=message) as caught:
        read_ktx2(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("vk", "format"), [(131, "bc1_unorm"), (132, "bc1_srgb")])
def test_bc1_without_alpha_is_read(tmp_path, vk, format):
    texture = random_texture(format, 8, 8, 2)
    write_ktx2(tmp_path / "a.ktx2", texture)
    (tmp_path / "a.ktx2").write_bytes(_put((tmp_path / "a.ktx2").read_bytes(), 12, vk))
    assert_same(read_ktx2(tmp_path / "a.ktx2"), texture)


def test_no_level_count_means_one(tmp_path):
    texture = random_texture("bc5_unorm", 8, 8)
    write_ktx2(tmp_path / "a.ktx2", texture)
    (tmp_path / "a.ktx2").write_bytes(_put((tmp_path / "a.ktx2").read_bytes(), 40, 0))
    assert_same(read_ktx2(tmp_path / "a.ktx2"), texture)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.ktx2: no such file; give the path of a KTX2 file"):
        read_ktx2(tmp_path / "a.ktx2")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        write_ktx2(tmp_path / "no" / "a.ktx2", random_texture("bc1_unorm", 4, 4))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damage(80 + 3 * 24 + 44 + 60))
def test_damaged_files_are_read_or_refused(tmp_path, done):
    path = tmp_path / "a.ktx2"
    write_ktx2(path, random_texture("bc7_unorm", 21, 9, 3, 2))
    content = damaged(path.read_bytes(), *done)
    path.write_bytes(content)
    try:
        texture = read_ktx2(path)
    except FormatError:
        return
    # Levels may overlap in a damaged index, so each is bounded by the file on its own.
    assert all(texture.layers * blocks.nbytes <= len(content) for blocks in texture.levels[0])
