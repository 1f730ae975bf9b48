"""How BC6H feature textures lie in memory at run time: the choice between bytes and decoding work.

Blocks of 4 × 4 texels lie row by row in every storage, so the number of a texel is 16 · block + 4y + x everywhere:

| storage | bytes a block | what a texel costs |
| --- | --- | --- |
| ``blocks`` | 16 | the BC6H block itself: its endpoints are gathered from the mode's bit fields, then as below |
| ``unquantised`` | 64 | two endpoints of 16 bits and their weights: one interpolation, in integers |
| ``half`` | 128 | float16 R, G, B and a zero: one conversion |

``unquantised`` knows no modes: two pairs of endpoints in 16 bytes each, words r₀ r₁ g₀ g₁ b₀ b₁ and two unused, then
two bytes for each texel: at which byte of :func:`weights` its weights lie, and at which of the block its pair, 0 or 16.
Unsigned endpoints are stored less 32768, so that one signed multiply-add takes a pair of them. A block fills one cache
line, so at random places this reads no more lines than 16 bytes would.
"""

import functools

import numpy as np

from warp_neumat.kernels.bc6h_tables import ANCHOR, MODES, PARTITION_BIT, PARTITIONS, WEIGHTS3, WEIGHTS4

BLOCK_BYTES = {"blocks": 16, "unquantised": 64, "half": 128, "rgba8": 64}
"""Bytes of a block by storage; ``rgba8``, four 8-bit numbers a texel, is not for features but for plain textures."""

NIBBLES = 21
"""Groups of 4 bits from bit 0 of a block that hold mode, endpoints and partition."""

_NONE = len(MODES)  # the place of the reserved modes in the tables


@functools.cache
def tables() -> dict[str, np.ndarray]:
    """Return what turns the bits of a block into endpoints without asking which bit goes where.

    Every bit of an endpoint is the exclusive or of some bits of the block (a sign extension repeats one), so the
    endpoints of a mode are the exclusive or of one table entry for each group of 4 bits.

    - ``mode`` (32,) uint8: row of the other tables by the lowest 5 bits of the block; 14 stands for the reserved ones;
    - ``ends`` (15, 21, 16, 16) int16: mode, group, its value, and the two pairs r₀ r₁ g₀ g₁ b₀ b₁ 0 0; numbers of b
      bits fill the upper b bits of a word, so that sums wrap around where the format has them do;
    - ``facts`` (15, 4) int32: precision b, whether endpoints 1 … 3 are differences, regions, rounding added by
      unquantisation.
    """
    mode = np.full(32, _NONE, np.uint8)
    ends = np.zeros((_NONE + 1, NIBBLES, 16, 16), np.uint16)
    facts = np.zeros((_NONE + 1, 4), np.int32)
    facts[_NONE] = 16, 0, 1, 0
    for row, m in enumerate(MODES):
        mode[m.bits :: 1 << m.mode_bits] = row
        facts[row] = m.precision, m.transformed, m.regions, 0x8000 >> m.precision if m.precision < 15 else 0
        single = np.zeros((4 * NIBBLES, 16), np.uint16)
        for position, (channel, end, bit) in enumerate(m.fields, m.mode_bits):
            top = m.transformed and end > 0 and bit == m.delta[channel] - 1
            value = ((1 << m.precision) - (1 << bit) if top else 1 << bit) << (16 - m.precision)
            single[position, 8 * (end >> 1) + 2 * channel + (end & 1)] = value
        for value in range(16):
            for k in range(4):
                if value >> k & 1:
                    ends[row, :, value] ^= single[k::4]
    return {"mode": mode, "ends": ends.view(np.int16), "facts": facts}


def weights() -> np.ndarray:
    """Return the factors of a pair of endpoints, (24, 2) int16: 64 − w and w.

    Row 0 … 7 is an index of two regions; 8 + i is index i of one region.
    """
    w = np.concatenate([WEIGHTS3, WEIGHTS4])
    return np.stack([64 - w, w], axis=1).astype(np.int16)


