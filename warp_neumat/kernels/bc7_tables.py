"""The tables of BC7: its eight modes, and how a block of 4 × 4 texels falls into two or three subsets.

Plain numbers, for the decoder and for whoever writes an encoder. Texel t = 4·y + x. Source: Khronos Data Format
Specification 1.3, section 20 (BPTC); the same numbers stand in Microsoft's BC7 Format Mode Reference.
"""

import dataclasses

import numpy as np

from warp_neumat.kernels.bc6h_tables import ANCHOR, PARTITIONS, WEIGHTS3, WEIGHTS4


@dataclasses.dataclass(frozen=True)
class Mode:
    """Bits of the fields of one mode, in the order in which a block stores them after ``number`` zeros and a one.

    Attributes:
        number: 0 to 7.
        subsets: Pairs of endpoints, 1 to 3.
        partition: Bits of the partition number.
        rotation: Bits of the rotation: 1, 2, 3 swap alpha with red, green, blue.
        selector: 1 if a bit says that colour has the second indices and alpha the first.
        color: Bits of red, green and blue of an endpoint.
        alpha: Bits of alpha of an endpoint; 0 where it is 255.
        own_pbit: 1 if each endpoint has a lowest bit of its own, shared by its components.
        shared_pbit: 1 if both endpoints of a subset share that bit.
        index: Bits of an index; the anchor of each subset stores one less.
        index2: Bits of an index of the second set; 0 where alpha follows the first.
    """

    number: int
    subsets: int
    partition: int
    rotation: int
    selector: int
    color: int
    alpha: int
    own_pbit: int
    shared_pbit: int
    index: int
    index2: int

    @property
    def bits(self) -> int:
        """Bits of all fields: 128 in every mode."""
        endpoints = 2 * self.subsets
        return (
            self.number + 1 + self.partition + self.rotation + self.selector
            + endpoints * (3 * self.color + self.alpha + self.own_pbit) + self.subsets * self.shared_pbit
            + 16 * self.index - self.subsets + (16 * self.index2 - 1 if self.index2 else 0)
        )  # fmt: skip


MODES = (
    Mode(0, 3, 4, 0, 0, 4, 0, 1, 0, 3, 0),
    Mode(1, 2, 6, 0, 0, 6, 0, 0, 1, 3, 0),
    Mode(2, 3, 6, 0, 0, 5, 0, 0, 0, 2, 0),
    Mode(3, 2, 6, 0, 0, 7, 0, 1, 0, 2, 0),
    Mode(4, 1, 0, 2, 1, 5, 6, 0, 0, 2, 3),
    Mode(5, 1, 0, 2, 0, 7, 8, 0, 0, 2, 2),
    Mode(6, 1, 0, 0, 0, 7, 7, 1, 0, 4, 0),
    Mode(7, 2, 6, 0, 0, 5, 5, 1, 0, 2, 0),
)

WEIGHTS = {
    2: (0, 21, 43, 64),
    3: tuple(WEIGHTS3.tolist()),
    4: tuple(WEIGHTS4.tolist()),
}
"""Bits of an index → share of the second endpoint in 64ths. In one formula: 64·index / (2^bits − 1), rounded."""

PARTITIONS_2 = (
    *PARTITIONS.tolist(),
    0xAAAA, 0xF0F0, 0x5A5A, 0x33CC, 0x3C3C, 0x55AA, 0x9696, 0xA55A,
    0x73CE, 0x13C8, 0x324C, 0x3BDC, 0x6996, 0xC33C, 0x9966, 0x0660,
    0x0272, 0x04E4, 0x4E40, 0x2720, 0xC936, 0x936C, 0x39C6, 0x639C,
    0x9336, 0x9CC6, 0x817E, 0xE718, 0xCCF0, 0x0FCC, 0x7744, 0xEE22,
)  # fmt: skip
"""Bit t set: texel t lies in subset 1. The first 32 are BC6H's."""

ANCHORS_2 = (
    *ANCHOR.tolist(),
    15, 15, 6, 8, 2, 8, 15, 15, 2, 8, 2, 2, 2, 15, 15, 6,
    6, 2, 6, 8, 15, 15, 2, 2, 15, 15, 15, 15, 15, 2, 2, 15,
)  # fmt: skip
"""The anchor of subset 1; that of subset 0 is always texel 0."""

