"""The bridge between torch and Warp: custom operators ``torch.ops.neumat.*``.

Each has a registered shape function, so that it works under ``torch.compile`` and passes ``torch.library.opcheck``.
"""

from __future__ import annotations

import torch
import warp as wp

from warp_neumat.kernels import healpix


@torch.library.custom_op("neumat::healpix_corners", mutates_args=())
def healpix_corners(nside: int, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the four HEALPix grid corners around each direction and their bilinear weights.

    Args:
        nside: Grid resolution N ≥ 1.
        direction: Directions of any length but zero, (N, 3) float32.

    Returns:
        indices (N, 4) int32, numbered ring by ring from the north pole; weights (N, 4) float32 in [0, 1], sum 1.
        Neither carries a gradient: which corners surround a direction is no differentiable question.

    Raises:
        ValueError: If ``nside`` or the shape is out of range.
    """
    wp.init()  # at no cost but the first time; mapping a torch device to Warp's needs it
    # An operator must return memory that torch itself allocated.
    indices = direction.new_empty((direction.shape[0], 4), dtype=torch.int32)
    weights = direction.new_empty((direction.shape[0], 4), dtype=torch.float32)
    healpix.corners(nside, direction.detach().contiguous(), out=(indices, weights))
    return indices, weights


@healpix_corners.register_fake
def _(nside, direction):
    shape = (direction.shape[0], 4)
    return direction.new_empty(shape, dtype=torch.int32), direction.new_empty(shape, dtype=torch.float32)


def _no_gradient(ctx, inputs, output):
    ctx.mark_non_differentiable(*output)


healpix_corners.register_autograd(lambda ctx, *gradients: (None, None), setup_context=_no_gradient)
