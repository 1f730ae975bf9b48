"""Triangle-ID atlas in NumPy float64: every triangle against every texel. Twin of ``kernels/atlas.py``."""

import numpy as np

FOOTPRINT = 1.0 + 1.0 / 64.0


def _cross(p, q):
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def texel_centres(width: int, height: int) -> np.ndarray:
    """Return the centres [texel] of a sheet, shape [height, width, 2]."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def box_meets_triangle(centres, corners, r: float) -> np.ndarray:
    """Return whether boxes of half-size ``r`` around ``centres`` [..., 2] meet the triangle ``corners`` [3, 2].

    Clips no polygons: two convex sets are apart exactly if one of their edge normals separates them.
    """
    axes = [np.array([1.0, 0.0]), np.array([0.0, 1.0])]
    axes += [np.array([-d[1], d[0]]) for d in np.roll(corners, -1, axis=0) - corners]
    meets = np.ones(centres.shape[:-1], bool)
    for axis in axes:
        triangle, middle, half = corners @ axis, centres @ axis, r * np.abs(axis).sum()
        meets &= (middle + half >= triangle.min()) & (middle - half <= triangle.max())
    return meets


def closest_on_triangle(centres, corners):
    """Return ``(inside, squared distance, weights of corners 2 and 3)`` of the triangle's point nearest each centre."""
    a, b, c = (corner - centres for corner in corners)
    area = _cross(b - a, c - a)
    inner = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=-1) / area[..., None]
    inside = (inner >= 0).all(axis=-1)
    best = np.full(centres.shape[:-1], np.inf)
    weights = np.zeros((*centres.shape[:-1], 3))
    for i, (p, q) in enumerate([(a, b), (b, c), (c, a)]):
        d = q - p
        t = np.clip(-(p * d).sum(-1) / (d * d).sum(-1), 0, 1)
        distance = ((p + t[..., None] * d) ** 2).sum(-1)
        nearer = distance < best
        best = np.where(nearer, distance, best)
        on_edge = np.zeros_like(weights)
        on_edge[..., i], on_edge[..., (i + 1) % 3] = 1 - t, t
        weights = np.where(nearer[..., None], on_edge, weights)
    weights = np.where(inside[..., None], inner, weights)
    return inside, np.where(inside, 0.0, best), weights[..., 1:]


def atlas_raster(corner_uv, chart, width: int, height: int, *, dilation: int = 2):
    """Return ``(triangle, barycentric, distance, rank)`` by the three rules of ``kernels.atlas.atlas_raster``.

    ``distance`` [texel] is that of the texel centre to its owner; ``rank`` is 0 inside, 1 in a footprint, 2 spare,
    3 unowned.
    """
    centres = texel_centres(width, height)
    triangle = np.full((height, width), -1, np.int32)
    barycentric = np.zeros((height, width, 2))
    distance = np.full((height, width), np.inf)
    rank = np.full((height, width), 3)
    for f, corners in enumerate(np.asarray(corner_uv, np.float64)):
        if (
            not np.isfinite(corners).all()
            or chart[f] < 0
            or _cross(corners[1] - corners[0], corners[2] - corners[0]) == 0
        ):
            continue
        inside, squared, weights = closest_on_triangle(centres, corners)
        owned = box_meets_triangle(centres, corners, dilation + 0.5)
        needed = box_meets_triangle(centres, corners, min(FOOTPRINT, dilation + 0.5))
        mine = np.where(inside, 0, np.where(needed, 1, 2))
        take = owned & ((mine < rank) | ((mine == rank) & (np.sqrt(squared) < distance)))
        triangle[take], barycentric[take], rank[take] = f, weights[take], mine[take]
        distance[take] = np.sqrt(squared)[take]
    return triangle, barycentric, distance, rank
