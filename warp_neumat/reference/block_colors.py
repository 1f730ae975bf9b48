"""BC1 and BC4 as their specification defines them: ramps of real numbers, in float64 and without rounding.

The twins of kernels/bc1.py and kernels/bc4.py, which turn these reals into bytes. Values are in steps of a byte, 255
(or 127, signed) standing for 1. Source: Microsoft, Texture Block Compression in Direct3D 11.
"""

import numpy as np


def _indices(words: np.ndarray, bits: int) -> np.ndarray:
    """Return 16 indices of ``bits`` bits from the low end of each of ``words`` (N,) uint64, (N, 16) int64."""
    shifts = np.arange(16, dtype=np.uint64) * np.uint64(bits)
    return ((words[:, None] >> shifts) & np.uint64(2**bits - 1)).astype(np.int64)


def bc1_reals(blocks: np.ndarray, opaque: bool = False) -> np.ndarray:
    """Return the RGBA of BC1 blocks in steps of a byte.

    Args:
        blocks: (N, 8) uint8.
        opaque: Whether there are always four opaque colours, as in BC3.

    Returns: (N, 4, 4, 4) float64, in 0 … 255.
    """
    words = np.ascontiguousarray(blocks, np.uint8).view("<u2").astype(np.int64)
    first, second = words[:, 0], words[:, 1]
    palette = np.zeros((len(words), 4, 4))
    four = np.full(len(words), True) if opaque else first > second
    for channel, (shift, most) in enumerate(((11, 31), (5, 63), (0, 31))):
        a, b = (first >> shift) & most, (second >> shift) & most
        palette[:, 0, channel], palette[:, 1, channel] = a * 255 / most, b * 255 / most
        palette[:, 2, channel] = np.where(four, (2 * a + b) * 255 / (3 * most), (a + b) * 255 / (2 * most))
        palette[:, 3, channel] = np.where(four, (a + 2 * b) * 255 / (3 * most), 0.0)
    palette[..., 3] = 255.0
    palette[~four, 3, 3] = 0.0
    index = _indices((words[:, 2] | words[:, 3] << 16).astype(np.uint64), 2)
    return np.take_along_axis(palette, index[..., None], axis=1).reshape(-1, 4, 4, 4)


def bc4_reals(blocks: np.ndarray, signed: bool = False) -> np.ndarray:
    """Return the values of BC4 blocks in steps of a byte.

    Args:
        blocks: (N, 8) uint8.
        signed: Whether the endpoints are two's complement, −128 counting as −127.

    Returns: (N, 4, 4) float64, in 0 … 255 or −127 … 127.
    """
    blocks = np.ascontiguousarray(blocks, np.uint8)
    ends = (blocks[:, :2].view(np.int8) if signed else blocks[:, :2]).astype(np.int64)
    long = ends[:, 0] > ends[:, 1]
    a, b = np.maximum(ends[:, 0], -127), np.maximum(ends[:, 1], -127)
    least, most = (-127, 127) if signed else (0, 255)
    palette = np.empty((len(blocks), 8))
    palette[:, 0], palette[:, 1] = a, b
    for i in range(2, 8):
        short = ((6 - i) * a + (i - 1) * b) / 5 if i < 6 else least if i == 6 else most
        palette[:, i] = np.where(long, ((8 - i) * a + (i - 1) * b) / 7, short)
    index = _indices(blocks.view("<u8")[:, 0] >> np.uint64(16), 3)
    return np.take_along_axis(palette, index, axis=1).reshape(-1, 4, 4)
