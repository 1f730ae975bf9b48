"""Blocks from given endpoints as their formats define them: nearest palette entries and bits, in float64.

The twin of kernels/block_pack.py, by looking at every entry of every palette. Colours are (N, 16, channels) in [0, 1],
texel t = 4·y + x; the metric is a symmetric (channels, channels) matrix G of squared differences δᵀGδ. Sources:
Microsoft, Texture Block Compression in Direct3D 11; Khronos Data Format Specification 1.3, section 20 (BPTC).
"""

import numpy as np

WEIGHTS = np.array([0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64])
"""Shares of the second endpoint in BC7's sixteen entries, in 64ths."""


def nearest(colours: np.ndarray, palette: np.ndarray, metric: np.ndarray | None = None):
    """Return the index of the entry nearest to each colour, the first of equal ones, and its squared difference.

    Args:
        colours: (N, 16, k).
        palette: (N, entries, k).
        metric: (k, k); None = identity.

    Returns: Indices (N, 16) int64 and squared differences (N, 16) float64.
    """
    difference = colours[:, :, None].astype(np.float64) - palette[:, None]
    metric = np.eye(colours.shape[2]) if metric is None else np.asarray(metric, np.float64)
    squared = np.einsum("ntec,cd,nted->nte", difference, metric, difference)
    index = squared.argmin(2)
    return index, np.take_along_axis(squared, index[..., None], 2)[..., 0]


def _bits(indices: np.ndarray, bits: int) -> np.ndarray:
    """Return (N, 16) indices of ``bits`` bits in one word of 64 bits, the first texel in the lowest bits."""
    shifts = np.arange(indices.shape[1], dtype=np.uint64) * np.uint64(bits)
    return np.bitwise_or.reduce(indices.astype(np.uint64) << shifts, axis=1)


def _clean(values: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(np.asarray(values, np.float64), nan=0.0), 0, 1)


def bc1_palette(codes: np.ndarray) -> np.ndarray:
    """Return the entries of four-colour blocks in the order of their indices, (N, 4, 3), from codes (N, 2, 3)."""
    a, b = np.moveaxis(codes / np.array([31, 63, 31]), 1, 0)
    return np.stack([a, b, (2 * a + b) / 3, (a + 2 * b) / 3], axis=1)


def bc1_pack(endpoints: np.ndarray, colours: np.ndarray, metric: np.ndarray | None = None):
    """Return BC1 blocks (N, 8) uint8 of four colours, and their squared errors, from endpoints (N, 2, 3)."""
    codes = np.floor(_clean(endpoints) * np.array([31, 63, 31]) + 0.5).astype(np.int64)
    words = codes @ np.array([1 << 11, 1 << 5, 1])
    high, low = words.max(1), words.min(1)
    equal = high == low
    low = np.where(equal & (low % 32 > 0), low - 1, low)
    high = np.where(equal & (low == high), high + 1, high)
    ordered = np.stack([high, low], axis=1)
    codes = np.stack([ordered >> 11, ordered >> 5 & 63, ordered & 31], axis=2)
    along = [0, 2, 3, 1]  # ties go to the entry that is nearer to the first endpoint
    index, error = nearest(_clean(colours), bc1_palette(codes)[:, along], metric)
    word = (high | low << 16).astype(np.uint64) | _bits(np.array(along)[index], 2) << np.uint64(32)
    return word.astype("<u8").view(np.uint8).reshape(-1, 8), error.sum(1)


def bc4_palette(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the decoded bytes of BC4's eight indices, (N, 8) int64, from endpoints (N,) in bytes."""
    a, b = first[:, None].astype(np.int64), second[:, None].astype(np.int64)
    i = np.arange(8)
    eight = np.where(i < 2, np.where(i == 0, a, b), ((8 - i) * a + (i - 1) * b) // 7)
    six = np.where(i < 2, np.where(i == 0, a, b), ((6 - i) * a + (i - 1) * b) // 5)
    return np.where(a > b, eight, np.where(i == 6, 0, np.where(i == 7, 255, six)))


def bc4_pack(endpoints: np.ndarray, colours: np.ndarray):
    """Return BC4 blocks (N, 8) uint8 and their squared errors, from endpoints (N, 2) and colours (N, 16)."""
    codes = np.floor(_clean(endpoints) * 255 + 0.5).astype(np.int64)
    best = None
    for first, second in ((codes.min(1), codes.max(1)), (codes.max(1), codes.min(1))):  # six values first
        palette = bc4_palette(first, second)
        rising = np.argsort(palette, axis=1, kind="stable")  # ties go to the lower value
        place, error = nearest(_clean(colours)[..., None], np.take_along_axis(palette, rising, 1)[..., None] / 255)
        index = np.take_along_axis(rising, place, 1)
        word = (first | second << 8).astype(np.uint64) | _bits(index, 3) << np.uint64(16)
        if best is None:
            best = word, error.sum(1)
        else:
            better = error.sum(1) <= best[1]
            best = np.where(better, word, best[0]), np.where(better, error.sum(1), best[1])
    return best[0].astype("<u8").view(np.uint8).reshape(-1, 8), best[1]


def bc7_palette(codes: np.ndarray) -> np.ndarray:
    """Return the decoded bytes of mode 6, (N, 16, 4) int64, from endpoints (N, 2, 4) in bytes."""
    weights = WEIGHTS[:, None]
    return (codes[:, None, 0] * (64 - weights) + codes[:, None, 1] * weights + 32) >> 6


def bc7_pack(endpoints: np.ndarray, colours: np.ndarray, metric: np.ndarray | None = None):
    """Return BC7 blocks (N, 16) uint8 of mode 6 and their squared errors, from endpoints (N, 2, k), k being 3 or 4."""
    count, _, k = endpoints.shape
    metric = np.eye(k) if metric is None else np.asarray(metric, np.float64)
    full = np.ones((count, 2, 4))
    full[..., :k] = _clean(endpoints)
    best = None
    for p in (1, 0):  # the lowest bit of all channels of an endpoint
        sevens = np.clip(np.floor((full * 255 - p) / 2 + 0.5), 0, 127).astype(np.int64)
        difference = (2 * sevens + p - full * 255)[..., :k]
        error = np.einsum("nec,cd,ned->ne", difference, metric, difference)
        if best is None:
            best, least = 2 * sevens + p, error
        else:  # an alpha that rounds to 255 is odd
            better = (error < least) & (full[..., 3] * 255 < 254.5)
            best = np.where(better[..., None], 2 * sevens + p, best)
    palette = bc7_palette(best)
    index, error = nearest(_clean(colours), palette[..., :k] / 255, metric)
    flip = index[:, 0] > 7
    index = np.where(flip[:, None], 15 - index, index)
    codes = np.where(flip[:, None, None], best[:, ::-1], best).astype(np.uint64)
    sevens = np.swapaxes(codes >> np.uint64(1), 1, 2).reshape(count, 8)
    low = _bits(sevens, 7) << np.uint64(7) | np.uint64(64) | (codes[:, 0, 0] & np.uint64(1)) << np.uint64(63)
    high = codes[:, 1, 0] & np.uint64(1) | index[:, 0].astype(np.uint64) << np.uint64(1)
    high = high | _bits(index[:, 1:], 4) << np.uint64(4)
    return np.stack([low, high], axis=1).astype("<u8").view(np.uint8).reshape(-1, 16), error.sum(1)
