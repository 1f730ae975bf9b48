"""BC6H encoding: pixels to blocks, all 14 modes or mode 10 alone (which is what [bcf] exports).

The search is in ``bc6h_encode_fit``, the bits in ``bc6h_encode_pack``. The error of a block is the sum over its
16 texels and 3 channels of the squared difference between the decoded half and the target, of

- half bits (default): bit patterns of halves as integers, sign-magnitude for signed blocks; within a factor of two this
  is relative error, 1024 steps an octave, so bright texels do not drown dark ones;
- linear values (``linear=True``): the halves' own values, as features see them.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels.bc6h_encode_fit import BATCH, make_fit_kernel, plan, tables
from warp_neumat.kernels.bc6h_encode_pack import as_scalars, pack_blocks

EFFORT = 4
"""Partitions tried in full, out of 32, unless told otherwise."""


def bc6h_encode(pixels, signed: bool = False, modes: str = "all", *, effort: int = EFFORT):
    """Encode blocks of pixels as BC6H, the error measured in half bits, spread over all cores.

    Args:
        pixels: Blocks of pixels, shape [n, 4, 4, 3] (row, column, channel), float16; numpy, torch or Warp.
        signed: Whether to write the signed format. The unsigned one takes negative values as 0. NaN becomes 0 in both,
            and what is beyond ±65504 becomes ±65504.
        modes: ``"all"`` for the best of the 14 modes, ``"single"`` for mode 10 (two regions, 6 bits) only.
        effort: Partitions tried in full, 1 … 32.

    Returns: Blocks, shape [n, 16], uint8, of the kind of ``pixels``.
    Raises: ValueError: If a shape, ``modes`` or ``effort`` is not one of these.
    Error: 1.09 times the squared error of an exhaustive descent over mode 10 (geometric mean); held by
        test_single_mode_comes_near_an_exhaustive_descent. Blocks of a BC6H file come back bit for bit at ``effort=32``,
        93 % of them at 4; held by test_blocks_of_a_texture_come_back.
    """
    kind = arrays.kind_of(pixels)
    targets = arrays.take(pixels, "pixels", ("n", 4, 4, 3), wp.float16, kind)
    blocks, _ = _fit(kind, targets, None, None, signed, modes, False, effort)
    return kind.give(blocks)


def bc6h_fit(
    targets,
    *,
    weights=None,
    shape=None,
    signed: bool = False,
    modes: str = "all",
    linear: bool,
    effort: int = EFFORT,
):
    """Fit BC6H blocks to targets that need not be halves, spread over all cores.

    Args:
        targets: Values, shape [n, 16, 3], texel t = 4y + x, float32; numpy, torch or Warp.
        weights: Factors of the squared errors, shape [n, 16, 3], float32; negative and NaN count as 0.
        shape: The only candidate of each block, shape [n], int: partition 0 … 31, 32 for one region, −1 for any.
        signed: Whether to write the signed format.
        modes: ``"all"`` or ``"single"``, as in :func:`bc6h_encode`; the latter has no one-region mode.
        linear: Measure errors in linear values instead of half bits.
        effort: Partitions tried in full, 1 … 32, where ``shape`` leaves the choice.

    Returns: Blocks, shape [n, 16], uint8, and the weighted squared error of each as decoded, shape [n], float32.
    Raises: ValueError: If a shape or option is not one of these.
    Error: the returned error is within 2e-6 of float64, relative; held by test_error_is_that_of_the_decoded_block.
    """
    kind = arrays.kind_of(targets)
    values = arrays.take(targets, "targets", ("n", 16, 3), wp.float32, kind)
    count = values.shape[0]
    if weights is not None:
        weights = arrays.take(weights, "weights", (count, 16, 3), wp.float32, kind)
    if shape is not None:
        shape = arrays.take(shape, "shape", (count,), wp.int32, kind)
    blocks, error = _fit(kind, values, weights, shape, signed, modes, linear, effort)
    return kind.give(blocks), kind.give(error)


def _fit(kind, targets, weights, shape, signed, modes, linear, effort) -> tuple[wp.array, wp.array]:
    if modes not in ("all", "single"):
        raise ValueError(f"modes must be 'all' or 'single', got {modes!r}")
    if not 1 <= effort <= 32:
        raise ValueError(f"effort must be 1 to 32 partitions, got {effort}")
    count, device = targets.shape[0], kind.device
    tries = int(effort)
    if shape is not None and count:
        asked = shape.numpy()
        most = 31 if modes == "single" else 32
        if asked.min() < -1 or asked.max() > most:
            bad = np.flatnonzero((asked < -1) | (asked > most))[0]
            raise ValueError(f"shape must be -1 to {most} with modes={modes!r}, got {asked[bad]} for block {bad}")
        tries = tries if asked.min() < 0 else 1
    error = wp.empty(count, dtype=wp.float32, device=device)
    parts = [
        wp.empty(count, dtype=wp.uint8, device=device),
        wp.empty(count, dtype=wp.uint8, device=device),
        wp.empty((count, 4, 3), dtype=wp.int32, device=device),
        wp.empty((count, 16), dtype=wp.uint8, device=device),
    ]
    if count:
        lanes = BATCH if device.is_cpu else 1
        rows, partitions, anchors = tables(modes, str(device))
        dispatch.launch(
            make_fit_kernel(lanes, bool(signed), bool(linear), weights is not None),
            dispatch.blocks(count, lanes),
            inputs=[
                as_scalars(targets, wp.uint8),
                int(targets.dtype == wp.float16),
                weights.flatten() if weights is not None else None,
                shape,
                count,
                rows,
                len(plan(modes)),
                tries,
                partitions,
                anchors,
            ],
            outputs=[*(part.flatten() for part in parts), error],
            device=device,
        )
    return pack_blocks(parts, count, signed, device, check=False), error
