"""What a mesh sequence is made of: parts that stay, and a motion that gives their points.

A part is one primitive as one node places it. Parts are merged in order, so that vertices of part k follow those of
part k − 1. A motion answers three questions: how many frames there are, which of them an index means, and where
everything is in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from warp_neumat.io.animation import Animator, Deformer
from warp_neumat.io.gltf import Animation, Document
from warp_neumat.io.mesh_files import MeshFrames
from warp_neumat.pipeline.surface import AUTHORED, FLAT, SMOOTH

NORMAL_MODES = {"auto": AUTHORED, "smooth": SMOOTH, "flat": FLAT}


@dataclass(frozen=True)
class Part:
    """One part before it is merged; ``group`` joins parts whose vertices may be welded."""

    name: str
    aliases: tuple[str, ...]
    faces: np.ndarray
    uv: np.ndarray | None
    material: str
    double_sided: bool
    source: int
    tangents: bool
    group: int
    count: int


class Motion(Protocol):
    """Where the vertices of a scene are, frame by frame."""

    def frame_count(self, fps: float) -> int:
        """Return the number of frames in one pass."""

    def key(self, index: int, count: int) -> int | None:
        """Return the frame that an index shows, or None where there is none."""

    def points(self, key: int, fps: float) -> np.ndarray:
        """Return positions (V, 3)."""

    def full(self, key: int, fps: float) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Return positions (V, 3) that the caller may keep, and authored normals (V, 3) and tangents (V, 4)."""


@dataclass(frozen=True)
class Scene:
    """Parts, their positions at rest and their motion."""

    name: str
    parts: list[Part]
    rest: np.ndarray  # (V, 3) float32
    motion: Motion
    animation: str | None = None
    animation_names: tuple[str, ...] = ()


class ArrayMotion:
    """Frames in memory; one frame repeats for ever, several end."""

    def __init__(self, points: np.ndarray, normals: np.ndarray | None, pick: np.ndarray | None):
        self._points, self._normals, self._pick = points, normals, pick

    def frame_count(self, fps: float) -> int:
        return len(self._points)

    def key(self, index: int, count: int) -> int | None:
        return 0 if count == 1 else index if 0 <= index < count else None

    def points(self, key: int, fps: float) -> np.ndarray:
        return self._points[key] if self._pick is None else self._points[key][self._pick]

    def full(self, key: int, fps: float):
        normals = None if self._normals is None else self._normals[key]
        if normals is not None and self._pick is not None:
            normals = normals[self._pick]
        return self.points(key, fps).copy(), normals, None


class GltfMotion:
    """Deforms the primitives of a document at the time of a frame."""

    def __init__(self, deformers: list[Deformer], counts: list[int], animator: Animator, duration: float):
        self._deformers, self._animator, self._duration = deformers, animator, duration
        self._slices = [slice(end - n, end) for n, end in zip(counts, np.cumsum(counts), strict=True)]
        self._count = sum(counts)
        self._moves = duration > 0.0 and any(animator.moves(d.node) for d in deformers)

    def frame_count(self, fps: float) -> int:
        return max(1, round(self._duration * fps)) if self._moves else 1

    def key(self, index: int, count: int) -> int | None:
        return index if self._moves else 0

    def _pose(self, key: int, fps: float):
        return self._animator.pose((key / fps) % self._duration if self._moves else 0.0)

    def points(self, key: int, fps: float) -> np.ndarray:
        world, weights = self._pose(key, fps)
        return np.concatenate([d.points(world, weights).T for d in self._deformers])

    def full(self, key: int, fps: float):
        world, weights = self._pose(key, fps)
        points = np.empty((self._count, 3), np.float32)
        normals, tangents = np.zeros((self._count, 3), np.float32), np.zeros((self._count, 4), np.float32)
        for rows, deformer in zip(self._slices, self._deformers, strict=True):
            p, n, t = deformer(world, weights)
            points[rows] = p.T
            if n is not None:
                normals[rows] = n.T
            if t is not None:
                tangents[rows] = t.T
        return points, normals, tangents


