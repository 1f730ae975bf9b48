"""BC7 decoding, all eight modes: RGBA on one to three lines between endpoints, with indices of 2 to 4 bits.

A block is 16 bytes, little-endian. As many zero bits as the mode's number and a one come first, then the fields that
:data:`~warp_neumat.kernels.bc7_tables.MODES` lists: endpoints channel by channel, at last the indices, texel
t = 4·y + x, where each subset's anchor texel stores one bit less. A value is ((64 − w)·e0 + w·e1 + 32) >> 6, bit exact
by the specification. A block whose first byte is 0 is reserved and decodes to zeros. Source: Khronos Data Format
Specification 1.3, section 20 (BPTC); Microsoft, BC7 Format Mode Reference.

Mixed modes would defeat a branch predictor, so the code has no branch on the mode: the widths of the fields are looked
up in constants of a nibble per mode, and what a mode lacks has width 0.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import bc7_tables, dispatch
from warp_neumat.kernels.block_launch import decode_blocks

# Short loops stay loops: LLVM widens the one over the 16 texels of a block.
wp.set_module_options(dispatch.module_options() | {"max_unroll": 4})


def _per_mode(field: str):
    """Return the constant that holds ``field`` of mode m in bits 4·m … 4·m + 3."""
    return wp.constant(wp.int32(np.uint32(bc7_tables.nibbles(field)).view(np.int32)))


_SUBSETS, _PARTITION, _ROTATION = _per_mode("subsets"), _per_mode("partition"), _per_mode("rotation")
_SELECTOR, _COLOR, _ALPHA = _per_mode("selector"), _per_mode("color"), _per_mode("alpha")
_OWN_PBIT, _SHARED_PBIT = _per_mode("own_pbit"), _per_mode("shared_pbit")
_INDEX, _INDEX2 = _per_mode("index"), _per_mode("index2")
_RED_BLUE = wp.constant(wp.int32(0x00FF00FF))
_ROUND_TWO = wp.constant(wp.int32(0x00200020))


@wp.struct
class Line:
    """The values between two endpoints: texel = (base + step·w) >> 6 for w in 0 … 64, two channels in a word."""

    base_rb: int
    step_rb: int
    base_ga: int
    step_ga: int


@wp.struct
class Bc7Block:
    """A block's header, unpacked for :func:`bc7_select`."""

    line0: Line
    line1: Line
    line2: Line
    subsets: int  # texels of subset 1 in the low, of subset 2 in the high 16 bits
    bits: int  # of an index that moves colour
    scale: int  # turns such an index into w·64
    low: int  # indices of texels 0 ... 7
    high: int  # indices of texels 8 ... 15
    bits_apart: int  # the same of the channel that has indices of its own
    scale_apart: int
    low_apart: int
    high_apart: int
    base_apart: int
    step_apart: int
    shift_apart: int  # first bit of that channel in RGBA8
    keep: int  # bits of RGBA8 that follow the colour indices; 0 in a reserved block


@wp.func
def _field(fields: int, mode: int) -> int:
    """Return the width of a field in ``mode``."""
    return (fields >> (4 * mode)) & 15


@wp.func
def _mask(bits: int) -> int:
    """Return ``bits`` ones, for 0 … 30."""
    return (1 << bits) - 1


@wp.func
def _low64(low: wp.uint64, high: wp.uint64, count: int) -> wp.uint64:
    """Return the low half of a 128-bit number shifted right by ``count`` in 0 … 63."""
    n = wp.uint64(count)
    return (low >> n) | ((high << wp.uint64(1)) << (wp.uint64(63) - n))


@wp.func
def _with_anchor(indices: wp.uint64, texel: int, bits: int) -> wp.uint64:
    """Return the stream of indices with the top bit, 0, that the anchor ``texel`` does not store; 16 is no texel."""
    at = wp.uint64(wp.min(bits * texel + bits - 1, 62))
    below = indices & ((wp.uint64(1) << at) - wp.uint64(1))
    return wp.where(texel < 16, below + ((indices - below) << wp.uint64(1)), indices)


