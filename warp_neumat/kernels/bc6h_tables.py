"""The BC6H format as data: mode layouts, partitions, anchor texels and interpolation weights.

One source for decoder, encoder, reference and shader writers. The facts are those of the "Khronos Data Format
Specification" 1.3, Sec. 20.2 (BC6H), and of the Direct3D 11.3 Functional Specification, Sec. 19.5.13.

A block is 16 bytes, read as one little-endian number of 128 bits: bit i is bit i mod 8 of byte ⌊i/8⌋. From bit 0 on:

| bits | two regions | one region |
| --- | --- | --- |
| mode | 2 or 5 | 5 |
| endpoints, scattered as ``Mode.fields`` tells | up to bit 77 | up to bit 65 |
| partition number | 77 … 81 | – |
| indices, texel 0 first | 46 bits from 82: 3 each, 2 for an anchor | 63 bits from 65: 4 each, 3 for texel 0 |

Texel t = 4y + x. Endpoints 0 and 1 belong to region 0, endpoints 2 and 3 to region 1; where ``Mode.transformed``,
endpoints 1 … 3 are signed differences from endpoint 0. An anchor texel (texel 0, and :data:`ANCHOR` for region 1)
stores its index without the top bit, which is zero. Mode bits 10011, 10111, 11011 and 11111 are reserved and decode to
zero.
"""

import dataclasses

import numpy as np

PARTITIONS = np.array(
    [
        0xCCCC, 0x8888, 0xEEEE, 0xECC8, 0xC880, 0xFEEC, 0xFEC8, 0xEC80,
        0xC800, 0xFFEC, 0xFE80, 0xE800, 0xFFE8, 0xFF00, 0xFFF0, 0xF000,
        0xF710, 0x008E, 0x7100, 0x08CE, 0x008C, 0x7310, 0x3100, 0x8CCE,
        0x088C, 0x3110, 0x6666, 0x366C, 0x17E8, 0x0FF0, 0x718E, 0x399C,
    ],
    np.uint16,
)  # fmt: skip
"""Regions of the 32 partitions: bit t is set where texel t = 4y + x lies in region 1."""

ANCHOR = np.array(
    [15] * 16 + [15, 2, 8, 2, 2, 8, 8, 15, 2, 8, 2, 2, 8, 8, 2, 2],
    np.uint8,
)
"""Texel of region 1, per partition, whose index loses its top bit; in region 0 it is always texel 0."""

WEIGHTS3 = np.array([0, 9, 18, 27, 37, 46, 55, 64], np.int32)
"""Weight of the second endpoint in 64ths for a 3-bit index (two regions)."""

WEIGHTS4 = np.array([0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64], np.int32)
"""Weight of the second endpoint in 64ths for a 4-bit index (one region)."""

PARTITION_BIT = 77
"""First bit of the partition number of a block with two regions."""

INDEX_BIT = {1: 65, 2: 82}
"""First bit of the indices by number of regions."""

RESERVED = (0b10011, 0b10111, 0b11011, 0b11111)
"""Five-bit mode values without a meaning."""


@dataclasses.dataclass(frozen=True)
class Mode:
    """One of the 14 ways to spend the bits of a block."""

    number: int
    """1 … 14, as Direct3D counts."""
    bits: int
    """Value of the mode bits; bit 0 of it is bit 0 of the block."""
    mode_bits: int
    """How many mode bits there are: 2 or 5."""
    regions: int
    """1 or 2 pairs of endpoints."""
    transformed: bool
    """Whether endpoints 1 … 3 are stored as signed differences from endpoint 0, modulo 2^precision."""
    precision: int
    """Bits of endpoint 0, and of every endpoint once differences are resolved."""
    delta: tuple[int, int, int]
    """Bits of endpoints 1 … 3 as stored, for red, green and blue."""
    fields: tuple[tuple[int, int, int], ...]
    """What each block bit from ``mode_bits`` on holds: (channel 0 … 2, endpoint 0 … 3, bit of that endpoint)."""

    @property
    def endpoints(self) -> int:
        """Number of endpoints: 2 or 4."""
        return 2 * self.regions

    def stored_bits(self, endpoint: int) -> tuple[int, int, int]:
        """Return how many bits of an endpoint are stored, for red, green and blue."""
        return self.delta if endpoint else (self.precision,) * 3


def _fields(text: str) -> tuple[tuple[int, int, int], ...]:
    """Parse a layout as the specification writes it: in ``r0:9-0``, endpoint 0 of red, bit 0 comes first in the stream;
    in ``r0:10-15`` bit 15 does."""
    result = []
    for item in text.split():
        name, _, span = item.partition(":")
        last, _, first = span.partition("-")
        last, first = int(last), int(first or last)
        bits = range(first, last + 1) if last >= first else range(first, last - 1, -1)
        result += [("rgb".index(name[0]), int(name[1]), bit) for bit in bits]
    return tuple(result)


