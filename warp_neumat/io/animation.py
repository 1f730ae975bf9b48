"""Animation of a glTF document: key frames, node hierarchy, morph targets and linear blend skinning.

Matrices (4, 4) float64 multiply column vectors; quaternions are xyzw; times are seconds. Vertices are stored as planes
(3, N) float32 while they are deformed, because numpy then runs over contiguous memory. Source: Khronos, glTF 2.0
specification, sections 3.7.2 (morph targets), 3.7.3 (skins), 3.11 (animations) and appendix C (interpolation).
"""

from __future__ import annotations

import math

import numpy as np

from warp_neumat.io.gltf import Animation, Channel, Document, Primitive, Skin


def sample(channel: Channel, time: float) -> np.ndarray:
    """Interpolate one channel at a time; before the first key and after the last one the value stays.

    Args:
        channel: Key frames; see `gltf.Channel` for their layout.
        time: Seconds.
    Returns: The value (C,) float64; rotations are unit quaternions.
    """
    times, values = channel.times, channel.values
    cubic = channel.interpolation == "CUBICSPLINE"
    k = int(np.searchsorted(times, time, side="right")) - 1
    if k < 0 or k >= len(times) - 1:
        value = values[max(k, 0)]
        value = value[1] if cubic else value
        return _unit(value) if channel.path == "rotation" else value
    span = times[k + 1] - times[k]  # positive, because searchsorted steps over equal times
    u = (time - times[k]) / span
    if channel.interpolation == "STEP":
        value = values[k]
    elif cubic:
        value = _hermite(values[k, 1], span * values[k, 2], span * values[k + 1, 0], values[k + 1, 1], u)
    elif channel.path == "rotation":
        return slerp(values[k], values[k + 1], u)
    else:
        value = values[k] + u * (values[k + 1] - values[k])
    return _unit(value) if channel.path == "rotation" else value


def slerp(a: np.ndarray, b: np.ndarray, u: float) -> np.ndarray:
    """Interpolate two unit quaternions (4,) along the shorter arc."""
    cosine = float(a @ b)
    sign = -1.0 if cosine < 0.0 else 1.0
    cosine *= sign
    if cosine > 0.9995:  # the arc is straight to 1e-8 here, and 1 / sin would lose digits
        return _unit((1.0 - u) * a + (sign * u) * b)
    angle = math.acos(cosine)
    scale = 1.0 / math.sin(angle)
    return _unit((math.sin((1.0 - u) * angle) * scale) * a + (sign * math.sin(u * angle) * scale) * b)


def _unit(quaternion: np.ndarray) -> np.ndarray:
    length = math.sqrt(float(quaternion @ quaternion))
    return quaternion / length if length > 0.0 else np.array([0.0, 0.0, 0.0, 1.0])


