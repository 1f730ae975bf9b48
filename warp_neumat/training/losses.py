"""What a fit minimises, by kind of data."""

from __future__ import annotations

import torch

SHARPNESS = 12.0
"""Scale s of :class:`LogCosine`: below 1/s the loss is linear in the radiance, above it sees ratios."""


class LogCosine:
    """Mean |g(f̂ cosθ_i) − g(f cosθ_i)| with g(x) = log(1 + s·x), rounded off at 0 (Charbonnier).

    Reflected radiance spans five orders of magnitude. The logarithm keeps a mirror peak from drowning the rest, and s
    puts the linear part where display encoding is nearly linear too: dark tones count as they are seen.
    """

    def __init__(self, sharpness: float = SHARPNESS, softness: float = 2e-3):
        self.sharpness, self.softness = sharpness, softness

    def target(self, samples: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return what :meth:`residual` needs of ``wi`` and ``value``, computed once per sample."""
        cosine = samples["wi"][:, 2:].contiguous()
        return {"cosine": cosine, "target": torch.log1p(self.sharpness * samples["value"] * cosine)}

    def residual(self, value: torch.Tensor, batch) -> torch.Tensor:
        """Return g(f̂ cosθ_i) − g(f cosθ_i), (B, 3); g goes on as a straight line below 0."""
        scaled = self.sharpness * value * batch["cosine"]
        return torch.log1p(scaled.clamp_min(0.0)) + scaled.clamp_max(0.0) - batch["target"]

    def __call__(self, value, batch) -> torch.Tensor:
        residual = self.residual(value, batch)
        return torch.sqrt(residual * residual + self.softness**2).mean()
