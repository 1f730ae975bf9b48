"""Normals and tangents of a deforming triangle mesh, per frame and without loops over vertices.

A tangent is xyz plus a handedness w = ±1 with bitangent = cross(normal, tangent.xyz) · w. As in glTF the tangent points
along increasing u and the bitangent along decreasing v (up in the texture, because v counts down). Where a mesh
has no usable uv, the tangent is that of a branchless basis: Duff et al., "Building an Orthonormal Basis, Revisited",
JCGT 6(1), 2017. Vertex normals are weighted by the corner angles: Thürmer and Wüthrich, "Computing Vertex Normals from
Polygonal Facets", JGT 3(1), 1998.

Inside this file vectors are planes (3, N), because numpy then runs over contiguous memory.
"""

from __future__ import annotations

import numpy as np

AUTHORED, SMOOTH, FLAT = 0, 1, 2
_TINY = np.float32(1e-30)  # squared length in units of the mesh's extent, below which an edge or area is zero
_WELD_CELLS = 1 << 20  # per extent
_CANCELLED = np.float32(1e-12)  # squared length of a sum of unit vectors, below which its direction is rounding


class Surface:
    """The parts of a mesh that do not move, prepared so that each frame costs a few array passes.

    Args:
        faces: (F, 3) int32. The corners of flat vertices belong to one face only.
        uv: (V, 2) float32 with its origin top left, NaN where there is none.
        rest: Positions (V, 3) that decide which vertices are welded: those of one group that agree to a millionth of
            the mesh's extent share a smooth normal, even if a later frame parts them.
        source: (V,) uint8, where the normal of a vertex comes from: AUTHORED, SMOOTH or FLAT.
        authored_tangents: (V,) bool, whether `complete` is given a tangent for the vertex.
        group: (V,) int32, vertices are welded within a group only.
    """

    def __init__(self, faces, uv, rest, source, authored_tangents, group):
        self._faces = faces
        self._corner = np.ascontiguousarray(faces.T).reshape(-1)  # (3F,), corner by corner
        count = len(rest)
        extent = float(np.ptp(rest, axis=0).max())
        self._scale = np.float32(1.0 / extent if extent > 0.0 else 1.0)
        self._flat_corners = np.flatnonzero(source[self._corner] == FLAT)
        self._authored = source == AUTHORED
        self._smooth = np.flatnonzero(source == SMOOTH)
        self._weld = np.arange(count)
        cell = np.rint((rest - rest.min(axis=0)).astype(np.float64) * (self._scale * _WELD_CELLS)).astype(np.int32)
        if len(self._smooth):
            self._weld = _weld(self._smooth, count, group, cell)
        self._authored_tangents = authored_tangents
        self._needs_uv_tangents = not authored_tangents.all()
        self._prepare_tangents(uv, group, cell)

    def _prepare_tangents(self, uv, group, cell) -> None:
        """Keep per face the weights of its two edges in dP/du, and per vertex its handedness; neither ever changes."""
        faces, count = self._faces, len(cell)
        a, b, c = (uv[faces[:, k]].astype(np.float64) for k in range(3))
        (du1, dv1), (du2, dv2) = (b - a).T, (c - a).T
        area = du1 * dv2 - du2 * dv1
        good = np.isfinite(area) & (np.abs(area) > 1e-12 * np.maximum(du1**2 + dv1**2, du2**2 + dv2**2))
        sign = np.where(good, np.sign(np.where(good, area, 0.0)), 0.0)
        size = np.where(good, np.abs(np.where(good, area, 0.0)), 1.0)
        self._edge_weights = np.where(good, np.stack([dv2, -dv1]) * sign / np.sqrt(size), 0.0).astype(np.float32)
        side = np.bincount(self._corner, np.tile(sign * size, 3), count)
        self._handedness = np.where(side > 0.0, -1.0, 1.0).astype(np.float32)  # v counts down, so P_u × P_v is inward
        self._tangent_weld = np.arange(count)
        if len(self._smooth) and self._needs_uv_tangents:
            self._tangent_weld = _weld(self._smooth, count, group, cell, uv, self._handedness)

    def complete(self, points, normals, tangents) -> tuple[np.ndarray, np.ndarray]:
        """Return unit normals and tangents of one frame.

        Args:
            points: Positions (V, 3) float32, in the space of the result.
            normals: Authored normals (V, 3), any length, read where the source is AUTHORED; or None.
            tangents: Authored tangents (V, 4), read where they are announced; or None.
        Returns: Normals (V, 3) and tangents (V, 4), float32. A normal that is zero or not finite falls back to that
            of a face at the vertex, then to +z; the result never holds NaN.
        """
        shape = _Faces(points, self._faces, self._scale)
        n = self._normals(shape, len(points), normals)
        t = np.zeros_like(n)
        handedness = self._handedness
        if self._needs_uv_tangents:
            face = self._edge_weights[0] * shape.edge1 + self._edge_weights[1] * shape.edge2
            face = _unit(face)[0]
            t = _gather_sum(self._tangent_weld, self._corner, face, shape.angles())
        if self._authored_tangents.any():
            t = np.where(self._authored_tangents, _rescaled(tangents[:, :3].T), t)
            handedness = np.where(self._authored_tangents, np.where(tangents[:, 3] < 0, -1, 1), handedness)
        t, good = _unit(t, _CANCELLED)
        t, clear = _unit(t - n * _dot(n, t), np.float32(1e-8))  # a tangent along the normal says nothing
        good &= clear
        if not good.all():
            t = np.where(good, t, basis_tangent(n))
            handedness = np.where(good, handedness, 1)
        return np.ascontiguousarray(n.T), np.concatenate([t, handedness[None]]).T.astype(np.float32, order="C")

    def _normals(self, shape: _Faces, count: int, normals) -> np.ndarray:
        n = np.zeros((3, count), np.float32)
        if normals is not None:
            n = np.where(self._authored, _rescaled(normals.T), n)
        if len(self._smooth):
            n[:, self._smooth] = _gather_sum(self._weld, self._corner, shape.normals, shape.angles())[:, self._smooth]
        if len(self._flat_corners):
            face = self._flat_corners % len(self._faces)
            n[:, self._corner[self._flat_corners]] = shape.normals[:, face]
        n, good = _unit(n, _CANCELLED)
        if not good.all():
            spare = np.zeros_like(n)
            spare[2] = 1.0
            solid = np.flatnonzero(np.tile(shape.solid, 3))
            spare[:, self._corner[solid]] = shape.normals[:, solid % len(self._faces)]
            n = np.where(good, n, spare)
        return n


