"""BCf in float64: the twin of ``kernels/bcf.py`` and of ``materials/bcf.py`` (paper [bcf], Eq. 3, 10, 11).

Textures are lists of mips, each (h, w, 3): what a conforming BC6H decoder gives, as float64.
"""

import numpy as np

from warp_neumat.reference.bc6h import bc6h_decode
from warp_neumat.reference.mlp import mlp


def wrapped(u, wrap: str) -> np.ndarray:
    """Return texture coordinates brought into [0, 1]; one that is not a number counts as 0.

    Args:
        u: Coordinates [1], any shape.
        wrap: ``"repeat"``, ``"clamp"`` or ``"mirror"``; infinite ones are 0, but 1 for +∞ under ``"clamp"``.
    """
    u = np.asarray(u, np.float64)
    if wrap == "clamp":
        return np.nan_to_num(np.clip(u, 0, 1), nan=0.0)
    u = np.where(np.isfinite(u), u, 0.0)
    return u - np.floor(u) if wrap == "repeat" else np.abs(u - 2 * np.floor((u + 1) / 2))


def bilinear(picture, u, v, wrap: str) -> np.ndarray:
    """Return ``picture`` (h, w, c) at (u, v), bilinearly filtered, shape [n, c]; texel i is centred at (i + 0.5)/w."""
    picture = np.asarray(picture, np.float64)
    height, width = picture.shape[:2]
    axes = []
    for coordinate, size in ((u, width), (v, height)):
        x = wrapped(coordinate, wrap) * size - 0.5
        first = np.floor(x).astype(np.int64)
        corner = np.stack([first, first + 1])
        corner = corner % size if wrap == "repeat" else np.clip(corner, 0, size - 1)
        axes.append((corner, (x - first)[:, None]))
    ((x0, x1), fx), ((y0, y1), fy) = axes
    top = picture[y0, x0] * (1 - fx) + picture[y0, x1] * fx
    return top * (1 - fy) + (picture[y1, x0] * (1 - fx) + picture[y1, x1] * fx) * fy


def level_of(lod, size: tuple[int, int], reference: tuple[int, int], mips: int) -> np.ndarray:
    """Return the mip level at which a texture is sampled, Eq. (11): clamp(lod + log2(max ratio of sides), 0, mips − 1).

    Args:
        lod: Mip level of the reference material, [n]; one that is not a number counts as −∞.
        size: (width, height) of the texture.
        reference: (width, height) of the reference material.
        mips: Number of the texture's mips.
    """
    bias = np.log2(max(size[0] / reference[0], size[1] / reference[1]))
    return np.clip(np.nan_to_num(np.asarray(lod, np.float64), nan=-np.inf) + bias, 0, mips - 1)


def trilinear(mips, u, v, level, wrap: str) -> np.ndarray:
    """Return a texture at (u, v) between its mips ⌊level⌋ and ⌊level⌋ + 1, Eq. (10), shape [n, c]."""
    level = np.asarray(level, np.float64)
    result = np.zeros((len(u), np.shape(mips[0])[2]))
    for m, picture in enumerate(mips):
        share = np.maximum(1 - np.abs(level - m), 0)  # a hat function over the levels
        used = share > 0
        result[used] += share[used, None] * bilinear(picture, u[used], v[used], wrap)
    return result


def features(textures, config: dict, uv, lod) -> np.ndarray:
    """Return what the network sees, [n, 3T].

    Args:
        textures: Per texture its decoded mips.
        config: The asset's config.
        uv: Texture coordinates, [n, 2].
        lod: Mip level of the reference material, [n] or a number.
    """
    u, v = np.asarray(uv, np.float64).T
    lod = np.broadcast_to(np.asarray(lod, np.float64), u.shape)
    reference, parts = (config["width"], config["height"]), []
    for mips, texture in zip(textures, config["textures"], strict=True):
        level = level_of(lod, (texture["width"], texture["height"]), reference, len(mips))
        parts.append(trilinear(mips, u, v, level, config["wrap"]))
    return np.concatenate(parts, axis=1)


def encoded(textures, weights, biases, config: dict, uv, lod) -> np.ndarray:
    """Return the network's outputs clamped to [0, 1], [n, C], Eq. (3); arguments as for :func:`features`."""
    return np.clip(mlp(features(textures, config, uv, lod), weights, biases), 0, 1)


def maps(y, config: dict) -> dict[str, np.ndarray]:
    """Return the maps [n, k] in linear values that outputs ``y`` [n, C] stand for; constants are broadcast."""
    y, result = np.asarray(y, np.float64), {}
    for k, channel in enumerate(config["channels"]):
        low, high = channel["range"]
        value = low + (high - low) * y[:, k]
        if channel["encoding"] == "srgb":
            positive = np.maximum(value, 0)
            value = np.where(value <= 0.04045, value / 12.92, ((positive + 0.055) / 1.055) ** 2.4)
        elif channel["encoding"] == "normal":
            value = 2 * value - 1
        result.setdefault(channel["map"], []).append(value)
    normals = {c["map"] for c in config["channels"] if c["encoding"] == "normal"}
    for name, columns in result.items():
        if name in normals:
            x, t = columns
            n = np.stack([x, t, np.sqrt(np.maximum(1 - x * x - t * t, 0))], axis=1)
            result[name] = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-30)
        else:
            result[name] = np.stack(columns, axis=1)
    for name, constant in config.get("constants", {}).items():
        result[name] = np.broadcast_to(np.asarray(constant, np.float64), (len(y), len(constant)))
    return result


def decoded(tensors: dict, config: dict) -> list[list[np.ndarray]]:
    """Return the mips (h, w, 3) float64 of every texture of an asset, decoded by :mod:`~warp_neumat.reference.bc6h`."""
    textures = []
    for t, texture in enumerate(config["textures"]):
        mips = []
        for m in range(texture["mips"]):
            blocks = tensors[f"texture{t}.mip{m}"]
            rows, columns = blocks.shape[:2]
            texels = bc6h_decode(blocks.reshape(-1, 16), config["signed"]).reshape(rows, columns, 4, 4, 3)
            picture = texels.swapaxes(1, 2).reshape(4 * rows, 4 * columns, 3).astype(np.float64)
            mips.append(picture[: max(1, texture["height"] >> m), : max(1, texture["width"] >> m)])
        textures.append(mips)
    return textures
