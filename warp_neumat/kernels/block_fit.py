"""BC1, BC4 and BC7 encoding: fits for the mips that are written at load, and endpoints of given blocks.

The search is in ``block_fit_cluster`` (BC1) and ``block_fit_code``, the choice of indices and the bits in
``block_pack``. A texel's error is δᵀGδ with a symmetric metric G of its channels, by default the identity. BC1 blocks
always have four colours, BC4 blocks the better of both palettes, BC7 blocks are of mode 6.

The functions for training targets, :func:`bc1_endpoints` and its like, read the endpoints of blocks in *line order*,
whatever the order in the block says about its palette.
"""

import functools
import typing

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels.block_fit_cluster import BC1
from warp_neumat.kernels.block_fit_code import BC4, BC7, LANES
from warp_neumat.kernels.block_pack import pack_code

BATCH = 16
"""Blocks that one CPU thread fits: a whole number of registers on every CPU."""

LUMINANCE = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in the luminance that orders endpoints."""


class _Search(typing.NamedTuple):
    """How a format is fitted: C++ of its class and of its calls."""

    channels: int
    size: int  # bytes of a block
    rounds: int  # of steps by one, at most; few blocks gain in the last
    scale: str
    text: str
    solve: str
    write: str


_BC7 = r"""
int ends[2][4], p[2];
for (int k = 0; k < 2; ++k) {
    for (int c = 0; c < 4; ++c) ends[k][c] = c < C ? (int)Lanes::lane(fit.code[k * C + (c < C ? c : 0)], l) : 255;
    p[k] = ends[k][0] & 1;
    for (int c = 0; c < 4; ++c) ends[k][c] >>= 1;
}
Pack::index_bc7(ends[0], ends[1], p[0], p[1], colours, C, metric.data, out);
"""

_SEARCHES = {
    "bc1": _Search(
        3,
        8,
        4,
        "1.0f",
        BC1 + "typedef FitBC1 Fit;",
        "fit.solve(metric.data, gains.data, cuts.data, rounds);",
        "float ends[6]; for (int c = 0; c < 6; ++c) ends[c] = Lanes::lane(fit.code[c], l) / fit.top(c % 3);"
        "Pack::write_bc1(ends, ends + 3, colours, metric.data, out);",
    ),
    "bc4": _Search(
        1,
        8,
        8,
        "255.0f",
        BC4 + "typedef FitBC4 Fit;",
        "fit.solve(rounds);",
        "Pack::write_bc4(Lanes::lane(fit.low, l) / 255.0f, Lanes::lane(fit.high, l) / 255.0f, colours, out);",
    ),
    "bc7": _Search(3, 16, 2, "255.0f", BC7 + "typedef FitBC7 Fit;", "fit.solve(metric.data, rounds);", _BC7),
    "bc7_alpha": _Search(4, 16, 2, "255.0f", BC7 + "typedef FitBC7 Fit;", "fit.solve(metric.data, rounds);", _BC7),
}

_MAIN = r"""
for (int base = 0; base < @LANES@; base += Lanes::NV) {
    if (start + base >= count) return;
    Fit fit;
    for (int l = 0; l < Lanes::NV; ++l) {    // lanes past the end repeat the last block
        const long long b = start + base + l < count ? start + base + l : count - 1;
        for (int k = 0; k < 16 * C; ++k) Lanes::lane(fit.x[k], l) = Pack::unit(pixels.data[16 * C * b + k]) * @SCALE@;
    }
    @SOLVE@
    for (int l = 0; l < Lanes::NV && start + base + l < count; ++l) {
        const long long b = start + base + l;
        float colours[16 * C];
        for (int t = 0; t < 16; ++t)
            for (int c = 0; c < C; ++c) colours[16 * c + t] = pixels.data[16 * C * b + C * t + c];
        unsigned char* out = blocks.data + @SIZE@ * b;
        @WRITE@
    }
}
"""


@functools.cache
def make_fit_kernel(lanes: int, format: str):
    """Return the kernel that fits ``lanes`` blocks a thread (:data:`BATCH` on the CPU, 1 on CUDA).

    Args:
        lanes: Blocks a thread.
        format: ``"bc1"``, ``"bc4"``, ``"bc7"`` or ``"bc7_alpha"``.
    """
    search = _SEARCHES[format]
    code = f"enum {{ C = {search.channels} }};" + pack_code() + LANES + search.text + _MAIN
    replaced = {"LANES": lanes, "SIZE": search.size, "SCALE": search.scale, "SOLVE": search.solve}
    for name, value in {**replaced, "WRITE": search.write}.items():
        code = code.replace(f"@{name}@", str(value))
    L = lanes

    @wp.func_native(code)
    def fit(
        start: int,
        pixels: wp.array(dtype=wp.float32),
        count: int,
        metric: wp.array(dtype=wp.float32),
        gains: wp.array(dtype=wp.float32),
        cuts: wp.array(dtype=wp.int32),
        rounds: int,
        blocks: wp.array(dtype=wp.uint8),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def block_fit_kernel(
        first: int,
        pixels: wp.array(dtype=wp.float32),
        count: int,
        metric: wp.array(dtype=wp.float32),
        gains: wp.array(dtype=wp.float32),
        cuts: wp.array(dtype=wp.int32),
        rounds: int,
        # outputs
        blocks: wp.array(dtype=wp.uint8),
    ):
        b = first + wp.tid()
        fit(b * L, pixels, count, metric, gains, cuts, rounds, blocks)

    return block_fit_kernel


@functools.cache
def _cluster_tables(device: str) -> tuple[wp.array, wp.array]:
    """Return 1 / det and i | j << 5 | k << 10 of BC1's choices, in the order in which the search goes through them."""
    i, j, k = (n.ravel() for n in np.meshgrid(*3 * [np.arange(17)], indexing="ij"))
    rising = (i <= j) & (j <= k)
    i, j, k = i[rising], j[rising], k[rising]
    weight = (48 - i - j - k) / 3  # summed over texels: 0 for the first i, then 1/3, 2/3 and 1
    square = (j - i) / 9 + (k - j) * 4 / 9 + (16 - k)
    det = 16 * square - weight**2
    gains = np.where(det > 1e-9, 1 / np.maximum(det, 1e-9), 0.0)
    words = i | j << 5 | k << 10
    return wp.array(gains, dtype=wp.float32, device=device), wp.array(words, dtype=wp.int32, device=device)