def _hermite(p0, m0, m1, p1, u: float) -> np.ndarray:
    u2, u3 = u * u, u * u * u
    return (2 * u3 - 3 * u2 + 1) * p0 + (u3 - 2 * u2 + u) * m0 + (3 * u2 - 2 * u3) * p1 + (u3 - u2) * m1


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the matrices (N, 4, 4) of translation (N, 3) × rotation (N, 4) xyzw × scale (N, 3)."""
    x, y, z, w = (rotation / np.maximum(np.linalg.norm(rotation, axis=1, keepdims=True), 1e-300)).T
    matrix = np.zeros((len(translation), 4, 4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:, :3, :3] = np.moveaxis(np.array(rows), 2, 0)
    matrix[:, :3, :3] *= scale[:, None, :]
    matrix[:, :3, 3] = translation
    matrix[:, 3, 3] = 1.0
    return matrix


class Animator:
    """Evaluates the node hierarchy of a document under one animation, or at rest where ``animation`` is None."""

    def __init__(self, document: Document, animation: Animation | None):
        self._nodes = document.nodes
        self._channels = animation.channels if animation else ()
        self._translation = np.array([n.translation for n in document.nodes]).reshape(-1, 3)
        self._rotation = np.array([n.rotation for n in document.nodes]).reshape(-1, 4)
        self._scale = np.array([n.scale for n in document.nodes]).reshape(-1, 3)
        self._fixed = [(i, n.matrix) for i, n in enumerate(document.nodes) if n.matrix is not None]
        self._weights = {
            i: n.weights if n.weights is not None else document.meshes[n.mesh].weights
            for i, n in enumerate(document.nodes)
            if n.mesh is not None
        }
        self._levels = _levels([n.parent for n in document.nodes])
        self._moving = _moving_nodes(document, self._channels)

    def moves(self, node: int) -> bool:
        """Return whether a channel changes the geometry that this node places: its own, an ancestor's or a joint's."""
        return node in self._moving

    def pose(self, time: float) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Evaluate all channels at a time.

        Args:
            time: Seconds.
        Returns: World matrices (nodes, 4, 4) float64, and morph weights (M,) per node that has a mesh.
        """
        translation, rotation, scale = self._translation.copy(), self._rotation.copy(), self._scale.copy()
        weights = dict(self._weights)
        targets = {"translation": translation, "rotation": rotation, "scale": scale, "weights": weights}
        for channel in self._channels:
            targets[channel.path][channel.node] = sample(channel, time)
        world = compose(translation, rotation, scale)
        for node, matrix in self._fixed:
            world[node] = matrix
        for nodes, parents in self._levels:
            world[nodes] = world[parents] @ world[nodes]
        return world, weights


