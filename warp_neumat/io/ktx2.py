"""Khronos texture files, version 2 (.ktx2), of block-compressed textures, with mips and array layers.

Layout, little-endian: identifier and header (80 bytes), level index (24 bytes a level, finest first), data format
descriptor, key/value data, then the levels, smallest first, each aligned to the bytes of a block; a level holds all
layers. Sources: Khronos, KTX File Format 2.0; Khronos Data Format Specification 1.3, sections 3-5.
"""

import struct
from pathlib import Path

import numpy as np

from warp_neumat import __version__
from warp_neumat.io.asset import FormatError
from warp_neumat.io.atomic import replacing
from warp_neumat.io.block_formats import FORMATS, BlockFormat, BlockTexture, check_size, mip_bytes, mip_shape, read_file

_IDENTIFIER = b"\xabKTX 20\xbb\r\n\x1a\n"
_HEADER, _LEVEL = struct.Struct("<13I2Q"), struct.Struct("<3Q")
_LEVELS_AT = len(_IDENTIFIER) + _HEADER.size
_WRITER = f"warp_neumat {__version__}"
_ORIENTATION = "rd"
"""Texels run to the right and downwards: uv origin top left."""

_BY_VK = {f.vk: f.name for f in FORMATS.values()} | {131: "bc1_unorm", 132: "bc1_srgb"}
_SCHEMES = {1: "BasisLZ", 2: "Zstandard", 3: "ZLIB"}

# --- data format descriptor -------------------------------------------------------------------------------------------

_MODEL = {"bc1": 128, "bc3": 130, "bc4": 131, "bc5": 132, "bc6h": 133, "bc7": 134}
_BT709, _LINEAR, _SRGB, _VERSION_1_3 = 1, 1, 2, 2
_IS_LINEAR, _IS_SIGNED, _IS_FLOAT = 0x10, 0x40, 0x80

# Family → (channel number, first bit, bits) of each sample. BC1 with the channel that says it has punch-through alpha,
# BC3 with alpha, then colour.
_SAMPLES = {
    "bc1": ((1, 0, 64),),
    "bc3": ((15, 0, 64), (0, 64, 64)),
    "bc4": ((0, 0, 64),),
    "bc5": ((0, 0, 64), (1, 64, 64)),
    "bc6h": ((0, 0, 128),),
    "bc7": ((0, 0, 128),),
}


def descriptor(format: BlockFormat) -> bytes:
    """Return the data format descriptor of ``format``: its total size, then one basic descriptor block."""
    qualifier = (_IS_SIGNED if format.signed else 0) | (_IS_FLOAT if format.family == "bc6h" else 0)
    if format.family == "bc6h":
        low, high = struct.pack("<f", -1.0 if format.signed else 0.0), struct.pack("<f", 1.0)
    elif format.signed:
        low, high = struct.pack("<i", -(2**31)), struct.pack("<i", 2**31 - 1)
    else:
        low, high = struct.pack("<I", 0), struct.pack("<I", 2**32 - 1)
    samples = b""
    for channel, first, bits in _SAMPLES[format.family]:
        alpha_of_srgb = _IS_LINEAR if format.srgb and channel == 15 else 0
        samples += struct.pack("<H2B4x", first, bits - 1, channel | qualifier | alpha_of_srgb) + low + high
    size = 24 + len(samples)
    transfer = _SRGB if format.srgb else _LINEAR
    block = struct.pack("<I2H4B", 0, _VERSION_1_3, size, _MODEL[format.family], _BT709, transfer, 0)
    block += struct.pack("<4B8B", 3, 3, 0, 0, format.block_bytes, 0, 0, 0, 0, 0, 0, 0)
    return struct.pack("<I", 4 + size) + block + samples


# --- key/value data ---------------------------------------------------------------------------------------------------


def _pack_values(values: dict[str, str]) -> bytes:
    """Return key/value data: sorted keys, each entry padded to 4 bytes."""
    data = b""
    for key in sorted(values):
        entry = key.encode() + b"\0" + values[key].encode() + b"\0"
        data += struct.pack("<I", len(entry)) + entry + b"\0" * (-len(entry) % 4)
    return data


def _unpack_values(path: Path, data: bytes) -> dict[bytes, bytes]:
    values, at = {}, 0
    while at + 4 <= len(data):
        (count,) = struct.unpack_from("<I", data, at)
        entry = data[at + 4 : at + 4 + count]
        key, mark, value = entry.partition(b"\0")
        if len(entry) != count or not mark:
            raise FormatError(path, "key/value data", f"the entry at byte {at} is broken", "copy or export it again")
        values[key] = value.removesuffix(b"\0")
        at += 4 + count + (-count % 4)
    return values