def scene_from_frames(frames: MeshFrames, normals: str, double_sided: bool) -> Scene:
    """Return a scene with one part per group of the file; ``normals`` is a key of NORMAL_MODES."""
    source = NORMAL_MODES[normals]
    if source == AUTHORED and frames.normals is None:
        source = SMOOTH
    parts, picks = [], []
    for k, (name, material) in enumerate(frames.parts):
        faces = frames.faces[frames.face_part == k]
        if not len(faces):
            continue
        if source == FLAT:
            pick, faces = _split(faces)
        elif len(frames.parts) == 1:
            pick = np.arange(frames.points.shape[1])
        else:
            pick, faces = np.unique(faces, return_inverse=True)
        uv = None if frames.uv is None else frames.uv[pick]
        aliases = tuple(n for n in (name, frames.name, material) if n)
        faces = faces.reshape(-1, 3).astype(np.int32)
        parts.append(Part(name, aliases, faces, uv, material, double_sided, source, False, 0, len(pick)))
        picks.append(pick)
    pick = np.concatenate(picks)
    same = np.array_equal(pick, np.arange(frames.points.shape[1]))
    motion = ArrayMotion(frames.points, frames.normals, None if same else pick)
    return Scene(frames.name, parts, frames.points[0][pick], motion)


def scene_from_document(document: Document, wanted: str | None, normals: str, double_sided: bool | None) -> Scene:
    """Return a scene with one part per primitive that a node of the default scene places.

    Args:
        document: A glTF file.
        wanted: Name of the animation that plays, any case; None is the first one.
        normals: A key of NORMAL_MODES.
        double_sided: Overrides the materials' own flag; None keeps it.
    Raises: ValueError: If there is no animation of that name, or no triangle.
    """
    names = unique_names([animation.name for animation in document.animations])
    animation, chosen = _find_animation(document, names, wanted)
    animator, rest = Animator(document, animation), Animator(document, None)
    world, weights = rest.pose(0.0)
    start, _ = animator.pose(0.0)
    parts, deformers, points = [], [], []
    for index in document.scene_nodes:
        node = document.nodes[index]
        if node.mesh is None:
            continue
        mesh = document.meshes[node.mesh]
        label = node.name or mesh.name or f"mesh_{node.mesh}"
        for primitive in mesh.primitives:
            if not len(primitive.faces):
                continue
            source = NORMAL_MODES[normals]
            if source == AUTHORED and primitive.normals is None:
                source = FLAT
            if source == FLAT:
                primitive = primitive.split()
            authored = source == AUTHORED
            skin = None if node.skin is None else document.skins[node.skin]
            tangents = authored and primitive.tangents is not None
            deformer = Deformer(primitive, index, skin, with_normals=authored, with_tangents=tangents)
            material = None if primitive.material is None else document.materials[primitive.material]
            title = material.name if material else "default"
            several = len(mesh.primitives) > 1
            faces = primitive.faces[:, ::-1].copy() if deformer.mirrors(start) else primitive.faces
            both = bool(material and material.double_sided) if double_sided is None else double_sided
            aliases = tuple(n for n in (node.name, mesh.name, title) if n)
            name = f"{label}:{title}" if several else label
            count = len(primitive.points)
            parts.append(Part(name, aliases, faces, primitive.uv, title, both, source, tangents, index, count))
            deformers.append(deformer)
            points.append(deformer.points(world, weights).T)
    if not parts:
        raise ValueError(f"{document.path}: empty mesh, the scene holds no triangles")
    duration = animation.duration if animation else 0.0
    motion = GltfMotion(deformers, [part.count for part in parts], animator, duration)
    rest_points = np.ascontiguousarray(np.concatenate(points))
    if not np.isfinite(rest_points).all():
        raise ValueError(f"{document.path}: the node transforms send vertices to infinity")
    return Scene(document.path.stem, parts, rest_points, motion, chosen, tuple(names))


def _find_animation(document: Document, names: list[str], wanted: str | None) -> tuple[Animation | None, str | None]:
    if wanted is None:
        return (document.animations[0], names[0]) if names else (None, None)
    for matches in (lambda name: name == wanted, lambda name: name.lower() == wanted.lower()):
        for k, name in enumerate(names):
            if matches(name):
                return document.animations[k], name
    known = f"it has {', '.join(names)}" if names else "it has none"
    raise ValueError(f"{document.path}: no animation named {wanted!r}; {known}")


def _split(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertex of every face corner, and faces that own their corners."""
    return faces.reshape(-1), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)


def unique_names(names: list[str]) -> list[str]:
    """Return the names with ``#2``, ``#3`` … behind those that occur again."""
    result: list[str] = []
    taken = set(names)
    for name in names:
        unique, n = name, 1
        while unique in result or (n > 1 and unique in taken):
            n += 1
            unique = f"{name}#{n}"
        result.append(unique)
    return result
