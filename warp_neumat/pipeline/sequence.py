"""Mesh sequences: a whole scene as one vertex and one face array, and its points, normals and tangents per frame.

World space of the file, right-handed; faces counter-clockwise seen from outside; uv origin top left. A part is one
primitive as one node places it, so a mesh with two materials is two parts, and a mesh placed twice is two as well.
Topology, uv and parts never change; only `MeshSequence.frame` does. docs/conventions.md says the rest.
"""

from __future__ import annotations

import fnmatch
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_neumat.io.gltf import load_gltf
from warp_neumat.io.mesh_files import FRAME_SUFFIXES, checked_frames, load_mesh_frames
from warp_neumat.pipeline.scene import (
    NORMAL_MODES,
    Part,
    Scene,
    scene_from_document,
    scene_from_frames,
    unique_names,
)
from warp_neumat.pipeline.surface import Surface, degenerate_faces

GLTF_SUFFIXES = (".glb", ".gltf")
_KEPT_FRAMES = 4  # a renderer asks for one frame several times, but seldom for an old one
_BOUND_SAMPLES = 64


@dataclass(frozen=True)
class Frame:
    """One instant in world space, float32 and C-contiguous; shared and read-only, so copy what you want to change."""

    points: np.ndarray  # (V, 3)
    normals: np.ndarray  # (V, 3), unit
    tangents: np.ndarray  # (V, 4), unit xyz and handedness ±1


