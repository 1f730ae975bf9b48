"""NTBC for torch: the fused training step, and its network as a differentiable operator (NTBC §3)."""

import torch
import warp as wp

from warp_neumat.kernels.dispatch import Job, launch
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.kernels.ntbc_rows import make_rows_kernel
from warp_neumat.kernels.ntbc_rows import scratch as rows_scratch
from warp_neumat.kernels.ntbc_train import LOSSES, PATCH, StepShape, make_step_kernel
from warp_neumat.ops.block_texture import flat


def _check(name: str, tensor: torch.Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} must be on cpu, got {tensor.device}; train the plain torch network there")
    if tensor.dtype != dtype or tuple(tensor.shape) != shape or not tensor.is_contiguous():
        raise ValueError(
            f"{name} must be contiguous {dtype} of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}"
        )


class NTBCStep:
    """A training step with buffers of its own, recorded once and replayed without allocation. CPU only.

    Args:
        shape: Sizes of both networks and the planes.
        rows, columns: Blocks of the texture.
        colours: Reference colours, (blocks, C, 16) float32, read at each run, as are all tensors below.
        endpoints: Reference endpoints, (blocks, 2C) float32: plane by plane e0, then e1.
        endpoint_grid, texel_grid: Grids of the networks, flat float32, (grid_words,).
        endpoint_net, texel_net: Packed weights, flat float32, (weights,).
        batch: Blocks a step, a multiple of :data:`warp_neumat.kernels.ntbc_train.PATCH`.
        parts: Buffers that gradients are summed in, one thread each. The same number gives the same bits.
        metric: (planes, 4, 4) float32, symmetric and positive; default: identity.
        temperature: T of the softmax (NTBC Eq. 13).
        gradients: Buffers to add the gradients to instead of own ones that each run clears, (parts, words) float32
            each, in the order of the attributes; whoever takes a step with them clears them.

    Attributes:
        weights: (5,) float32 factors of the losses :data:`warp_neumat.kernels.ntbc_train.LOSSES`, to be written at any
            time; ones to begin with. Work whose weight is 0 is left out.
        losses: (batch / PATCH, 5): mean of each patch and loss, before its factor; of weight 0, too. The last is the
            squared error of what is decoded. In the naive variant only the first and last are not 0.
        endpoint_grid_gradient, endpoint_net_gradient, texel_grid_gradient, texel_net_gradient: Gradients of the
            weighed sum of the mean losses; zero where no loss of weight above 0 reaches.

    Error: losses 2e-6 relative, gradients 2e-5 of the largest, against torch in float64; held by
    test_step_matches_torch.
    """

    def __init__(
        self,
        shape: StepShape,
        rows: int,
        columns: int,
        colours: torch.Tensor,
        endpoints: torch.Tensor,
        endpoint_grid: torch.Tensor,
        endpoint_net: torch.Tensor,
        texel_grid: torch.Tensor,
        texel_net: torch.Tensor,
        *,
        batch: int,
        parts: int,
        metric: torch.Tensor | None = None,
        temperature: float = 0.01,
        gradients: list[torch.Tensor] | None = None,
    ):
        wp.init()
        if batch < 1 or batch % PATCH:
            raise ValueError(f"batch must be a multiple of {PATCH}, got {batch}")
        if parts < 1:
            raise ValueError(f"parts must be at least 1, got {parts}")
        if not temperature > 0.0:
            raise ValueError(f"temperature must be above 0, got {temperature}")
        if metric is None:
            metric = torch.eye(4).repeat(len(shape.planes), 1, 1)
        count, channels = rows * columns, shape.channels
        for name, tensor, size in (
            ("colours", colours, (count, channels, 16)),
            ("endpoints", endpoints, (count, 2 * channels)),
            ("endpoint_grid", endpoint_grid, (shape.endpoint.grid_words,)),
            ("endpoint_net", endpoint_net, (shape.endpoint.weights,)),
            ("texel_grid", texel_grid, (shape.texel.grid_words,)),
            ("texel_net", texel_net, (shape.texel.weights,)),
            ("metric", metric, (len(shape.planes), 4, 4)),
        ):
            _check(name, tensor, torch.float32, size)
        self.shape, self.batch, self.count = shape, batch, count
        self.weights = torch.ones(len(LOSSES))
        self.losses = torch.zeros(batch // PATCH, len(LOSSES))
        self._blocks = torch.zeros(batch, dtype=torch.int32)
        grids = (shape.endpoint.grid_words, shape.endpoint.weights, shape.texel.grid_words, shape.texel.weights)
        self._own = gradients is None
        self._gradients = [torch.zeros(parts, size) for size in grids] if self._own else list(gradients)
        for tensor, size in zip(self._gradients, grids, strict=True):
            _check("gradients", tensor, torch.float32, (parts, size))
        scratch = torch.zeros(parts * shape.scratch)
        tables = [torch.from_numpy(network.table()) for network in (shape.endpoint, shape.texel)]
        inputs = [self._blocks, colours, endpoints, metric, self.weights, tables[0], endpoint_grid, endpoint_net]
        inputs += [tables[1], texel_grid, texel_net, scratch]
        self._keep = inputs
        self._job = Job(
            make_step_kernel(shape),
            parts,
            inputs=[
                parts, batch // PATCH, rows, columns, shape.endpoint.grid_words, shape.texel.grid_words,
                1.0 / temperature, 0, *(flat(t) for t in inputs),
            ],
            outputs=[flat(t) for t in (*self._gradients, self.losses)],
            device="cpu",
            grain=1,
        )  # fmt: skip

    def run(self, blocks: torch.Tensor, *, quantised: bool = False, temperature: float | None = None) -> None:
        """Fill losses and gradients for one batch.

        Args:
            blocks: Numbers of blocks, row by row, (batch,) integers; a block may come twice.
            quantised: In the naive variant, round the weights to palette entries and train the endpoints alone.
            temperature: T from now on.

        Raises: ValueError: If a number is no block's, or the shape differs.
        """
        if tuple(blocks.shape) != (self.batch,):
            raise ValueError(f"blocks must have shape ({self.batch},), got {tuple(blocks.shape)}")
        low, high = torch.aminmax(blocks)
        if low < 0 or high >= self.count:
            raise ValueError(f"blocks must be in [0, {self.count}), got {int(low)} to {int(high)}")
        self._blocks.copy_(blocks)
        if self._own:
            for gradient in self._gradients:
                gradient.zero_()
        if temperature is not None:
            if not temperature > 0.0:
                raise ValueError(f"temperature must be above 0, got {temperature}")
            self._job.set(6, 1.0 / temperature)
        self._job.set(7, int(quantised))
        self._job.run()

    def _sum(self, index: int) -> torch.Tensor:
        parts = self._gradients[index]
        return parts[0] if len(parts) == 1 else parts.sum(0)

    endpoint_grid_gradient = property(lambda self: self._sum(0))
    endpoint_net_gradient = property(lambda self: self._sum(1))
    texel_grid_gradient = property(lambda self: self._sum(2))
    texel_net_gradient = property(lambda self: self._sum(3))


PARTS = 4
"""Buffers that the operator's backward sums gradients in: as many on every machine, so that rounding is the same."""


def _run(shape: NetworkShape, positions, grids, net, gradient, outputs, grid_parts, net_parts) -> None:
    wp.init()
    _check("positions", positions, torch.float32, (positions.shape[0], 2))
    _check("grids", grids, torch.float32, (shape.grid_words,))
    _check("net", net, torch.float32, (shape.weights,))
    scratch = torch.zeros(PARTS * rows_scratch(shape.layout))  # zeros: rows of a last patch that nothing fills
    table = torch.from_numpy(shape.table())
    inputs = [PARTS, positions.shape[0], shape.grid_words, int(gradient is not None)]
    empty = outputs if gradient is None else gradient
    inputs += [flat(t) for t in (positions, table, grids, net, empty, scratch)]
    results = [flat(t) for t in (empty if outputs is None else outputs, grid_parts, net_parts)]
    launch(make_rows_kernel(shape), PARTS, inputs, results, device="cpu", grain=1)


def _shape(sizes: list[int], outputs: int, hidden: list[int], features: int) -> NetworkShape:
    return NetworkShape(tuple(zip(sizes[::2], sizes[1::2], strict=True)), outputs, tuple(hidden), features)


@torch.library.custom_op("neumat::ntbc_network", mutates_args=())
def _ntbc_network(
    positions: torch.Tensor,
    grids: torch.Tensor,
    net: torch.Tensor,
    sizes: list[int],
    outputs: int,
    hidden: list[int],
    features: int,
) -> torch.Tensor:
    shape = _shape(sizes, outputs, hidden, features)
    result = positions.new_empty((positions.shape[0], outputs))
    nothing = result.new_empty(1)
    tensors = [t.detach().contiguous() for t in (positions, grids, net)]
    _run(shape, *tensors, None, result, nothing, nothing)
    return result


@_ntbc_network.register_fake
def _(positions, grids, net, sizes, outputs, hidden, features):
    return positions.new_empty((positions.shape[0], outputs))


@torch.library.custom_op("neumat::ntbc_network_adjoint", mutates_args=())
def _ntbc_network_adjoint(
    gradient: torch.Tensor,
    positions: torch.Tensor,
    grids: torch.Tensor,
    net: torch.Tensor,
    sizes: list[int],
    outputs: int,
    hidden: list[int],
    features: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    shape = _shape(sizes, outputs, hidden, features)
    grid_parts, net_parts = grids.new_zeros((PARTS, grids.numel())), net.new_zeros((PARTS, net.numel()))
    tensors = [t.detach().contiguous() for t in (positions, grids, net, gradient)]
    _run(shape, *tensors, None, grid_parts, net_parts)
    return grid_parts.sum(0), net_parts.sum(0)


@_ntbc_network_adjoint.register_fake
def _(gradient, positions, grids, net, sizes, outputs, hidden, features):
    return torch.empty_like(grids), torch.empty_like(net)


def _keep(ctx, inputs, output):
    *tensors, ctx.sizes, ctx.outputs, ctx.hidden, ctx.features = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx, gradient):
    numbers = (ctx.sizes, ctx.outputs, ctx.hidden, ctx.features)
    return None, *_ntbc_network_adjoint(gradient, *ctx.saved_tensors, *numbers), *([None] * 4)


_ntbc_network.register_autograd(_backward, setup_context=_keep)


def ntbc_network(positions: torch.Tensor, grids: torch.Tensor, net: torch.Tensor, shape: NetworkShape) -> torch.Tensor:
    """Return a network's outputs (n, outputs) at positions (u, v), differentiable in ``grids`` and ``net``. CPU only.

    Look-up, layers and their backward are each one pass; the backward runs the forward again and keeps nothing.

    Args:
        positions: (n, 2) float32; wraps around outside [0, 1). No gradient reaches it.
        grids: Flat float32, (grid_words,).
        net: Packed weights, flat float32, (weights,).
        shape: Sizes of the network.

    Raises: ValueError: If a shape, type or device differs.

    Error: outputs 1e-6, gradients 1e-5 of the largest against torch in float64; held by test_network_matches_torch.
    """
    sizes = [side for size in shape.levels for side in size]
    return _ntbc_network(positions, grids, net, sizes, shape.outputs, list(shape.hidden), shape.features)


__all__ = ["PARTS", "NTBCStep", "NetworkShape", "StepShape", "ntbc_network"]
