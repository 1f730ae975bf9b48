"""Maps in ordinary block-compressed textures (BC1, BC3, BC4, BC5, BC7), as any engine samples them.

Every mip is decoded once, by the bit-exact decoders of this package, to UNORM8: number v stands for v/255, in the
encoded domain of its channel (a ``_srgb`` format is not linearised before it is filtered; its channel's encoding says
what comes after). Channels lie by threes in the storage ``rgba8`` of :mod:`warp_neumat.kernels.bcf_storage`, four bytes
a texel, in the order of the channels, so that the features that :mod:`warp_neumat.kernels.bcf` samples are the
channels, and there is no network behind them. Beside the storage ``half``, which could hold them too, this takes half
the memory, is exact, and needs no neighbour beside a texel, for a tenth to a quarter of the speed.
"""

from collections.abc import Sequence

import numpy as np

from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import FORMATS, BlockTexture
from warp_neumat.kernels import bcf as kernels
from warp_neumat.kernels.bc1 import bc1_decode, bc3_decode
from warp_neumat.kernels.bc4 import bc4_decode, bc5_decode
from warp_neumat.kernels.bc7 import bc7_decode
from warp_neumat.kernels.filter import MOST_MIPS, level_table
from warp_neumat.materials.map_config import check_maps
from warp_neumat.materials.map_material import MapMaterial

DECODERS = {"bc1": bc1_decode, "bc3": bc3_decode, "bc4": bc4_decode, "bc5": bc5_decode, "bc7": bc7_decode}
"""Decoder of each family that maps may lie in."""

STORAGE = "rgba8"
"""How decoded texels lie in memory."""


class BlockMaps(MapMaterial):
    """A material whose channels lie in block-compressed textures of one size.

    Args:
        textures: The textures, alike in width, height and mips, one layer each.
        sources: For each channel (number of its texture, component 0 … 3 in it).
        config: ``width`` and ``height`` of the textures, ``wrap``, ``channels`` and ``constants`` as
            :mod:`~warp_neumat.materials.map_config` says; further fields are left alone.
        name: For reports.
        header: What :attr:`header` is; default: kind and config alone.
        device: Warp device.

    Raises:
        FormatError: If the config is not what it should be.
        ValueError: If a texture is signed, floating point or an array, or textures and sources do not fit together.

    Error: at texel centres of a mip :meth:`encoded` is v/255 within 2e-7; held by test_texel_centres_are_exact.
    """

    kind = "block_maps"

    def __init__(
        self,
        textures: Sequence[BlockTexture],
        sources: Sequence[tuple[int, int]],
        config: dict,
        *,
        name: str = "maps",
        header: dict | None = None,
        device=None,
    ):
        check_maps(config, name)
        self.name = name
        self.header = {"kind": self.kind, "version": 1, "config": config} if header is None else header
        self.textures = tuple(textures)
        """The textures, ``BlockTexture`` each, as :func:`warp_neumat.write_dds` writes them."""
        self.sources = tuple((int(t), int(c)) for t, c in sources)
        """Texture and component of each channel."""
        _check(self.textures, self.sources, config, name)
        self.block_bytes = sum(t.nbytes for t in self.textures)
        """Bytes of all blocks."""
        self.bytes = self.block_bytes
        groups = -(-len(self.sources) // 3)
        first = self.textures[0]
        size = (first.width, first.height)
        try:
            levels, _ = level_table([size] * groups, [0.0] * groups, [first.mips] * groups)
        except ValueError as error:
            raise FormatError(name, "textures", str(error), "use smaller ones") from None
        texels = interleave(self.textures, self.sources)
        self.stored_bytes = texels.nbytes
        """Bytes of the decoded texels on the device."""
        held = {
            "texels": texels.ravel(),
            "tables": np.zeros(1, np.uint8),
            "levels": levels,
            "weights": np.zeros(1, np.float32),
        }
        layout = kernels.Layout(groups, 0, 3 * groups, config["wrap"], False, STORAGE)
        super().__init__(config, layout, held, device)


def decode_texture(texture: BlockTexture) -> np.ndarray:
    """Return the texels of all mips of ``texture``'s first layer, one after another, (blocks, 4, 4, k) uint8."""
    size = FORMATS[texture.format].block_bytes
    blocks = np.concatenate([mip.reshape(-1, size) for mip in texture.levels[0]])
    texels = DECODERS[FORMATS[texture.format].family](blocks)
    return texels.reshape(*texels.shape[:3], -1)


def interleave(textures: Sequence[BlockTexture], sources: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return channels in the storage ``rgba8``, three a texel, (groups, blocks, 4, 4, 4) uint8, unused bytes 0."""
    groups = -(-len(sources) // 3)
    result = None
    for t, texture in enumerate(textures):
        wanted = [(k, component) for k, (source, component) in enumerate(sources) if source == t]
        if not wanted:
            continue
        texels = decode_texture(texture)
        if result is None:
            result = np.zeros((groups, len(texels), 4, 4, 4), np.uint8)
        for k, component in wanted:
            result[k // 3, ..., k % 3] = texels[..., component]
    return result


def _check(textures, sources, config: dict, name: str) -> None:
    """Raise a ValueError unless the channels lie where ``sources`` says, in textures that are all alike."""
    if not textures:
        raise ValueError(f"{name}: textures must hold at least one")
    size = (config["width"], config["height"])
    for t, texture in enumerate(textures):
        where, format = f"{name}: textures[{t}]", FORMATS[texture.format]
        if format.family not in DECODERS or format.signed:
            raise ValueError(f"{where} must be unsigned BC1, BC3, BC4, BC5 or BC7, got {texture.format}")
        if texture.layers != 1 or texture.mips != textures[0].mips or texture.mips > MOST_MIPS:
            have = f"{texture.layers} and {texture.mips}"
            raise ValueError(f"{where} must have one layer, and {textures[0].mips} mips up to {MOST_MIPS}, got {have}")
        if (texture.width, texture.height) != size:
            have = f"{texture.width}x{texture.height}"
            raise ValueError(f"{where} must be {size[0]}x{size[1]} as the config says, got {have}")
    if len(sources) != len(config["channels"]):
        raise ValueError(f"{name}: sources must name {len(config['channels'])} channels, got {len(sources)}")
    for k, (t, component) in enumerate(sources):
        if not 0 <= t < len(textures) or not 0 <= component < FORMATS[textures[t].format].channels:
            raise ValueError(f"{name}: sources[{k}]: there is no component {component} of texture {t}")
