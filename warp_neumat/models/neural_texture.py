"""A mip-mapped texture of learned features, the plug-in for what varies over a surface (NeuBRDF Sec. 3.4, Eq. 4)."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from warp_neumat.io.mipmaps import mip_sizes


class NeuralTexture(nn.Module):
    """Features by texture coordinate and level of detail; repeats beyond [0, 1).

    Args:
        width, height: Texels of the finest mip; every further mip halves both, down to 1×1.
        channels: Features of a texel.
        generator: Draws the initial features.

    ``texels`` is (P, channels): all mips, finest first, row by row, v downwards.
    """

    TAPS = 8
    """Rows that a look-up mixes: bilinear in two mips."""

    def __init__(self, width: int, height: int, channels: int, *, generator: torch.Generator):
        super().__init__()
        self.sizes = mip_sizes(width, height)
        count = sum(w * h for w, h in self.sizes)
        self.texels = nn.Parameter(torch.randn(count, channels, generator=generator) * 0.05)

    def taps(self, uv: torch.Tensor, lod: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the rows (B, 8) int32 and weights (B, 8) float32 of trilinear look-ups.

        Args:
            uv: Texture coordinates, (B, 2) float32; texel i of W is centred at (i + ½)/W.
            lod: Mip level of this texture, (B,) float32, 0 = finest; clamped to what there is.
        """
        device, top = uv.device, len(self.sizes) - 1
        size = torch.tensor(self.sizes, dtype=torch.int64, device=device)
        start = torch.cumsum(size[:, 0] * size[:, 1], 0) - size[:, 0] * size[:, 1]
        level = lod.clamp(0.0, float(top))
        fine = level.floor().clamp_max(max(top - 1, 0)).long()
        rest = level - fine
        rows, weights = [], []
        for mip, share in ((fine, 1.0 - rest), ((fine + 1).clamp_max(top), rest)):
            w, h = size[mip, 0], size[mip, 1]
            x, y = uv[:, 0] * w - 0.5, uv[:, 1] * h - 0.5
            x0, y0 = x.floor(), y.floor()
            fx, fy = x - x0, y - y0
            for dy, wy in ((0, 1.0 - fy), (1, fy)):
                for dx, wx in ((0, 1.0 - fx), (1, fx)):
                    column, row = (x0.long() + dx) % w, (y0.long() + dy) % h
                    rows.append(start[mip] + row * w + column)
                    weights.append(share * wx * wy)
        return torch.stack(rows, 1).int(), torch.stack(weights, 1)

    def mips(self) -> list[np.ndarray]:
        """Return the mips as stored, (h, w, channels) float16, finest first."""
        found, at = [], 0
        texels = self.texels.detach().half().cpu().numpy()
        for width, height in self.sizes:
            found.append(texels[at : at + width * height].reshape(height, width, -1).copy())
            at += width * height
        return found

    @torch.no_grad()
    def load(self, mips: list[np.ndarray]) -> None:
        """Take the features out of stored mips."""
        flat = np.concatenate([mip.reshape(-1, mip.shape[2]) for mip in mips])
        self.texels.copy_(torch.from_numpy(flat.astype(np.float32)))
