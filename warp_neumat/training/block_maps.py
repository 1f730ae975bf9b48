"""What a fit does with maps that networks write the blocks of: model ``ntbc``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from warp_neumat.io.block_formats import to_blocks
from warp_neumat.kernels.block_fit import (
    bc1_encode,
    bc1_endpoints,
    bc4_encode,
    bc4_endpoints,
    bc7_encode,
    bc7_endpoints,
)
from warp_neumat.materials.ntbc import NTBC as NTBCMaterial
from warp_neumat.models.ntbc import plane_colours
from warp_neumat.models.ntbc_config import MODES
from warp_neumat.training.maps import MapData, mean_psnr
from warp_neumat.training.ntbc_loop import NTBCTrainer


class BlockMapData(MapData):
    """What a fit does with sources of kind ``block_maps``: folders of PBR textures, as for ``maps``."""

    UNIT = 8
    BATCHES = 256
    """Steps of an epoch, which the batch is chosen for: so every texture is seen equally often."""

    @classmethod
    def batch(cls, shape) -> int:
        """Return the blocks that a step takes: a share of the texture's, 128 to 4,096."""
        return 8 * round(min(max(shape.rows * shape.columns / cls.BATCHES, 128), 4096) / 8)

    @staticmethod
    def described(source, shape) -> str:
        """Return the table of maps, and a line on what is written and by how much."""
        written = ", ".join(f"{texture.name} {texture.format}" for texture in shape.textures)
        finest = " and ".join(
            f"{m.texel.levels[-1][0]}×{m.texel.levels[-1][1]} at {m.texel.bits} bits" for m in shape.models
        )
        share = f"{100 * shape.bytes / shape.block_bytes:.0f} %"
        return (
            f"{source.table()}\nblocks: {written}: {shape.block_bytes} bytes with mips"
            f"\nfile: {shape.bytes} bytes, {share} of that; finest grids: {finest}{_note(shape)}"
        )

    @staticmethod
    def trainer(module, source, shape, plan, device, *, checkpoint, **more):
        """Return the trainer of the texture set."""
        pixels = source.pixels
        return NTBCTrainer(
            module.build(shape, plan.seed).to(device),
            pixels,
            lambda planes: reference_endpoints(planes, pixels),
            plan,
            checkpoint_path=checkpoint,
            **more,
        )

    @staticmethod
    def stored(module, source, trainer) -> tuple[dict, dict, dict]:
        """Return (tensors, header, metrics); the PSNR is of the decoded blocks, averaged over all mips."""
        tensors, header = trainer.model.to_asset()
        material = NTBCMaterial(tensors, header, path=Path(source.name), device="cpu")
        header["maps"] = {"files": source.files, "notes": list(source.notes)}
        psnr = mean_psnr(source.mips(), material.encoded)
        return tensors, header, {"psnr": psnr, "block_bytes": material.block_bytes}


def _note(shape) -> str:
    if shape.bytes <= max(MODES.values()) * shape.block_bytes:
        return ""
    return "\nnote: networks pay for themselves on larger maps; of small ones take many together, or store the blocks"


def reference_endpoints(planes, pixels: np.ndarray) -> torch.Tensor:
    """Return the endpoints of the best block compression of a picture, plane by plane, (blocks, 2c) float32.

    The encoders are those of :mod:`warp_neumat.kernels.block_fit`, which keep more than any of PyPI's (paper:
    Compressonator). The brighter endpoint is e₀.
    """
    found = []
    for plane in planes:
        blocks = to_blocks(plane_colours(plane, pixels))
        blocks = np.ascontiguousarray(blocks.reshape(-1, 4, 4, plane.components))
        if plane.format == "bc4":
            found.append(bc4_endpoints(bc4_encode(blocks[..., 0])))
        elif plane.format == "bc1":
            found.append(bc1_endpoints(bc1_encode(blocks)))
        else:
            found.append(bc7_endpoints(bc7_encode(blocks), plane.components))
    return torch.from_numpy(np.ascontiguousarray(np.concatenate(found, axis=1), np.float32))
