"""The one launcher of the block decoders: (N, block bytes) uint8 in, (N, 4, 4, …) of the same kind out."""

import warp as wp

from warp_neumat.kernels import arrays, dispatch


def decode_blocks(
    make_kernel,
    blocks,
    block_bytes: int,
    texel_shape: tuple,
    dtype,
    word,
    *,
    out=None,
    word_in=wp.int32,
    extra=lambda device: [],
):
    """Decode ``blocks`` with the kernel that ``make_kernel(lanes)`` gives, over all cores.

    Args:
        make_kernel: Lanes → kernel (first, blocks as ``word_in``, count, *extra, texels as ``word``).
        blocks: (N, ``block_bytes``) uint8; numpy, torch or Warp.
        block_bytes: 8 or 16.
        texel_shape: Shape of a block's result.
        dtype: Warp type of the result.
        word: Warp type in which the kernel stores it.
        out: Warp array of the result's shape and type, written in place when given.
        word_in: Warp type in which the kernel reads the blocks.
        extra: Warp device → further kernel arguments.

    Returns: (N, *texel_shape) of ``dtype``, of the kind of ``blocks``.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``out`` differs.
    """
    kind = arrays.kind_of(blocks)
    if str(getattr(blocks, "dtype", "")).removeprefix("torch.") not in ("uint8", str(wp.uint8)):
        raise TypeError(
            f"blocks must be uint8, got {getattr(blocks, 'dtype', type(blocks).__name__)}; view it as bytes"
        )
    source = arrays.take(blocks, "blocks", ("N", block_bytes), wp.uint8, kind)
    if source.ptr and source.ptr % 8:  # a view into a file's bytes: the kernels read whole words
        source = wp.clone(source)
    count = source.shape[0]
    result = kind.empty((count, *texel_shape), dtype) if out is None else out
    if result.shape != (count, *texel_shape) or result.dtype != dtype or result.device != kind.device:
        raise ValueError(
            f"out must be {dtype.__name__} of shape {(count, *texel_shape)} on {kind.device},"
            f" got {result.dtype.__name__} of shape {result.shape} on {result.device}"
        )
    if count:
        lanes = dispatch.lanes(kind.device)
        dispatch.launch(
            make_kernel(lanes),
            dispatch.blocks(count, lanes),
            inputs=[_view(source, word_in), count, *extra(kind.device)],
            outputs=[_view(result, word)],
            device=kind.device,
        )
    return kind.give(result) if out is None else out


def _view(array: wp.array, dtype) -> wp.array:
    """Return the memory of a contiguous ``array`` as a vector of ``dtype``."""
    size = array.size * wp.types.type_size_in_bytes(array.dtype) // wp.types.type_size_in_bytes(dtype)
    view = wp.array(ptr=array.ptr, shape=(size,), dtype=dtype, device=array.device)
    view._ref = array  # the view borrows the memory
    return view
