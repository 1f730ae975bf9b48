"""Carrying radiance by a proxy in float64: the twin of ``kernels/carry.py``, and what is stored for it."""

import numpy as np

from .proxy import proxy
from .shade import punctual, raised


def proxy_radiance(terms, alpha2, points, normals, eye, position, intensity, limits=None) -> np.ndarray:
    """Return the radiance of proxies under point lights, (N, 3) float64.

    Args:
        terms: Diffuse, specular and grazing of red, green and blue, (N, 3, 3).
        alpha2: α², (N,).
        points, normals: Of the samples, (N, 3) each, normals of any length.
        eye: Position of the viewer, (3,).
        position, intensity: Of the lights, (L, 3) each.
        limits: For each light, what :func:`~.shade.punctual` takes after its first argument; None = without end.
    """
    points, normals, terms = (np.asarray(a, np.float64) for a in (points, normals, terms))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    viewer = np.asarray(eye, np.float64) - points
    viewer = raised(viewer / np.linalg.norm(viewer, axis=1, keepdims=True), normals)
    none = np.zeros(len(points))
    radiance = np.zeros((len(points), 3))
    limits = [()] * len(position) if limits is None else limits
    for at, power, limit in zip(
        np.asarray(position, np.float64), np.asarray(intensity, np.float64), limits, strict=True
    ):
        d = at - points
        distance = np.linalg.norm(d, axis=1, keepdims=True)
        # Diffuse alone, the lobe alone, and the lobe with nothing but what Fresnel adds at grazing angles.
        alone = [
            proxy(np.stack([none + a, none + b, alpha2], 1), normals, d / distance, viewer)
            for a, b in ((1.0, 0.0), (0.0, 1.0), (0.0, -1e-300))
        ]
        value = np.einsum("knc,kn->nc", terms.transpose(1, 0, 2), alone)
        radiance += value * power * (punctual(-d, *limit) / distance[:, 0] ** 2)[:, None]
    return radiance


def stored(radiance, proxies, epsilon) -> np.ndarray:
    """Return the ratio that is stored of a radiance."""
    return (radiance + epsilon) / (proxies + epsilon)


def shown(ratio, proxies, epsilon) -> np.ndarray:
    """Return the radiance that a ratio stands for, under what the proxies are now."""
    return np.maximum(ratio * (proxies + epsilon) - epsilon, 0.0)


def bilinear(texture, x, y, rate) -> np.ndarray:
    """Return (N, channels) read bilinearly from the anchors of each point's rate; texel i is centred at i + 0.5."""
    step = 1 << np.asarray(rate, np.int64)
    i, j = (np.floor((np.asarray(a, np.float64) - 0.5) / step).astype(np.int64) for a in (x, y))
    u, v = ((np.asarray(a, np.float64) - 0.5) / step - k for a, k in ((x, i), (y, j)))
    texture = np.asarray(texture, np.float64)
    result = 0.0
    for dj, wv in ((0, 1 - v), (1, v)):
        for di, wu in ((0, 1 - u), (1, u)):
            result = result + texture[(j + dj) * step, (i + di) * step] * (wu * wv)[:, None]
    return result
