"""Shading of surface samples under point lights in float64: the twin of ``kernels/shade.py``."""

import numpy as np

HORIZON = 0.01
"""Least cos θ_o that is shaded, as in the kernel."""


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def shade(points, normals, tangents, corner_weights, eye, position, intensity, evaluate) -> np.ndarray:
    """Return the radiance of samples on triangles, (N, 3) float64.

    Args:
        points, normals, tangents: Of the samples' three vertices, (N, 3, 3), (N, 3, 3) and (N, 3, 4).
        corner_weights: Barycentric weights of the three vertices, (N, 3).
        eye: Position of the viewer, (3,).
        position, intensity: Of the lights, (L, 3) each.
        evaluate: ``evaluate(wi, wo) -> (N, 3)``, BRDF without the cosine; local directions.
    """
    weights = np.asarray(corner_weights, np.float64)[..., None]
    p = (np.asarray(points, np.float64) * weights).sum(1)
    n = _unit((np.asarray(normals, np.float64) * weights).sum(1))
    t = (np.asarray(tangents, np.float64)[..., :3] * weights).sum(1)
    t = _unit(t - n * (n * t).sum(1, keepdims=True))
    b = np.cross(n, t) * np.asarray(tangents, np.float64)[:, 0, 3:]
    frame = np.stack([t, b, n], axis=1)
    wo = np.einsum("nij,nj->ni", frame, _unit(np.asarray(eye, np.float64) - p))
    low = wo[:, 2] < HORIZON
    flat = np.linalg.norm(wo[low, :2], axis=1, keepdims=True)
    wo[low] = np.concatenate([wo[low, :2] / flat * np.sqrt(1 - HORIZON**2), np.full_like(flat, HORIZON)], axis=1)
    radiance = np.zeros_like(p)
    for at, power in zip(np.asarray(position, np.float64), np.asarray(intensity, np.float64), strict=True):
        d = at - p
        wi = np.einsum("nij,nj->ni", frame, _unit(d))
        lit = wi[:, 2] > 0
        cosine = wi[lit, 2:] / (d[lit] ** 2).sum(1, keepdims=True)
        radiance[lit] += evaluate(wi[lit], wo[lit]) * cosine * power
    return radiance
