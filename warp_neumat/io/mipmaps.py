"""Smaller and larger copies of a texture set's channels, filtered in the domain where averaging means something.

Channels are in the encoded domain, (H, W, C) float32 in [0, 1], row 0 on top. What is averaged: sRGB channels as linear
light; the x and y of a normal map together with their z as unit vectors, renormalised; all others as they are.

Smaller is an exact area filter: texel i of n covers the interval [i·W/n, (i + 1)·W/n) of the W texels it is made of,
each weighted by its overlap, so that no size shifts the picture or changes its mean. A chain halves with floor, down to
1×1, and carries linear light and unnormalised vectors from level to level: nothing is quantised or renormalised twice.
Larger is bilinear between texel centres, clamped at the border.

The length that averaged normals lose measures the roughness that the finer level had; Toksvig, "Mipmapping Normal
Maps", 2005, turns it into roughness (:func:`toksvig`).
"""

from __future__ import annotations

import math

import numpy as np

from warp_neumat.io.block_formats import mip_limit, mip_size

_ROWS = 128  # rows of a power at a time, so that the temporaries stay in cache


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """Return linear light for sRGB-encoded values (IEC 61966-2-1), float32, any shape; below 0 it is odd.

    Error: at most 3e-7 against float64, held by test_srgb_round_trip_matches_float64.
    """
    return _in_rows(values, _srgb_to_linear)


def linear_to_srgb(values: np.ndarray) -> np.ndarray:
    """Return sRGB-encoded values (IEC 61966-2-1) for linear light, float32, any shape; below 0 it is odd.

    Error: at most 3e-7 against float64, held by test_srgb_round_trip_matches_float64.
    """
    return _in_rows(values, _linear_to_srgb)


def _in_rows(values, function) -> np.ndarray:
    values = np.asarray(values, np.float32)
    if values.ndim < 2 or len(values) <= _ROWS:
        return function(values)
    result = np.empty(values.shape, np.float32)
    for row in range(0, len(values), _ROWS):
        result[row : row + _ROWS] = function(values[row : row + _ROWS])
    return result


def _srgb_to_linear(v):
    size = np.abs(v)
    curve = ((size + np.float32(0.055)) * np.float32(1 / 1.055)) ** np.float32(2.4)
    return np.copysign(np.where(size <= np.float32(0.04045), size * np.float32(1 / 12.92), curve), v)


def _linear_to_srgb(v):
    size = np.abs(v)
    curve = np.float32(1.055) * size ** np.float32(1 / 2.4) - np.float32(0.055)
    return np.copysign(np.where(size <= np.float32(0.0031308), size * np.float32(12.92), curve), v)


def unit_normals(xy: np.ndarray) -> np.ndarray:
    """Return unit vectors (…, 3) float32 for encoded x and y (…, 2) in [0, 1]; beyond the unit circle z is 0."""
    normal = np.empty((*xy.shape[:-1], 3), np.float32)
    normal[..., :2] = 2.0 * xy - 1.0
    square = normal[..., 0] ** 2 + normal[..., 1] ** 2
    normal[..., 2] = np.sqrt(np.maximum(1.0 - square, 0.0))
    normal[..., :2] /= np.sqrt(np.maximum(square, 1.0))[..., None]
    return normal


def resample(pixels: np.ndarray, channels, width: int, height: int) -> np.ndarray:
    """Return a set's channels at another size, (height, width, C) float32 in the encoded domain.

    Per axis: the area filter where the new size is smaller, bilinear where it is larger.

    Args:
        pixels: (H, W, C) float32 in [0, 1].
        channels: C objects with ``map``, ``component`` and ``encoding`` (``linear``, ``srgb`` or ``normal``).

    Raises:
        ValueError: If the shapes do not fit or a size is below 1.
    """
    pixels = _checked(pixels, channels)
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width}×{height}")
    if pixels.shape[:2] == (height, width):
        return pixels
    result = np.empty((height, width, pixels.shape[2]), np.float32)
    for encoding, at in _groups(channels):
        values = _to_filtered(pixels[..., at], encoding)
        values = _resize_axis(_resize_axis(values, height, 0), width, 1)
        result[..., at] = _to_encoded(values, encoding)
    return result


def mip_chain(pixels: np.ndarray, channels, *, toksvig_roughness: bool = False) -> list[np.ndarray]:
    """Return the mip levels of a set, from ``pixels`` itself (not copied) to 1×1, (h, w, C) float32, encoded domain.

    Args:
        pixels: (H, W, C) float32 in [0, 1].
        channels: As for :func:`resample`.
        toksvig_roughness: Raise ``roughness`` by the length that the normals of ``normal`` lost.

    Raises:
        ValueError: If ``toksvig_roughness`` is asked of a set without both maps.

    Error: at most 2e-6 against the same chain in float64, held by test_chain_matches_float64.
    """
    pixels = _checked(pixels, channels)
    height, width, _ = pixels.shape
    sizes = mip_sizes(width, height)
    levels = [pixels, *(np.empty((h, w, pixels.shape[2]), np.float32) for w, h in sizes[1:])]
    lengths: list[np.ndarray] = []
    for encoding, at in _groups(channels):
        values = _to_filtered(pixels[..., at], encoding)
        shared = toksvig_roughness and channels[at[0]].map == "normal"
        for level, (w, h) in enumerate(sizes[1:], start=1):
            values = _resize_axis(_resize_axis(values, h, 0), w, 1)
            levels[level][..., at] = _to_encoded(values, encoding)
            if shared:
                lengths.append(_length(values))
    if toksvig_roughness:
        rough = [i for i, channel in enumerate(channels) if channel.map == "roughness"]
        if len(rough) != 1 or not any(channel.map == "normal" for channel in channels):
            raise ValueError("toksvig_roughness needs a learnt roughness and a learnt normal map; leave it off")
        for level, length in zip(levels[1:], lengths, strict=True):
            level[..., rough[0]] = toksvig(level[..., rough[0]], length)
    return levels


