"""The pictures that a BTF fit is judged by: slices beside those of the asset, and a texel's unfolded apparent BRDF.

What is shown is value × cos θ_i (MobileVR Eq. 1) times π, so that a white diffuser facing the light shows white:
clipped to [0, 1] and sRGB-encoded. Slices have row 0 on top.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.io.btf_source import checked_pairs
from warp_neumat.training.sphere import tone_map

EXPOSURE = np.float32(np.pi)
"""What values in 1/sr are multiplied by before they are shown."""

GAIN = 10.0
"""What differences are multiplied by."""


def slice_strip(source, eval_slices, pairs) -> np.ndarray:
    """Return reference, asset and ten times their difference below each other, a column a pair.

    Args:
        source: :class:`warp_neumat.io.btf_source.BTFSource`.
        eval_slices: The asset's ``pairs (N, 2) -> (N, height, width, 3)``, value × cos θ_i in 1/sr, like
            ``source.slices``.
        pairs: (N, 2) indices of light and view, N ≥ 1.

    Returns: (3 · height, N · width, 3) float32 display values.

    Raises:
        ValueError: If ``pairs`` is empty or out of range, or the asset's slices have another shape.
    """
    pairs = _some_pairs(source, pairs)
    reference, asset = (_shown(f, source, pairs) for f in (source.slices, eval_slices))
    rows = reference, asset, np.minimum(GAIN * np.abs(reference - asset), 1.0)
    return np.concatenate([np.concatenate(list(row), axis=1) for row in rows]).astype(np.float32)


def apparent_brdf(source, uv, *, eval_slices=None, chunk: int = 64) -> np.ndarray:
    """Return the apparent BRDF of one texel unfolded, lights down and views across, (L, V, 3) float32 values in 1/sr.

    The 4-D function of light and view at one place (MobileVR Figure 9), value × cos θ_i. Directions follow each other
    as in the source: ring by ring, so that every block of the picture is a pair of rings.

    Args:
        source: :class:`warp_neumat.io.btf_source.BTFSource`.
        uv: (u, v); the texel that holds it is taken, and the texture repeats.
        eval_slices: What to ask for slices; the source's own by default. An asset's has the same form.
        chunk: Slices asked for at once; memory is chunk · height · width · 12 bytes.

    Raises:
        ValueError: If ``uv`` is not two finite numbers, or slices have another shape.
    """
    uv = np.asarray(uv, np.float64)
    if uv.shape != (2,) or not np.isfinite(uv).all():
        raise ValueError(f"uv must be two finite numbers, got {uv.tolist()}")
    if chunk < 1:
        raise ValueError(f"chunk must be at least 1, got {chunk}")
    x, y = (int(np.floor(t * n)) % n for t, n in zip(uv, (source.width, source.height), strict=True))
    lights, views = len(source.lights), len(source.views)
    pairs = np.stack(np.divmod(np.arange(lights * views), views), 1)
    ask, values = eval_slices or source.slices, np.empty((len(pairs), 3), np.float32)
    for first in range(0, len(pairs), chunk):
        part = pairs[first : first + chunk]
        values[first : first + chunk] = _checked(ask(part), source, part)[:, y, x]
    return values.reshape(lights, views, 3)


def brdf_strip(reference: np.ndarray, asset: np.ndarray, *, gap: int = 4) -> np.ndarray:
    """Return two unfolded apparent BRDFs and ten times their difference side by side, display values float32.

    Args:
        reference: (L, V, 3) from :func:`apparent_brdf`.
        asset: The same of the asset.
        gap: White columns between them.

    Raises:
        ValueError: If the shapes differ.
    """
    if reference.shape != asset.shape or reference.ndim != 3:
        raise ValueError(f"reference and asset must have one shape (L, V, 3), got {reference.shape}, {asset.shape}")
    a, b = (tone_map(EXPOSURE * picture) for picture in (reference, asset))
    between = np.ones((len(a), gap, 3), np.float32)
    difference = np.minimum(GAIN * np.abs(a - b), 1.0)
    return np.concatenate([a, between, b, between, difference], axis=1).astype(np.float32)


def telling_pairs(source, count: int = 6) -> np.ndarray:
    """Return (count, 2) pairs to look at: lights from the zenith down to 70°, views down to 70° and back up.

    Azimuths advance by the golden angle, those of the views by two of them, so that light and view meet from all sides.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    step = np.arange(count) / max(count - 1, 1)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    theta_light, theta_view = np.radians(70 * step), np.radians(70 * np.abs(np.sin(np.pi * step)))
    wanted = _unit(theta_light, turn), _unit(theta_view, turn * 2 + np.pi)
    return np.stack([np.argmax(w @ d.T, 1) for w, d in zip(wanted, (source.lights, source.views), strict=True)], 1)


def _unit(theta, phi) -> np.ndarray:
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], 1)


def _some_pairs(source, pairs) -> np.ndarray:
    pairs = checked_pairs(pairs, len(source.lights), len(source.views))
    if len(pairs) == 0:
        raise ValueError("pairs must hold at least one pair of a light and a view")
    return pairs


def _checked(slices, source, pairs) -> np.ndarray:
    slices, wanted = np.asarray(slices), (len(pairs), source.height, source.width, 3)
    if slices.shape != wanted:
        raise ValueError(f"slices must have shape {wanted}, got {slices.shape}")
    return slices


def _shown(ask, source, pairs) -> np.ndarray:
    return tone_map(EXPOSURE * _checked(ask(pairs), source, pairs).astype(np.float32, copy=False))
