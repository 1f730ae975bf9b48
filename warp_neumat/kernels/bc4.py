"""BC4 and BC5 decoding: one or two channels of 8-bit values on a ramp between two endpoints.

A BC4 block is 8 bytes, little-endian: endpoints e0 and e1 (a byte each), then 16 indices of 3 bits, texel t = 4·y + x
from the lowest bit up. With e0 > e1 the indices 2 … 7 are the ramp ((8 − i)·e0 + (i − 1)·e1) / 7; otherwise 2 … 5 are
((6 − i)·e0 + (i − 1)·e1) / 5, and 6 and 7 the least and the greatest value. A BC5 block is two of them, red and green;
alpha of BC3 is one too. Source: Microsoft, Texture Block Compression in Direct3D 11; Khronos Data Format Specification
1.3, section 19 (RGTC).

Rounding: Direct3D defines the ramp in real numbers and leaves bytes to whoever wants them. We divide and drop the
fraction (towards zero), as bcdec 0.98 and texture2ddecoder do, so that pictures can be compared bit for bit; an older
bcdec (in OpenImageIO) adds 1 before it divides. A GPU that filters the reals differs by less than one step.
Signed endpoints are compared as stored, then −128 counts as −127, the other name of −1.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.block_launch import decode_blocks

# Short loops stay loops: LLVM widens the one over the 16 texels of a block.
wp.set_module_options(dispatch.module_options() | {"max_unroll": 4})


# Share of e1 in sevenths (fifths), for index i in bits 4·i … 4·i + 3.
_SEVENTHS = wp.constant(wp.int32(0x65432170))
_FIFTHS = wp.constant(wp.int32(0x00432150))


@wp.struct
class Ramp:
    """The values of a BC4 block: entry i is (base + step·share(i)) / sevenths or fifths."""

    base: int
    step: int
    shares: int
    reciprocal: int  # 65536 / 7 or 65536 / 5, rounded up: exact for the sums that occur
    low: int  # of entry 6 in a block of fifths
    high: int  # of entry 7 in one
    sevenths: bool


@wp.func
def bc4_ramp(endpoints: int, snorm: bool) -> Ramp:
    """Return the ramp of a BC4 block.

    Args:
        endpoints: The first two bytes of the block; higher bits are ignored.
        snorm: Whether they and the values are two's complement.
    """
    sign = wp.where(snorm, 128, 0)
    a = ((endpoints & 255) ^ sign) - sign
    b = (((endpoints >> 8) & 255) ^ sign) - sign
    ramp = Ramp()
    ramp.sevenths = a > b
    a = wp.max(a, -127)
    b = wp.max(b, -127)
    ramp.base = wp.where(ramp.sevenths, 7, 5) * a
    ramp.step = b - a
    ramp.shares = wp.where(ramp.sevenths, _SEVENTHS, _FIFTHS)
    ramp.reciprocal = wp.where(ramp.sevenths, 9363, 13108)
    ramp.low = wp.where(snorm, -127, 0)
    ramp.high = wp.where(snorm, 127, 255)
    return ramp


@wp.func
def bc4_indices(word0: int, word1: int):
    """Return the indices of a BC4 block of two little-endian words: 3 bits each, texels 0 … 7, then 8 … 15."""
    return ((word0 >> 16) & 65535) | ((word1 & 255) << 16), (word1 >> 8) & 0xFFFFFF


@wp.func
def bc4_select(t: int, indices0: int, indices1: int, ramp: Ramp) -> int:
    """Return the value of texel ``t`` from :func:`bc4_indices` and :func:`bc4_ramp`."""
    i = (wp.where(t < 8, indices0, indices1) >> (3 * (t & 7))) & 7
    x = ramp.base + ramp.step * ((ramp.shares >> (4 * i)) & 15)
    magnitude = (wp.abs(x) * ramp.reciprocal) >> 16  # towards zero
    value = wp.where(x < 0, -magnitude, magnitude)
    end = wp.where(i == 6, ramp.low, ramp.high)
    return wp.where(ramp.sevenths or i < 6, value, end)


@functools.cache
def make_kernels(lanes: int):
    """Return the kernels that decode BC4 and BC5 blocks.

    BC4: int32 (2·N,) → a byte a texel (16·N,) as uint8. BC5: int32 (4·N,) → red | green << 8 (16·N,) as uint16.
    """
    L = lanes

    @wp.kernel
    def bc4_kernel(
        first: int,
        blocks: wp.array(dtype=wp.int32),
        count: int,
        snorm: bool,
        # outputs
        values: wp.array(dtype=wp.uint8),
    ):
        b = first + wp.tid()
        B = wp.array(ptr=blocks.ptr + wp.uint64(b) * wp.uint64(8 * L), shape=(2 * L,), dtype=wp.int32)
        V = wp.array(ptr=values.ptr + wp.uint64(b) * wp.uint64(16 * L), shape=(16 * L,), dtype=wp.uint8)
        for l in range(L):
            if b * L + l < count:
                ramp = bc4_ramp(B[2 * l], snorm)
                i0, i1 = bc4_indices(B[2 * l], B[2 * l + 1])
                for t in range(16):
                    V[16 * l + t] = wp.uint8(bc4_select(t, i0, i1, ramp))

    @wp.kernel
    def bc5_kernel(
        first: int,
        blocks: wp.array(dtype=wp.int32),
        count: int,
        snorm: bool,
        # outputs
        values: wp.array(dtype=wp.uint16),
    ):
        b = first + wp.tid()
        B = wp.array(ptr=blocks.ptr + wp.uint64(b) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.int32)
        V = wp.array(ptr=values.ptr + wp.uint64(b) * wp.uint64(32 * L), shape=(16 * L,), dtype=wp.uint16)
        for l in range(L):
            if b * L + l < count:
                red = bc4_ramp(B[4 * l], snorm)
                green = bc4_ramp(B[4 * l + 2], snorm)
                i0, i1 = bc4_indices(B[4 * l], B[4 * l + 1])
                j0, j1 = bc4_indices(B[4 * l + 2], B[4 * l + 3])
                for t in range(16):
                    x = bc4_select(t, i0, i1, red) & 255
                    V[16 * l + t] = wp.uint16(x | (bc4_select(t, j0, j1, green) << 8))

    return bc4_kernel, bc5_kernel


def bc4_decode(blocks, signed: bool = False, *, out=None):
    """Decode BC4 blocks to bytes.

    Args:
        blocks: (N, 8) uint8, in the byte order of DDS files; numpy, torch or Warp.
        signed: Whether they are BC4_SNORM.
        out: Warp array, written in place and returned when given.

    Returns: Values of the kind of ``blocks``, (N, 4, 4) uint8 in 0 … 255 for [0, 1], or int8 in −127 … 127 for [−1, 1].
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    Error: none against bcdec and texture2ddecoder (test_bc4_decode_matches_bcdec); below one step of 255 or 127 of the
        real ramp (test_bc4_drops_less_than_one_step).
    """
    dtype = wp.int8 if signed else wp.uint8
    return decode_blocks(
        lambda lanes: make_kernels(lanes)[0],
        blocks,
        8,
        (4, 4),
        dtype,
        wp.uint8,
        out=out,
        extra=lambda _: [bool(signed)],
    )


def bc5_decode(blocks, signed: bool = False, *, out=None):
    """Decode BC5 blocks to bytes: red and green, each as :func:`bc4_decode` does.

    Args:
        blocks: (N, 16) uint8, in the byte order of DDS files; numpy, torch or Warp.
        signed: Whether they are BC5_SNORM.
        out: Warp array, written in place and returned when given.

    Returns: Values, (N, 4, 4, 2) uint8 or int8, of the kind of ``blocks``.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    Error: none against bcdec and texture2ddecoder; held by test_bc5_decode_matches_bcdec.
    """
    dtype = wp.int8 if signed else wp.uint8
    return decode_blocks(
        lambda lanes: make_kernels(lanes)[1],
        blocks,
        16,
        (4, 4, 2),
        dtype,
        wp.uint16,
        out=out,
        extra=lambda _: [bool(signed)],
    )