PARTITIONS_3 = (
    (0x08CC, 0xF600), (0x8CC8, 0x7300), (0xCC80, 0x3310), (0xEC00, 0x00CE),
    (0x3300, 0xCC00), (0x00CC, 0xCC00), (0xFF00, 0x00CC), (0xCCCC, 0x3300),
    (0x0F00, 0xF000), (0x0FF0, 0xF000), (0x00F0, 0xFF00), (0x4444, 0x8888),
    (0x6666, 0x8888), (0x2222, 0xCCCC), (0x136C, 0xEC80), (0x008C, 0x7310),
    (0x36C8, 0xC800), (0x08CE, 0x3100), (0x3330, 0xCCC0), (0xF000, 0x0CCC),
    (0x00EE, 0xEE00), (0x8888, 0x7700), (0x22C0, 0xCC00), (0x4430, 0x3300),
    (0x0C22, 0x00CC), (0x0344, 0xFC88), (0x6996, 0x0660), (0x9960, 0x6600),
    (0x0330, 0xC88C), (0x0066, 0xF900), (0xC22C, 0x0CC0), (0x8C00, 0x7310),
    (0x1300, 0xEC80), (0xC400, 0x08CE), (0x004C, 0xEC80), (0x2222, 0x4444),
    (0x00F0, 0x0F00), (0x2492, 0x4924), (0x2942, 0x4294), (0xC30C, 0x0C30),
    (0xC03C, 0x03C0), (0x00AA, 0xFF00), (0xAA00, 0x5500), (0x3030, 0xCCCC),
    (0xC0C0, 0x0C0C), (0x9090, 0x6666), (0xA00A, 0x0FF0), (0xAAA0, 0x5550),
    (0x0AAA, 0xF000), (0xE0E0, 0x0E0E), (0x7070, 0x8888), (0x6660, 0x9990),
    (0x0EE0, 0xE00E), (0x0770, 0x8888), (0x0666, 0xF000), (0x6600, 0x9900),
    (0x0066, 0xFF00), (0x0CC0, 0xC00C), (0x0330, 0xCCCC), (0x6000, 0x9000),
    (0x8080, 0x0808), (0x1010, 0xEEEE), (0x000A, 0xFFF0), (0x08CE, 0x7310),
)  # fmt: skip
"""Bit t of the first number set: texel t lies in subset 1; of the second: in subset 2."""

ANCHORS_3 = (
    (3, 15), (3, 8), (15, 8), (15, 3), (8, 15), (3, 15), (15, 3), (15, 8),
    (8, 15), (8, 15), (6, 15), (6, 15), (6, 15), (5, 15), (3, 15), (3, 8),
    (3, 15), (3, 8), (8, 15), (15, 3), (3, 15), (3, 8), (6, 15), (10, 8),
    (5, 3), (8, 15), (8, 6), (6, 10), (8, 15), (5, 15), (15, 10), (15, 8),
    (8, 15), (15, 3), (3, 15), (5, 10), (6, 10), (10, 8), (8, 9), (15, 10),
    (15, 6), (3, 15), (15, 8), (5, 15), (15, 3), (15, 6), (15, 6), (15, 8),
    (3, 15), (15, 3), (5, 15), (5, 15), (5, 15), (8, 15), (5, 15), (10, 15),
    (5, 15), (10, 15), (8, 15), (13, 15), (15, 3), (12, 15), (3, 15), (3, 8),
)  # fmt: skip
"""The anchors of subsets 1 and 2."""


def partition_words() -> np.ndarray:
    """Return the partitions as the kernels read them, (192, 2) int32.

    Rows 0 … 63 are no partition (one subset), 64 … 127 two subsets, 128 … 191 three. Column 0 holds the texels of
    subset 1 in its low and those of subset 2 in its high 16 bits; column 1 the two anchors beside texel 0 in ascending
    order, in bits 0 … 4 and 8 … 12, with 16 for none.
    """
    rows = [(0, 16 | 16 << 8)] * 64
    rows += [(mask, anchor | 16 << 8) for mask, anchor in zip(PARTITIONS_2, ANCHORS_2, strict=True)]
    rows += [
        (one | two << 16, min(anchors) | max(anchors) << 8)
        for (one, two), anchors in zip(PARTITIONS_3, ANCHORS_3, strict=True)
    ]
    return np.array(rows, np.int64).astype(np.uint32).view(np.int32)


def nibbles(field: str) -> int:
    """Return ``field`` of all modes in one number, mode m in bits 4·m … 4·m + 3."""
    return sum(getattr(mode, field) << 4 * mode.number for mode in MODES)