def _metric_words(metric, channels: int) -> np.ndarray:
    """Return G and its symmetric root R as 4 × 4 matrices, one after the other: 32 numbers."""
    words = np.zeros((2, 4, 4))
    if metric is None:
        words[:, :channels, :channels] = np.eye(channels)
        return words.ravel()
    matrix = np.asarray(metric, np.float64)
    if matrix.shape != (channels, channels) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        raise ValueError(
            f"metric must be a symmetric matrix of {channels} x {channels} finite numbers, got shape {matrix.shape}"
        )
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < -1e-6 * max(values[-1], 0.0) or values[-1] <= 0:
        raise ValueError(f"metric must have no negative and some positive eigenvalue, got {values.tolist()}")
    words[0, :channels, :channels] = matrix
    words[1, :channels, :channels] = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
    return words.ravel()


def _flat(array: wp.array) -> wp.array:
    """Return a dense ``array`` as a vector; one block may have any stride, which ``flatten`` refuses."""
    view = wp.array(ptr=array.ptr, shape=(array.size,), dtype=array.dtype, device=array.device)
    view._ref = array  # the view borrows the memory
    return view


def _encode(format: str, pixels, metric, out):
    search = _SEARCHES[format]
    kind = arrays.kind_of(pixels)
    dtype = getattr(pixels, "dtype", None)
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    if "float" not in getattr(scalar, "__name__", str(scalar)):
        raise TypeError(f"pixels must be floats in [0, 1], got {dtype or type(pixels).__name__}; divide bytes by 255")
    shape = ("N", 4, 4) if search.channels == 1 else ("N", 4, 4, search.channels)
    source = arrays.take(pixels, "pixels", shape, wp.float32, kind)
    words = _metric_words(metric, search.channels)
    count = source.shape[0]
    blocks = kind.empty((count, search.size), wp.uint8) if out is None else out
    if blocks.shape != (count, search.size) or blocks.dtype != wp.uint8 or blocks.device != kind.device:
        raise ValueError(
            f"out must be uint8 of shape {(count, search.size)} on {kind.device},"
            f" got {blocks.dtype.__name__} of shape {blocks.shape} on {blocks.device}"
        )
    if count:
        lanes = BATCH if kind.device.is_cpu else 1
        dispatch.launch(
            make_fit_kernel(lanes, format),
            dispatch.blocks(count, lanes),
            inputs=[
                _flat(source),
                count,
                wp.array(words, dtype=wp.float32, device=kind.device),
                *_cluster_tables(str(kind.device)),
                search.rounds,
            ],
            outputs=[_flat(blocks)],
            device=kind.device,
        )
    return kind.give(blocks) if out is None else out