_ENDPOINT0 = "r0:9-0 g0:9-0 b0:9-0 "
_LAYOUTS = (
    # bits, mode_bits, regions, transformed, precision, delta, fields
    (0b00, 2, 2, True, 10, (5, 5, 5),
     "g2:4 b2:4 b3:4 " + _ENDPOINT0 +
     "r1:4-0 g3:4 g2:3-0 g1:4-0 b3:0 g3:3-0 b1:4-0 b3:1 b2:3-0 r2:4-0 b3:2 r3:4-0 b3:3"),
    (0b01, 2, 2, True, 7, (6, 6, 6),
     "g2:5 g3:4 g3:5 r0:6-0 b3:0 b3:1 b2:4 g0:6-0 b2:5 b3:2 g2:4 b0:6-0 b3:3 b3:5 b3:4"
     " r1:5-0 g2:3-0 g1:5-0 g3:3-0 b1:5-0 b2:3-0 r2:5-0 r3:5-0"),
    (0b00010, 5, 2, True, 11, (5, 4, 4), _ENDPOINT0 +
     "r1:4-0 r0:10 g2:3-0 g1:3-0 g0:10 b3:0 g3:3-0 b1:3-0 b0:10 b3:1 b2:3-0 r2:4-0 b3:2 r3:4-0 b3:3"),
    (0b00110, 5, 2, True, 11, (4, 5, 4), _ENDPOINT0 +
     "r1:3-0 r0:10 g3:4 g2:3-0 g1:4-0 g0:10 g3:3-0 b1:3-0 b0:10 b3:1 b2:3-0 r2:3-0 b3:0 b3:2 r3:3-0 g2:4 b3:3"),
    (0b01010, 5, 2, True, 11, (4, 4, 5), _ENDPOINT0 +
     "r1:3-0 r0:10 b2:4 g2:3-0 g1:3-0 g0:10 b3:0 g3:3-0 b1:4-0 b0:10 b2:3-0 r2:3-0 b3:1 b3:2 r3:3-0 b3:4 b3:3"),
    (0b01110, 5, 2, True, 9, (5, 5, 5),
     "r0:8-0 b2:4 g0:8-0 g2:4 b0:8-0 b3:4 r1:4-0 g3:4 g2:3-0 g1:4-0 b3:0 g3:3-0 b1:4-0 b3:1 b2:3-0 r2:4-0 b3:2"
     " r3:4-0 b3:3"),
    (0b10010, 5, 2, True, 8, (6, 5, 5),
     "r0:7-0 g3:4 b2:4 g0:7-0 b3:2 g2:4 b0:7-0 b3:3 b3:4 r1:5-0 g2:3-0 g1:4-0 b3:0 g3:3-0 b1:4-0 b3:1 b2:3-0"
     " r2:5-0 r3:5-0"),
    (0b10110, 5, 2, True, 8, (5, 6, 5),
     "r0:7-0 b3:0 b2:4 g0:7-0 g2:5 g2:4 b0:7-0 g3:5 b3:4 r1:4-0 g3:4 g2:3-0 g1:5-0 g3:3-0 b1:4-0 b3:1 b2:3-0"
     " r2:4-0 b3:2 r3:4-0 b3:3"),
    (0b11010, 5, 2, True, 8, (5, 5, 6),
     "r0:7-0 b3:1 b2:4 g0:7-0 b2:5 g2:4 b0:7-0 b3:5 b3:4 r1:4-0 g3:4 g2:3-0 g1:4-0 b3:0 g3:3-0 b1:5-0 b2:3-0"
     " r2:4-0 b3:2 r3:4-0 b3:3"),
    (0b11110, 5, 2, False, 6, (6, 6, 6),
     "r0:5-0 g3:4 b3:0 b3:1 b2:4 g0:5-0 g2:5 b2:5 b3:2 g2:4 b0:5-0 g3:5 b3:3 b3:5 b3:4"
     " r1:5-0 g2:3-0 g1:5-0 g3:3-0 b1:5-0 b2:3-0 r2:5-0 r3:5-0"),
    (0b00011, 5, 1, False, 10, (10, 10, 10), _ENDPOINT0 + "r1:9-0 g1:9-0 b1:9-0"),
    (0b00111, 5, 1, True, 11, (9, 9, 9), _ENDPOINT0 + "r1:8-0 r0:10 g1:8-0 g0:10 b1:8-0 b0:10"),
    (0b01011, 5, 1, True, 12, (8, 8, 8), _ENDPOINT0 + "r1:7-0 r0:10-11 g1:7-0 g0:10-11 b1:7-0 b0:10-11"),
    (0b01111, 5, 1, True, 16, (4, 4, 4), _ENDPOINT0 + "r1:3-0 r0:10-15 g1:3-0 g0:10-15 b1:3-0 b0:10-15"),
)  # fmt: skip

MODES = tuple(
    Mode(number, bits, mode_bits, regions, transformed, precision, delta, _fields(text))
    for number, (bits, mode_bits, regions, transformed, precision, delta, text) in enumerate(_LAYOUTS, 1)
)
"""The 14 modes in Direct3D's order: ``MODES[n - 1]`` is mode n; mode 10 is the two-region 6.6.6.6 one."""
