"""glTF 2.0 reader: a ``.glb`` or ``.gltf`` file becomes plain numpy arrays.

Layouts: positions (N, 3) in the frame of their own mesh, quaternions xyzw, matrices (4, 4) that multiply column
vectors, uv with its origin top left (as glTF stores it). Every primitive becomes an indexed triangle list; points and
lines have no surface and are left out. Only what shapes a surface is read: nodes, meshes, skins, morph targets,
animations and the names of materials. Source: Khronos, glTF 2.0 specification, sections 3.5 (scenes), 3.7 (meshes,
skins, morph targets) and 3.11 (animations).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_neumat.io.gltf_buffers import Buffers, Malformed, open_gltf

TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6


@dataclass(frozen=True)
class Primitive:
    """One indexed triangle list with its attributes and morph deltas; absent attributes are None."""

    points: np.ndarray  # (N, 3) float32
    faces: np.ndarray  # (F, 3) int32
    normals: np.ndarray | None  # (N, 3) float32
    tangents: np.ndarray | None  # (N, 4) float32, w is the handedness
    uv: np.ndarray | None  # (N, 2) float32
    joints: np.ndarray | None  # (N, 4 sets) int64, index into Skin.joints
    weights: np.ndarray | None  # (N, 4 sets) float32
    morph_points: np.ndarray | None  # (M, N, 3) float32
    morph_normals: np.ndarray | None  # (M, N, 3) float32
    morph_tangents: np.ndarray | None  # (M, N, 3) float32
    material: int | None

    def split(self) -> Primitive:
        """Return the same surface with one vertex per face corner, as flat normals need; tangents are dropped."""
        order = self.faces.reshape(-1)
        rows = {name: getattr(self, name) for name in ("points", "normals", "uv", "joints", "weights")}
        rows = {name: None if array is None else array[order] for name, array in rows.items()}
        faces = np.arange(len(order), dtype=np.int32).reshape(-1, 3)
        morph = None if self.morph_points is None else self.morph_points[:, order]
        return replace(
            self, faces=faces, tangents=None, **rows, morph_points=morph, morph_normals=None, morph_tangents=None
        )


@dataclass(frozen=True)
class Mesh:
    """A named list of primitives with default morph weights (M,)."""

    name: str | None
    primitives: tuple[Primitive, ...]
    weights: np.ndarray


@dataclass(frozen=True)
class Node:
    """One node of the hierarchy; ``matrix`` is None where translation, rotation and scale hold."""

    name: str | None
    parent: int | None
    mesh: int | None
    skin: int | None
    matrix: np.ndarray | None  # (4, 4) float64
    translation: np.ndarray  # (3,) float64
    rotation: np.ndarray  # (4,) float64, xyzw
    scale: np.ndarray  # (3,) float64
    weights: np.ndarray | None  # (M,) float64


@dataclass(frozen=True)
class Skin:
    """Joints as node indices (J,) and their inverse bind matrices (J, 4, 4) float64."""

    joints: np.ndarray
    inverse_bind: np.ndarray


@dataclass(frozen=True)
class Channel:
    """Key frames of one property of one node: times (K,) [s], values (K, C), or (K, 3, C) for CUBICSPLINE."""

    node: int
    path: str  # translation, rotation, scale or weights
    interpolation: str  # STEP, LINEAR or CUBICSPLINE
    times: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Animation:
    """A named set of channels; ``duration`` [s] is the last key time of all of them."""

    name: str
    channels: tuple[Channel, ...]
    duration: float


@dataclass(frozen=True)
class Material:
    """The part of a material that geometry needs."""

    name: str
    double_sided: bool


@dataclass(frozen=True)
class Document:
    """Everything read from one file; ``scene_nodes`` are the nodes of the default scene, parents first."""

    path: Path
    nodes: tuple[Node, ...]
    scene_nodes: tuple[int, ...]
    meshes: tuple[Mesh, ...]
    skins: tuple[Skin, ...]
    animations: tuple[Animation, ...]
    materials: tuple[Material, ...]


def load_gltf(path) -> Document:
    """Read a glTF 2.0 file, text or binary, with its external and embedded buffers.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
    Returns: The `Document`; meshes that no node of the default scene reaches are read too.
    Raises: FileNotFoundError: If the file or a buffer is missing. ValueError: If the file is truncated, malformed, not
        version 2, or requires an extension that changes geometry.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return _Reader(open_gltf(path)).document()
    except Malformed as error:
        raise ValueError(f"{path}: {error}") from None
    except KeyError as error:
        raise ValueError(f"{path}: malformed glTF, property {error} is missing") from None
    except (TypeError, AttributeError, IndexError, ValueError, OverflowError, MemoryError) as error:
        raise ValueError(f"{path}: malformed glTF ({error})") from None


