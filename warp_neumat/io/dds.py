"""DirectDraw Surface files (.dds) of block-compressed textures, with mips and array layers.

Layout, little-endian: "DDS ", a header of 124 bytes, for FourCC "DX10" a second one of 20 bytes, then for each layer
its mips, finest first, without padding. Files are written with the DX10 header, which names the exact DXGI format;
older FourCC files are read too. Source: Microsoft, Programming Guide for DDS.
"""

import struct
from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError
from warp_neumat.io.atomic import replacing
from warp_neumat.io.block_formats import FORMATS, BlockTexture, check_size, mip_bytes, mip_shape, read_file

_MAGIC, _HEADER, _HEADER_DX10 = b"DDS ", struct.Struct("<7I44x2I4s5I5I"), struct.Struct("<5I")
_HEADER_BYTES, _PIXEL_FORMAT_BYTES = 124, 32

# Flags of the header: caps, height, width, pixel format; then those of mips and of a linear size.
_HAS_BASICS, _HAS_MIPS, _HAS_LINEAR_SIZE, _HAS_FOURCC = 0x1007, 0x20000, 0x80000, 0x4
_CAPS_TEXTURE, _CAPS_COMPLEX, _CAPS_MIPS = 0x1000, 0x8, 0x400000
_CAPS2_CUBE, _CAPS2_VOLUME = 0x200, 0x200000
_TEXTURE_2D, _MISC_CUBE = 3, 0x4

_BY_DXGI = {f.dxgi: f.name for f in FORMATS.values()}
_BY_FOURCC = {
    b"DXT1": "bc1_unorm",
    b"DXT5": "bc3_unorm",
    b"ATI1": "bc4_unorm",
    b"BC4U": "bc4_unorm",
    b"BC4S": "bc4_snorm",
    b"ATI2": "bc5_unorm",
    b"BC5U": "bc5_unorm",
    b"BC5S": "bc5_snorm",
}


def write_dds(path, texture: BlockTexture) -> None:
    """Write ``texture`` as a DDS file with a DX10 header, whole or not at all.

    The same texture gives the same bytes.

    Raises:
        OSError: If the folder is missing or cannot be written.
    """
    format, several = FORMATS[texture.format], texture.mips > 1 or texture.layers > 1
    flags = _HAS_BASICS | _HAS_LINEAR_SIZE | (_HAS_MIPS if texture.mips > 1 else 0)
    caps = _CAPS_TEXTURE | (_CAPS_COMPLEX if several else 0) | (_CAPS_MIPS if texture.mips > 1 else 0)
    linear_size = min(texture.levels[0][0].nbytes, 2**32 - 1)
    header = _HEADER.pack(
        _HEADER_BYTES, flags, texture.height, texture.width, linear_size, 1, texture.mips,
        _PIXEL_FORMAT_BYTES, _HAS_FOURCC, b"DX10", 0, 0, 0, 0, 0,
        caps, 0, 0, 0, 0,
    )  # fmt: skip
    header += _HEADER_DX10.pack(format.dxgi, _TEXTURE_2D, 0, texture.layers, 0)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(_MAGIC + header)
        for mips in texture.levels:
            for blocks in mips:
                file.write(np.ascontiguousarray(blocks).data)


def read_dds(path) -> BlockTexture:
    """Return the texture in the DDS file at ``path``.

    Read are 2D textures and arrays of them in the formats of :data:`~warp_neumat.io.block_formats.FORMATS`, with DX10
    header or with the FourCC DXT1, DXT5, ATI1, ATI2, BC4U, BC4S, BC5U, BC5S. FourCC files do not say whether their
    colours are sRGB: they come as ``_unorm``. Bytes after the last mip are ignored.

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If it is no DDS file, truncated, contradicts itself, or holds something else.
    """
    path = Path(path)
    data = read_file(path, "DDS", _MAGIC, len(_MAGIC) + _HEADER_BYTES)
    size, _, height, width, _, _, mips, pf_size, pf_flags, fourcc, *_, caps2, _, _, _ = _HEADER.unpack_from(data, 4)
    if size != _HEADER_BYTES or pf_size != _PIXEL_FORMAT_BYTES:
        rule = f"sizes must be {_HEADER_BYTES} and {_PIXEL_FORMAT_BYTES}, got {size} and {pf_size}"
        raise FormatError(path, "header", rule, "copy or export it again")
    if not pf_flags & _HAS_FOURCC:
        raise FormatError(path, "format", "the pixels are not block-compressed", "convert it to one of BC1 to BC7")
    layers, start = 1, len(_MAGIC) + _HEADER_BYTES
    if fourcc == b"DX10":
        if len(data) < start + _HEADER_DX10.size:
            raise FormatError(path, "header", "the DX10 header is truncated", "copy or export it again")
        dxgi, dimension, misc, layers, _ = _HEADER_DX10.unpack_from(data, start)
        start += _HEADER_DX10.size
        name, got = _BY_DXGI.get(dxgi), f"DXGI format {dxgi}"
        plain = dimension == _TEXTURE_2D and not misc & _MISC_CUBE
    else:
        name, got, plain = _BY_FOURCC.get(fourcc), f"FourCC {fourcc!r}", True
    if name is None:
        raise FormatError(
            path, "format", f"{got} is none that this release reads", f"convert it to {', '.join(FORMATS)}"
        )
    if not plain or caps2 & (_CAPS2_CUBE | _CAPS2_VOLUME):
        raise FormatError(path, "dimension", "it is a cube map, a volume or a 1D texture", "export a 2D texture")
    mips = max(1, mips)  # many writers leave 0 where there is only one
    check_size(path, width, height, mips, layers)
    sizes = [mip_bytes(name, width, height, m) for m in range(mips)]
    if len(data) - start < layers * sum(sizes):
        rule = f"{layers} layers of {mips} mips need {layers * sum(sizes)} bytes, the file has {len(data) - start}"
        raise FormatError(path, "data", rule, "copy or export it again")
    levels = []
    for _ in range(layers):
        chain = []
        for mip, count in enumerate(sizes):
            blocks = np.frombuffer(data, np.uint8, count, start).copy()
            chain.append(blocks.reshape(mip_shape(name, width, height, mip)))
            start += count
        levels.append(tuple(chain))
    return BlockTexture(name, width, height, tuple(levels))
