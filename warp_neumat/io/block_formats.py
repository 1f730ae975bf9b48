"""Block-compressed texture formats: their names, their numbers in DDS, KTX2 and Vulkan files, and textures of them.

A block holds 4 × 4 texels, texel t = 4·y + x, in 8 or 16 bytes. A picture of H × W texels is a grid of ceil(H/4) rows
and ceil(W/4) columns of blocks, row-major, top row first; texels beyond the right and lower edge are padding. The
bytes of a block are the same in DDS, in KTX2 and in the memory of a GPU.
"""

import dataclasses
from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError


@dataclasses.dataclass(frozen=True)
class BlockFormat:
    """One format: how we call it and how files do.

    Attributes:
        name: As ``"bc6h_uf16"``: family, then what a decoder gives (unorm, snorm, srgb, uf16, sf16).
        block_bytes: Bytes of a block, 8 or 16.
        dxgi: DXGI_FORMAT, the number in a DDS file.
        vk: VkFormat, the number in a KTX2 file.
        channels: Components of a texel, 1 to 4.
    """

    name: str
    block_bytes: int
    dxgi: int
    vk: int
    channels: int

    @property
    def family(self) -> str:
        """The name without its suffix: ``"bc1"`` … ``"bc7"``, ``"bc6h"``."""
        return self.name.split("_", 1)[0]

    @property
    def srgb(self) -> bool:
        """Whether a GPU turns the colours that it reads from sRGB to linear."""
        return self.name.endswith("_srgb")

    @property
    def signed(self) -> bool:
        """Whether values may be negative."""
        return self.name.endswith(("_snorm", "_sf16"))


FORMATS: dict[str, BlockFormat] = {
    f.name: f
    for f in (
        BlockFormat("bc1_unorm", 8, 71, 133, 4),
        BlockFormat("bc1_srgb", 8, 72, 134, 4),
        BlockFormat("bc3_unorm", 16, 77, 137, 4),
        BlockFormat("bc3_srgb", 16, 78, 138, 4),
        BlockFormat("bc4_unorm", 8, 80, 139, 1),
        BlockFormat("bc4_snorm", 8, 81, 140, 1),
        BlockFormat("bc5_unorm", 16, 83, 141, 2),
        BlockFormat("bc5_snorm", 16, 84, 142, 2),
        BlockFormat("bc6h_uf16", 16, 95, 143, 3),
        BlockFormat("bc6h_sf16", 16, 96, 144, 3),
        BlockFormat("bc7_unorm", 16, 98, 145, 4),
        BlockFormat("bc7_srgb", 16, 99, 146, 4),
    )
}
"""Every format that this package reads and writes, by name."""


