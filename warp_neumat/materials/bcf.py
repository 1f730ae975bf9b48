"""BCf at run time: block-compressed feature textures and a small network on a device (paper [bcf], Eq. 3, 10, 11)."""

import math
from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError, expect
from warp_neumat.io.block_formats import BlockTexture, grid, mip_limit, mip_size
from warp_neumat.kernels import bcf as kernels
from warp_neumat.kernels import bcf_storage
from warp_neumat.kernels.bc6h import bc6h_decode
from warp_neumat.kernels.filter import MOST_MIPS, level_table
from warp_neumat.kernels.mlp import pack
from warp_neumat.materials.map_config import AGAIN, check_maps, check_object, whole_number
from warp_neumat.materials.map_material import MapMaterial


class BCf(MapMaterial):
    """A material whose maps are decoded from block-compressed features, at any place and scale.

    Args:
        tensors: ``texture{t}.mip{m}`` uint8 (rows, columns, 16) BC6H blocks; ``weight0`` (H, 3T), ``bias0`` (H,),
            ``weight1`` (C, H), ``bias1`` (C,) float16.
        header: The asset's header; its config says sizes, wrap mode, channels and constants.
        path: Where they come from, for messages.
        device: Warp device.
        storage: How features lie in memory: ``"blocks"``, ``"unquantised"`` or ``"half"``, 1, 4 or 8 bytes a texel; the
            results are the same. Each is faster than the one before it, at random places by half or more;
            ``kernels.bcf_storage`` has the figures.

    Raises:
        FormatError: If an array is missing, has another shape or type, or the config is not one of this kind.
        ValueError: If there is no such storage.
    """

    kind = "bcf"

    def __init__(
        self,
        tensors: dict,
        header: dict,
        *,
        path: Path = Path("asset"),
        device=None,
        storage: str = "unquantised",
    ):
        if storage not in kernels.STORAGES:
            raise ValueError(f"storage must be one of {', '.join(kernels.STORAGES)}, got {storage!r}")
        self.header, self.name = header, path.stem
        self.bytes = sum(t.nbytes for t in tensors.values())
        config = _checked(header.get("config"), path)
        signed = config["signed"]
        self.textures = tuple(_texture(tensors, t, signed, config, path) for t in range(len(config["textures"])))
        """The feature textures, ``BlockTexture`` each."""
        count, hidden, outputs = len(self.textures), config["hidden"], len(config["channels"])
        weights, biases = [], []
        for n, (i, o) in enumerate(((3 * count, hidden), (hidden, outputs))):
            weights.append(expect(tensors, f"weight{n}", "float16", (o, i), path))
            biases.append(expect(tensors, f"bias{n}", "float16", (o,), path))
        self.weights = {f"weight{n}": w for n, w in enumerate(weights)} | {f"bias{n}": b for n, b in enumerate(biases)}
        """The network as it is stored: ``weight0`` (H, 3T), ``bias0``, ``weight1`` (C, H), ``bias1``, float16."""

        blocks = np.concatenate([b.reshape(-1, 16) for t in self.textures for b in t.levels[0]])
        wide = bcf_storage.unquantise(blocks, signed) if signed or storage == "unquantised" else None
        if signed and bcf_storage.overflows(wide).any():
            raise FormatError(path, "texture", "a block of mode 14 holds −32768, which decodes to −∞", AGAIN)
        sizes = [(t.width, t.height) for t in self.textures]
        biases_of_level = [math.log2(max(w / config["width"], h / config["height"])) for w, h in sizes]
        try:
            levels, _ = level_table(sizes, biases_of_level, [t.mips for t in self.textures])
        except ValueError as error:
            raise FormatError(path, "textures", str(error), "fit smaller ones") from None
        self.stored_bytes = len(blocks) * bcf_storage.BLOCK_BYTES[storage]
        """Bytes of the features on the device, in their storage."""
        if storage == "half":
            texels = np.concatenate(
                [
                    bcf_storage.paired(
                        bc6h_decode(b.reshape(-1, 16), signed).reshape(*b.shape[:2], 4, 4, 3),
                        *mip_size(t.width, t.height, m),
                        config["wrap"] == "repeat",
                    )
                    for t in self.textures
                    for m, b in enumerate(t.levels[0])
                ]
            )
        else:
            texels = (wide if storage == "unquantised" else blocks).ravel()
        held = {
            "texels": texels,
            "tables": bcf_storage.packed_tables(signed),
            "levels": levels,
            "weights": pack(weights, biases),
        }
        layout = kernels.Layout(count, hidden, outputs, config["wrap"], signed, storage)
        super().__init__(config, layout, held, device)


# ---- what an asset must hold -----------------------------------------------------------------------------------------


def _checked(config, path) -> dict:
    """Return ``config`` if everything in it can be read.

    Raises: FormatError: Naming the first field that cannot.
    """
    check_maps(config, path)
    whole_number(config, "hidden", 1, 512, path)
    if not isinstance(config.get("signed"), bool):
        raise FormatError(path, "config.signed", f"must be true or false, got {config.get('signed')!r}", AGAIN)
    textures = config.get("textures")
    if not isinstance(textures, list) or not 1 <= len(textures) <= 64:
        raise FormatError(path, "config.textures", f"must list 1 to 64 textures, got {textures!r}", AGAIN)
    for t, texture in enumerate(textures):
        field = f"config.textures[{t}]"
        check_object(texture, field, path)
        most = (1 << MOST_MIPS) - 1
        width, height = (whole_number(texture, name, 1, most, path, field) for name in ("width", "height"))
        whole_number(texture, "mips", 1, mip_limit(width, height), path, field)
    return config


def _texture(tensors: dict, t: int, signed: bool, config: dict, path) -> BlockTexture:
    """Return feature texture ``t`` of an asset.

    Raises: FormatError: If a mip is missing or has another shape.
    """
    facts = config["textures"][t]
    width, height = facts["width"], facts["height"]
    mips = tuple(
        expect(tensors, f"texture{t}.mip{m}", "uint8", (*grid(*mip_size(width, height, m)), 16), path)
        for m in range(facts["mips"])
    )
    return BlockTexture("bc6h_sf16" if signed else "bc6h_uf16", width, height, (mips,))