def _levels(parents: list[int | None]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return (nodes, their parents) per depth below the roots, so that one product serves a whole depth."""
    depth: dict[int, int] = {}
    for start in range(len(parents)):
        chain, node = [], start
        while node is not None and node not in depth:
            chain.append(node)
            node = parents[node]
        base = -1 if node is None else depth[node]
        for step, member in enumerate(reversed(chain), 1):
            depth[member] = base + step
    levels = []
    for d in range(1, max(depth.values(), default=0) + 1):
        nodes = [i for i in range(len(parents)) if depth[i] == d]
        levels.append((np.array(nodes), np.array([parents[i] for i in nodes])))
    return levels


def _moving_nodes(document: Document, channels: tuple[Channel, ...]) -> set[int]:
    driven = {c.node for c in channels if c.path != "weights"}
    placed: set[int] = set()
    for i in range(len(document.nodes)):
        node = i
        while node is not None:
            if node in driven:
                placed.add(i)
                break
            node = document.nodes[node].parent
    morphed = {c.node for c in channels if c.path == "weights"}
    moving = set()
    for i, node in enumerate(document.nodes):
        skinned = node.mesh is not None and node.skin is not None
        sources = document.skins[node.skin].joints.tolist() if skinned else [i]
        if i in morphed or any(source in placed for source in sources):
            moving.add(i)
    return moving


class Deformer:
    """Places one primitive in the world: morph targets first, then its skin, or else its node's matrix.

    A skinned primitive ignores the transform of the node that holds it, as the specification demands. Weights are
    normalised to sum 1; a vertex without any weight follows its first joint.
    """

    def __init__(self, primitive: Primitive, node: int, skin: Skin | None, *, with_normals: bool, with_tangents: bool):
        self.node = node
        self._primitive = primitive
        self._skin = skin if primitive.joints is not None and primitive.weights is not None else None
        self._normals = primitive.normals if with_normals else None
        self._tangents = primitive.tangents if with_tangents else None
        if self._skin is not None:
            self._influences = _influences(primitive.joints, primitive.weights)

    def _matrices(self, world: np.ndarray) -> np.ndarray:
        """Return the placement as (3, 4, N) float32 per vertex for a skin, or (3, 4, 1) for a node."""
        if self._skin is None:
            return world[self.node, :3, :, None].astype(np.float32)
        joints = (world[self._skin.joints] @ self._skin.inverse_bind)[:, :3].reshape(-1, 12).astype(np.float32)
        blend = np.float32(0)
        for joint, weight in self._influences:  # whole rows: 48 bytes of one joint lie together
            blend = blend + np.take(joints, joint, axis=0) * weight[:, None]
        return np.ascontiguousarray(blend.T).reshape(3, 4, -1)

    def mirrors(self, world: np.ndarray) -> bool:
        """Return whether the placement turns the surface inside out, so that its winding has to be flipped."""
        if self._skin is None:
            return bool(np.linalg.det(world[self.node, :3, :3]) < 0.0)
        sides = np.sign(np.linalg.det((world[self._skin.joints] @ self._skin.inverse_bind)[:, :3, :3]))
        return sum(float(np.sum(sides[joint] * weight)) for joint, weight in self._influences) < 0.0

    def points(self, world: np.ndarray, weights: dict[int, np.ndarray]) -> np.ndarray:
        """Return world positions (3, N) float32."""
        return self._place(self._matrices(world), weights)

    def __call__(self, world: np.ndarray, weights: dict[int, np.ndarray]):
        """Place positions, normals and tangents.

        Args:
            world: World matrices (nodes, 4, 4), from `Animator.pose`.
            weights: Morph weights per node, from `Animator.pose`.
        Returns: Planes float32: positions (3, N), normals (3, N) by the inverse transpose, tangents (4, N); neither
            normals nor tangents have unit length yet, and each is None where the file has none.
        """
        m, p, active = self._matrices(world), self._primitive, weights.get(self.node)
        points, normals, tangents = self._place(m, weights), None, None
        if self._normals is None and self._tangents is None:
            return points, None, None
        rows = m[:, :3]
        cofactor = np.stack([_cross(rows[1], rows[2]), _cross(rows[2], rows[0]), _cross(rows[0], rows[1])])
        side = np.where((rows[0] * cofactor[0]).sum(axis=0) < 0.0, np.float32(-1), np.float32(1))
        if self._normals is not None:
            x, y, z = _morphed(self._normals, p.morph_normals, active)
            normals = (cofactor[:, 0] * x + cofactor[:, 1] * y + cofactor[:, 2] * z) * side
        if self._tangents is not None:
            x, y, z = _morphed(self._tangents[:, :3], p.morph_tangents, active)
            direction = rows[:, 0] * x + rows[:, 1] * y + rows[:, 2] * z
            tangents = np.concatenate([direction, (self._tangents[:, 3] * side)[None]])
        return points, normals, tangents

    def _place(self, m: np.ndarray, weights: dict[int, np.ndarray]) -> np.ndarray:
        x, y, z = _morphed(self._primitive.points, self._primitive.morph_points, weights.get(self.node))
        return m[:, 0] * x + m[:, 1] * y + m[:, 2] * z + m[:, 3]


def _influences(joints: np.ndarray, weights: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return (joint (N,), weight (N,)) per influence; the weights of a vertex sum to 1, unused influences are gone."""
    weights = np.where(np.isfinite(weights), weights, 0.0).astype(np.float64)
    total = weights.sum(axis=1, keepdims=True)
    weights = np.where(total > 0.0, weights / np.where(total > 0.0, total, 1.0), np.eye(1, weights.shape[1]))
    used = [k for k in range(weights.shape[1]) if k == 0 or weights[:, k].any()]
    return [(joints[:, k].copy(), weights[:, k].astype(np.float32)) for k in used]


def _morphed(base: np.ndarray, deltas: np.ndarray | None, weights: np.ndarray | None) -> np.ndarray:
    """Return base (N, 3) plus the weighted deltas (M, N, 3), as planes (3, N)."""
    if deltas is not None and weights is not None:
        for weight, delta in zip(weights, deltas, strict=False):
            if weight != 0.0:
                base = base + np.float32(weight) * delta
    return np.ascontiguousarray(base.T)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