@wp.func
def _scale(bits: int) -> int:
    """Return 4096 / (2^bits − 1): an index times that, plus 32, shifted right by 6, is its weight in 64ths."""
    return wp.where(bits == 2, 1365, wp.where(bits == 3, 585, 273))


@wp.func
def _endpoint(k: int, red: int, green: int, blue: int, alpha: int, pbits: int, color: int, width: int, pbit: int):
    """Return endpoint ``k`` as two words, red | blue << 16 and green | alpha << 16, widened to 8 bits each.

    Args:
        k: 0 … 5.
        red: Values of all endpoints, ``color`` bits each; green, blue and alpha (``width`` bits) alike.
        pbits: Lowest bits of all endpoints, one each, used if ``pbit`` is 1.
    """
    p = ((pbits >> k) & pbit) * 0x00010001
    rb = ((red >> (k * color)) & _mask(color)) | (((blue >> (k * color)) & _mask(color)) << 16)
    rb = ((rb << pbit) | p) << (8 - color - pbit)
    rb = rb | ((rb >> (color + pbit)) & _RED_BLUE)
    g = (((green >> (k * color)) & _mask(color)) << pbit) | (p & 1)
    g = g << (8 - color - pbit)
    g = g | (g >> (color + pbit))
    a = (((alpha >> (k * width)) & _mask(width)) << pbit) | (p & 1)
    a = a << (8 - width - pbit)
    a = wp.where(width == 0, 255, a | (a >> (width + pbit)))
    return rb, g | (a << 16)


@wp.func
def _line(rb0: int, ga0: int, rb1: int, ga1: int) -> Line:
    """Return the line from one endpoint to the other."""
    line = Line()
    line.base_rb = rb0 * 64 + _ROUND_TWO
    line.step_rb = rb1 - rb0  # negative in a channel borrows from the next one, which base + step·w gives back
    line.base_ga = ga0 * 64 + _ROUND_TWO
    line.step_ga = ga1 - ga0
    return line


