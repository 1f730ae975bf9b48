"""What a fit does with folders of PBR maps: open, describe, train, store; for ``bcf``, and the pattern for ``ntbc``."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np

from warp_neumat.io.texture_set import open_texture_set
from warp_neumat.materials.bcf import BCf as BCfMaterial
from warp_neumat.training.block_loop import BlockTrainer
from warp_neumat.training.evaluate_maps import sample_grid
from warp_neumat.training.presets import PRESETS, length_of


class MapData:
    """What a fit does with sources of kind ``maps``: folders of PBR textures."""

    OPTIONS = ("size", "crop", "overrides")
    BATCH = 16384
    UNIT = 256
    """What a batch is a multiple of."""
    open = staticmethod(open_texture_set)

    @classmethod
    def configured(cls, module, source, preset, options):
        """Return (length factor, batch, config); a preset names the sizes of the features, or the length."""
        length, unit = preset if preset in PRESETS else None, cls.UNIT
        batch = options.pop("batch", None)
        if batch is not None and (
            isinstance(batch, bool) or not isinstance(batch, int) or batch < unit or batch % unit
        ):
            raise ValueError(f"batch must be a multiple of {unit}, got {batch!r}")
        if preset is not None and length is None:
            length_of(preset, {**PRESETS, **module.PRESETS})
        try:
            shape = module.configure(source, options, None if length else preset)
        except TypeError as error:
            given = ", ".join(f"{name}={value!r}" for name, value in options.items())
            raise ValueError(f"an option is of the wrong type: {given} ({error})") from None
        return length_of(length), batch or cls.batch(shape), shape

    @staticmethod
    def batch(shape) -> int:
        """Return the samples a step takes: 2¹⁴, and in proportion to the features beyond 2¹⁷ texels, up to 2¹⁷."""
        share = shape.pyramids.texel_count / (1 << 17)
        return 256 * round(min(max(share, 1.0), 8.0) * MapData.BATCH / 256)

    @staticmethod
    def opening(source, arguments: dict) -> dict:
        """Return the arguments that open the source equally: size and crop as they were settled, and overrides."""
        settled = source.manifest()
        found = {name: settled[name] for name in ("size", "crop") if name in settled}
        if arguments.get("overrides"):
            found["overrides"] = json.loads(json.dumps(arguments["overrides"], default=os.fspath))
        return found

    @staticmethod
    def described(source, shape) -> str:
        """Return the table of maps and a line on the feature textures."""
        sizes = ", ".join(f"{width}×{height}" for width, height in shape.features)
        return f"{source.table()}\nfeature textures: {sizes}"

    @staticmethod
    def trainer(module, source, shape, plan, device, *, checkpoint, **more):
        """Return the trainer of the texture set."""
        mips = source.mips()
        mean = mips[0].reshape(-1, mips[0].shape[2]).mean(axis=0)
        model = module.build(shape, plan.seed, mean).to(device)
        return BlockTrainer(model, mips, plan, checkpoint_path=checkpoint, **more)

    @staticmethod
    def stored(module, source, trainer) -> tuple[dict, dict, dict]:
        """Return (tensors, header, metrics); metrics hold the PSNR averaged over mips, as the paper does."""
        tensors, header = trainer.model.to_asset(trainer.packed)
        material = BCfMaterial(tensors, header, path=Path(source.name), device="cpu")
        header["maps"] = {"files": source.files, "notes": list(source.notes)}
        return tensors, header, {"psnr": mean_psnr(trainer.mips, material.encoded)}


def mean_psnr(mips, encoded) -> float:
    """Return the PSNR [dB] of the squared error averaged over channels and mips, each mip counting the same."""
    errors = []
    for level, picture in enumerate(mips):
        height, width, channels = picture.shape
        decoded = sample_grid(encoded, height, width, channels, float(level))
        errors.append(float(np.square(decoded - picture).mean(dtype=np.float64)))
    return round(-10.0 * math.log10(max(np.mean(errors), 1e-12)), 4)
