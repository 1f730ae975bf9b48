"""Training samples of a BTF: quads of places under the pairs of directions of a few slices.

A draw takes slices at random among all pairs of a light and a view, with the means of their mips, and quads at random
in them. Centres are stratified: every 2×2 texels of the level get one in turn, at a random place within, so that the
neural textures are trained between their texels too (MobileVR §4.4). Differs from the paper, whose batch is one slice.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.io.mipmaps import area_weights, mip_sizes
from warp_neumat.kernels.slice_fetch import fetch_quads

MOST_SLICES = 256
"""Slices of a draw at most."""

LEAST_QUADS = 32
"""Quads of a draw for each of its slices at least, unless it has one slice only."""

BEYOND = 0.25
"""Share of the quads under the lowest lights, and views, that stand for directions between those and the horizon."""


def pyramids(slices: np.ndarray, mips: int) -> np.ndarray:
    """Return slices (N, H, W, 3) with the means over the areas of coarser texels, (N, texels, 3) float16.

    Raises:
        ValueError: If a value is beyond float16.
    """
    count, height, width, _ = slices.shape
    sizes = mip_sizes(width, height)[:mips]
    stack = np.empty((count, sum(w * h for w, h in sizes), 3), np.float16)
    at = 0
    for w, h in sizes:
        for axis, (old, new) in ((1, (slices.shape[1], h)), (2, (slices.shape[2], w))):
            if old != new:
                slices = np.moveaxis(np.tensordot(_averaging(old, new), slices, (1, axis)), 0, axis)
        with np.errstate(over="ignore"):
            stack[:, at : at + w * h] = slices.reshape(count, w * h, 3)
        at += w * h
    if not np.isfinite(stack).all():
        raise ValueError("a slice holds values that are not finite or beyond 65504, which float16 does not hold")
    return stack


def _averaging(old: int, new: int) -> np.ndarray:
    """Return the matrix (new, old) float32 of the means over areas."""
    first, weights = area_weights(old, new)
    matrix = np.zeros((new, old), np.float32)
    for tap in range(weights.shape[1]):
        np.add.at(matrix, (np.arange(new), np.minimum(first + tap, old - 1)), weights[:, tap])
    return matrix


class SliceSampler:
    """Draws quads from a :class:`warp_neumat.io.btf_source.BTFSource`.

    Args:
        source: The source.
        mips: Levels drawn; half of the quads are at level 0, a quarter at level 1 and so on.
        beyond: See :data:`BEYOND`; 0 for measuring.
        aligned: Draw quads of texels of level 0 only, four texel centres each: what the paper's error is taken on.
    """

    def __init__(self, source, mips: int, *, beyond: float = BEYOND, aligned: bool = False):
        self.source, self.mips, self.beyond, self.aligned = source, 1 if aligned else mips, beyond, aligned
        self.sizes = mip_sizes(source.width, source.height)[: self.mips]

    def __call__(self, rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
        """Return ``wi``, ``wo`` (count, 3), ``place`` (count, 4) and ``value`` (count, 12), float32.

        ``place``: centre u, v, distance of the four places in texels of the level, level. ``value``: × cos θ_i.
        """
        source = self.source
        lights, views = len(source.lights), len(source.views)
        slices = max(1, min(MOST_SLICES, count // LEAST_QUADS, lights * views))
        chosen = rng.choice(lights * views, slices, replace=False)
        pairs = np.stack([chosen // views, chosen % views], 1)
        stack = pyramids(source.slices(pairs), self.mips)
        number = rng.integers(0, slices, count).astype(np.int32)
        place = self._places(rng, count)
        value = fetch_quads(stack, self.sizes, number, place)
        wi, wo = source.lights[pairs[number, 0]].copy(), source.views[pairs[number, 1]].copy()
        if self.beyond:
            gain = _lower(wi, source.lights, rng.random(count) < self.beyond, rng.random(count))
            value *= gain[:, None]
            _lower(wo, source.views, rng.random(count) < self.beyond, rng.random(count))
        return {"wi": wi, "wo": wo, "place": place, "value": value}

    def _places(self, rng, count: int) -> np.ndarray:
        place = np.empty((count, 4), np.float32)
        level = np.minimum(np.floor(-np.log2(1.0 - rng.random(count))), self.mips - 1).astype(np.int64)
        place[:, 2] = 1.0 if self.aligned else np.where(rng.random(count) < 0.5, 1.0, rng.random(count))
        place[:, 3] = level
        for number, (w, h) in enumerate(self.sizes):
            mine = np.flatnonzero(level == number)
            columns, rows = max(1, w // 2), max(1, h // 2)
            if self.aligned:  # texel centres, where a side is odd too
                x, y = rng.integers(0, columns, len(mine)), rng.integers(0, rows, len(mine))
                place[mine, 0], place[mine, 1] = (2 * x + 1) / w, (2 * y + 1) / h
                continue
            cell = rng.permutation(columns * rows)[np.arange(len(mine)) % (columns * rows)]
            jitter = rng.random((2, len(mine)))
            place[mine, :2] = (np.stack([cell % columns, cell // columns]) + jitter).T / (columns, rows)
        return place


def _lower(directions: np.ndarray, known: np.ndarray, chosen: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Turn those of ``chosen`` that lie in the lowest ring of ``known`` towards the horizon, u of the way in angle.

    Returns: How their cosine changed, (n,). What reflects stays as it is: the only guess that a measurement which ends
    above the horizon allows, and better than what a network makes up there.
    """
    least = known[:, 2].min()
    gain = np.ones(len(directions), np.float32)
    rows = np.flatnonzero(chosen & (directions[:, 2] <= least + 1e-3) & (directions[:, 2] < 0.9))
    theta = np.arccos(np.clip(directions[rows, 2], -1, 1))
    turned = theta + u[rows] * (0.5 * np.pi - theta)
    gain[rows] = np.cos(turned) / directions[rows, 2]
    directions[rows, :2] *= (np.sin(turned) / np.sin(theta))[:, None]
    directions[rows, 2] = np.cos(turned)
    return gain
