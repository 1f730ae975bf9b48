"""A neural BTF in float64: the twin of ``kernels/btf.py`` (MobileVR [mobilevr] §4.1, 4.3).

A coarse network sees the angles and a coarse texture once for a quad of 2 × 2 texels; its latent vector and a fine
texture enter a fine network once for each texel. Without a coarse network the fine one sees the angles itself.

The tensors are those of the asset.
"""

import numpy as np

from warp_neumat.reference.bc6h import bc6h_decode
from warp_neumat.reference.bcf import bilinear
from warp_neumat.reference.mlp import ACTIVATIONS, mlp

SEAM = 4.0
"""A quad whose texels lie further apart than this [texels of its mip] is no quad: each lane is evaluated by itself."""


def unit(v) -> np.ndarray:
    """Return ``v`` [n, 3] at unit length; (0, 0, 1) where it is 0 or not finite."""
    v = np.asarray(v, np.float64)
    big = np.abs(v).max(-1, keepdims=True)
    good = np.isfinite(big) & (big > 0)
    v = np.where(good, v / np.where(good, big, 1), (0.0, 0.0, 1.0))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def angles(wi, wo, half_vector: bool = True) -> np.ndarray:
    """Return what a network sees of unit directions: ω_i, ω_o and, if asked for, the half vector; [n, 6 or 9]."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    if not half_vector:
        return np.concatenate([wi, wo], -1)
    s = wi + wo
    length = np.linalg.norm(s, axis=-1, keepdims=True)
    h = np.where(length < 1e-6, (0.0, 0.0, 1.0), s / np.maximum(length, 1e-6))
    return np.concatenate([wi, wo, h], -1)


def level_of(lod, mips: int) -> np.ndarray:
    """Return the mip of each lod, int; one that is not a number is the finest."""
    lod = np.nan_to_num(np.asarray(lod, np.float64), nan=0.0)
    return np.floor(np.clip(lod, 0, mips - 1) + 0.5).astype(int)


def finite_uv(uv) -> np.ndarray:
    """Return texture coordinates with 0 for those that are not finite."""
    uv = np.asarray(uv, np.float64)
    return np.where(np.isfinite(uv), uv, 0.0)


def fetch(mips, uv, level) -> np.ndarray:
    """Return the features [n, c] of a texture at ``uv`` [n, 2], bilinear within the mip ``level`` [n], repeated."""
    uv, level = finite_uv(uv), np.asarray(level)
    result = np.zeros((len(uv), np.shape(mips[0])[2]))
    for m, picture in enumerate(mips):
        mine = level == m
        result[mine] = bilinear(picture, *uv[mine].T, "repeat")
    return result


def layers(tensors: dict, network: str) -> tuple[list, list]:
    """Return (weights, biases) of the network ``"fine"`` or ``"coarse"``."""
    count = sum(name.startswith(f"{network}.weight") for name in tensors)
    return tuple([tensors[f"{network}.{part}{n}"] for n in range(count)] for part in ("weight", "bias"))


def textures(tensors: dict, config: dict) -> dict[str, list]:
    """Return the mips (h, w, c) of ``"fine"`` and, if there is one, ``"coarse"``, decoded where they are blocks."""
    names = ["fine", "coarse"] if config["coarse"] else ["fine"]
    if config["features"] == "half":
        return {name: [tensors[f"{name}.mip{m}"] for m in range(config["mips"])] for name in names}
    result = {}
    for name in names:
        channels, halves = config[name]["channels"], 1 if name == "fine" else 2
        result[name] = []
        for m in range(config["mips"]):
            width, height = (max(1, max(1, config[side] >> m) // halves) for side in ("width", "height"))
            parts = []
            for t in range(-(-channels // 3)):
                blocks = tensors[f"{name}.block{t}.mip{m}"]
                rows, columns = blocks.shape[:2]
                texels = bc6h_decode(blocks.reshape(-1, 16), True).reshape(rows, columns, 4, 4, 3)
                parts.append(texels.swapaxes(1, 2).reshape(4 * rows, 4 * columns, 3)[:height, :width])
            result[name].append(np.concatenate(parts, 2)[..., :channels])
    return result


def btf(tensors: dict, config: dict, uv, wi, wo, level, *, uv_coarse=None) -> np.ndarray:
    """Return value × cos θ_i [1/sr], shape [n, 3], of n texels.

    Args:
        tensors, config: Of the asset.
        uv: Texture coordinates of the texels, [n, 2].
        wi, wo: Unit directions, of the texel or the mean of its quad, [n, 3].
        level: Mip level, int, [n].
        uv_coarse: Where the coarse texture is read, [n, 2]; None = at ``uv``.
    """
    mips, how = textures(tensors, config), config["activation"]
    x = angles(wi, wo, config["half_vector"])
    if config["coarse"]:
        features = fetch(mips["coarse"], uv if uv_coarse is None else uv_coarse, level)
        x = ACTIVATIONS[how](mlp(np.concatenate([x, features], 1), *layers(tensors, "coarse"), how))
    y = mlp(np.concatenate([x, fetch(mips["fine"], uv, level)], 1), *layers(tensors, "fine"), how)
    above = (np.asarray(wi)[:, 2:] > 0) & (np.asarray(wo)[:, 2:] > 0)
    return np.where(above, np.maximum(y, 0), 0)


def btf_rows(tensors: dict, config: dict, uv, wi, wo, lod=0.0) -> np.ndarray:
    """Return the values [n, 3] of rows by themselves, as ``BTF.eval`` does it."""
    level = np.broadcast_to(level_of(lod, config["mips"]), len(uv))
    return btf(tensors, config, uv, unit(wi), unit(wo), level)


def btf_quads(tensors: dict, config: dict, uv, wi, wo, lod=0.0, *, wanted=None, lit=None) -> np.ndarray:
    """Return the values [n, 4, 3] of quads, whose coarse network is evaluated once; of a single level, of their texels.

    Args:
        tensors, config: Of the asset.
        uv: Texture coordinates, [n, 4, 2].
        wi, wo: Directions of the quad [n, 3] or of its texels [n, 4, 3].
        lod: Level: a number, of the quads [n], or of the texels [n, 4].
        wanted: Texels that are wanted, bool [n, 4]; uv, ω_o and lod are means over them.
        lit: Those of them that the light reaches, bool [n, 4]; ω_i is the mean over them. Others get any value.
    """
    uv = finite_uv(uv)
    count = len(uv)
    wanted = np.ones((count, 4), bool) if wanted is None else wanted
    lit = wanted if lit is None else lit
    lod = np.asarray(lod, np.float64)
    lod = np.broadcast_to(lod[:, None] if lod.ndim == 1 else lod, (count, 4))
    wi, wo = (
        np.broadcast_to(unit(d)[:, None] if np.ndim(d) == 2 else unit(d), (count, 4, 3)) for d in (wi, wo)
    )  # fmt: skip

    def mean(values, chosen):
        weight = chosen[..., None] / np.maximum(chosen.sum(1), 1)[:, None, None]
        return (values * weight).sum(1)

    own_level = level_of(lod, config["mips"])
    level = level_of(mean(lod[..., None], wanted)[:, 0], config["mips"])
    sizes = np.array([np.shape(mip)[1::-1] for mip in textures(tensors, config)["fine"]])
    low = np.where(wanted[..., None], uv, np.inf).min(1)
    high = np.where(wanted[..., None], uv, -np.inf).max(1)
    split = ((high - low) * sizes[level] > SEAM).any(1)[:, None, None] | (config["coarse"] is None)

    def spread(values):
        return np.broadcast_to(values[:, None], (count, 4, values.shape[-1]))

    uv_coarse = np.where(split, uv, spread(mean(uv, wanted)))
    wi_used = np.where(split, wi, spread(unit(mean(wi, lit))))
    wo_used = np.where(split, wo, spread(unit(mean(wo, wanted))))
    level = np.where(split[..., 0], own_level, level[:, None])
    flat = [a.reshape(4 * count, -1) for a in (uv, wi_used, wo_used, uv_coarse)]
    value = btf(tensors, config, *flat[:3], level.ravel(), uv_coarse=flat[3]).reshape(count, 4, 3)
    return np.where((wi[..., 2:] > 0) & (wo[..., 2:] > 0), value, 0)
