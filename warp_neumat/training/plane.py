"""The pictures that a spatially varying fit is judged by: a flat patch under one key and one fill light, mip by mip.

The texture fills the square [−1, 1]² of the plane z = 0, u along +x and v along −y, seen by a pinhole camera from the
−y side, 45° above the plane. Lights are points, so that ω_i varies over the patch, but without fall-off. One picture
shows one level of detail throughout. What is compared is what is seen: radiance clipped to [0, 1] and sRGB-encoded;
MAE and RMSE over the pixels of the patch, SSIM over the whole picture.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.metrics import ssim
from warp_neumat.training.samplers import measured_directions
from warp_neumat.training.sphere import tone_map

LIGHTS = (
    ((0.3, 1.9, 2.0), (np.pi, np.pi, np.pi)),  # key; its mirror image lies within the patch
    ((2.0, -0.6, 1.2), (0.9, 0.9, 0.9)),  # fill, from the side and low
)
"""Position of each light, and its irradiance RGB on a surface that faces it."""

EYE = np.array([0.0, -2.2, 2.2])
_ZOOM = 1.5  # half the height of the picture spans the angle atan(1 / (2 · zoom))
COARSEST = 4
"""Texels along the longer side of the coarsest mip that is shown."""

SAMPLES = 1 << 14
"""Directions a level that ``mse_raw`` is taken over."""


def plane_pixels(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (mask (h, w) bool, points (n, 2) float64 in the plane of covered pixels in row order); w = ``size``."""
    height = 3 * size // 4
    forward = -EYE / np.linalg.norm(EYE)
    right = np.array([1.0, 0.0, 0.0])
    up = np.cross(right, forward)
    x = (np.arange(size) + 0.5 - size / 2) / height
    y = (height / 2 - np.arange(height) - 0.5) / height
    ray = forward * _ZOOM + x[None, :, None] * right + y[:, None, None] * up
    hit = EYE[:2] - ray[..., :2] * (EYE[2] / np.minimum(ray[..., 2:], -1e-6))
    mask = (np.abs(hit) < 1.0).all(-1) & (ray[..., 2] < 0)
    return mask, hit[mask]


def render_plane(eval_fn, lod: float, size: int = 192, lights=LIGHTS) -> np.ndarray:
    """Return the linear picture (3/4 size, size, 3) float32 of the patch at one level of detail.

    Args:
        eval_fn: ``eval_fn(uv (N, 2), lod (N,), wi (N, 3), wo (N, 3)) -> (N, 3)``, value without the cosine, 1/sr.
        lod: log2 of the footprint's side in texels of the source's finest data.
        size: Width of the picture in pixels.
        lights: Pairs of position and RGB irradiance.
    """
    mask, point = plane_pixels(size)
    place = np.concatenate([point, np.zeros((len(point), 1))], 1)
    uv = np.stack([0.5 + 0.5 * point[:, 0], 0.5 - 0.5 * point[:, 1]], 1).astype(np.float32)
    lods, wo = np.full(len(uv), lod, np.float32), _towards(EYE, place)
    colour = np.zeros((len(uv), 3))
    for position, irradiance in lights:
        wi = _towards(np.asarray(position, np.float64), place)
        colour += np.asarray(eval_fn(uv, lods, wi, wo), np.float64) * wi[:, 2:] * np.asarray(irradiance)
    image = np.zeros((*mask.shape, 3), np.float32)
    image[mask] = colour
    return image


def _towards(position, place) -> np.ndarray:
    ray = position - place
    return (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)


def shown_lods(source) -> list[int]:
    """Return the levels that are looked at: all down to :data:`COARSEST` texels."""
    return list(range(max(1, int(np.log2(max(source.width, source.height) / COARSEST)) + 1)))


def plane_metrics(source, eval_fn, *, size: int = 192) -> dict:
    """Return ``mae, rmse, ssim`` of the lit patch and ``mse_raw``, means over the levels, and ``mips``, level by level.

    ``ssim`` is left out where scikit-image is missing.

    Args:
        source: :class:`warp_neumat.io.svbrdf.SpatialSource`; its :meth:`refined` form is what is compared with.
        eval_fn: The asset's ``(uv, lod, wi, wo) -> (N, 3)``, value without the cosine in 1/sr; ``lod`` counts in
            texels of the source.
        size: Width of the pictures in pixels.

    ``mse_raw`` is the mean squared error of the values themselves, in 1/sr², at random places and directions spaced as
    a MERL table is. Bent normals make values near the horizon as large as one likes, and they decide it; ``mse_log``
    is that of log(1 + f).
    """
    source, rng = source.refined(), np.random.default_rng(0)
    mips = []
    for lod in shown_lods(source):
        picture, reference = (tone_map(render_plane(f, lod, size)) for f in (eval_fn, source.eval))
        mask, _ = plane_pixels(size)
        difference = (picture - reference)[mask].astype(np.float64)
        wi, wo = measured_directions(SAMPLES, rng)
        uv, lods = rng.random((len(wi), 2), dtype=np.float32), np.full(len(wi), lod, np.float32)
        fitted, expected = (np.asarray(f(uv, lods, wi, wo), np.float64) for f in (eval_fn, source.eval))
        mips.append(
            {
                "lod": lod,
                "mae": float(np.abs(difference).mean()),
                "rmse": float(np.sqrt((difference**2).mean())),
                **_ssim(reference, picture),
                "mse_raw": float(((fitted - expected) ** 2).mean()),
                "mse_log": float(((np.log1p(fitted) - np.log1p(expected)) ** 2).mean()),
            }
        )
    means = {name: float(np.mean([mip[name] for mip in mips])) for name in mips[0] if name != "lod"}
    return {**means, "mips": mips}


def _ssim(reference, picture) -> dict:
    try:
        return {"ssim": ssim(reference, picture)}
    except ImportError:
        return {}


def plane_strip(source, eval_fn, *, size: int = 192) -> np.ndarray:
    """Return source, asset and ten times their difference side by side, a row a level, display values float32."""
    source, rows = source.refined(), []
    for lod in shown_lods(source):
        a, b = (tone_map(render_plane(f, lod, size)) for f in (source.eval, eval_fn))
        rows.append(np.concatenate([a, b, np.minimum(10.0 * np.abs(a - b), 1.0)], axis=1))
    return np.concatenate(rows)
