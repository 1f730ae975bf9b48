"""What a fit does otherwise where the reflectance varies over a surface (NeuBRDF Sec. 3.4, Eq. 4).

The sampler draws places and levels of detail beside directions; the model's config gets a neural texture. Levels are
counted twice: in texels of the source's finest data (``SpatialSource``), and in texels of the neural texture's finest
mip (the model and the asset). The second is the first less :func:`lod_shift`.

Differs from the paper: all mips are trained, each on the mean reflectance of its own footprints. A texture whose level
0 alone is trained has no answer for what is far away, because the decoder is not linear: a mean of its features is not
the feature of the mean.
"""

from __future__ import annotations

import math

import numpy as np

from warp_neumat.io.block_formats import mip_limit
from warp_neumat.training.samplers import BRDFSampler

MOST_TEXELS = 256
"""Longer side of a neural texture's finest mip at most, by default."""

CHANNELS = 8
"""Channels of a neural texture by default."""

DEFAULTS = {"frame": "half", "nside": 16, "bits": 9}
"""Config of a spatially varying material where it differs from :class:`~warp_neumat.models.neubrdf.NeuBRDFConfig`'s."""


def configured(source, options: dict) -> dict:
    """Return ``options`` over the defaults for ``source``: half as many texels as the source has, up to 256.

    ``texture=None`` (or "none", as it comes from the command line) gives a material that does not vary, for comparison.
    """
    if options.get("texture", "") == "none":
        options = {**options, "texture": None}
    half = max(2.0, max(source.width, source.height) / MOST_TEXELS)
    texture = (max(1, round(source.width / half)), max(1, round(source.height / half)), CHANNELS)
    return {**DEFAULTS, "texture": texture, **options}


def lod_shift(source, texture) -> float:
    """Return the level of the source whose texels are as large as those of ``texture`` (width, height, …) or None."""
    if texture is None:
        return 0.0
    width, height = (texture["width"], texture["height"]) if isinstance(texture, dict) else texture[:2]
    return math.log2(max(source.width / width, source.height / height))


def on_source_levels(source, texture, evaluate):
    """Return ``(uv, lod, wi, wo) -> (N, 3)`` with levels of ``source``, of an asset's ``evaluate(wi, wo, uv, lod)``."""
    shift = lod_shift(source, texture)
    return lambda uv, lod, wi, wo: evaluate(wi, wo, uv, np.asarray(lod, np.float32) - np.float32(shift))


def material_on_source_levels(source, material):
    """Return the same of a loaded material: its ``eval`` without the cosine."""

    def evaluate(wi, wo, uv, lod):
        return material.eval(uv, wi, wo, lod) / np.maximum(wi[:, 2:], np.float32(1e-30))

    return on_source_levels(source, material.config["texture"], evaluate)


def bits_per_texel(source, size: int) -> float:
    """Return the bits that an asset of ``size`` bytes takes for each texel of the source."""
    return round(8.0 * size / (source.width * source.height), 4)


class SpatialSampler(BRDFSampler):
    """Draws training samples from a :class:`warp_neumat.io.svbrdf.SpatialSource`.

    Places are uniform, directions those of :class:`BRDFSampler`. The level is max(0, (t + ½)·u² − ½), u uniform and t
    the coarsest level: a quarter of the samples at level 0, which magnified textures are read at, and of the rest the
    more the finer the mip, because it has more texels; yet each mip has its share of samples.

    Args:
        source: The source.
        rng: Its draws are all that the samples depend on.
        texture: Of the model's config: (width, height, channels), or None.
        lods: Lowest and highest level drawn; default: all mips.
    """

    def __init__(self, source, rng: np.random.Generator, texture, lods: tuple[float, float] | None = None):
        super().__init__(source, rng)
        width, height = (source.width, source.height) if texture is None else texture[:2]
        self.shift = lod_shift(source, texture)
        self.lods = (0.0, float(mip_limit(width, height) - 1)) if lods is None else lods

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """Return ``wi``, ``wo``, ``value``, (count, 3) each, ``uv`` (count, 2), ``lod`` (count,); all float32.

        ``value`` is in 1/sr without the cosine; ``lod`` counts from the model's finest mip.
        """
        wi, wo = self.directions(count)
        uv = self.rng.random((count, 2), dtype=np.float32)
        low, high = self.lods
        draw = self.rng.random(count)
        lod = np.clip((high + 0.5) * draw * draw - 0.5, low, high).astype(np.float32)
        value = self.source.eval(uv, lod + np.float32(self.shift), wi, wo)
        return {"wi": wi, "wo": wo, "value": value, "uv": uv, "lod": lod}
