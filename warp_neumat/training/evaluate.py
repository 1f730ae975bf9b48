"""How close a stored asset is to its source, measured on what the file holds, by kind of data."""

from __future__ import annotations

import numpy as np

from warp_neumat.io.svbrdf import is_spatial
from warp_neumat.training.furnace import energy, reciprocity_error
from warp_neumat.training.plane import plane_metrics
from warp_neumat.training.samplers import measured_directions
from warp_neumat.training.sphere import render_sphere, sphere_error, tone_map


def brdf_metrics(source, eval_fn, *, size: int = 256) -> dict:
    """Return ``mae, rmse, ssim`` of the rendered sphere, ``mse_raw``, and the energy and reciprocity of the fit.

    Args:
        source: The BRDF source.
        eval_fn: The asset's ``(wi, wo) -> (N, 3)``, value without the cosine in 1/sr.
        size: Side of the picture in pixels.

    A source that varies over a surface has :func:`warp_neumat.training.plane.plane_metrics` instead, and an ``eval_fn``
    of ``(uv, lod, wi, wo)``.

    ``mse_raw`` is the mean squared error of the BRDF values themselves, in 1/sr², on 2¹⁷ directions spaced as a MERL
    table is; mirror peaks of several hundred decide it, so ``mse_log`` is that of log(1 + f) there. The
    sphere is that of :func:`warp_neumat.training.sphere.render_sphere`. ``albedo_max``, ``albedo_max_source``,
    ``albedo_excess`` and ``reciprocity`` are those of :mod:`warp_neumat.training.furnace`.
    """
    if is_spatial(source):
        return plane_metrics(source, eval_fn, size=size)
    error = sphere_error(render_sphere(eval_fn, size), render_sphere(source.eval, size))
    wi, wo = measured_directions(1 << 17, np.random.default_rng(0))
    fitted, expected = np.asarray(eval_fn(wi, wo), np.float64), source.eval(wi, wo).astype(np.float64)
    logarithms = np.log1p(fitted) - np.log1p(expected)
    return {
        **error,
        "mse_raw": float(((fitted - expected) ** 2).mean()),
        "mse_log": float((logarithms**2).mean()),
        **energy(eval_fn, source.eval, isotropic=bool(source.isotropic)),
        "reciprocity": reciprocity_error(eval_fn),
    }


def sphere_strip(source_fn, asset_fn, *, size: int = 256) -> np.ndarray:
    """Return source, asset and ten times their difference side by side, display values (size, 3 size, 3) float32."""
    source, asset = tone_map(render_sphere(source_fn, size)), tone_map(render_sphere(asset_fn, size))
    return np.concatenate([source, asset, np.minimum(10.0 * np.abs(source - asset), 1.0)], axis=1)