class _Faces:
    """Edges and unit normals of all faces in one frame, and the corner angles once they are asked for."""

    def __init__(self, points: np.ndarray, faces: np.ndarray, scale: np.float32):
        planes = np.ascontiguousarray(points.T) * scale
        a, b, c = (planes[:, faces[:, k]] for k in range(3))
        self.edge1, self.edge2 = b - a, c - a
        cross = _cross(self.edge1, self.edge2)
        self.normals, self.solid = _unit(cross)
        self._twice_area = np.sqrt(_dot(cross, cross))
        self._angles = None

    def angles(self) -> np.ndarray:
        """Return the corner angles (3F,) [rad], corner by corner, zero for faces without area."""
        if self._angles is None:
            dot = _dot(self.edge1, self.edge2)
            dots = [dot, _dot(self.edge1, self.edge1) - dot, _dot(self.edge2, self.edge2) - dot]
            self._angles = np.where(self.solid, np.arctan2(self._twice_area, np.stack(dots)), 0).reshape(-1)
        return self._angles


def basis_tangent(normals: np.ndarray) -> np.ndarray:
    """Return unit tangents (3, N) for unit normals (3, N), continuous but for z = 0. Duff et al. 2017."""
    x, y, z = normals
    sign = np.copysign(np.float32(1), z)
    a = np.float32(-1) / (sign + z)
    return np.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x])


def degenerate_faces(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which faces repeat an index or have no area to float32 precision, shape (F,) bool.

    Without area means |edge × edge| ≤ 1e-7 of the longest edge squared.
    """
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    cross = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum.reduce([((q - p) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    i, j, k = faces.T
    return (i == j) | (j == k) | (k == i) | (cross <= 1e-7 * longest)


def _weld(rows: np.ndarray, count: int, *keys: np.ndarray) -> np.ndarray:
    """Return per vertex (count,) the first vertex whose keys all equal its own, looking at ``rows`` only."""
    columns = [
        np.asarray(k, np.float32 if k.dtype.kind == "f" else np.int32)[rows].reshape(len(rows), -1) for k in keys
    ]
    bits = np.concatenate([(c + 0 if c.dtype.kind == "f" else c).view(np.int32) for c in columns], axis=1)  # −0 is 0
    packed = np.ascontiguousarray(bits).view([("", np.int32)] * bits.shape[1]).ravel()
    _, first, inverse = np.unique(packed, return_index=True, return_inverse=True)
    weld = np.arange(count)
    weld[rows] = rows[first[inverse.ravel()]]
    return weld


def _gather_sum(weld: np.ndarray, corner: np.ndarray, face_vectors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sum face vectors (3, F) into their corners with weights (3F,), and hand each sum to its welded vertices."""
    target = weld[corner]
    sums = [np.bincount(target, np.tile(plane, 3) * weights, len(weld))[weld] for plane in face_vectors]
    return np.stack(sums).astype(np.float32)


def _rescaled(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (3, N) divided by their largest component, zero where they are zero or not finite."""
    largest = np.abs(vectors).max(axis=0)
    usable = np.isfinite(largest) & (largest > 0.0)
    return np.where(usable, vectors, np.float32(0)) / np.where(usable, largest, np.float32(1))


def _unit(vectors: np.ndarray, tiny: np.float32 = _TINY) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (3, N) and which of them are; the others become zero."""
    squared = _dot(vectors, vectors)
    good = squared > tiny
    return vectors * np.where(good, 1 / np.sqrt(np.where(good, squared, np.float32(1))), np.float32(0)), good


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
