"""Camera raster in float64 NumPy: every triangle against every pixel centre, the twin of ``kernels/visibility.py``.

Homogeneous rasterisation (Olano and Greer 1997) as in the kernel, but in whole-picture coordinates and without tiles,
bounds or near-plane special cases: z of clip space decides what is between near and far. For small pictures and few
triangles. Pixels and clip space: docs/conventions.md.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Visibility:
    """What :func:`rasterize` returns.

    Attributes:
        triangle: Triangle ids, shape (H, W), int32, −1 for background.
        barycentric: Weights of the second and third vertex, shape (H, W, 2), float64, 0 for background.
        depth: View depth w, shape (H, W), float64, +inf for background.
        slope: Change of a weight over a pixel, the largest of the three [1/px], shape (H, W), float64, 0 for
            background.
        decided: Whether the triangle id is safe from rounding, shape (H, W): no edge of a triangle that could show
            passes within ``edge`` pixels of the centre, no near or far plane within a relative ``tie``, and no other
            triangle lies within a relative ``tie`` of the depth shown.
    """

    triangle: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray
    slope: np.ndarray
    decided: np.ndarray


def rasterize(points, faces, clip, width, height, *, double_sided=None, edge=1e-5, tie=1e-6) -> Visibility:
    """Return the nearest triangle of each pixel centre, its weights and depth; of equal depths, the lower id.

    Args:
        points: World positions, shape (V, 3).
        faces: Vertex indices, shape (F, 3).
        clip: World → clip matrix, shape (4, 4), w = view depth, 0 ≤ z ≤ w from near to far.
        width: Picture width [px].
        height: Picture height [px].
        double_sided: Whether each triangle is seen from behind, shape (F,); ``None``: none is.
        edge: Distance to an edge [px] below which ``decided`` is false.
        tie: Relative depth difference below which ``decided`` is false.
    """
    points, clip = np.asarray(points, np.float64), np.asarray(clip, np.float64)
    with np.errstate(invalid="ignore"):
        corner = np.concatenate([points, np.ones((len(points), 1))], 1) @ clip.T
    screen = np.stack(
        [
            0.5 * width * (corner[:, 3] + corner[:, 0]),
            0.5 * height * (corner[:, 3] - corner[:, 1]),
            corner[:, 3],
        ],
        axis=1,
    )
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    centre = np.stack([x, y, np.ones_like(x)], axis=-1)
    triangle = np.full((height, width), -1, np.int32)
    barycentric = np.zeros((height, width, 2))
    depth = np.full((height, width), np.inf)
    slope = np.zeros((height, width))
    doubtful = np.full((height, width), np.inf)  # nearest depth at which an edge or a plane is too close to call
    second = np.full((height, width), np.inf)
    sided = np.zeros(len(faces), bool) if double_sided is None else np.asarray(double_sided, bool)
    for t, face in enumerate(np.asarray(faces)):
        p = screen[face]
        if not np.isfinite(p).all():
            continue
        # Rows of edges such that edge i is positive on vertex i's side for a counter-clockwise triangle (y runs down).
        edges = -np.stack([np.cross(p[1], p[2]), np.cross(p[2], p[0]), np.cross(p[0], p[1])])
        det = p[0] @ edges[0]
        if det < 0.0 and sided[t]:
            edges, det = -edges, -det
        if not det > 0.0:
            continue
        e = centre @ edges.T
        total = e.sum(-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            w = det / total
            weights = e / total[..., None]
            z = (weights @ corner[face][:, 2]) / w
            slack = (e / np.maximum(np.hypot(edges[:, 0], edges[:, 1]), 1e-300)).min(-1)
        inside = (e >= 0.0).all(-1) & (total > 0.0) & (z >= 0.0) & (z <= 1.0)
        close = (total > 0.0) & (slack > -edge) & (z > -tie) & (z < 1.0 + tie)
        close &= (slack < edge) | (z < tie) | (z > 1.0 - tie)
        doubtful = np.where(close, np.minimum(doubtful, w), doubtful)
        second = np.where(inside, np.minimum(second, np.maximum(depth, w)), second)
        wins = inside & (w < depth)
        triangle[wins], depth[wins], barycentric[wins] = t, w[wins], weights[wins][:, 1:]
        # The derivative of E_i / ΣE, whose numerator and denominator are linear in the pixel.
        change = edges[:, :2] - weights[wins][..., None] * edges[:, :2].sum(0)
        slope[wins] = np.linalg.norm(change, axis=-1).max(-1) / total[wins]
    decided = (doubtful > depth * (1.0 + tie)) & ~(second <= depth * (1.0 + tie))
    decided |= np.isinf(depth) & np.isinf(doubtful)
    return Visibility(triangle, barycentric, depth, slope, decided)