class _Reader:
    """Turns the JSON tree into the dataclasses above."""

    def __init__(self, buffers: Buffers):
        self.buffers, self.path, self.tree = buffers, buffers.path, buffers.tree

    def document(self) -> Document:
        nodes = self._nodes()
        meshes = tuple(self._mesh(i, mesh) for i, mesh in enumerate(self.tree.get("meshes", ())))
        materials = tuple(
            Material(m.get("name") or f"material_{i}", bool(m.get("doubleSided", False)))
            for i, m in enumerate(self.tree.get("materials", ()))
        )
        skins = tuple(self._skin(i, skin, len(nodes)) for i, skin in enumerate(self.tree.get("skins", ())))
        self._check_references(nodes, meshes, skins, materials)
        animations = tuple(self._animation(i, a, nodes, meshes) for i, a in enumerate(self.tree.get("animations", ())))
        return Document(self.path, nodes, self._scene(nodes), meshes, skins, animations, materials)

    # ---- meshes

    def _mesh(self, index: int, mesh: dict) -> Mesh:
        label = f"mesh {index} ({mesh.get('name', 'unnamed')})"
        primitives = tuple(
            self._primitive(f"{label}, primitive {k}", primitive)
            for k, primitive in enumerate(mesh["primitives"])
            if primitive.get("mode", TRIANGLES) >= TRIANGLES
        )
        targets = max((len(p.get("targets", ())) for p in mesh["primitives"]), default=0)
        weights = np.zeros(targets)
        given = np.asarray(mesh.get("weights", ()), np.float64)[:targets]
        weights[: len(given)] = given
        return Mesh(mesh.get("name"), primitives, weights)

    def _attribute(self, label: str, name: str, index: int, count: int | None, width: int) -> np.ndarray:
        values = self.buffers.accessor(index)
        if values.shape[1] != width:
            raise Malformed(f"{label}: {name} must have {width} components, got {values.shape[1]}")
        if count is not None and len(values) != count:
            raise Malformed(f"{label}: {name} has {len(values)} elements, POSITION has {count}")
        return values

    def _primitive(self, label: str, primitive: dict) -> Primitive:
        attributes = primitive["attributes"]
        points = self._attribute(label, "POSITION", attributes["POSITION"], None, 3).astype(np.float32, copy=False)
        bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
        if bad:
            raise Malformed(f"{label}: {bad} of {len(points)} vertices are NaN or Inf")
        count = len(points)

        def floats(name: str, width: int) -> np.ndarray | None:
            if name not in attributes:
                return None
            return self._attribute(label, name, attributes[name], count, width).astype(np.float32, copy=False)

        joints, weights, k = [], [], 0
        while f"JOINTS_{k}" in attributes:
            joints.append(self._attribute(label, f"JOINTS_{k}", attributes[f"JOINTS_{k}"], count, 4).astype(np.int64))
            weights.append(self._attribute(label, f"WEIGHTS_{k}", attributes[f"WEIGHTS_{k}"], count, 4))
            k += 1
        morphs = [self._morph(label, primitive.get("targets", ()), n, count) for n in ("POSITION", "NORMAL", "TANGENT")]
        return Primitive(
            points=points,
            faces=self._faces(label, primitive, count),
            normals=floats("NORMAL", 3),
            tangents=floats("TANGENT", 4),
            uv=floats("TEXCOORD_0", 2),
            joints=np.concatenate(joints, axis=1) if joints else None,
            weights=np.concatenate(weights, axis=1).astype(np.float32) if weights else None,
            morph_points=morphs[0],
            morph_normals=morphs[1],
            morph_tangents=morphs[2],
            material=primitive.get("material"),
        )

    def _morph(self, label: str, targets, name: str, count: int) -> np.ndarray | None:
        """Stack one attribute's deltas over all targets, shape (M, N, 3); None where no target has it."""
        if not any(name in target for target in targets):
            return None
        deltas = np.zeros((len(targets), count, 3), np.float32)
        for m, target in enumerate(targets):
            if name in target:
                deltas[m] = self._attribute(f"{label}, target {m}", name, target[name], count, 3)
        if not np.isfinite(deltas).all():
            raise Malformed(f"{label}: morph target {name} holds NaN or Inf")
        return deltas

    def _faces(self, label: str, primitive: dict, count: int) -> np.ndarray:
        """Return triangles (F, 3) int32 of a list, strip or fan, indexed or not."""
        if "indices" in primitive:
            order = self._attribute(label, "indices", primitive["indices"], None, 1)[:, 0].astype(np.int64)
        else:
            order = np.arange(count)
        mode, n = primitive.get("mode", TRIANGLES), len(order)
        if mode == TRIANGLES:
            corners = np.arange(n - n % 3).reshape(-1, 3)
        elif mode in (TRIANGLE_STRIP, TRIANGLE_FAN):
            i = np.arange(max(n - 2, 0))
            odd = i % 2  # every second triangle of a strip swaps two corners to keep its side
            strip = mode == TRIANGLE_STRIP
            corners = np.stack([i, i + 1 + odd, i + 2 - odd] if strip else [i + 1, i + 2, 0 * i], axis=1)
        else:
            raise Malformed(f"{label}: unknown primitive mode {mode}")
        faces = order[corners]
        if faces.size and not 0 <= faces.min() <= faces.max() < count:
            face = int(np.argmax((faces >= count).any(axis=1)))
            raise Malformed(f"{label}: face {face} has index {faces[face].max()}, but there are {count} vertices")
        return np.ascontiguousarray(faces, np.int32)

    # ---- nodes, skins and animations

    def _nodes(self) -> tuple[Node, ...]:
        entries = self.tree.get("nodes", [])
        parents: list[int | None] = [None] * len(entries)
        for i, entry in enumerate(entries):
            for child in entry.get("children", ()):
                self.buffers.item("nodes", child)
                if parents[child] is not None:
                    raise Malformed(f"node {child} has two parents, {parents[child]} and {i}")
                parents[child] = i
        reached = [i for i in range(len(entries)) if parents[i] is None]
        for node in reached:  # grows while it is walked
            reached.extend(entries[node].get("children", ()))
        if len(reached) < len(entries):
            raise Malformed(f"node {min(set(range(len(entries))) - set(reached))} is its own ancestor")
        return tuple(self._node(i, entry, parents[i]) for i, entry in enumerate(entries))

    def _node(self, index: int, entry: dict, parent: int | None) -> Node:
        def vector(name: str, default: tuple) -> np.ndarray:
            value = np.asarray(entry.get(name, default), np.float64)
            if value.shape != (len(default),) or not np.isfinite(value).all():
                raise Malformed(f"node {index}: {name} must be {len(default)} finite numbers, got {entry[name]}")
            return value

        has_matrix = "matrix" in entry
        return Node(
            name=entry.get("name"),
            parent=parent,
            mesh=entry.get("mesh"),
            skin=entry.get("skin"),
            matrix=vector("matrix", (0.0,) * 16).reshape(4, 4).T.copy() if has_matrix else None,
            translation=vector("translation", (0.0, 0.0, 0.0)),
            rotation=vector("rotation", (0.0, 0.0, 0.0, 1.0)),
            scale=vector("scale", (1.0, 1.0, 1.0)),
            weights=np.asarray(entry["weights"], np.float64) if "weights" in entry else None,
        )

    def _scene(self, nodes: tuple[Node, ...]) -> tuple[int, ...]:
        """Return the nodes of the default scene in depth-first order; without scenes, all of them."""
        children: list[list[int]] = [list(entry.get("children", ())) for entry in self.tree.get("nodes", [])]
        if self.tree.get("scenes"):
            stack = list(reversed(self.buffers.item("scenes", self.tree.get("scene", 0)).get("nodes", [])))
        else:
            stack = [i for i in reversed(range(len(nodes))) if nodes[i].parent is None]
        order, seen = [], set()
        while stack:
            node = stack.pop()
            self.buffers.item("nodes", node)
            if node not in seen:
                seen.add(node)
                order.append(node)
                stack.extend(reversed(children[node]))
        return tuple(order)

    def _skin(self, index: int, skin: dict, node_count: int) -> Skin:
        joints = np.asarray(skin["joints"], np.int64)
        if joints.size == 0 or joints.min() < 0 or joints.max() >= node_count:
            raise Malformed(f"skin {index}: its joints must be nodes in 0..{node_count - 1}")
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            values = self._attribute(f"skin {index}", "inverseBindMatrices", skin["inverseBindMatrices"], None, 16)
            if len(values) < len(joints) or not np.isfinite(values).all():
                raise Malformed(f"skin {index}: {len(joints)} joints need as many finite inverse bind matrices")
            inverse = values[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
        return Skin(joints, inverse)

    def _check_references(self, nodes, meshes, skins, materials) -> None:
        for i, node in enumerate(nodes):
            if node.mesh is not None:
                self.buffers.item("meshes", node.mesh)
            if node.mesh is None or node.skin is None:
                continue
            self.buffers.item("skins", node.skin)
            for primitive in meshes[node.mesh].primitives:
                top = -1 if primitive.joints is None else int(primitive.joints.max(initial=-1))
                if top >= len(skins[node.skin].joints):
                    raise Malformed(
                        f"node {i}: joint {top} is out of range, its skin has {len(skins[node.skin].joints)}"
                    )
        for mesh in meshes:
            for primitive in mesh.primitives:
                if primitive.material is not None:
                    self.buffers.item("materials", primitive.material)

    def _animation(self, index: int, animation: dict, nodes, meshes) -> Animation:
        name = animation.get("name") or f"animation_{index}"
        channels = []
        for k, channel in enumerate(animation["channels"]):
            target = channel["target"]
            if "node" in target and target["path"] != "pointer":  # the rest belongs to extensions
                sampler = animation["samplers"][channel["sampler"]]
                channels.append(self._channel(f"animation {name}, channel {k}", target, sampler, nodes, meshes))
        return Animation(name, tuple(channels), max((float(c.times[-1]) for c in channels), default=0.0))

    def _channel(self, label: str, target: dict, sampler: dict, nodes, meshes) -> Channel:
        self.buffers.item("nodes", target["node"])
        node, path, interpolation = nodes[target["node"]], target["path"], sampler.get("interpolation", "LINEAR")
        if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
            raise Malformed(f"{label}: unknown interpolation {interpolation}")
        widths = {"translation": 3, "rotation": 4, "scale": 3}
        widths["weights"] = len(meshes[node.mesh].weights) if node.mesh is not None else 0
        if path not in widths:
            raise Malformed(f"{label}: unknown path {path}")
        if path != "weights" and node.matrix is not None:
            raise Malformed(f"{label}: animates {path} of node {target['node']}, which has a matrix")
        times = self._attribute(label, "input", sampler["input"], None, 1)[:, 0].astype(np.float64)
        values = self.buffers.accessor(sampler["output"]).astype(np.float64)
        keys = (3,) if interpolation == "CUBICSPLINE" else ()
        shape = (len(times), *keys, widths[path])
        if not len(times) or values.size != np.prod(shape) or not values.size:
            raise Malformed(
                f"{label}: {len(times)} keys of {path} need {int(np.prod(shape))} numbers, got {values.size}"
            )
        if not np.isfinite(times).all() or not np.isfinite(values).all() or (np.diff(times) < 0).any():
            raise Malformed(f"{label}: keys must be finite and their times must increase")
        return Channel(target["node"], path, interpolation, times, values.reshape(shape))
