"""BC6H decoding: whole blocks, and single texels at random for other kernels.

Half floats come out bit for bit as the specification says (``reference.bc6h`` is its readable form), all 14 modes,
signed and unsigned; reserved modes give zero. The format itself is data in ``bc6h_tables``, and the code that moves the
bits of a block to its endpoints is generated from there, per mode: shifts, masks and constants that the compiler sees.

On a CPU core a block takes one jump to its mode's code and some 160 instructions, most of them on vectors; runs of
mode 10, which is what this project writes by default, skip the jump. On CUDA a thread owns a texel. ``bc6h_code``
tells how.

What bounds it: instructions. A block moves 112 bytes, 16 in and 96 out, at 7 GB/s a core in mode 10 (15 ns a block on
Zen 3): filling the result alone takes a quarter to half of that. Blocks of mixed modes also pay for one mispredicted
jump each. ``python -m bench codec`` measures both.

Layouts: blocks [n, 16] uint8 in DDS byte order; pixels [n, 4, 4, 3] float16: row y, column x, channel.
"""

import functools

import warp as wp

from warp_neumat.kernels import arrays, bc6h_code, dispatch

wp.set_module_options(dispatch.module_options())

GRAIN = 8
"""Fewest thread blocks of 256 BC6H blocks worth a chunk of their own: some 40 µs."""


@wp.func_native(bc6h_code.texel_code())
def bc6h_texel_bits(lo: wp.uint64, hi: wp.uint64, texel: int, is_signed: bool) -> wp.uint64:
    """Return the half floats of one texel of a block as bits: red in bits 0 … 15, then green, then blue.

    For use in kernels. ``lo`` and ``hi`` are bytes 0 … 7 and 8 … 15 of the block, little endian: read a texture as a
    ``wp.uint64`` array of two numbers a block. ``texel`` is 4y + x. Any mode; reserved ones give 0.

    Error: none, bit for bit; held by test_texels_match_blocks.
    """
    ...


@wp.func
def bc6h_texel(lo: wp.uint64, hi: wp.uint64, texel: int, is_signed: bool) -> wp.vec3:
    """Return one texel of a block as linear values; arguments as for :func:`bc6h_texel_bits`."""
    bits = bc6h_texel_bits(lo, hi, texel, is_signed)
    r = wp.cast(wp.uint16(bits & wp.uint64(65535)), wp.float16)
    g = wp.cast(wp.uint16((bits >> wp.uint64(16)) & wp.uint64(65535)), wp.float16)
    b = wp.cast(wp.uint16((bits >> wp.uint64(32)) & wp.uint64(65535)), wp.float16)
    return wp.vec3(float(r), float(g), float(b))


@functools.cache
def make_decode_kernel(signed: bool, lanes: int, *, portable: bool = False):
    """Return the kernel behind :func:`bc6h_decode`, whose threads own ``lanes`` blocks each; with 1, a texel each.

    ``portable`` leaves out what only AVX2 has, as on a core without it.
    """
    if lanes == 1:

        @wp.kernel(module="unique", module_options=dispatch.module_options())
        def bc6h_decode_kernel(
            first: int,
            blocks: wp.array2d(dtype=wp.uint8),
            count: int,
            # outputs
            pixels: wp.array4d(dtype=wp.float16),
        ):
            # A thread owns a texel: neighbours then write side by side, and only two modes meet in a warp of 32.
            i = first + wp.tid()
            n, texel = i // 16, i % 16
            lo, hi = wp.uint64(0), wp.uint64(0)
            for k in range(8):
                lo = lo | (wp.uint64(blocks[n, k]) << wp.uint64(8 * k))
                hi = hi | (wp.uint64(blocks[n, k + 8]) << wp.uint64(8 * k))
            bits = bc6h_texel_bits(lo, hi, texel, signed)
            for c in range(3):
                half = wp.uint16((bits >> wp.uint64(16 * c)) & wp.uint64(65535))
                pixels[n, texel // 4, texel % 4, c] = wp.cast(half, wp.float16)

        return bc6h_decode_kernel

    @wp.func_native(bc6h_code.block_code(signed, portable=portable))
    def decode_blocks(
        blocks: wp.array2d(dtype=wp.uint8), first: int, count: int, pixels: wp.array4d(dtype=wp.float16)
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def bc6h_decode_kernel(
        first: int,
        blocks: wp.array2d(dtype=wp.uint8),
        count: int,
        # outputs
        pixels: wp.array4d(dtype=wp.float16),
    ):
        n = (first + wp.tid()) * lanes
        decode_blocks(blocks, n, wp.min(lanes, count - n), pixels)

    return bc6h_decode_kernel


def bc6h_decode(blocks, signed: bool = False, *, out=None):
    """Decode BC6H blocks of any modes, spread over all cores.

    Args:
        blocks: Shape [n, 16], uint8, in the byte order of DDS and KTX2 files; numpy, torch or Warp.
        signed: Whether the blocks are of the signed format (BC6H_SF16).
        out: Warp array, shape [n, 4, 4, 3], float16, written in place when given.

    Returns: Pixels [row, column, channel] of each block, shape [n, 4, 4, 3], float16, of the kind of ``blocks``;
        reserved modes are zero.
    Raises: TypeError: If ``blocks`` is not uint8. ValueError: If a shape or device differs.
    Error: none, bit for bit as bcdec and ``reference.bc6h``; held by test_decode_matches_bcdec.
    """
    dtype = str(getattr(blocks, "dtype", "uint8")).rsplit(".", 1)[-1].removesuffix("'>")
    if dtype != "uint8":
        raise TypeError(f"blocks must be uint8, the bytes of the file, got {dtype}; view them with .view('uint8')")
    kind = arrays.kind_of(blocks)
    data = arrays.take(blocks, "blocks", ("n", 16), wp.uint8, kind)
    count = data.shape[0]
    shape = (count, 4, 4, 3)
    pixels = kind.empty(shape, wp.float16) if out is None else out
    if pixels.shape != shape or pixels.dtype != wp.float16 or pixels.device != kind.device:
        raise ValueError(
            f"out must be float16 of shape [{count}, 4, 4, 3] on {kind.device}, got {pixels.dtype.__name__} of "
            f"{tuple(pixels.shape)} on {pixels.device}"
        )
    lanes = dispatch.lanes(kind.device)
    dispatch.launch(
        make_decode_kernel(bool(signed), lanes),
        dispatch.blocks(count, lanes) if lanes > 1 else 16 * count,
        inputs=[data, count],
        outputs=[pixels],
        device=kind.device,
        grain=GRAIN,
    )
    return pixels if out is not None else kind.give(pixels)