def bc1_encode(pixels, *, metric=None, out=None):
    """Encode blocks of pixels as BC1 with four opaque colours, spread over all cores.

    Args:
        pixels: (N, 4, 4, 3) floats in [0, 1]: row, column, channel; numpy, torch or Warp. What lies outside is clamped,
            and NaN counts as 0.
        metric: Symmetric (3, 3) matrix G of the squared differences δᵀGδ; None = identity.
        out: Warp array, written in place and returned when given.

    Returns: Blocks, (N, 8) uint8 in the byte order of DDS files, of the kind of ``pixels``.
    Raises:
        TypeError: If ``pixels`` are not floats.
        ValueError: If their shape, ``metric`` or ``out`` differs.
    Error: on real maps PSNR is from 0.15 dB below to 3.3 dB above that of quicktex at level 18 with four colours, and
        from 0.5 dB below to 0.9 dB above with three; held by test_bc1_beside_quicktex_and_etcpak. Speed on one core:
        84 times quicktex's.
    """
    return _encode("bc1", pixels, metric, out)


def bc4_encode(pixels, *, out=None):
    """Encode blocks of one channel as BC4, spread over all cores; arguments and result as for :func:`bc1_encode`.

    Args:
        pixels: (N, 4, 4) floats in [0, 1].
        out: Warp array, written in place and returned when given.

    Returns: Blocks, (N, 8) uint8.
    Raises:
        TypeError: If ``pixels`` are not floats.
        ValueError: If their shape or ``out`` differs.
    Error: on real maps PSNR is 1.5 to 2.4 dB above that of quicktex, which takes the least and the greatest value; held
        by test_bc4_beside_quicktex_and_etcpak. Speed on one core: half of quicktex's.
    """
    return _encode("bc4", pixels, None, out)


def bc7_encode(pixels, *, metric=None, out=None):
    """Encode blocks of pixels as BC7 of mode 6, spread over all cores; arguments and result as for :func:`bc1_encode`.

    Args:
        pixels: (N, 4, 4, 3) or (N, 4, 4, 4) floats in [0, 1]; without alpha, and where it is 1 throughout, the block
            decodes to 255.
        metric: Symmetric matrix of as many rows as there are channels; None = identity.
        out: Warp array, written in place and returned when given.

    Returns: Blocks, (N, 16) uint8.
    Raises:
        TypeError: If ``pixels`` are not floats.
        ValueError: If their shape, ``metric`` or ``out`` differs.
    Error: on real maps PSNR is from 0.1 dB below to 11 dB above that of etcpak's mode 6 at uber level 4; held by
        test_bc7_beside_etcpaks_mode_6. Speed on one core: 4.6 times etcpak's.
    """
    shape = tuple(np.shape(pixels)) if not hasattr(pixels, "shape") else tuple(pixels.shape)
    if len(shape) != 4 or shape[3] not in (3, 4):
        raise ValueError(f"pixels must have shape [N, 4, 4, 3] or [N, 4, 4, 4], got {shape}")
    return _encode("bc7" if shape[3] == 3 else "bc7_alpha", pixels, metric, out)