def mip_sizes(width: int, height: int) -> list[tuple[int, int]]:
    """Return (width, height) of every mip level from the full size to 1×1, halved with floor."""
    return [mip_size(width, height, mip) for mip in range(mip_limit(width, height))]


def toksvig(roughness: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return the roughness that an averaged normal of ``length`` in [0, 1] adds up to, float32.

    Toksvig 2005, Eq. for the exponent: s' = |N| s / (|N| + s (1 − |N|)), with s = 2/α² − 2 and α = roughness² to go
    from roughness to the exponent and back. Written in u = 1/s, which stays finite: u' = u + (1 − |N|)/|N|.
    """
    square = np.clip(roughness, 0.0, 1.0).astype(np.float32) ** 4  # α²
    length = np.clip(length, 1e-6, 1.0).astype(np.float32)
    u = square / np.maximum(2.0 - 2.0 * square, 1e-7) + (1.0 - length) / length
    return np.sqrt(np.sqrt(2.0 * u / (1.0 + 2.0 * u)))  # 2/(s' + 2), s' = 1/u'


# --- the domain that is averaged --------------------------------------------------------------------------------------


def _checked(pixels, channels) -> np.ndarray:
    pixels = np.asarray(pixels, np.float32)
    if pixels.ndim != 3 or pixels.shape[2] != len(channels) or 0 in pixels.shape[:2]:
        raise ValueError(f"pixels must have shape (H, W, {len(channels)}), got {pixels.shape}")
    return pixels


def _groups(channels) -> list[tuple[str, list[int]]]:
    """Return (encoding, channel numbers) of what is filtered together: one entry per map and encoding."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, channel in enumerate(channels):
        if channel.encoding not in ("linear", "srgb", "normal"):
            raise ValueError(f"channel {i}: encoding must be linear, srgb or normal, got {channel.encoding!r}")
        groups.setdefault((channel.map, channel.encoding), []).append(i)
    for (name, encoding), at in groups.items():
        if encoding == "normal" and [channels[i].component for i in at] != ["x", "y"]:
            raise ValueError(f"map {name}: a normal has the components x and y, in this order")
    return [(encoding, at) for (_, encoding), at in groups.items()]


def _to_filtered(values: np.ndarray, encoding: str) -> np.ndarray:
    if encoding == "srgb":
        return srgb_to_linear(values)
    return unit_normals(values) if encoding == "normal" else values


def _to_encoded(values: np.ndarray, encoding: str) -> np.ndarray:
    if encoding == "srgb":
        return np.clip(linear_to_srgb(values), 0.0, 1.0)
    if encoding == "normal":
        length = _length(values)[..., None]
        return np.where(length > 1e-6, 0.5 + 0.5 * values[..., :2] / np.maximum(length, 1e-6), np.float32(0.5))
    return values


def _length(vectors: np.ndarray) -> np.ndarray:
    x, y, z = (vectors[..., c] for c in range(3))
    return np.sqrt(x * x + y * y + z * z)


# --- one axis ---------------------------------------------------------------------------------------------------------


def _resize_axis(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    old = values.shape[axis]
    if size == old:
        return values
    if old == 2 * size:
        even, odd = (values[start::2] if axis == 0 else values[:, start::2] for start in (0, 1))
        return (even + odd) * np.float32(0.5)
    first, weights = area_weights(old, size) if size < old else _bilinear_weights(old, size)
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    result = None
    for tap in range(weights.shape[1]):
        part = values.take(np.clip(first + tap, 0, old - 1), axis=axis)
        part *= weights[:, tap].astype(np.float32).reshape(shape)
        result = part if result is None else np.add(result, part, out=result)
    return result


def area_weights(old: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (first (size,), weights (size, taps)) float64: texel i is Σ weights[i, k] · source[first[i] + k].

    Each row sums to 1, and every source texel is used size/old in all. Taps beyond the end weigh 0.
    """
    edges = np.arange(size + 1) * old / size
    start, end = edges[:-1], edges[1:]
    first = np.minimum(np.floor(start).astype(int), old - 1)
    taps = math.ceil((end - first).max() - 1e-9)
    cell = first[:, None] + np.arange(taps)
    overlap = np.minimum(end[:, None], cell + 1) - np.maximum(start[:, None], cell)
    weights = np.maximum(overlap, 0.0)
    return first, weights / weights.sum(1, keepdims=True)


def _bilinear_weights(old: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    at = (np.arange(size) + 0.5) * old / size - 0.5
    first = np.floor(at).astype(int)
    return first, np.stack([1.0 - (at - first), at - first], axis=1)
