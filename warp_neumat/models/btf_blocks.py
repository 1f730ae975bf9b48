"""Features of a BTF as BC6H blocks: what a texture unit reads, at 3/16 of the bytes of halves (as BCf stores its own).

Three channels make a texture, signed; a last one that is not full is padded with zeros.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.io.block_formats import from_blocks, to_blocks
from warp_neumat.kernels.bc6h import bc6h_decode
from warp_neumat.kernels.bc6h_encode import bc6h_fit


def by_threes(count: int) -> list[int]:
    """Return an order of 0 … ``count`` − 1 in which the greatest come first in each three, the least with the first."""
    left, found = list(range(count)), []
    heads = [left.pop() for _ in range(-(-count // 3))]
    for head in heads:
        found += [head, *(left.pop(0) for _ in range(min(2, len(left))))]
    return found


def encode(mip: np.ndarray) -> list[np.ndarray]:
    """Return the blocks (rows, columns, 16) uint8 of each three channels of ``mip`` (h, w, C)."""
    height, width, channels = mip.shape
    padded = np.zeros((height, width, -(-channels // 3) * 3), np.float16)
    padded[..., :channels] = mip
    found = []
    for first in range(0, channels, 3):
        texels = to_blocks(np.ascontiguousarray(padded[..., first : first + 3]))
        rows, columns = texels.shape[:2]
        targets = np.ascontiguousarray(texels.astype(np.float32)).reshape(-1, 16, 3)
        blocks, _ = bc6h_fit(targets, signed=True, linear=True)  # an error counts alike wherever it is
        found.append(blocks.reshape(rows, columns, 16))
    return found


def decode(blocks: list[np.ndarray], width: int, height: int, channels: int) -> np.ndarray:
    """Return the mip (height, width, channels) float16 that a texture unit reads from ``blocks``."""
    parts = []
    for block in blocks:
        rows, columns, _ = block.shape
        texels = bc6h_decode(np.ascontiguousarray(block).reshape(-1, 16), signed=True)
        parts.append(from_blocks(texels.reshape(rows, columns, 4, 4, 3), width, height))
    return np.concatenate(parts, axis=2)[..., :channels]
