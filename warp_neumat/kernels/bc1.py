"""BC1 and BC3 decoding: colours on a line between two RGB565 endpoints, alpha by a bit (BC1) or a ramp (BC3).

A BC1 block is 8 bytes, little-endian: endpoints c0 and c1 (16 bits each: 5 red in the high bits, 6 green, 5 blue), then
16 indices of 2 bits, texel t = 4·y + x from the lowest bit up. With c0 > c1, index 2 is (2·c0 + c1)/3 and 3 is
(c0 + 2·c1)/3; otherwise 2 is the middle and 3 is transparent black. A BC3 block is a BC4 block of alpha, then a colour
block that always has four opaque colours. Source: Microsoft, Texture Block Compression in Direct3D 11; Khronos Data
Format Specification 1.3, section 18 (S3TC).

Rounding: the specification interpolates real numbers c/31 and c/63. We give 255 times that, rounded to the nearest
byte, as bcdec does. texture2ddecoder widens the endpoints to bytes first and truncates, so that its interpolated
colours differ by up to 1; it gives every texel alpha 255, and it reads BC3 colours with c0 ≤ c1 as three-colour
blocks, which the specification rules out. GPUs differ by a few steps from all of these, as Direct3D allows them.
"""

import functools

import warp as wp

from warp_neumat.kernels import bc4, dispatch
from warp_neumat.kernels.block_launch import decode_blocks

# Short loops stay loops: LLVM widens the one over the 16 texels of a block.
wp.set_module_options(dispatch.module_options() | {"max_unroll": 4})

_OPAQUE = wp.constant(wp.int32(-(1 << 24)))


@wp.func
def _thirds(r: int, g: int, b: int) -> int:
    """Return RGBA8 of thrice a 565 colour: 255·r/93, 255·g/189, 255·b/93 rounded, as multiplications.

    Multipliers, here and in :func:`_halves`: Giesen 2021, GPU BCn decoding; exact for every sum that occurs.
    """
    return ((r * 351 + 61) >> 7) | (((g * 2763 + 1039) >> 11) << 8) | (((b * 351 + 61) >> 7) << 16) | _OPAQUE


@wp.func
def _halves(r: int, g: int, b: int) -> int:
    """Return RGBA8 of twice a 565 colour: 255·r/62, 255·g/126, 255·b/62 rounded, as multiplications."""
    return ((r * 1053 + 125) >> 8) | (((g * 4145 + 1019) >> 11) << 8) | (((b * 1053 + 125) >> 8) << 16) | _OPAQUE


@wp.func
def bc1_palette(endpoints: int, opaque: bool):
    """Return the four colours of a BC1 block as RGBA8, red in the low byte.

    Args:
        endpoints: The first word of the block.
        opaque: Whether there are always four opaque colours, as in BC3.
    """
    r0 = (endpoints >> 11) & 31
    g0 = (endpoints >> 5) & 63
    b0 = endpoints & 31
    r1 = (endpoints >> 27) & 31
    g1 = (endpoints >> 21) & 63
    b1 = (endpoints >> 16) & 31
    four = opaque or (endpoints & 65535) > ((endpoints >> 16) & 65535)
    p2 = wp.where(four, _thirds(2 * r0 + r1, 2 * g0 + g1, 2 * b0 + b1), _halves(r0 + r1, g0 + g1, b0 + b1))
    p3 = wp.where(four, _thirds(r0 + 2 * r1, g0 + 2 * g1, b0 + 2 * b1), 0)
    return _halves(2 * r0, 2 * g0, 2 * b0), _halves(2 * r1, 2 * g1, 2 * b1), p2, p3


@wp.func
def bc1_select(t: int, indices: int, p0: int, p1: int, p2: int, p3: int) -> int:
    """Return RGBA8 of texel ``t`` from the second word of a block and :func:`bc1_palette`."""
    i = indices >> (2 * t)
    even = (i & 1) == 0
    return wp.where((i & 2) == 0, wp.where(even, p0, p1), wp.where(even, p2, p3))


@functools.cache
def make_kernels(lanes: int):
    """Return the kernels that decode BC1, int32 (2·N,), and BC3, int32 (4·N,), to RGBA8, int32 (16·N,)."""
    L = lanes

    @wp.kernel
    def bc1_kernel(
        first: int,
        blocks: wp.array(dtype=wp.int32),
        count: int,
        # outputs
        texels: wp.array(dtype=wp.int32),
    ):
        b = first + wp.tid()
        B = wp.array(ptr=blocks.ptr + wp.uint64(b) * wp.uint64(8 * L), shape=(2 * L,), dtype=wp.int32)
        T = wp.array(ptr=texels.ptr + wp.uint64(b) * wp.uint64(64 * L), shape=(16 * L,), dtype=wp.int32)
        for l in range(L):
            if b * L + l < count:
                p0, p1, p2, p3 = bc1_palette(B[2 * l], False)
                indices = B[2 * l + 1]
                for t in range(16):
                    T[16 * l + t] = bc1_select(t, indices, p0, p1, p2, p3)

    @wp.kernel
    def bc3_kernel(
        first: int,
        blocks: wp.array(dtype=wp.int32),
        count: int,
        # outputs
        texels: wp.array(dtype=wp.int32),
    ):
        b = first + wp.tid()
        B = wp.array(ptr=blocks.ptr + wp.uint64(b) * wp.uint64(16 * L), shape=(4 * L,), dtype=wp.int32)
        T = wp.array(ptr=texels.ptr + wp.uint64(b) * wp.uint64(64 * L), shape=(16 * L,), dtype=wp.int32)
        for l in range(L):
            if b * L + l < count:
                alpha = bc4.bc4_ramp(B[4 * l], False)
                i0, i1 = bc4.bc4_indices(B[4 * l], B[4 * l + 1])
                p0, p1, p2, p3 = bc1_palette(B[4 * l + 2], True)
                indices = B[4 * l + 3]
                for t in range(16):
                    color = bc1_select(t, indices, p0, p1, p2, p3) & 0xFFFFFF
                    T[16 * l + t] = color | (bc4.bc4_select(t, i0, i1, alpha) << 24)

    return bc1_kernel, bc3_kernel


def bc1_decode(blocks, *, out=None):
    """Decode BC1 blocks to RGBA bytes; texels of a three-colour block with index 3 are (0, 0, 0, 0).

    Args:
        blocks: (N, 8) uint8, in the byte order of DDS files; numpy, torch or Warp.
        out: Warp array, written in place and returned when given.

    Returns: Texels, (N, 4, 4, 4) uint8, alpha 0 or 255; of the kind of ``blocks``.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    Error: none against bcdec (test_bc1_decode_matches_bcdec) and the reals, rounded (test_bc1_rounds_to_the_nearest).
    """
    return decode_blocks(lambda lanes: make_kernels(lanes)[0], blocks, 8, (4, 4, 4), wp.uint8, wp.int32, out=out)


def bc3_decode(blocks, *, out=None):
    """Decode BC3 blocks to RGBA bytes.

    Args:
        blocks: (N, 16) uint8, in the byte order of DDS files; numpy, torch or Warp.
        out: Warp array, written in place and returned when given.

    Returns: Texels, (N, 4, 4, 4) uint8, straight alpha; of the kind of ``blocks``.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    Error: none against bcdec; held by test_bc3_decode_matches_bcdec.
    """
    return decode_blocks(lambda lanes: make_kernels(lanes)[1], blocks, 16, (4, 4, 4), wp.uint8, wp.int32, out=out)
