"""The fused training step of a reflectance network for torch: loss and all gradients in one pass (NeuBRDF Eq. 3, 4)."""

import torch
import warp as wp

from warp_neumat.kernels.brdf_train import PATCH, StepShape, make_step_kernel
from warp_neumat.kernels.dispatch import Job
from warp_neumat.ops.block_texture import flat


class BRDFStep:
    """A training step with buffers of its own, recorded once and replayed without allocation. CPU only.

    Args:
        shape: Sizes of the network and its inputs.
        table: Rows of all groups, flat float32, read at each run.
        offsets: Where the rows of each group begin in ``table``, in float32 words.
        net: Packed weights, flat float32, read at each run; see :class:`StepShape`.
        batch: Samples a step, a multiple of :data:`warp_neumat.kernels.brdf_train.PATCH`.
        parts: Buffers that gradients are summed in, one thread each. The same number gives the same bits.
        sharpness, softness: Of the loss, :class:`warp_neumat.training.losses.LogCosine`.

    Attributes:
        table, net: The tensors it was made with.
        losses: (batch / PATCH,): mean loss of each patch.
        errors: (batch,): sum of the squared residuals of each sample, over channels.
        table_gradient, weight_gradient: Gradients of the mean loss, of the shape of ``table`` and ``net``.

    Error: loss and gradients 2e-5 of the largest against torch in float64; held by test_step_matches_torch.
    """

    def __init__(self, shape: StepShape, table, offsets, net, *, batch: int, parts: int, sharpness, softness):
        wp.init()
        if batch % PATCH:
            raise ValueError(f"batch must be a multiple of {PATCH}, got {batch}")
        if table.device.type != "cpu" or net.device.type != "cpu":
            raise ValueError(f"table and net must be on cpu, got {table.device} and {net.device}")
        if len(offsets) != len(shape.groups):
            raise ValueError(f"offsets must name {len(shape.groups)} groups, got {len(offsets)}")
        for name, tensor, size in (("table", table, table.numel()), ("net", net, shape.weights)):
            if tensor.dtype != torch.float32 or tensor.shape != (size,) or not tensor.is_contiguous():
                raise ValueError(
                    f"{name} must be contiguous float32 of shape ({size},), got {tensor.dtype} {tuple(tensor.shape)}"
                )
        self.shape, self.batch, self.table, self.net = shape, batch, table, net
        patches = batch // PATCH
        self.corner = torch.zeros(batch, shape.taps, dtype=torch.int32)
        self.weight = torch.zeros(batch, shape.taps)
        self.cosine, self.target = torch.zeros(batch), torch.zeros(batch, 3)
        self.losses, self.errors = torch.zeros(patches), torch.zeros(batch)
        self._table_parts = torch.zeros(parts, table.numel())
        self._weight_parts = torch.zeros(parts, shape.weights)
        self._keep = (torch.tensor(offsets, dtype=torch.int32), torch.zeros(parts * shape.scratch))
        self._job = Job(
            make_step_kernel(shape),
            parts,
            inputs=[
                parts, patches, table.numel(), 1, 1.0 / (3.0 * batch), float(sharpness), float(softness),
                *(flat(t) for t in (self.corner, self.weight, self.cosine, self.target)),
                flat(self._keep[0]), flat(table), flat(net), flat(self._keep[1]),
            ],
            outputs=[flat(t) for t in (self._table_parts, self._weight_parts, self.losses, self.errors)],
            device="cpu",
            grain=1,
        )  # fmt: skip

    def run(self, corner, weight, cosine, target, *, backward: bool = True) -> None:
        """Fill losses, errors and gradients for one batch.

        Args:
            corner: Rows of every sample, (batch, taps) int32.
            weight: Their weights, (batch, taps) float32.
            cosine: cos θ_i, (batch, 1) float32.
            target: g(f cosθ_i), (batch, 3) float32.
            backward: False leaves the gradients as they were.
        """
        self.corner.copy_(corner)
        self.weight.copy_(weight)
        self.cosine.copy_(cosine.view(-1))
        self.target.copy_(target)
        if backward:
            self._table_parts.zero_()
            self._weight_parts.zero_()
        self._job.set(3, int(backward))
        self._job.run()

    @property
    def table_gradient(self) -> torch.Tensor:
        """Gradient of the mean loss by ``table``."""
        return self._table_parts[0] if len(self._table_parts) == 1 else self._table_parts.sum(0)

    @property
    def weight_gradient(self) -> torch.Tensor:
        """Gradient of the mean loss by ``net``."""
        return self._weight_parts[0] if len(self._weight_parts) == 1 else self._weight_parts.sum(0)
