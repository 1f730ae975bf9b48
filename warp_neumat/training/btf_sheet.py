"""One picture of how close a BTF asset is: slices beside the source's, and below them the apparent BRDF of a texel."""

from __future__ import annotations

import types

import numpy as np

from warp_neumat.training.btf_pictures import apparent_brdf, brdf_strip, slice_strip, telling_pairs

MOST_TEXELS = 1 << 26
"""Texels of the slices that an apparent BRDF is read from at most; beyond that, directions are left out."""

GAP = 8
"""White rows between the slices and the apparent BRDF."""


def asset_slices(source, material):
    """Return ``pairs (N, 2) -> (N, height, width, 3)``, value × cos θ_i [1/sr]: the asset in the place of ``source``.

    Texels are evaluated in quads at level 0, the first one at the upper left; at an odd side the last quad's outer
    texels wrap and are dropped.

    Args:
        source: :class:`warp_neumat.io.btf_source.BTFSource`, for its size and directions.
        material: :class:`warp_neumat.materials.btf.BTF`.
    """
    rows, columns = -(-source.height // 2), -(-source.width // 2)
    x = (np.arange(2 * columns, dtype=np.float32) + 0.5) / source.width
    y = (np.arange(2 * rows, dtype=np.float32) + 0.5) / source.height
    texels = np.stack(np.broadcast_arrays(x, y[:, None]), -1).astype(np.float32)
    quads = texels.reshape(rows, 2, columns, 2, 2).swapaxes(1, 2).reshape(-1, 4, 2)

    def evaluate(pairs) -> np.ndarray:
        out = np.empty((len(pairs), source.height, source.width, 3), np.float32)
        for picture, (light, view) in zip(out, np.asarray(pairs), strict=True):
            wi, wo = (np.repeat(d[None], len(quads), 0) for d in (source.lights[light], source.views[view]))
            value = material.eval_quads(quads, wi, wo).reshape(rows, columns, 2, 2, 3)
            whole = value.swapaxes(1, 2).reshape(2 * rows, 2 * columns, 3)
            picture[:] = whole[: source.height, : source.width]
        return out

    return evaluate


def asset_brdf(source, material, uv) -> np.ndarray:
    """Return the asset's twin of :func:`~.btf_pictures.apparent_brdf`, (L, V, 3) in 1/sr, without its slices."""
    x, y = (int(np.floor(t * n)) % n for t, n in zip(uv, (source.width, source.height), strict=True))
    corner = np.array([(x & ~1, y & ~1)]) + [(0, 0), (1, 0), (0, 1), (1, 1)]
    quad = ((corner + 0.5) / (source.width, source.height)).astype(np.float32)
    lights, views = len(source.lights), len(source.views)
    wi, wo = np.repeat(source.lights, views, 0), np.tile(source.views, (lights, 1))
    value = material.eval_quads(np.repeat(quad[None], len(wi), 0), wi, wo)
    return value[:, 2 * (y & 1) + (x & 1)].reshape(lights, views, 3)


def btf_sheet(source, material) -> np.ndarray:
    """Return source, asset and ten times their difference: of six slices, and of the central texel's apparent BRDF.

    The slices stand below each other, the apparent BRDFs, lights down and views across, side by side beneath. Where
    the source has so many slices that reading one texel of all takes long, evenly spaced directions stand for them.

    Returns: (rows, columns, 3) float32 display values.
    """
    top = slice_strip(source, asset_slices(source, material), telling_pairs(source))
    fewer = _fewer(source)
    uv = (0.5, 0.5)
    below = brdf_strip(apparent_brdf(fewer, uv), asset_brdf(fewer, material, uv))
    below = below.repeat(size := max(1, top.shape[1] // below.shape[1]), 0).repeat(size, 1)
    width = max(top.shape[1], below.shape[1])
    parts = [
        np.pad(part, ((0, space), (0, width - part.shape[1]), (0, 0)), constant_values=1.0)
        for part, space in ((top, GAP), (below, 0))
    ]
    return np.concatenate(parts)


def _fewer(source):
    """Return ``source`` with as many of its lights and views as :data:`MOST_TEXELS` allows."""
    side = max(2, int((MOST_TEXELS / (source.width * source.height)) ** 0.5))
    kept = [
        np.unique(np.linspace(0, len(known) - 1, min(side, len(known))).round().astype(np.int64))
        for known in (source.lights, source.views)
    ]
    return types.SimpleNamespace(
        lights=source.lights[kept[0]], views=source.views[kept[1]], width=source.width, height=source.height,
        slices=lambda pairs: source.slices(np.stack([kept[0][pairs[:, 0]], kept[1][pairs[:, 1]]], 1)),
    )  # fmt: skip