def unquantise(blocks: np.ndarray, signed: bool) -> np.ndarray:
    """Return BC6H blocks (n, 16) uint8 as (n, 64) uint8, the storage ``unquantised``."""
    blocks = np.ascontiguousarray(blocks, np.uint8).reshape(-1, 16)
    table = tables()
    mode = table["mode"][blocks[:, 0] & 31]
    precision, transformed, regions, rounding = table["facts"][mode].T[:, :, None]
    words = np.zeros((len(blocks), 16), np.int16)
    for k in range(NIBBLES):
        words ^= table["ends"][mode, k, blocks[:, k // 2] >> 4 * (k % 2) & 15]
    base = words[:, [0, 2, 4]].repeat(2, axis=1)
    sums = words.reshape(-1, 2, 8)
    sums[:, 0, 1:6:2] += np.where(transformed, base[:, ::2], 0).astype(np.int16)
    sums[:, 1, :6] += np.where(transformed, base, 0).astype(np.int16)
    words = _widen(words, precision, rounding, signed)

    one = regions[:, 0] == 1
    high = blocks.view("<u8")[:, 1].astype(np.uint64)
    partition = (blocks[:, 9] >> (PARTITION_BIT - 72)).astype(np.uint64) | (blocks[:, 10].astype(np.uint64) << 3 & 31)
    three, region = _indices3(high, partition.astype(np.int64))
    result = np.zeros((len(blocks), 64), np.uint8)
    result[:, :32] = words.view(np.uint8)
    result[one, 16:32] = 0  # not random bits: the same contents give the same bytes
    result[:, 32::2] = 4 * np.where(one[:, None], 8 + _indices4(high), three)
    result[:, 33::2] = 16 * np.where(one[:, None], 0, region)
    return result


def _widen(words, precision, rounding, signed) -> np.ndarray:
    """Unquantise endpoints that fill the upper ``precision`` bits of a word; unsigned ones are given less 32768."""
    top = words.astype(np.int32)
    if signed:
        largest = ((1 << (precision - 1)) - 1) << (16 - precision)
        size = np.where(np.abs(top) >= largest, 0x7FFF, np.abs(top) + rounding)
        wide = np.where(precision == 16, top, np.sign(top) * size)
        return wide.astype(np.int16)
    top &= 0xFFFF
    largest = ((1 << precision) - 1) << (16 - precision)
    wide = np.where(top == largest, 0xFFFF, np.where(top == 0, 0, top + rounding))
    return (wide - 0x8000).astype(np.int16)


def _indices4(high) -> np.ndarray:
    """Return the indices (n, 16) of blocks with one region from the upper half of their bits."""
    at = np.maximum(4 * np.arange(16), 1)  # bit 64 belongs to the endpoints; texel 0 has 3 bits
    at[1:] = 4 * np.arange(1, 16)
    size = np.where(np.arange(16) == 0, 7, 15)
    return (high[:, None] >> at.astype(np.uint64)).astype(np.int64) & size


def _indices3(high, partition) -> np.ndarray:
    """Return the indices and the regions (n, 16) of blocks with two regions."""
    texel, anchor = np.arange(16), ANCHOR[partition].astype(np.int64)[:, None]
    at = 18 + 3 * texel - (texel > 0) - (texel > anchor)
    size = np.where((texel == 0) | (texel == anchor), 3, 7)
    region = PARTITIONS[partition].astype(np.int64)[:, None] >> texel & 1
    return (high[:, None] >> at.astype(np.uint64)).astype(np.int64) & size, region


@functools.cache
def packed_tables(signed: bool) -> np.ndarray:
    """Return every table that the kernels read, in one flat uint8 array; :data:`OFFSETS` says what lies where.

    ``fac`` int16 (24, 2) is :func:`weights`; ``region`` uint8 (32, 16): 16 times the region of a texel; ``facts`` int32
    (15, 4): whether endpoints are differences (0 or −1), rounding, the largest endpoint, whether there is one region;
    ``anchor`` (32,) and ``modes`` (32,) uint8; ``ends`` as in :func:`tables`.
    """
    table = tables()
    precision, transformed, regions, rounding = table["facts"].T
    largest = (((1 << (precision - 1)) - 1) if signed else ((1 << precision) - 1)) << (16 - precision)
    region = (16 * (PARTITIONS[:, None] >> np.arange(16, dtype=np.uint16) & 1)).astype(np.uint8)
    facts = np.stack([-transformed, rounding, largest, regions == 1], axis=1).astype(np.int32)
    parts = {"fac": weights(), "region": region, "facts": facts, "anchor": ANCHOR, "modes": table["mode"]}
    parts["ends"] = table["ends"]
    result = np.zeros(OFFSETS["ends"] + table["ends"].nbytes, np.uint8)
    for name, part in parts.items():
        data = np.ascontiguousarray(part).view(np.uint8).ravel()
        result[OFFSETS[name] : OFFSETS[name] + len(data)] = data
    return result


OFFSETS = {"fac": 0, "anchor": 96, "modes": 128, "region": 160, "facts": 672, "ends": 928}
"""Byte at which each part of :func:`packed_tables` begins."""


def overflows(stored: np.ndarray) -> np.ndarray:
    """Return whether signed ``unquantised`` blocks (n, 64) uint8 hold an endpoint of −32768, which decodes to −∞."""
    words = np.ascontiguousarray(stored[:, :32]).view(np.int16)
    return (words == -0x8000).any(axis=1)


def padded(pixels: np.ndarray) -> np.ndarray:
    """Return decoded blocks (n, 4, 4, 3) float16 as the storage ``half``, flat uint8."""
    texels = np.zeros((len(pixels), 16, 4), np.float16)
    texels[:, :, :3] = pixels.reshape(-1, 16, 3)
    return texels.view(np.uint8).ravel()