class MeshSequence:
    """A scene that moves over constant topology.

    Attributes:
        name: Stem of the file, or name of the folder.
        fps: Frames per second.
        frame_count: Frames in one pass, 1 for a static scene.
        animation: Name of the animation that plays, None where there is none.
        animation_names: Names of all animations in the file.
        faces: (F, 3) int32.
        uv: (V, 2) float32, rows are NaN where a part has none.
        face_mesh: (F,) int32, part of each face.
        mesh_names: One unique name per part.
        mesh_aliases: Per part all names that select it: its own, its node's, its mesh's and its material's.
        face_material: (F,) int32, index into ``material_names``.
        material_names: Names of the materials in use.
        face_double_sided: (F,) bool.
        degenerate_faces: Number of faces that repeat an index or have no area at rest.
        vertex_count: V.
    """

    def __init__(self, scene: Scene, *, fps: float):
        """Merge the parts of a scene; `load` and `from_arrays` are the usual ways in."""
        name, parts, rest = scene.name, scene.parts, scene.rest
        if not np.isfinite(fps) or fps <= 0.0:
            raise ValueError(f"{name}: fps must be a positive number, got {fps}")
        self.name, self.fps = name, float(fps)
        self.animation, self.animation_names = scene.animation, list(scene.animation_names)
        starts = np.cumsum([0] + [part.count for part in parts])
        self.vertex_count, self._rest, self._motion = int(starts[-1]), rest, scene.motion
        self.faces = _per_face(parts, lambda k, p: p.faces + np.int32(starts[k]), np.int32)
        self.uv = np.full((self.vertex_count, 2), np.nan, np.float32)
        for part, start in zip(parts, starts[:-1], strict=True):
            if part.uv is not None:
                known = np.isfinite(part.uv).all(axis=1, keepdims=True)
                self.uv[start : start + part.count] = np.where(known, part.uv, np.nan)
        self.mesh_names = unique_names([part.name for part in parts])
        own = zip(self.mesh_names, parts, strict=True)
        self.mesh_aliases = [tuple(dict.fromkeys((unique, *part.aliases))) for unique, part in own]
        self.material_names = list(dict.fromkeys(part.material for part in parts))
        order = {material: i for i, material in enumerate(self.material_names)}
        self.face_mesh = _per_face(parts, lambda k, p: np.full(len(p.faces), k), np.int32)
        self.face_material = _per_face(parts, lambda k, p: np.full(len(p.faces), order[p.material]), np.int32)
        self.face_double_sided = _per_face(parts, lambda k, p: np.full(len(p.faces), p.double_sided), bool)
        self.degenerate_faces = int(np.count_nonzero(degenerate_faces(rest, self.faces)))
        counts = [part.count for part in parts]
        self._surface = Surface(
            self.faces,
            self.uv,
            rest,
            np.repeat(np.array([part.source for part in parts], np.uint8), counts),
            np.repeat(np.array([part.tangents for part in parts], bool), counts),
            np.repeat(np.array([part.group for part in parts], np.int32), counts),
        )
        self._frames: dict[int, Frame] = {}
        self._bounds: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __repr__(self) -> str:
        return (
            f"MeshSequence({self.name!r}, {self.frame_count} frames, {len(self.mesh_names)} parts, "
            f"{self.vertex_count} vertices, {len(self.faces)} faces)"
        )

    @classmethod
    def load(
        cls,
        path,
        *,
        animation: str | None = None,
        fps: float | None = None,
        normals: str = "auto",
        double_sided: bool | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> MeshSequence:
        """Load a glTF scene, a mesh file, a folder of OBJ or PLY frames, or an ``.npz``.

        Args:
            path: ``.glb``, ``.gltf``, ``.obj``, ``.ply``, ``.npz`` (``points`` (T, V, 3) or (V, 3), ``faces``, optional
                ``uv``, ``normals``, ``fps``), or a folder of ``.obj`` or ``.ply`` frames in natural order.
            animation: Name of a glTF animation, any case; None plays the first one.
            fps: Frames per second; None means what the ``.npz`` says, else 30.
            normals: ``"auto"`` takes the file's normals, and where it has none computes flat ones for glTF (as its
                specification demands) and smooth ones else; ``"smooth"`` and ``"flat"`` compute them in any case.
                Flat normals split vertices, one per face corner.
            double_sided: Overrides the materials' own flag.
            progress: Called as ``progress(done, total)`` while the files of a folder are read.
        Raises: FileNotFoundError: If there is no such path, or a buffer of it is missing. ValueError: If the file is
            malformed, empty or not supported, has no animation of that name, or its topology changes.
        """
        path = Path(path)
        _check_mode(normals)
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        suffix = path.suffix.lower()
        if path.is_file() and suffix in GLTF_SUFFIXES:
            scene = scene_from_document(load_gltf(path), animation, normals, double_sided)
            return cls(scene, fps=30.0 if fps is None else fps)
        if path.is_file() and suffix not in (*FRAME_SUFFIXES, ".npz"):
            known = " ".join((*GLTF_SUFFIXES, *FRAME_SUFFIXES, ".npz"))
            raise ValueError(f"{path}: unknown suffix {suffix or '(none)'}; use {known} or a folder of frames")
        if animation is not None:
            raise ValueError(f"{path}: no animation named {animation!r}, such files have one nameless sequence")
        frames = load_mesh_frames(path, progress=progress)
        rate = fps if fps is not None else frames.fps if frames.fps is not None else 30.0
        return cls(scene_from_frames(frames, normals, bool(double_sided)), fps=rate)

    @classmethod
    def from_arrays(
        cls,
        points,
        faces,
        uv=None,
        *,
        vertex_normals=None,
        fps: float = 30.0,
        name: str = "mesh",
        normals: str = "auto",
        double_sided: bool = False,
        face_mesh=None,
        mesh_names: list[str] | None = None,
    ) -> MeshSequence:
        """Build a sequence from arrays.

        Args:
            points: (T, V, 3), or (V, 3) for a static mesh.
            faces: (F, 3) integers.
            uv: (V, 2) with its origin top left, or None.
            vertex_normals: Shape of ``points``, or None.
            fps: Frames per second.
            name: Name of the sequence, and of its part where there is one.
            normals: ``"auto"`` (the given ones, else smooth), ``"smooth"`` or ``"flat"``.
            double_sided: Whether faces are seen from both sides.
            face_mesh: (F,) part index of each face; None makes one part and keeps the vertices as they are;
                several parts share no vertices in the result, which are then sorted by part.
            mesh_names: One name per part of ``face_mesh``.
        Raises: ValueError: If a shape is wrong, a vertex is not finite or an index out of range.
        """
        _check_mode(normals)
        frames = checked_frames(name, points, faces, uv, vertex_normals, name=name)
        if face_mesh is not None:
            face_mesh = np.asarray(face_mesh, np.int32)
            names = mesh_names or [f"{name}_{k}" for k in range(int(face_mesh.max(initial=0)) + 1)]
            if face_mesh.shape != (len(frames.faces),) or face_mesh.min() < 0 or face_mesh.max() >= len(names):
                raise ValueError(f"{name}: face_mesh must be ({len(frames.faces)},) indices into {len(names)} names")
            frames = replace(frames, face_part=face_mesh, parts=[(n, "default") for n in names])
        return cls(scene_from_frames(frames, normals, double_sided), fps=fps)

    @property
    def frame_count(self) -> int:
        return self._motion.frame_count(self.fps)

    def frame(self, index: int) -> Frame:
        """Return points, normals and tangents of one frame.

        Args:
            index: Frame number. A glTF animation loops: the frame shows time (index / fps) mod duration. A static scene
                repeats.
        Returns: The frame; the last few are kept.
        Raises: IndexError: If a folder or array sequence has no such frame.
        """
        key = self._key(index)
        frame = self._frames.get(key)
        if frame is None:
            points, normals, tangents = self._motion.full(key, self.fps)
            frame = Frame(points, *self._surface.complete(points, normals, tangents))
            for array in vars(frame).values():
                array.flags.writeable = False
            self._frames = dict([*self._frames.items()][1 - _KEPT_FRAMES :]) | {key: frame}
        return frame

    def _key(self, index: int) -> int:
        key = self._motion.key(int(index), self.frame_count)
        if key is None:
            raise IndexError(
                f"{self.name}: frame {index} does not exist, there are {self.frame_count} (0 to {self.frame_count - 1})"
            )
        return key

    def select(self, pattern: str) -> np.ndarray:
        """Return the parts that one of their names selects.

        Args:
            pattern: A name or a glob such as ``"*Hose*"``; case does not matter.
        Returns: Part indices (P,) int32, ascending.
        Raises: ValueError: If nothing matches; the message lists the names.
        """
        glob = pattern.lower()
        hits = [
            k
            for k, names in enumerate(self.mesh_aliases)
            if any(fnmatch.fnmatchcase(n.lower(), glob) or n.lower() == glob for n in names)
        ]
        if not hits:
            known = ", ".join(dict.fromkeys(n for names in self.mesh_aliases for n in names))
            raise ValueError(f"{self.name}: no mesh or material matches {pattern!r}; there are {known}")
        return np.array(hits, np.int32)

    def bounds(self, frames=None) -> tuple[np.ndarray, np.ndarray]:
        """Return the box around the sequence, lowest and highest corner (3,) float32.

        Args:
            frames: Frame numbers to look at; None means all, or 64 evenly spaced ones of a longer sequence.
        """
        if frames is None:
            frames = np.unique(np.linspace(0, self.frame_count - 1, _BOUND_SAMPLES).round().astype(int))
        lows, highs = [], []
        for index in frames:
            key = self._key(index)
            if key not in self._bounds:
                points = self._motion.points(key, self.fps)
                self._bounds[key] = points.min(axis=0), points.max(axis=0)
            lows.append(self._bounds[key][0])
            highs.append(self._bounds[key][1])
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def outline(self, frames=None) -> np.ndarray:
        """Return vertices that span the sequence's outline from every side: extremes along 128 directions, per frame.

        Args:
            frames: Frame numbers to look at; None means all, or 64 evenly spaced ones of a longer sequence.
        Returns: Points (N, 3) float32.
        """
        if frames is None:
            frames = np.unique(np.linspace(0, self.frame_count - 1, _BOUND_SAMPLES).round().astype(int))
        # A Fibonacci lattice spreads the directions evenly.
        k = np.arange(128)
        z, turn = 1.0 - (2.0 * k + 1.0) / 128, k * np.pi * (3.0 - np.sqrt(5.0))
        radius = np.sqrt(1.0 - z * z)
        directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), z]).astype(np.float32)
        found = []
        for key in dict.fromkeys(self._key(index) for index in frames):
            points = self._motion.points(key, self.fps)
            found.append(points[np.unique((points @ directions).argmax(axis=0))])
        return np.concatenate(found)

    def digest(self) -> str:
        """Return a hash of faces, uv and rest points, 32 hexadecimal digits; the same for all animations of a file."""
        state = hashlib.blake2b(digest_size=16)
        for array in (self.faces, self.uv, self._rest):
            state.update(str((array.dtype.str, array.shape)).encode())
            state.update(np.ascontiguousarray(array).tobytes())
        return state.hexdigest()


def _per_face(parts: list[Part], value, dtype) -> np.ndarray:
    return np.ascontiguousarray(np.concatenate([value(k, part) for k, part in enumerate(parts)]), dtype)


def _check_mode(normals: str) -> None:
    if normals not in NORMAL_MODES:
        raise ValueError(f"normals must be one of {', '.join(NORMAL_MODES)}, got {normals!r}")
