"""How BC6H feature textures lie in memory at run time: the choice between bytes and decoding work.

Blocks of 4 × 4 texels lie row by row in every storage, mip after mip:

| storage | bytes a block | what a texel costs |
| --- | --- | --- |
| ``blocks`` | 16 | the BC6H block itself: its endpoints are gathered from the mode's bit fields, then as below |
| ``unquantised`` | 64 | two endpoints of 16 bits and their weights: one interpolation, in integers |
| ``half`` | 128 | float16 R, G, B: one conversion |

``unquantised`` knows no modes: two pairs of endpoints in 16 bytes each, words r₀ r₁ g₀ g₁ b₀ b₁ and two unused, then
two bytes for each texel: which row of :func:`weights` it takes (twice the number), and how many bytes on from 32 bytes
before these two its pair of endpoints begins. Unsigned endpoints are stored less 32768, so that one signed multiply-add
takes a pair of them. A block fills one cache line: a footprint of 2 × 2 texels at a random place touches 1.6 of them.

``half`` keeps the right neighbour of a block's last column with it, as float16 without padding: 15 words a row, two
rows in a cache line, one word of zero before the first and after the second. One 16-byte load takes both texels of a
footprint's row and never leaves the line, so a footprint touches 1.5 lines.

What each costs on one core (the materials and places of ``python -m bench decode``: preset 1k, all modes, random
places, 4 textures and network; Zen 3 at 3 GHz, its other hardware thread busy; million samples a CPU second, best of 13
interleaved runs):

| lod | ``blocks`` | ``unquantised`` | ``half`` | torch, fp32 |
| --- | --- | --- | --- | --- |
| 1.5: two mips of the finest texture, one of the others | 6.5 | 12.9 | 14.5 | 4.3 |
| 4.5: two mips of all four | 4.4 | 13.4 | 15.9 | 5.3 |
| 0 to 8, one for each sample | 4.1 | 10.2 | 15.3 | 2.1 |

``blocks`` is bound by decoding: a footprint lies in 1.6 blocks on average, so a sample of 8 footprints decodes 12.5
blocks at about 10 ns, some 75 instructions each; without that step the rest runs at 9.5. Along a picture, where
neighbours share decoded blocks, it reaches 9 to 12.
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
    result[:, 32::2] = 2 * np.where(one[:, None], 8 + _indices4(high), three)
    result[:, 33::2] = 16 * np.where(one[:, None], 0, region) + 32 - 2 * np.arange(16)
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


MODE_BYTES = 384
"""Bytes of a row of :func:`mode_tables`."""

LOOSE = 5
"""Groups of 4 bits that hold a mode's loose bits, at most."""


def _run(bits: dict[int, int]) -> tuple[int, int]:
    """Return (first position, length) of the longest run of ``bits`` {position: bit} in which both rise by one."""
    best = (0, 0)
    for position, bit in bits.items():
        length = 1
        while bits.get(position + length) == bit + length:
            length += 1
        best = max(best, (position, length), key=lambda run: run[1])
    return best


