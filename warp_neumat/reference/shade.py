"""Shading of surface samples under point lights in float64: the twin of ``kernels/shade.py``."""

import numpy as np

HORIZON = 0.01
"""Least cos θ_o that is shaded, as in the kernel."""


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def raised(viewer, normals) -> np.ndarray:
    """Return unit vectors ``viewer``, those lower than :data:`HORIZON` over unit ``normals`` raised to it."""
    z = (viewer * normals).sum(axis=1, keepdims=True)
    flat = viewer - normals * z
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    return np.where(z < HORIZON, flat * np.sqrt(1 - HORIZON**2) + normals * HORIZON, viewer)


def punctual(away, reach=np.inf, axis=None, inner=0.0, outer=np.pi) -> np.ndarray:
    """Return what range and cone of one light leave of its intensity, (N,) float64, as KHR_lights_punctual says.

    Args:
        away: Vectors from the light, (N, 3).
        reach: Its range.
        axis: The way a spot shines, (3,); None = no spot.
        inner, outer: Half angles of its cone [radian].
    """
    window = np.clip(1 - (np.linalg.norm(away, axis=-1) / reach) ** 4, 0, 1)
    if axis is None or outer == np.pi:
        return window
    cosine = _unit(away) @ _unit(np.asarray(axis, np.float64))
    return window * np.clip((cosine - np.cos(outer)) / (np.cos(inner) - np.cos(outer)), 0, 1) ** 2


def shade(
    points, normals, tangents, corner_weights, eye, position, intensity, evaluate, *, projected=False, limits=None
) -> np.ndarray:
    """Return the radiance of samples on triangles, (N, 3) float64.

    Args:
        points, normals, tangents: Of the samples' three vertices, (N, 3, 3), (N, 3, 3) and (N, 3, 4).
        corner_weights: Barycentric weights of the three vertices, (N, 3).
        eye: Position of the viewer, (3,).
        position, intensity: Of the lights, (L, 3) each.
        evaluate: ``evaluate(wi, wo) -> (N, 3)``, BRDF without the cosine; local directions. With ``projected``, it is
            ``evaluate(wi, wo, lit)``, ``lit`` says which of the N samples are asked for, and the cosine is included.
        limits: For each light, what :func:`punctual` takes after its first argument; None = all shine without end.
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
    limits = [()] * len(position) if limits is None else limits
    position, intensity = np.asarray(position, np.float64), np.asarray(intensity, np.float64)
    for at, power, limit in zip(position, intensity, limits, strict=True):
        d = at - p
        wi = np.einsum("nij,nj->ni", frame, _unit(d))
        lit = wi[:, 2] > 0
        irradiance = power * punctual(-d[lit], *limit)[:, None] / (d[lit] ** 2).sum(1, keepdims=True)
        if projected:
            radiance[lit] += evaluate(wi[lit], wo[lit], lit) * irradiance
        else:
            radiance[lit] += evaluate(wi[lit], wo[lit]) * wi[lit, 2:] * irradiance
    return radiance


def pixel_lod(points, uv, ray, x, y, texels) -> np.ndarray:
    """Return log₂ of the longer derivative of (u W, v H) by a pixel, (N,), from rays a thousandth of a pixel apart.

    Args:
        points, uv: Of the samples' three vertices, (N, 3, 3) and (N, 3, 2).
        ray: ``ray(x, y)`` gives the eye and a direction through each picture point, as ``Camera.ray``.
        x, y: Where the samples lie in the picture [px], (N,).
        texels: W and H.
    """
    points, uv = np.asarray(points, np.float64), np.asarray(uv, np.float64)
    edges = points[:, 1:] - points[:, :1]

    def at(dx, dy):
        eye, direction = ray(x + dx, y + dy)
        matrix = np.concatenate([edges, -direction[:, None]], axis=1).transpose(0, 2, 1)
        b1, b2 = np.linalg.solve(matrix, (eye - points[:, 0])[..., None])[:, :2, 0].T
        return (uv * np.stack([1 - b1 - b2, b1, b2], 1)[..., None]).sum(1) * texels

    h = 5e-4
    derivatives = [(at(h, 0) - at(-h, 0)) / (2 * h), (at(0, h) - at(0, -h)) / (2 * h)]
    return np.log2(np.max([np.linalg.norm(d, axis=1) for d in derivatives], axis=0))