@wp.func
def bc7_unpack(word0: wp.uint64, word1: wp.uint64, partitions: wp.array2d(dtype=wp.int32)) -> Bc7Block:
    """Return the header of the block of two little-endian words.

    Args:
        word0: Bytes 0 … 7.
        word1: Bytes 8 … 15.
        partitions: :func:`partition_table` of the device.
    """
    one = int(word0 & wp.uint64(255))
    one = one & (-one)
    mode = wp.where((one & 0xAA) != 0, 1, 0) + wp.where((one & 0xCC) != 0, 2, 0) + wp.where((one & 0xF0) != 0, 4, 0)

    subsets = _field(_SUBSETS, mode)
    partition_bits = _field(_PARTITION, mode)
    rotation_bits = _field(_ROTATION, mode)
    color = _field(_COLOR, mode)
    width = _field(_ALPHA, mode)
    at = mode + 1
    head = int((word0 >> wp.uint64(at)) & wp.uint64(511))
    partition = head & _mask(partition_bits)
    rotation = head & _mask(rotation_bits)
    swapped = (head >> rotation_bits) & _field(_SELECTOR, mode)

    at += partition_bits + rotation_bits + _field(_SELECTOR, mode)
    low = _low64(word0, word1, at)
    high = word1 >> wp.uint64(at)
    step = 2 * subsets * color  # at most 30
    red = int(low & wp.uint64(0x3FFFFFFF))
    low = _low64(low, high, step)
    high = high >> wp.uint64(step)
    green = int(low & wp.uint64(0x3FFFFFFF))
    low = _low64(low, high, step)
    high = high >> wp.uint64(step)
    blue = int(low & wp.uint64(0x3FFFFFFF))
    low = _low64(low, high, step)
    high = high >> wp.uint64(step)
    alpha = int(low & wp.uint64(0x3FFFFFFF))
    low = _low64(low, high, 2 * subsets * width)
    high = high >> wp.uint64(2 * subsets * width)
    own = _field(_OWN_PBIT, mode)
    shared = _field(_SHARED_PBIT, mode)
    pbits = int(low & wp.uint64(63))
    pbits = wp.where(shared == 1, (pbits & 1) * 3 + (pbits & 2) * 6, pbits)
    count = subsets * (2 * own + shared)
    low = _low64(low, high, count)
    high = high >> wp.uint64(count)

    entry = 64 * (subsets - 1) + partition
    anchors = partitions[entry, 1]
    bits = _field(_INDEX, mode)
    bits2 = _field(_INDEX2, mode)
    first = low & ((wp.uint64(1) << wp.uint64(wp.min(16 * bits - subsets, 63))) - wp.uint64(1))
    first = _with_anchor(first, 0, bits)
    first = _with_anchor(first, anchors & 31, bits)
    first = _with_anchor(first, (anchors >> 8) & 31, bits)
    apart = bits2 > 0
    second = wp.where(apart, _with_anchor(_low64(low, high, 16 * bits - 1), 0, bits2), first)
    bits2 = wp.where(apart, bits2, bits)

    pbit = own | shared
    rb0, ga0 = _endpoint(0, red, green, blue, alpha, pbits, color, width, pbit)
    rb1, ga1 = _endpoint(1, red, green, blue, alpha, pbits, color, width, pbit)
    rb2, ga2 = _endpoint(2, red, green, blue, alpha, pbits, color, width, pbit)
    rb3, ga3 = _endpoint(3, red, green, blue, alpha, pbits, color, width, pbit)
    rb4, ga4 = _endpoint(4, red, green, blue, alpha, pbits, color, width, pbit)
    rb5, ga5 = _endpoint(5, red, green, blue, alpha, pbits, color, width, pbit)

    block = Bc7Block()
    # Alpha of modes 4 and 5 has its own indices; rotated, a colour sits in its place and the alpha in the colour's.
    a0 = ga0 >> 16
    a1 = ga1 >> 16
    block.base_apart = a0 * 64 + 32
    block.step_apart = a1 - a0
    shift = wp.where(rotation == 0, 24, 8 * (rotation - 1))
    from_rb = wp.where(rotation == 1, 0, 16)
    moved0 = wp.where(rotation == 2, ga0, rb0 >> from_rb) & 255
    moved1 = wp.where(rotation == 2, ga1, rb1 >> from_rb) & 255
    ga0 = wp.where(rotation == 0, ga0, (ga0 & 255) | (moved0 << 16))
    ga1 = wp.where(rotation == 0, ga1, (ga1 & 255) | (moved1 << 16))

    block.line0 = _line(rb0, ga0, rb1, ga1)
    block.line1 = _line(rb2, ga2, rb3, ga3)
    block.line2 = _line(rb4, ga4, rb5, ga5)
    block.subsets = partitions[entry, 0]
    color_bits = wp.where(swapped == 1, bits2, bits)
    apart_bits = wp.where(swapped == 1, bits, bits2)
    color_stream = wp.where(swapped == 1, second, first)
    apart_stream = wp.where(swapped == 1, first, second)
    valid = one > 0
    block.bits = color_bits
    block.scale = _scale(color_bits)
    block.low = int(color_stream & wp.uint64(0xFFFFFFFF))
    block.high = int((color_stream >> wp.uint64(8 * color_bits)) & wp.uint64(0xFFFFFFFF))
    block.bits_apart = apart_bits
    block.scale_apart = _scale(apart_bits)
    block.low_apart = int(apart_stream & wp.uint64(0xFFFFFFFF))
    block.high_apart = int((apart_stream >> wp.uint64(8 * apart_bits)) & wp.uint64(0xFFFFFFFF))
    block.shift_apart = shift
    block.keep = wp.where(valid, wp.where(apart, ~(255 << shift), -1), 0)
    # Without indices of its own the channel adds nothing.
    block.base_apart = wp.where(apart, block.base_apart, 0)
    block.step_apart = wp.where(apart, block.step_apart, 0)
    return block