@functools.cache
def mode_tables(signed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return what decodes the endpoints of any mode by the same few vector instructions.

    Most bits of an endpoint lie side by side: its run. Each pair of endpoints fills a 32-bit lane, so two shuffles of
    bytes and four shifts by lane bring all runs to the upper ends of their 16-bit words. The loose bits that are left
    are extracted together, and each group of 4 selects a vector.

    Returns:
        uint8 (15, 384), a row for each mode and one for the reserved ones: byte shuffles of even and of odd endpoints
        (32 each), shifts left of both and right of both (8 × uint32 each), mask of the runs, rounding, largest
        endpoint (16 × int16 each), byte shuffle of what is added to differences (32), codes of weights and of pairs by
        index (16 each), loose bits in the lower and in the upper half of a block (uint64 each), then int32: number of
        the former, place of the indices in the upper half, and the two numbers that turn bits 13 … into the row of
        :func:`index_tables` by and, or;
        int16 (15, 4, 16, 16): mode, group, its value, endpoints as in :func:`tables`.
    """
    facts = tables()["facts"]
    rows = np.zeros((_NONE + 1, MODE_BYTES), np.uint8)
    loose = np.zeros((_NONE + 1, LOOSE, 16, 16), np.uint16)
    for row, (precision, transformed, regions, rounding) in enumerate(facts.tolist()):
        where: dict[int, dict[int, int]] = {}
        if row < _NONE:
            for position, (channel, end, bit) in enumerate(MODES[row].fields, MODES[row].mode_bits):
                where.setdefault(8 * (end >> 1) + 2 * channel + (end & 1), {})[position] = bit
        shuffle, shift = np.full((2, 8, 4), 0x80, np.uint8), np.zeros((4, 8), np.uint32)
        mask, rest = np.zeros(16, np.uint16), []
        for word, bits in where.items():
            channel, end = word % 8 // 2, 2 * (word // 8) + word % 2
            delta = MODES[row].delta[channel] if transformed and end else 99
            position, length = _run(bits)
            low = 16 - precision + bits[position]
            lane, odd = divmod(word, 2)
            shuffle[odd, lane] = position // 8 + np.arange(4)
            shift[odd, lane] = 32 - position % 8 - length
            shift[2 + odd, lane] = 32 - low - length - 16 * odd
            signs = bits[position] + length == delta
            mask[word] = (1 << 16 if signs else 1 << low + length) - (1 << low)
            for p, bit in bits.items():
                if not position <= p < position + length:
                    value = (1 << precision) - (1 << bit) if bit == delta - 1 else 1 << bit
                    rest.append((p, word, value << (16 - precision)))
        rest.sort()
        assert len(rest) <= 4 * LOOSE, "a mode has more loose bits than tables"
        for k, (_, word, value) in enumerate(rest):
            loose[row, k // 4, np.arange(16) >> k % 4 & 1 == 1, word] ^= value
        largest = (((1 << (precision - 1)) - 1) if signed else ((1 << precision) - 1)) << (16 - precision)
        base = np.full((2, 8, 2), 0x80, np.uint8)
        if transformed:
            for word in range(6):
                if word % 2:
                    base[0, word] = 4 * (word // 2) + np.arange(2)
                if regions == 2:
                    base[1, word] = 4 * (word // 2) + np.arange(2)
        index = np.arange(16)
        codes = [2 * (index & 7), index >> 3 << 4] if regions == 2 else [2 * (8 + index), 0 * index]
        halves = [sum(1 << (p - 64 * half) for p, _, _ in rest if p // 64 == half) for half in range(2)]
        parts = [
            shuffle, shift, mask, np.full(16, rounding, np.int16), np.full(16, largest, np.uint16), base,
            np.array(codes, np.uint8), np.array(halves, np.uint64),
            np.array([halves[0].bit_count(), *((18, 31, 0) if regions == 2 else (1, 0, 32))], np.int32),
        ]  # fmt: skip
        rows[row] = np.concatenate([np.ascontiguousarray(p).view(np.uint8).ravel() for p in parts])
    return rows, loose.view(np.int16)


@functools.cache
def index_tables() -> np.ndarray:
    """Return how indices lie, uint64 (33, 2) by partition and for one region: the bits of each texel's index, the bits
    of its region, in 4 bits a texel. Anchors have one bit less."""
    result = np.zeros((33, 2), np.uint64)
    for row in range(33):
        short = (0, int(ANCHOR[row])) if row < 32 else (0,)
        bits = (3, 1) if row < 32 else (7, 0)
        result[row, 0] = sum((bits[0] if t in short else 2 * bits[0] + 1) << 4 * t for t in range(16))
        if row < 32:
            result[row, 1] = sum((int(PARTITIONS[row]) >> t & 1) << 4 * t + 3 for t in range(16))
    return result


@functools.cache
def packed_tables(signed: bool) -> np.ndarray:
    """Return every table that the kernels read, in one flat uint8 array; :data:`OFFSETS` says what lies where.

    ``fac`` int16 (24, 4, 2) is :func:`weights`, each four times; ``region`` uint8 (32, 16): 16 times the region of a
    texel; ``facts`` int32 (15, 4): whether endpoints are differences (0 or −1), rounding, the largest endpoint, whether
    there is one region; ``anchor`` (32,) and ``modes`` (32,) uint8; ``nibbles`` is :func:`index_tables`; ``mode_rows``
    and ``loose`` are :func:`mode_tables`; ``ends`` as in :func:`tables`.
    """
    table = tables()
    precision, transformed, regions, rounding = table["facts"].T
    largest = (((1 << (precision - 1)) - 1) if signed else ((1 << precision) - 1)) << (16 - precision)
    region = (16 * (PARTITIONS[:, None] >> np.arange(16, dtype=np.uint16) & 1)).astype(np.uint8)
    facts = np.stack([-transformed, rounding, largest, regions == 1], axis=1).astype(np.int32)
    rows, loose = mode_tables(signed)
    parts = {
        "fac": weights().repeat(4, axis=0), "region": region, "facts": facts, "anchor": ANCHOR, "modes": table["mode"],
        "nibbles": index_tables(), "mode_rows": rows, "loose": loose, "ends": table["ends"],
    }  # fmt: skip
    result = np.zeros(OFFSETS["ends"] + table["ends"].nbytes, np.uint8)
    for name, part in parts.items():
        data = np.ascontiguousarray(part).view(np.uint8).ravel()
        result[OFFSETS[name] : OFFSETS[name] + len(data)] = data
    return result


OFFSETS = {
    "fac": 0, "anchor": 384, "modes": 416, "region": 448, "facts": 960, "nibbles": 1216, "mode_rows": 1792,
    "loose": 7552, "ends": 45952,
}  # fmt: skip
"""Byte at which each part of :func:`packed_tables` begins."""


def overflows(stored: np.ndarray) -> np.ndarray:
    """Return whether signed ``unquantised`` blocks (n, 64) uint8 hold an endpoint of −32768, which decodes to −∞."""
    words = np.ascontiguousarray(stored[:, :32]).view(np.int16)
    return (words == -0x8000).any(axis=1)


def paired(pixels: np.ndarray, width: int, height: int, repeat: bool) -> np.ndarray:
    """Return a decoded mip as the storage ``half``, flat uint8.

    Args:
        pixels: Decoded blocks (rows, columns, 4, 4, 3) float16.
        width: Texels of the mip; what blocks hold beyond them is not used.
        height: As width.
        repeat: Whether the right neighbour of the last column is the first one, or itself.
    """
    rows, columns = pixels.shape[:2]
    image = pixels.swapaxes(1, 2).reshape(4 * rows, 4 * columns, 3)[:height, :width]
    beyond = ((0, 4 * rows - height), (0, 4 * columns + 1 - width), (0, 0))
    image = np.pad(image, beyond, "wrap" if repeat else "edge").reshape(rows, 2, 2, -1)
    lines = np.zeros((rows, columns, 2, 32), np.float16)
    for parity in range(2):
        strips = np.lib.stride_tricks.sliding_window_view(image[:, :, parity], 15, axis=2)[:, :, ::12]
        lines[..., 1 + 15 * parity : 16 + 15 * parity] = strips.swapaxes(1, 2)
    return lines.view(np.uint8).ravel()
