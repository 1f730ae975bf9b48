"""Features that are quantised instead of compressed, the other way to few bits (BCf §6.4, Fig. 13).

Free texels of 3n channels are trained, then rounded to q bits within the feature range, and trained on through the
rounding (straight-through), then the network alone. Everything else is as in the fit.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from warp_neumat.kernels.patches import PATCH, draw_patches, pad_reference
from warp_neumat.models import bcf
from warp_neumat.ops import Step
from warp_neumat.training.fit import MapData

SHARES = {"free": 0.5, "rounded": 0.4, "network": 0.1}


class QuantisedFeatures:
    """A material with features of ``channels`` (a multiple of 3) times ``bits`` at every level of BCf's pyramids.

    Attributes:
        bytes: Of features, bit-packed, and the float16 weights.
    """

    def __init__(self, opened, mips, *, channels: int, bits: int, scale: float, steps: int | None, seed: int):
        if channels % 3:
            raise ValueError(f"channels must be a multiple of 3, got {channels}")
        longest = max(opened.width, opened.height)
        sides = [max(4, round(scale * fraction * longest)) for fraction in bcf.PRESETS["1k"]]
        sides = [side for side in sides for _ in range(channels // 3)]
        self.config = bcf.configure(opened, {"features": tuple(sides)})
        mean = mips[0].reshape(-1, mips[0].shape[2]).mean(axis=0)
        self.model = bcf.build(self.config, seed, mean)
        self.bits, self.steps, self.seed = bits, steps or bcf.DEFAULT_STEPS, seed
        texels = sum(w * h for levels in self.config.mips for w, h in levels)
        self.bytes = math.ceil(3 * texels * bits / 8) + 2 * self.config.shape.weights
        self._train(mips)
        offsets = [row[0] for row in self.config.pyramids.feature_offsets] + [self.config.pyramids.texel_count]
        self._pictures = [
            bcf._images(self.model.texels[offsets[t] : offsets[t + 1]], levels)
            for t, levels in enumerate(self.config.mips)
        ]

    def _rounded(self, texels: torch.Tensor) -> torch.Tensor:
        low, high = self.config.feature_range
        step = (high - low) / (2**self.bits - 1)
        return low + torch.round((texels - low) / step) * step

    def _train(self, mips) -> None:
        model, pyramids, shape = self.model, self.config.pyramids, self.config.shape
        latent, net = model.texels.clone(), model.net
        reference = torch.from_numpy(pad_reference(mips, shape.stride, "repeat"))
        step = Step(pyramids, shape, model.texels, net, reference, MapData.BATCH // PATCH, 2)
        optimiser = torch.optim.Adam(
            [{"params": [latent], "lr": 2e-2}, {"params": [net], "lr": 5e-3}], betas=(0.9, 0.99), eps=1e-14, fused=True
        )
        low, high = self.config.feature_range
        for number in range(self.steps):
            at = number / self.steps
            rounded, frozen = at >= SHARES["free"], at >= 1.0 - SHARES["network"]
            for group, (first, last) in zip(optimiser.param_groups, ((2e-2, 2e-4), (5e-3, 1e-4)), strict=True):
                group["lr"] = first * (last / first) ** at
            if frozen:
                optimiser.param_groups[0]["lr"] = 0.0
            model.texels.copy_(self._rounded(latent) if rounded else latent)
            step.run(
                torch.from_numpy(draw_patches(self.seed, number, len(step.patches), pyramids)), number * 2654435761
            )
            latent.grad, net.grad = step.texel_gradient.sum(0), step.weight_gradient.sum(0)
            optimiser.step()
            latent.clamp_(low, high)
        model.texels.copy_(self._rounded(latent))
        net.copy_(net.half().float())
        latent.grad = net.grad = None

    def encoded(self, uv: np.ndarray, lod) -> np.ndarray:
        """Return the network's outputs in [0, 1], (n, C), as a material does; ``lod`` is one number."""
        where, s = torch.from_numpy(np.ascontiguousarray(uv, np.float32)), float(np.ravel(lod)[0])
        inputs = [
            bcf._trilinear(pictures, where, min(max(s + bias, 0.0), len(pictures) - 1.0), "bilinear", True)
            for pictures, bias in zip(self._pictures, self.config.pyramids.biases, strict=True)
        ]
        w0, b0, w1, b1 = self.model.layers()
        return (torch.relu(torch.cat(inputs, 1) @ w0 + b0) @ w1 + b1).clamp(0.0, 1.0).numpy()