def grid(width: int, height: int) -> tuple[int, int]:
    """Return (rows, columns) of the blocks that hold ``height`` × ``width`` texels."""
    return -(-height // 4), -(-width // 4)


def mip_size(width: int, height: int, mip: int) -> tuple[int, int]:
    """Return (width, height) of mip level ``mip``: mip 0 halved ``mip`` times, rounded down, at least 1."""
    return max(1, width >> mip), max(1, height >> mip)


def mip_limit(width: int, height: int) -> int:
    """Return how many mip levels a texture can have, down to 1 × 1."""
    return max(width, height).bit_length()


def mip_shape(format: str, width: int, height: int, mip: int) -> tuple[int, int, int]:
    """Return (rows, columns, block bytes) of mip level ``mip``."""
    return (*grid(*mip_size(width, height, mip)), FORMATS[format].block_bytes)


def mip_bytes(format: str, width: int, height: int, mip: int) -> int:
    """Return the bytes of mip level ``mip`` of one layer."""
    rows, columns, size = mip_shape(format, width, height, mip)
    return rows * columns * size


@dataclasses.dataclass(frozen=True, eq=False)
class BlockTexture:
    """A block-compressed texture with its mips, or an array of several alike.

    Attributes:
        format: A key of :data:`FORMATS`.
        width: Texels across of mip 0; need not be a multiple of 4.
        height: Texels down of mip 0.
        levels: ``levels[layer][mip]``, uint8 of shape (rows, columns, block bytes) as :func:`mip_shape` says.

    Raises:
        ValueError: If the format is unknown or an array has another shape.
        TypeError: If an array is not uint8.
    """

    format: str
    width: int
    height: int
    levels: tuple[tuple[np.ndarray, ...], ...]

    def __post_init__(self):
        if self.format not in FORMATS:
            raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {self.format!r}")
        if not 1 <= self.width < 2**31 or not 1 <= self.height < 2**31:
            raise ValueError(f"width and height must be at least 1, got {self.width} and {self.height}")
        object.__setattr__(self, "levels", tuple(tuple(mips) for mips in self.levels))
        limit = mip_limit(self.width, self.height)
        if not self.levels or not 1 <= len(self.levels[0]) <= limit:
            raise ValueError(f"levels must hold at least one layer of 1 to {limit} mips for {self.width}x{self.height}")
        for layer, mips in enumerate(self.levels):
            if len(mips) != len(self.levels[0]):
                raise ValueError(f"levels[{layer}] must have {len(self.levels[0])} mips like layer 0, got {len(mips)}")
            for mip, blocks in enumerate(mips):
                shape = mip_shape(self.format, self.width, self.height, mip)
                if not isinstance(blocks, np.ndarray) or blocks.dtype != np.uint8:
                    kind = getattr(blocks, "dtype", type(blocks).__name__)
                    raise TypeError(f"levels[{layer}][{mip}] must be a numpy array of uint8, got {kind}")
                if blocks.shape != shape:
                    raise ValueError(f"levels[{layer}][{mip}] must have shape {shape}, got {blocks.shape}")

    @property
    def layers(self) -> int:
        """Number of layers; 1 for a plain texture."""
        return len(self.levels)

    @property
    def mips(self) -> int:
        """Number of mip levels of each layer."""
        return len(self.levels[0])

    @property
    def nbytes(self) -> int:
        """Bytes of all blocks, without any file header."""
        return sum(blocks.nbytes for mips in self.levels for blocks in mips)

    def size(self, mip: int = 0) -> tuple[int, int]:
        """Return (width, height) of mip level ``mip`` in texels."""
        return mip_size(self.width, self.height, mip)


# --- texels in blocks -------------------------------------------------------------------------------------------------


def to_blocks(picture: np.ndarray) -> np.ndarray:
    """Cut a picture into blocks of 4 × 4 texels; the last row and column are repeated where it does not fill them.

    Args:
        picture: (H, W, C) or (H, W), any type.

    Returns: (rows, columns, 4, 4, C) or (rows, columns, 4, 4), contiguous, same type.
    Raises: ValueError: If it has no texel or another number of axes.
    """
    picture = np.asarray(picture)
    if picture.ndim not in (2, 3) or 0 in picture.shape:
        raise ValueError(f"picture must have shape (H, W) or (H, W, C) with at least one texel, got {picture.shape}")
    height, width, *rest = picture.shape
    rows, columns = grid(width, height)
    edges = [(0, 4 * rows - height), (0, 4 * columns - width)] + [(0, 0)] * len(rest)
    padded = np.pad(picture, edges, mode="edge") if any(after for _, after in edges) else picture
    return np.ascontiguousarray(padded.reshape(rows, 4, columns, 4, *rest).swapaxes(1, 2))


def from_blocks(texels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the picture whose blocks are ``texels``: the inverse of :func:`to_blocks`, padding cut off.

    Args:
        texels: (N, 4, 4, …) or (rows, columns, 4, 4, …), as the decoders of ``kernels`` give them.
        width: Texels across.
        height: Texels down.

    Returns: (H, W, …), contiguous, same type.
    Raises: ValueError: If there are more or fewer blocks than the size needs.
    """
    texels, (rows, columns) = np.asarray(texels), grid(width, height)
    if texels.shape[:4] == (rows, columns, 4, 4):
        rest = texels.shape[4:]
    elif texels.shape[:3] == (rows * columns, 4, 4):
        rest = texels.shape[3:]
    else:
        raise ValueError(
            f"texels must have shape ({rows * columns}, 4, 4, …) or ({rows}, {columns}, 4, 4, …)"
            f" for {width}x{height}, got {texels.shape}"
        )
    picture = texels.reshape(rows, columns, 4, 4, *rest).swapaxes(1, 2).reshape(4 * rows, 4 * columns, *rest)
    return np.ascontiguousarray(picture[:height, :width])


# --- shared by the readers --------------------------------------------------------------------------------------------


def read_file(path, kind: str, magic: bytes, least: int) -> bytes:
    """Return the bytes of the ``kind`` file at ``path``, which starts with ``magic`` and has ``least`` or more bytes.

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If it is something else.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the path of a {kind} file")
    with open(path, "rb") as file:
        start = file.read(len(magic))  # a huge file of another kind is not read
        if start != magic:
            rule = f"a {kind} file starts with {magic!r}, got {start!r}"
            raise FormatError(path, "file", rule, f"give a {kind} file")
        data = start + file.read()
    if len(data) < least:
        rule = f"a {kind} file has at least {least} bytes, got {len(data)}"
        raise FormatError(path, "header", rule, "copy or export it again")
    return data


def check_size(path, width: int, height: int, mips: int, layers: int) -> None:
    """Raise a FormatError unless a texture of these numbers, as read from ``path``, is possible."""
    again = "copy or export it again"
    if not 1 <= width < 2**31 or not 1 <= height < 2**31:
        raise FormatError(
            path, "size", f"both sides must be at least 1 texel and below 2^31, got {width}x{height}", again
        )
    if not 1 <= mips <= mip_limit(width, height):
        limit = mip_limit(width, height)
        raise FormatError(path, "mips", f"{width}x{height} has 1 to {limit} mip levels, got {mips}", again)
    if layers < 1:
        raise FormatError(path, "layers", f"there must be at least 1, got {layers}", again)
