"""The trainable block texture as a torch operator (BCf Eq. 6–9)."""

import torch
import warp as wp

from warp_neumat.kernels.block_texture import make_block_kernels
from warp_neumat.kernels.dispatch import Job, launch
from warp_neumat.ops.stream import torch_stream

GRAIN = 64
"""Blocks worth a chunk of their own."""


def _checked(endpoints, positions, shapes, modes) -> int:
    count = endpoints.shape[0]
    expected = ((endpoints, "endpoints", (count, 4, 3)), (positions, "positions", (count, 16)))
    expected += ((shapes, "shapes", (count,)), (modes, "modes", (count,)))
    for tensor, name, shape in expected:
        dtype = torch.float32 if name in ("endpoints", "positions") else torch.int32
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            raise ValueError(f"{name} must be {dtype} of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}")
    return count


def flat(tensor: torch.Tensor) -> wp.array:
    """Return a Warp view of a contiguous tensor, flat."""
    return wp.from_torch(tensor.detach().view(-1))


@torch.library.custom_op("neumat::block_decode", mutates_args=())
def block_decode(
    endpoints: torch.Tensor,
    positions: torch.Tensor,
    shapes: torch.Tensor,
    modes: torch.Tensor,
    signed: bool = False,
) -> torch.Tensor:
    """Return the texels (16 B, 4) of B blocks: r, g, b and a zero; differentiable in endpoints and positions.

    Args:
        endpoints: (B, 4, 3) float32: half bits / 31744; clamped to [0, 1), or (−1, 1) where signed.
        positions: (B, 16) float32, clamped to [0, 1]: where each texel 4y + x lies between its region's endpoints.
        shapes: (B,) int32: partition 0 … 31, or 32 for one region.
        modes: (B,) int32: 0 = continuous; 1 … 14 = as a BC6H block of that mode decodes, with straight-through
            gradients. Modes 1 … 10 need a partition, 11 … 14 shape 32.
        signed: Whether the texture is of the signed format.

    Raises: ValueError: If a shape or type differs.

    Error: values 4e-6 relative against float64, exact in modes 1 … 14; gradients 4e-6 of the block's largest. Held by
    test_block_decode_matches_torch and test_quantised_blocks_decode_exactly.
    """
    wp.init()
    count = _checked(endpoints, positions, shapes, modes)
    texels = endpoints.new_empty((16 * count, 4))
    tensors = [t.contiguous() for t in (endpoints, positions, shapes, modes)]
    inputs = [int(signed), *(flat(t) for t in tensors)]
    device = wp.device_from_torch(endpoints.device)
    with torch_stream(device):
        launch(make_block_kernels()[0], count, inputs, [flat(texels)], device=device, grain=GRAIN)
    return texels


@block_decode.register_fake
def _(endpoints, positions, shapes, modes, signed=False):
    return endpoints.new_empty((16 * endpoints.shape[0], 4))


@torch.library.custom_op("neumat::block_decode_adjoint", mutates_args=())
def block_decode_adjoint(
    gradient: torch.Tensor,
    endpoints: torch.Tensor,
    positions: torch.Tensor,
    shapes: torch.Tensor,
    modes: torch.Tensor,
    signed: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the gradients of endpoints and positions from that of the texels (16 B, 4)."""
    wp.init()
    count = _checked(endpoints, positions, shapes, modes)
    tensors = [t.contiguous() for t in (endpoints, positions, shapes, modes, gradient)]
    out = torch.empty_like(tensors[0]), torch.empty_like(tensors[1])
    inputs = [count, 1, int(signed), *(flat(t) for t in tensors)]
    device = wp.device_from_torch(endpoints.device)
    with torch_stream(device):
        launch(make_block_kernels()[1], count, inputs, [flat(t) for t in out], device=device, grain=GRAIN)
    return out


@block_decode_adjoint.register_fake
def _(gradient, endpoints, positions, shapes, modes, signed):
    return torch.empty_like(endpoints), torch.empty_like(positions)


def _keep(ctx, inputs, output):
    *tensors, ctx.signed = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx, gradient):
    return (*block_decode_adjoint(gradient.contiguous(), *ctx.saved_tensors, ctx.signed), None, None, None)


block_decode.register_autograd(_backward, setup_context=_keep)


class BlockJobs:
    """Decode and adjoint of fixed tensors, recorded once: what a training loop runs without allocation.

    Args:
        endpoints: As for :func:`block_decode`, contiguous, as the others.
        positions: As for :func:`block_decode`.
        shapes: As for :func:`block_decode`.
        modes: As for :func:`block_decode`.
        texels: (16 B, 4) that :meth:`decode` writes.
        gradients: (parts, 16 B, 4), the parts of the gradient that :meth:`adjoint` sums and takes back.
        signed: Whether the texture is of the signed format.
    """

    def __init__(self, endpoints, positions, shapes, modes, texels, gradients, signed: bool):
        wp.init()
        count = _checked(endpoints, positions, shapes, modes)
        self.endpoint_gradient, self.position_gradient = torch.zeros_like(endpoints), torch.zeros_like(positions)
        blocks = [flat(t) for t in (endpoints, positions, shapes, modes)]
        decode, adjoint = make_block_kernels()
        self._device = device = wp.device_from_torch(endpoints.device)
        self._decode = Job(decode, count, [int(signed), *blocks], [flat(texels)], device=device, grain=GRAIN)
        inputs = [count, gradients.shape[0], int(signed), *blocks, flat(gradients)]
        outputs = [flat(self.endpoint_gradient), flat(self.position_gradient)]
        self._adjoint = Job(adjoint, count, inputs, outputs, device=device, grain=GRAIN)

    def decode(self) -> None:
        """Write the texels of the blocks."""
        with torch_stream(self._device):
            self._decode.run()

    def adjoint(self) -> None:
        """Write the gradients of endpoints and positions."""
        with torch_stream(self._device):
            self._adjoint.run()