def _block_bytes(blocks, size: int) -> np.ndarray:
    blocks = np.asarray(blocks)
    if blocks.dtype != np.uint8:
        raise TypeError(f"blocks must be uint8, got {blocks.dtype}; view it as bytes")
    if blocks.ndim != 2 or blocks.shape[1] != size:
        raise ValueError(f"blocks must have shape [N, {size}], got {blocks.shape}")
    return np.ascontiguousarray(blocks)


def _brighter_first(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return both endpoints (N, k) side by side, the one with the larger luminance first."""
    swap = ((second - first)[:, :3] @ np.array(LUMINANCE) > 1e-9)[:, None]
    return np.concatenate([np.where(swap, second, first), np.where(swap, first, second)], axis=1).astype(np.float32)


def bc1_endpoints(blocks) -> np.ndarray:
    """Return the endpoints of BC1 blocks in line order, in [0, 1].

    Args:
        blocks: (N, 8) uint8, NumPy.

    Returns: (N, 6) float32: red, green, blue of the endpoint with the larger luminance, then of the other.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape differs.
    """
    words = _block_bytes(blocks, 8)[:, :4].copy().view("<u2").astype(np.int64)
    channels = [words >> 11, words >> 5 & 63, words & 31]
    ends = np.stack(channels, axis=2) / np.array([31, 63, 31])
    return _brighter_first(ends[:, 0], ends[:, 1])


def bc4_endpoints(blocks) -> np.ndarray:
    """Return the endpoints of unsigned BC4 blocks in [0, 1], the larger first; otherwise as :func:`bc1_endpoints`.

    Args:
        blocks: (N, 8) uint8, NumPy.

    Returns: (N, 2) float32.
    """
    ends = _block_bytes(blocks, 8)[:, :2].astype(np.float32) / np.float32(255)
    return np.stack([ends.max(1), ends.min(1)], axis=1)


def bc7_endpoints(blocks, channels: int = 4) -> np.ndarray:
    """Return the endpoints of BC7 blocks of mode 6 in line order, in [0, 1]; as :func:`bc1_endpoints`.

    Args:
        blocks: (N, 16) uint8, NumPy.
        channels: 4, or 3 to leave out alpha.

    Returns: (N, 2·channels) float32.
    Raises:
        TypeError: If ``blocks`` does not hold bytes.
        ValueError: If its shape or ``channels`` differs, or a block has another mode.
    """
    words = _block_bytes(blocks, 16).view("<u8")
    if channels not in (3, 4):
        raise ValueError(f"channels must be 3 or 4, got {channels}")
    other = np.flatnonzero((words[:, 0] & np.uint64(127)) != 64)
    if other.size:
        raise ValueError(f"block {other[0]} is not of mode 6, the only one with one line; encode with bc7_encode")
    shifts = np.arange(7, 63, 7, dtype=np.uint64)
    sevens = (words[:, :1] >> shifts & np.uint64(127)).astype(np.int64).reshape(-1, 4, 2)
    lowest = np.stack([words[:, 0] >> np.uint64(63), words[:, 1] & np.uint64(1)], axis=1).astype(np.int64)
    ends = (2 * sevens + lowest[:, None]) / 255
    return _brighter_first(ends[:, :channels, 0], ends[:, :channels, 1])
