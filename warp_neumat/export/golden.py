"""A golden vector: a few inputs of an exported decoder and what it must give, for whoever ports it to an engine.

Some inputs are ``exact``: every texture is read at a whole mip level with bilinear weights that are multiples of 1/256,
so that a sampler with 8-bit weights, as GPUs have, gives the same features as one in float32. The others lie between
mips, beyond [0, 1] and at the edge, to show wrap mode and level selection.
"""

import math

import numpy as np

from warp_neumat.export.shader_source import lod_bias
from warp_neumat.io.block_formats import from_blocks
from warp_neumat.kernels.bc6h import bc6h_decode

_WEIGHT_STEPS = 256


def golden_inputs(config: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return (uv [n, 2], lod [n]), float32: texel centres of the finest texture, then other places."""
    width = max(texture["width"] for texture in config["textures"])
    height = max(texture["height"] for texture in config["textures"])
    last = math.floor(math.log2(max(config["width"], config["height"])))
    places, lods = [], []
    for n, (u, v) in enumerate([(0.1, 0.8), (0.36, 0.27), (0.61, 0.55), (0.89, 0.03), (0.47, 0.94)]):
        places.append(((math.floor(u * width) + 0.5) / width, (math.floor(v * height) + 0.5) / height))
        lods.append([-1, 0, 1, 2, last][n])
    places += [(0.3137, 0.7213), (0.9993, 0.0007), (-0.2731, 1.6184), (0.5502, 0.4419), (2.3701, -0.8127)]
    lods += [0.0, 0.5, 1.25, last - 0.6, last + 2.0]
    return np.array(places, np.float32), np.array(lods, np.float32)


def decoded(texture) -> list[np.ndarray]:
    """Return the mips of a BC6H texture, (h, w, 3) float64."""
    signed = texture.format == "bc6h_sf16"
    mips = []
    for mip, blocks in enumerate(texture.levels[0]):
        texels = bc6h_decode(np.ascontiguousarray(blocks.reshape(-1, 16)), signed=signed)
        mips.append(from_blocks(texels, *texture.size(mip)).astype(np.float64))
    return mips


def golden_vector(material) -> dict:
    """Return inputs and outputs of a BCf as the manifest holds them.

    ``levels`` [n, T] are the mip levels of Eq. 11 of [bcf], ``features`` [n, 3T] what the samplers give (float64
    filtering of the decoded halves, rounded), ``outputs`` [n, C] and ``maps`` what ``material`` makes of them.
    """
    config = material.header["config"]
    uv, lod = golden_inputs(config)
    levels = np.empty((len(lod), len(config["textures"])))
    features = np.empty((len(lod), 3 * len(config["textures"])))
    exact = np.ones(len(lod), bool)
    for t, (texture, entry) in enumerate(zip(material.textures, config["textures"], strict=True)):
        mips = decoded(texture)
        levels[:, t] = np.clip(lod.astype(np.float64) + lod_bias(config, entry), 0, entry["mips"] - 1)
        for n in range(len(lod)):
            features[n, 3 * t : 3 * t + 3], same = _trilinear(mips, uv[n], levels[n, t], config["wrap"])
            exact[n] &= same
    maps = {name: _rounded(value) for name, value in material.maps(uv, lod).items()}
    return {
        "uv": _rounded(uv),
        "lod": _rounded(lod),
        "exact": exact.tolist(),
        "levels": _rounded(levels),
        "features": _rounded(features),
        "outputs": _rounded(material.encoded(uv, lod)),
        "maps": maps,
    }


def _trilinear(mips, uv, level: float, wrap: str) -> tuple[np.ndarray, bool]:
    """Return a texture's three channels at one place, and whether 8-bit weights are enough for it."""
    first = math.floor(level)
    share = level - first
    value, exact = _bilinear(mips[first], uv, wrap)
    if share == 0:
        return value, exact
    return (1 - share) * value + share * _bilinear(mips[first + 1], uv, wrap)[0], False


def _bilinear(picture, uv, wrap: str) -> tuple[np.ndarray, bool]:
    corners, weights = [], []
    for coordinate, size in zip(map(float, uv), picture.shape[1::-1], strict=True):
        if wrap == "clamp":
            coordinate = min(max(coordinate, 0.0), 1.0)
        elif wrap == "mirror":
            coordinate = abs(coordinate - 2 * math.floor((coordinate + 1) / 2))
        place = coordinate * size - 0.5
        first = math.floor(place)
        pair = np.array([first, first + 1])
        corners.append(pair % size if wrap == "repeat" else np.clip(pair, 0, size - 1))
        weights.append(np.array([1 - (place - first), place - first]))
    value = weights[1] @ np.einsum("yxc,x->yc", picture[np.ix_(corners[1], corners[0])], weights[0])
    return value, all(float(w[1] * _WEIGHT_STEPS).is_integer() for w in weights)


def _rounded(values) -> list:
    """Return an array as nested lists of numbers with the nine digits that float32 needs."""
    values = np.asarray(values, np.float64)
    return [float(f"{x:.9g}") for x in values] if values.ndim == 1 else [_rounded(row) for row in values]
