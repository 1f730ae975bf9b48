"""The picture that a BRDF fit is judged by: a sphere under one key and one fill light, and its error measures.

Orthographic view along −z, sphere of the picture's size, directional lights. What is compared is what is seen: radiance
clipped to [0, 1] and sRGB-encoded. MAE and RMSE are taken over the pixels of the sphere, SSIM over the whole picture.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.io.mipmaps import linear_to_srgb

LIGHTS = (
    ((-0.5, 0.5, 0.70710678), (np.pi, np.pi, np.pi)),  # key, 45° from the view: a white Lambertian facing it shows 1
    ((0.8, -0.1, 0.59160798), (0.6, 0.6, 0.6)),  # fill, 54° on the other side
)
"""Default lights: direction to the light, irradiance RGB on a surface that faces it."""


def sphere_pixels(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (mask (size, size) bool, normals (n, 3) float64 of covered pixels in row order); y up, z to the viewer."""
    axis = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(axis, -axis)
    square = 1.0 - x * x - y * y
    mask = square > 0.0
    return mask, np.stack([x[mask], y[mask], np.sqrt(square[mask])], 1)


def render_sphere(eval_fn, size: int = 256, lights=LIGHTS) -> np.ndarray:
    """Return the linear picture (size, size, 3) float32 of a sphere with BRDF ``eval_fn``.

    Args:
        eval_fn: ``eval_fn(wi (N, 3), wo (N, 3)) -> (N, 3)``, value without the cosine, 1/sr; tangents run along +x.
        size: Side of the picture in pixels.
        lights: Pairs of unit direction to the light and RGB irradiance.
    """
    mask, normal = sphere_pixels(size)
    tangent = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], 1)
    wo = np.ascontiguousarray(frame[:, :, 2], np.float32)
    colour = np.zeros((len(normal), 3))
    for direction, irradiance in lights:
        wi = np.ascontiguousarray(frame @ np.asarray(direction, np.float64), np.float32)
        cosine = np.maximum(wi[:, 2:], 0.0)
        colour += np.asarray(eval_fn(wi, wo), np.float64) * cosine * np.asarray(irradiance)
    image = np.zeros((size, size, 3), np.float32)
    image[mask] = colour
    return image


def tone_map(image: np.ndarray) -> np.ndarray:
    """Return ``image`` as shown: clipped to [0, 1] and sRGB-encoded (IEC 61966-2-1)."""
    return linear_to_srgb(np.clip(image, 0.0, 1.0))


def sphere_error(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return MAE, RMSE (and SSIM where scikit-image is installed) of two linear sphere pictures, tone-mapped."""
    a, b = tone_map(image), tone_map(reference)
    mask, _ = sphere_pixels(image.shape[0])
    difference = (a - b)[mask].astype(np.float64)
    result = {"mae": float(np.abs(difference).mean()), "rmse": float(np.sqrt((difference**2).mean()))}
    try:
        from skimage.metrics import structural_similarity
    except ImportError:
        return result
    result["ssim"] = float(structural_similarity(a, b, channel_axis=2, data_range=1.0))
    return result
