"""BC6H decoding in plain NumPy, written to be read beside the specification: the twin of ``kernels.bc6h``.

Steps and names follow the Direct3D 11.3 Functional Specification, Sec. 19.5.13, and the "Khronos Data Format
Specification" 1.3, Sec. 20.2. All arithmetic is on whole numbers, so there is nothing to round differently.

Points on which decoders differ:

- **Sign of zero** (signed format). The specification scales the magnitude by 31/32 first and takes the sign of what is
  left, so −1 becomes 0 and is stored as +0: no block decodes to −0.
- **−32768** (signed format, mode 14) scales to 0xFC00, minus infinity. Encoders do not write it; the specification's
  text does not clamp it, so it is not clamped here.
- **The largest endpoint** 2^precision − 1 widens to 0xFFFF. ``texture2ddecoder`` 1.0 gives that to 2^(precision − 1)
  instead, half of the range, and treats the largest like any other: it is wrong wherever a block has one of the two.
"""

import numpy as np

from warp_neumat.kernels.bc6h_tables import (
    ANCHOR,
    INDEX_BIT,
    MODES,
    PARTITION_BIT,
    PARTITIONS,
    WEIGHTS3,
    WEIGHTS4,
    Mode,
)


def bc6h_decode(blocks, signed: bool = False) -> np.ndarray:
    """Decode BC6H blocks.

    Args:
        blocks: Shape [N, 16], uint8, in the byte order of DDS files.
        signed: Whether the blocks are of the signed format (BC6H_SF16).

    Returns: Pixels, shape [N, 4, 4, 3], float16; reserved modes are zero.
    """
    bits = np.unpackbits(np.asarray(blocks, np.uint8), axis=1, bitorder="little").astype(np.int64)
    halves = np.zeros((len(bits), 16, 3), np.uint16)
    for mode in MODES:
        rows = np.flatnonzero(_number(bits[:, : mode.mode_bits]) == mode.bits)
        if len(rows):
            halves[rows] = _decode_mode(bits[rows], mode, signed)
    return halves.view(np.float16).reshape(-1, 4, 4, 3)


def mode_numbers(blocks) -> np.ndarray:
    """Return the mode of each block as Direct3D counts, 1 … 14, or 0 for a reserved one; shape [N], int64."""
    bits = np.unpackbits(np.asarray(blocks, np.uint8)[:, :1], axis=1, bitorder="little").astype(np.int64)
    return sum(mode.number * (_number(bits[:, : mode.mode_bits]) == mode.bits) for mode in MODES)


def endpoints(bits, mode: Mode, signed: bool) -> np.ndarray:
    """Return the endpoints of blocks of one mode before unquantisation.

    Args:
        bits: Bits of the blocks, lowest first, shape [n, 128].
        mode: Their mode.
        signed: Whether they are of the signed format.

    Returns: Shape [n, endpoints, 3], in [0, 2^precision), or signed in [−2^(precision − 1), 2^(precision − 1)).
    """
    result = np.zeros((len(bits), mode.endpoints, 3), np.int64)
    for position, (channel, endpoint, bit) in enumerate(mode.fields, mode.mode_bits):
        result[:, endpoint, channel] |= bits[:, position] << bit
    if mode.transformed:
        result[:, 1:] = _extend(result[:, 1:], np.array(mode.delta)) + result[:, :1]
        result &= (1 << mode.precision) - 1
    return _extend(result, mode.precision) if signed else result


def unquantize(value, precision: int, signed: bool) -> np.ndarray:
    """Widen endpoints to 16 bits (signed: 15 and a sign) so that the largest value becomes the largest."""
    if signed:
        if precision >= 16:
            return value
        size, largest = np.abs(value), (1 << (precision - 1)) - 1
        wide = np.where(size >= largest, 0x7FFF, ((size << 15) + 0x4000) >> (precision - 1))
        return np.sign(value) * wide
    if precision >= 15:
        return value
    wide = np.where(value == (1 << precision) - 1, 0xFFFF, ((value << 16) + 0x8000) >> precision)
    return np.where(value == 0, 0, wide)


def interpolate(a, b, weight) -> np.ndarray:
    """Blend two unquantised endpoints with ``weight`` 64ths of the second."""
    return (a * (64 - weight) + b * weight + 32) >> 6


def finish(value, signed: bool) -> np.ndarray:
    """Turn an interpolated value into the bits of a half float, uint16."""
    if not signed:
        return ((value * 31) >> 6).astype(np.uint16)
    size = (np.abs(value) * 31) >> 5
    return np.where((value < 0) & (size > 0), size | 0x8000, size).astype(np.uint16)


def _decode_mode(bits, mode: Mode, signed: bool) -> np.ndarray:
    """Return the half-float bits [n, 16, 3] of blocks of one mode."""
    ends = unquantize(endpoints(bits, mode, signed), mode.precision, signed)
    if mode.regions == 2:
        partition = _number(bits[:, PARTITION_BIT : PARTITION_BIT + 5])
        region = (PARTITIONS[partition].astype(np.int64)[:, None] >> np.arange(16)) & 1
        anchor = ANCHOR[partition].astype(np.int64)
        table, size = WEIGHTS3, 3
    else:
        region = np.zeros((len(bits), 16), np.int64)
        anchor = np.zeros(len(bits), np.int64)
        table, size = WEIGHTS4, 4
    weight = np.zeros((len(bits), 16), np.int64)
    at = np.full(len(bits), INDEX_BIT[mode.regions])
    row = np.arange(len(bits))
    for texel in range(16):
        index = np.zeros(len(bits), np.int64)
        stored = size - ((texel == 0) | (texel == anchor))  # an anchor's top bit is zero and left out
        for bit in range(size):
            index |= np.where(bit < stored, bits[row, np.minimum(at + bit, 127)] << bit, 0)
        weight[:, texel] = table[index]
        at = at + stored
    row = row[:, None]
    a, b = ends[row, 2 * region], ends[row, 2 * region + 1]
    return finish(interpolate(a, b, weight[..., None]), signed)


def _number(bits) -> np.ndarray:
    """Read bits [n, k], lowest first, as numbers [n]."""
    return bits @ (1 << np.arange(bits.shape[1]))


def _extend(value, bits) -> np.ndarray:
    """Read the low ``bits`` bits of a number as two's complement."""
    sign = 1 << (bits - 1)
    return ((value & (2 * sign - 1)) ^ sign) - sign
