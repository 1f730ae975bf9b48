"""How close a stored asset is to its source, measured on what the file holds, by kind of data."""

from __future__ import annotations

import numpy as np

from warp_neumat.training.samplers import measured_directions
from warp_neumat.training.sphere import render_sphere, sphere_error, tone_map


def brdf_metrics(source, eval_fn, *, size: int = 256) -> dict:
    """Return ``mae, rmse, ssim`` of the rendered sphere and ``mse_raw``.

    Args:
        source: The BRDF source.
        eval_fn: The asset's ``(wi, wo) -> (N, 3)``, value without the cosine in 1/sr.

    ``mse_raw`` is the mean squared error of the BRDF values themselves, in 1/sr², on 2¹⁷ directions spaced as a MERL
    table is. The sphere is that of :func:`warp_neumat.training.sphere.render_sphere`.
    """
    error = sphere_error(render_sphere(eval_fn, size), render_sphere(source.eval, size))
    wi, wo = measured_directions(1 << 17, np.random.default_rng(0))
    difference = np.asarray(eval_fn(wi, wo), np.float64) - source.eval(wi, wo)
    return {**error, "mse_raw": float((difference**2).mean())}


def sphere_strip(source_fn, asset_fn, *, size: int = 256) -> np.ndarray:
    """Return source, asset and ten times their difference side by side, display values (size, 3 size, 3) float32."""
    source, asset = tone_map(render_sphere(source_fn, size)), tone_map(render_sphere(asset_fn, size))
    return np.concatenate([source, asset, np.minimum(10.0 * np.abs(source - asset), 1.0)], axis=1)