@wp.func
def _weight(t: int, low: int, high: int, bits: int, scale: int) -> int:
    """Return the weight of texel ``t``, 0 … 64."""
    i = (wp.where(t < 8, low, high) >> (bits * (t & 7))) & _mask(bits)
    return (i * scale + 32) >> 6


@wp.func
def bc7_select(t: int, block: Bc7Block) -> int:
    """Return RGBA8 of texel ``t`` of a block that :func:`bc7_unpack` gave."""
    one = ((block.subsets >> t) & 1) != 0
    two = ((block.subsets >> (16 + t)) & 1) != 0
    base_rb = wp.where(two, block.line2.base_rb, wp.where(one, block.line1.base_rb, block.line0.base_rb))
    step_rb = wp.where(two, block.line2.step_rb, wp.where(one, block.line1.step_rb, block.line0.step_rb))
    base_ga = wp.where(two, block.line2.base_ga, wp.where(one, block.line1.base_ga, block.line0.base_ga))
    step_ga = wp.where(two, block.line2.step_ga, wp.where(one, block.line1.step_ga, block.line0.step_ga))
    w = _weight(t, block.low, block.high, block.bits, block.scale)
    rb = ((base_rb + step_rb * w) >> 6) & _RED_BLUE
    ga = ((base_ga + step_ga * w) >> 6) & _RED_BLUE
    v = _weight(t, block.low_apart, block.high_apart, block.bits_apart, block.scale_apart)
    apart = (block.base_apart + block.step_apart * v) >> 6
    return ((rb | (ga << 8)) & block.keep) | (apart << block.shift_apart)


@functools.cache
def make_bc7_kernel(lanes: int):
    """Return the kernel that decodes BC7 blocks, uint64 (2·N,) → RGBA8 (16·N,) as int32."""
    L = lanes

    @wp.kernel
    def bc7_kernel(
        first: int,
        blocks: wp.array(dtype=wp.uint64),
        count: int,
        partitions: wp.array2d(dtype=wp.int32),
        # outputs
        texels: wp.array(dtype=wp.int32),
    ):
        b = first + wp.tid()
        B = wp.array(ptr=blocks.ptr + wp.uint64(b) * wp.uint64(16 * L), shape=(2 * L,), dtype=wp.uint64)
        T = wp.array(ptr=texels.ptr + wp.uint64(b) * wp.uint64(64 * L), shape=(16 * L,), dtype=wp.int32)
        for l in range(L):
            if b * L + l < count:
                block = bc7_unpack(B[2 * l], B[2 * l + 1], partitions)
                for t in range(16):
                    T[16 * l + t] = bc7_select(t, block)

    return bc7_kernel


@functools.cache
def _partition_table(device: str) -> wp.array:
    return wp.array(bc7_tables.partition_words(), dtype=wp.int32, device=device)


def partition_table(device) -> wp.array:
    """Return :func:`~warp_neumat.kernels.bc7_tables.partition_words` on ``device``, made once."""
    return _partition_table(str(wp.get_device(device)))


def bc7_decode(blocks, *, out=None):
    """Decode BC7 blocks to RGBA bytes; reserved blocks give zeros.

    Args:
        blocks: (N, 16) uint8, in the byte order of DDS files; numpy, torch or Warp.
        out: Warp array, written in place and returned when given.

    Returns: Texels, (N, 4, 4, 4) uint8, of the kind of ``blocks``.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    Error: none against bcdec and texture2ddecoder; held by test_bc7_decode_matches_bcdec.
    """
    return decode_blocks(
        make_bc7_kernel,
        blocks,
        16,
        (4, 4, 4),
        wp.uint8,
        wp.int32,
        out=out,
        word_in=wp.uint64,
        extra=lambda device: [partition_table(device)],
    )