# --- file -------------------------------------------------------------------------------------------------------------


def write_ktx2(path, texture: BlockTexture) -> None:
    """Write ``texture`` as a KTX2 file without supercompression, whole or not at all.

    ``bc1_*`` is written as VK_FORMAT_BC1_RGBA_*, because our decoder gives punch-through alpha. The same texture gives
    the same bytes.

    Raises:
        OSError: If the folder is missing or cannot be written.
    """
    format = FORMATS[texture.format]
    dfd = descriptor(format)
    kvd = _pack_values({"KTXorientation": _ORIENTATION, "KTXwriter": _WRITER})
    dfd_at = _LEVELS_AT + texture.mips * _LEVEL.size
    kvd_at = dfd_at + len(dfd)
    counts = [texture.layers * mip_bytes(texture.format, texture.width, texture.height, m) for m in range(texture.mips)]
    offsets, at = [0] * texture.mips, kvd_at + len(kvd)
    for mip in reversed(range(texture.mips)):
        at += -at % format.block_bytes
        offsets[mip] = at
        at += counts[mip]
    header = _HEADER.pack(
        format.vk, 1, texture.width, texture.height, 0, texture.layers if texture.layers > 1 else 0, 1, texture.mips, 0,
        dfd_at, len(dfd), kvd_at, len(kvd), 0, 0,
    )  # fmt: skip
    index = b"".join(_LEVEL.pack(o, c, c) for o, c in zip(offsets, counts, strict=True))
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(_IDENTIFIER + header + index + dfd + kvd)
        for mip in reversed(range(texture.mips)):
            file.write(b"\0" * (offsets[mip] - file.tell()))
            for layer in texture.levels:
                file.write(np.ascontiguousarray(layer[mip]).data)


def read_ktx2(path) -> BlockTexture:
    """Return the texture in the KTX2 file at ``path``.

    Read are 2D textures and arrays of them in the formats of :data:`~warp_neumat.io.block_formats.FORMATS`, without
    supercompression, top row first. VK_FORMAT_BC1_RGB_* comes as ``bc1_*``: only the alpha of its punch-through
    texels differs. The data format descriptor is not read: the VkFormat says the same.

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If it is no KTX2 file, truncated, contradicts itself, or holds something else.
    """
    path, again = Path(path), "copy or export it again"
    data = read_file(path, "KTX2", _IDENTIFIER, _LEVELS_AT)
    vk, _, width, height, depth, layers, faces, mips, scheme, _, _, kvd_at, kvd_bytes, _, _ = _HEADER.unpack_from(
        data, len(_IDENTIFIER)
    )
    if scheme:
        rule = f"it is supercompressed with {_SCHEMES.get(scheme, f'scheme {scheme}')}"
        raise FormatError(path, "supercompression", rule, "write it without, as `ktx create` does by default")
    name = _BY_VK.get(vk)
    if name is None:
        way_out = f"convert it to {', '.join(FORMATS)}"
        raise FormatError(path, "format", f"VkFormat {vk} is none that this release reads", way_out)
    if depth or faces != 1 or not height:
        raise FormatError(path, "dimension", "it is a cube map, a volume or a 1D texture", "export a 2D texture")
    mips, layers = max(1, mips), max(1, layers)  # 0 stands for "make the others yourself" and "no array"
    check_size(path, width, height, mips, layers)
    if len(data) < _LEVELS_AT + mips * _LEVEL.size or len(data) < kvd_at + kvd_bytes:
        raise FormatError(path, "header", "the level index or the key/value data is truncated", again)
    orientation = _unpack_values(path, data[kvd_at : kvd_at + kvd_bytes]).get(b"KTXorientation", b"rd")
    if orientation != _ORIENTATION.encode():
        rule = f"must be 'rd' (right, down), got {orientation.decode('ascii', 'replace')!r}"
        raise FormatError(path, "KTXorientation", rule, "flip the picture before compressing it")
    chains: list[list[np.ndarray]] = []
    for mip in range(mips):
        offset, count, _ = _LEVEL.unpack_from(data, _LEVELS_AT + mip * _LEVEL.size)
        needed = layers * mip_bytes(name, width, height, mip)
        if count != needed:
            raise FormatError(path, f"level {mip}", f"must have {needed} bytes, got {count}", again)
        if offset + count > len(data):
            rule = f"ends at byte {offset + count}, the file has {len(data)}"
            raise FormatError(path, f"level {mip}", rule, again)
        level = np.frombuffer(data, np.uint8, count, offset).reshape(layers, *mip_shape(name, width, height, mip))
        chains.append([blocks.copy() for blocks in level])
    return BlockTexture(name, width, height, tuple(zip(*chains, strict=True)))
