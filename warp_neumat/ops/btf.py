"""The fused training step of a BTF network for torch: loss and all gradients in one pass (MobileVR Eq. 3–5)."""

import torch
import warp as wp

from warp_neumat.kernels.btf_train import EXPORT, FORWARD, QUADS, TRAIN, StepShape, make_step_kernel
from warp_neumat.kernels.dispatch import Job
from warp_neumat.ops.block_texture import flat


class BTFStep:
    """A training step with buffers of its own, recorded once and replayed without allocation. CPU only.

    Args:
        shape: Sizes of the networks and textures.
        levels: (offset in float32 words, width, height) of every mip of the fine texture, then of the coarse one.
        table: Texels of both textures, flat float32, read at each run.
        net: Packed weights, flat float32, read at each run; see :class:`StepShape`.
        quads: Quads a step, a multiple of :data:`warp_neumat.kernels.btf_train.QUADS`.
        parts: Buffers that gradients are summed in, one thread each. The same number gives the same bits.
        sigma, lambdas: Weights σ, (λ₁, λ₂) of the distillation (MobileVR Eq. 5).

    Attributes:
        output: (quads, 12): the last run's outputs, RGB of each of the four texels.
        latent1, latent2: z₁ (quads, rows · width) and z₂ (quads, 4 · width), or z − h; see :attr:`StepShape.hints`.
        losses: (patches, 2): mean |y − y_gt| of each patch, and all that distillation adds.
        table_gradient, weight_gradient: Gradients of the mean loss, of the shape of ``table`` and ``net``.

    Error: outputs and gradients 2e-5 of the largest against torch in float64; held by test_step_matches_torch.
    """

    def __init__(self, shape: StepShape, levels, table, net, *, quads: int, parts: int, sigma=0.0, lambdas=(0.0, 0.0)):
        wp.init()
        if quads % QUADS:
            raise ValueError(f"quads must be a multiple of {QUADS}, got {quads}")
        if table.device.type != "cpu" or net.device.type != "cpu":
            raise ValueError(f"table and net must be on cpu, got {table.device} and {net.device}")
        for name, tensor, size in (("table", table, table.numel()), ("net", net, shape.weights)):
            if tensor.dtype != torch.float32 or tensor.shape != (size,) or not tensor.is_contiguous():
                raise ValueError(
                    f"{name} must be contiguous float32 of shape ({size},), got {tensor.dtype} {tuple(tensor.shape)}"
                )
        if table.numel() >= 1 << 31:
            raise ValueError(
                f"table must have fewer than 2³¹ numbers, got {table.numel()}; use fewer features or texels"
            )
        count = 2 if shape.coarse else 1
        if len(levels) % count:
            raise ValueError(
                f"levels must list as many mips of the coarse texture as of the fine one, got {len(levels)}"
            )
        self.shape, self.quads, self.table, self.net = shape, quads, table, net
        self.sigma, self.lambdas = float(sigma), tuple(map(float, lambdas))
        patches, (rows, width1, width2) = quads // QUADS, shape.hints
        self.angles, self.place = torch.zeros(quads, shape.angles), torch.zeros(quads, 4)
        self.target, self.teacher = torch.zeros(quads, 12), torch.zeros(quads, 12)
        self.hint1, self.hint2 = torch.zeros(quads, rows * width1), torch.zeros(quads, 4 * width2)
        self.latent1, self.latent2 = torch.zeros(quads, rows * width1), torch.zeros(quads, 4 * width2)
        self.output, self.losses = torch.zeros(quads, 12), torch.zeros(patches, 2)
        self.hint_gains = (1.0 / self.hint1.numel(), 1.0 / self.hint2.numel())
        self._table_parts = torch.zeros(parts, table.numel())
        self._weight_parts = torch.zeros(parts, shape.weights)
        self._keep = (torch.tensor(levels, dtype=torch.int32).view(-1), torch.zeros(parts * shape.scratch))
        self._job = Job(
            make_step_kernel(shape),
            parts,
            inputs=[
                parts, patches, len(levels) // count, table.numel(), TRAIN, 1.0 / (12.0 * quads), *self.hint_gains,
                self.sigma, *self.lambdas,
                *(flat(t) for t in (self.angles, self.place, self.target, self.teacher, self.hint1, self.hint2)),
                flat(self._keep[0]), flat(table), flat(net), flat(self._keep[1]),
            ],
            outputs=[
                flat(t)
                for t in (
                    self._table_parts, self._weight_parts, self.output, self.latent1, self.latent2, self.losses,
                )
            ],
            device="cpu",
            grain=1,
        )  # fmt: skip

    def run(self, angles, place, target, teacher=None, hint1=None, hint2=None, *, mode: int = TRAIN) -> None:
        """Fill outputs and losses for one batch, and by ``mode`` latents and gradients.

        Args:
            angles: ω_i, ω_o, and h with nine of them, (quads, 6 or 9) float32.
            place: Centre u_c, v_c, distance of the four places in texels, mip level, (quads, 4).
            target: y_gt of the four, (quads, 12): upper left, upper right, lower left, lower right.
            teacher, hint1, hint2: y_t and h₁, h₂; needed where their weight is not 0.
            mode: :data:`FORWARD`, :data:`EXPORT` or :data:`TRAIN` of ``kernels.btf_train``.
        """
        for own, given in (
            (self.angles, angles), (self.place, place), (self.target, target), (self.teacher, teacher),
            (self.hint1, hint1), (self.hint2, hint2),
        ):  # fmt: skip
            if given is not None:
                own.copy_(given)
        if mode == TRAIN:
            self._table_parts.zero_()
            self._weight_parts.zero_()
        self._job.set(4, mode)
        self._job.run()

    @property
    def table_gradient(self) -> torch.Tensor:
        """Gradient of the mean loss by ``table``."""
        return self._table_parts[0] if len(self._table_parts) == 1 else self._table_parts.sum(0)

    @property
    def weight_gradient(self) -> torch.Tensor:
        """Gradient of the mean loss by ``net``."""
        return self._weight_parts[0] if len(self._weight_parts) == 1 else self._weight_parts.sum(0)


__all__ = ["BTFStep", "EXPORT", "FORWARD", "TRAIN"]
