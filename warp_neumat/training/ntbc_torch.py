"""A training step of NTBC and its optimiser in plain torch, for devices that the fused ones do not run on.

Both do what :class:`warp_neumat.ops.ntbc.NTBCStep` and :class:`warp_neumat.ops.grid_update.GridAdam` do, with the same
names, so that the trainer takes either.
"""

from __future__ import annotations

import torch

from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.kernels.ntbc_train import LOSSES, StepShape
from warp_neumat.models.ntbc import rounded_grid
from warp_neumat.models.ntbc_plain import losses, network, places


class TorchStep:
    """A training step by autograd; arguments and attributes as of :class:`warp_neumat.ops.ntbc.NTBCStep`.

    Gradients are added to ``gradients``, one part each. Losses are means over the batch, (1, 5).
    """

    def __init__(
        self, shape: StepShape, rows, columns, colours, endpoints, *values, batch, parts, metric, temperature, gradients
    ):
        if parts != 1:
            raise ValueError(f"parts must be 1, got {parts}: torch sums gradients itself")
        device = values[0].device
        self.shape, self.batch, self._size, self._temperature = shape, batch, (rows, columns), temperature
        self._colours, self._endpoints, self._metric = (x.to(device) for x in (colours, endpoints, metric))
        self._values, self._gradients = values, gradients
        self.weights = torch.ones(len(LOSSES))
        self.losses = torch.zeros(1, len(LOSSES))

    def run(self, blocks: torch.Tensor, *, quantised: bool = False) -> None:
        """Add the gradients of one batch of block numbers, and keep its losses."""
        device = self._values[0].device
        blocks = blocks.to(device).long()
        grids = [value.detach().requires_grad_() for value in self._values]
        said = network(self.shape.endpoint, grids[0], grids[1], places(*self._size, blocks, False))
        x = network(self.shape.texel, grids[2], grids[3], places(*self._size, blocks, True))
        found = losses(
            self.shape,
            said,
            x,
            self._endpoints[blocks],
            self._colours[blocks],
            self._metric,
            self._temperature,
            quantised,
        )
        used = [n for n in range(len(LOSSES)) if float(self.weights[n]) != 0.0]
        total = sum(found[n] * float(self.weights[n]) for n in used)
        for gradient, part in zip(torch.autograd.grad(total, grids, allow_unused=True), self._gradients, strict=True):
            if gradient is not None:
                part[0] += gradient
        self.losses = found.detach().cpu()[None]


class TorchAdam:
    """Adam over one flat array; arguments and attributes as of :class:`warp_neumat.ops.grid_update.GridAdam`."""

    def __init__(self, values, gradients, *, shape: NetworkShape | None, bits: int | None, betas, eps, lazy=True):
        self.values, self.gradients, self._shape, self._bits = values, gradients, shape, bits
        self._betas, self._eps, self._lazy = betas, eps, lazy
        self.first, self.second, self.used = torch.zeros_like(values), torch.zeros_like(values), values.clone()

    def step(self, rate: float, number: int, rounded: bool = False) -> None:
        """Take one step with the gradients at hand, clear them, and bring ``used`` up to date."""
        gradient = self.gradients.sum(0)
        self.gradients.zero_()
        first, second = (1.0 - beta**number for beta in self._betas)
        moved = gradient != 0.0 if self._lazy else torch.ones_like(gradient, dtype=torch.bool)
        self.first.copy_(torch.where(moved, torch.lerp(gradient, self.first, self._betas[0]), self.first))
        self.second.copy_(torch.where(moved, torch.lerp(gradient * gradient, self.second, self._betas[1]), self.second))
        change = rate / first * self.first / ((self.second / second).sqrt() + self._eps)
        self.values.sub_(torch.where(moved, change, 0.0))
        self.refresh(rounded)

    def refresh(self, rounded: bool = False) -> None:
        """Bring ``used`` up to date after values were written from elsewhere."""
        if not rounded:
            self.used.copy_(self.values)
        elif self._bits is None:
            self.used.copy_(self.values.half().float())
        else:
            rounded_grid(self._shape, self.values, self._bits, self.used)
