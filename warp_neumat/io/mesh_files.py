"""Mesh frames from OBJ and PLY files, folders of them, and ``.npz``: all become one `MeshFrames`.

uv comes back with its origin top left; OBJ and PLY store it bottom left, so v becomes 1 − v, while an ``.npz`` is taken
as it is. OBJ is read here and not by trimesh, which drops the normal indices that line the frames of a sequence up,
reorders quads and reports a bad index without its place; PLY is read by trimesh.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

FRAME_SUFFIXES = (".obj", ".ply")


@dataclass(frozen=True)
class MeshFrames:
    """Frames of one topology: every vertex has one position, normal and uv."""

    name: str
    points: np.ndarray  # (T, V, 3) float32
    faces: np.ndarray  # (F, 3) int32
    uv: np.ndarray | None  # (V, 2) float32, NaN where a vertex has none
    normals: np.ndarray | None  # (T, V, 3) float32
    face_part: np.ndarray  # (F,) int32, index into parts
    parts: list[tuple[str, str]]  # (part name, material name)
    fps: float | None = None


def load_mesh_frames(path, *, progress: Callable[[int, int], None] | None = None) -> MeshFrames:
    """Read a ``.obj``, ``.ply`` or ``.npz`` file, or a folder of OBJ or PLY frames in natural order.

    Args:
        path: A file, or a folder whose ``.obj`` or ``.ply`` files are the frames (``f2`` comes before ``f10``).
        progress: Called as ``progress(done, total)`` after each file of a folder.
    Returns: All frames, in memory.
    Raises: FileNotFoundError: If there is no such path. ValueError: If a file is malformed or empty, holds NaN or Inf
        vertices or a face index out of range, or changes the topology.
    """
    path = Path(path)
    if path.is_dir():
        return _load_folder(path, progress)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.suffix.lower() == ".npz":
        return _load_npz(path)
    corner, frame = _first_frame(path)
    return _assemble(path.stem, corner, [frame])


# ---- polygon soup: the corners of one file


@dataclass
class _Polygons:
    """Triangulated faces of one file with separate index triples (position, uv, normal), −1 where there is none."""

    path: Path
    points: np.ndarray  # (N, 3) float32
    uv: np.ndarray  # (N', 2) float32
    normals: np.ndarray  # (N'', 3) float32
    corners: np.ndarray  # (F, 3, 3) int64: face, corner, (v, vt, vn)
    face_part: np.ndarray  # (F,) int32
    parts: list[tuple[str, str]]
    frame: int = 0
    lines: list[int] = field(default_factory=list)  # line of each face in a text file, for messages

    def check(self) -> _Polygons:
        if not len(self.points) or not len(self.corners):
            raise ValueError(f"{self.path}: empty mesh, {len(self.points)} vertices and {len(self.corners)} faces")
        _check_finite(self.points, self.path, self.frame)
        for k, (kind, count) in enumerate(
            [("vertex", len(self.points)), ("uv", len(self.uv)), ("normal", len(self.normals))]
        ):
            index = self.corners[:, :, k]
            low = 0 if kind == "vertex" else -1
            bad = ((index < low) | (index >= count)).any(axis=1)
            if bad.any():
                face = int(np.argmax(bad))
                value = next(i for i in index[face] if not low <= i < count)
                where = f" (line {self.lines[face]})" if self.lines else ""
                raise ValueError(
                    f"{self.path}: face {face}{where} has {kind} index {value} counted from 0, but there are {count}"
                )
        return self


def _check_finite(points: np.ndarray, path: Path, frame: int) -> None:
    bad = int(np.count_nonzero(~np.isfinite(points).all(axis=-1)))
    if bad:
        raise ValueError(f"{path}: frame {frame} has {bad} NaN or Inf vertices of {len(points)}")


def _read_polygons(path: Path, frame: int) -> _Polygons:
    polygons = _read_obj(path) if path.suffix.lower() == ".obj" else _read_ply(path)
    polygons.frame = frame
    return polygons.check()


def _read_obj(path: Path) -> _Polygons:
    """Read positions, uv, normals and faces of a Wavefront OBJ; polygons become fans."""
    rows: dict[str, list] = {"v": [], "vt": [], "vn": []}
    widths = {"v": 3, "vt": 2, "vn": 3}
    tokens: dict[str, tuple[int, int, int]] = {}
    corners, face_part, lines = [], [], []
    parts: dict[tuple[str, str], int] = {}
    group, material = path.stem, "default"
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        key, _, rest = line.strip().partition(" ")
        try:
            if key in rows:
                rows[key].append([float(x) for x in rest.split()[: widths[key]]])
                if len(rows[key][-1]) < widths[key]:
                    raise ValueError("too few numbers")
            elif key == "f":
                ring = [tokens.get(token) or _corner(token, rows, tokens) for token in rest.split()]
                if len(ring) < 3:
                    raise ValueError("a face needs three corners")
                part = parts.setdefault((group, material), len(parts))
                for k in range(1, len(ring) - 1):
                    corners.append((ring[0], ring[k], ring[k + 1]))
                    face_part.append(part)
                    lines.append(number)
            elif key in ("o", "g"):
                group = rest.split("#")[0].strip() or path.stem
            elif key == "usemtl":
                material = rest.strip() or "default"
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: cannot read {line.strip()[:60]!r} ({error})") from None
    return _Polygons(
        path,
        np.array(rows["v"], np.float32).reshape(-1, 3),
        np.array(rows["vt"], np.float32).reshape(-1, 2),
        np.array(rows["vn"], np.float32).reshape(-1, 3),
        np.array(corners, np.int64).reshape(-1, 3, 3),
        np.array(face_part, np.int32),
        list(parts),
        lines=lines,
    )


def _corner(token: str, rows: dict[str, list], tokens: dict) -> tuple[int, int, int]:
    """Turn ``v/vt/vn`` (counted from 1, or backwards from −1) into indices from 0, −1 where one is left out."""
    fields = (token.split("/") + ["", ""])[:3]
    triple = []
    for key, text in zip(("v", "vt", "vn"), fields, strict=True):
        index = int(text) if text else 0
        if text and not index:
            raise ValueError("indices count from 1")
        back = len(rows[key]) + index
        triple.append(index - 1 if index > 0 else -1 if not text else back if back >= 0 else -2)
    if "-" not in token:  # a relative index means another vertex further down
        tokens[token] = tuple(triple)
    return tuple(triple)


def _read_ply(path: Path) -> _Polygons:
    """Read positions, faces, normals and uv (per vertex, or per corner as ``texcoord``) of a PLY."""
    import trimesh

    try:
        with path.open("rb") as file:  # fix_texture would renumber the vertices
            mesh = trimesh.load(file, file_type="ply", process=False, fix_texture=False)
        if not isinstance(mesh, trimesh.Trimesh):
            raise ValueError("it holds no faces")
        points, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int64).reshape(-1, 3)
        raw = mesh.metadata["_ply_raw"]
        uv = _columns(raw, ("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
        normals = _columns(raw, ("nx", "ny", "nz"))
        wedge = _wedge_uv(raw, len(faces))
    except Exception as error:  # trimesh raises whatever the broken bytes lead it into
        if "out of bounds for axis" in str(error):
            raise ValueError(f"{path}: a face has a vertex index out of range ({error})") from None
        raise ValueError(f"{path}: not a readable PLY mesh ({type(error).__name__}: {error})") from None
    corners = np.stack([faces, faces if len(uv) else faces * 0 - 1, faces if len(normals) else faces * 0 - 1], axis=2)
    if wedge is not None:
        uv, index = np.unique(wedge.reshape(-1, 2), axis=0, return_inverse=True)
        corners[:, :, 1] = index.reshape(-1, 3)
    face_part = np.zeros(len(faces), np.int32)
    return _Polygons(path, points, uv, normals, corners, face_part, [(path.stem, "default")])


def _columns(raw: dict, *options: tuple[str, ...]) -> np.ndarray:
    """Return the vertex properties of the first option that the file has, (V, n) or (0, n)."""
    data = raw["vertex"]["data"]
    for option in options:
        if all(name in raw["vertex"]["properties"] for name in option):
            return np.stack([np.asarray(data[name], np.float32).reshape(-1) for name in option], axis=1)
    return np.zeros((0, len(options[0])), np.float32)


def _wedge_uv(raw: dict, face_count: int) -> np.ndarray | None:
    """Return uv per face corner (F, 6), or None where faces carry none."""
    if "texcoord" not in raw["face"]["properties"]:
        return None
    uv = raw["face"]["data"]["texcoord"]
    uv = np.asarray(uv["f1"] if getattr(uv, "dtype", None) is not None and uv.dtype.names else uv, np.float32)
    if uv.shape != (face_count, 6):
        raise ValueError("its polygons carry uv per corner; triangulate the mesh first")
    return uv


# ---- frames of one topology


def _first_frame(path: Path) -> tuple[_Corners, tuple[np.ndarray, np.ndarray | None]]:
    corners = _Corners(_read_polygons(path, 0))
    return corners, corners.gather(corners.first)


class _Corners:
    """Splits the corners of the first file into vertices, and picks the same corners out of the later ones."""

    def __init__(self, first: _Polygons):
        self.first = first
        flat = first.corners.reshape(-1, 3)
        pair = flat[:, 0] * (len(first.uv) + 1) + flat[:, 1] + 1  # one integer sorts far faster than rows do
        pair = np.unique(pair, return_inverse=True)[1]
        triple = pair * (len(first.normals) + 1) + flat[:, 2] + 1
        _, self.pick, vertex = np.unique(triple, return_index=True, return_inverse=True)
        self.faces = np.ascontiguousarray(vertex.reshape(-1, 3), np.int32)
        vt = flat[self.pick, 1]
        self.uv = None
        if (vt >= 0).any():
            uv = np.where(vt[:, None] >= 0, first.uv[np.maximum(vt, 0)], np.float32(np.nan))
            self.uv = np.stack([uv[:, 0], np.float32(1) - uv[:, 1]], axis=1)
        self.has_normals = bool((flat[:, 2] >= 0).any())

    def gather(self, polygons: _Polygons) -> tuple[np.ndarray, np.ndarray | None]:
        """Return one file's positions (V, 3) and normals (V, 3), zero where a corner has none."""
        self._check_topology(polygons)
        v, _, vn = polygons.corners.reshape(-1, 3)[self.pick].T
        normals = None
        if self.has_normals:
            source = polygons.normals if len(polygons.normals) else np.zeros((1, 3), np.float32)
            normals = np.where(vn[:, None] >= 0, source[np.maximum(vn, 0)], np.float32(0))
        return polygons.points[v], normals

    def _check_topology(self, other: _Polygons) -> None:
        a, b = self.first, other
        if len(a.points) != len(b.points):
            change = f"{len(b.points)} vertices instead of {len(a.points)}"
        elif len(a.corners) != len(b.corners):
            change = f"{len(b.corners)} faces instead of {len(a.corners)}"
        elif (a.corners[:, :, 0] != b.corners[:, :, 0]).any():
            change = f"other corners at face {int(np.argmax((a.corners != b.corners)[:, :, 0].any(axis=1)))}"
        else:
            return
        raise ValueError(f"{b.path}: the topology changes, it has {change} as in {a.path}")


def _assemble(name: str, corners: _Corners, frames: list) -> MeshFrames:
    normals = np.stack([n for _, n in frames]) if corners.has_normals else None
    first = corners.first
    points = np.stack([p for p, _ in frames])
    return MeshFrames(name, points, corners.faces, corners.uv, normals, first.face_part, first.parts)


def _natural(path: Path) -> list:
    return [(0, int(s), "") if s.isdigit() else (1, 0, s) for s in re.split(r"([0-9]+)", path.name.lower()) if s]


def _load_folder(folder: Path, progress: Callable[[int, int], None] | None) -> MeshFrames:
    files = [p for p in folder.iterdir() if p.suffix.lower() in FRAME_SUFFIXES and p.is_file()]
    files = sorted(files, key=_natural)
    if not files:
        raise ValueError(f"{folder}: no .obj or .ply frames in this folder")
    kinds = {p.suffix.lower() for p in files}
    if len(kinds) > 1:
        raise ValueError(f"{folder}: mixes .obj and .ply frames; keep one kind in the folder")
    corners, frame = _first_frame(files[0])
    frames = [frame]
    for k, file in enumerate(files):
        if k > 0:
            frames.append(corners.gather(_read_polygons(file, k)))
        if progress:
            progress(k + 1, len(files))
    return _assemble(folder.resolve().name, corners, frames)


# ---- npz


def _load_npz(path: Path) -> MeshFrames:
    """Read ``points`` (T, V, 3) or (V, 3), ``faces`` (F, 3) and optional ``uv``, ``normals`` and ``fps``."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, AttributeError) as error:
        raise ValueError(f"{path}: not a readable .npz archive ({error})") from None
    for key in ("points", "faces"):
        if key not in arrays:
            raise ValueError(f"{path}: array {key!r} is missing; it holds {', '.join(sorted(arrays)) or 'nothing'}")
    fps = arrays.get("fps")
    frames = checked_frames(
        path, arrays["points"], arrays["faces"], arrays.get("uv"), arrays.get("normals"), name=path.stem
    )
    return frames if fps is None else replace(frames, fps=float(np.asarray(fps).reshape(-1)[0]))


def checked_frames(source, points, faces, uv, normals, *, name: str) -> MeshFrames:
    """Check arrays in memory and return them as `MeshFrames`; ``source`` names them in messages.

    Args:
        source: A path or a word such as ``"points"``.
        points: (T, V, 3), or (V, 3) for one frame.
        faces: (F, 3) integers.
        uv: (V, 2) with its origin top left, or None.
        normals: Shape of ``points``, or None.
        name: Name of the sequence and of its only part.
    Raises: ValueError: If a shape is wrong, a vertex is not finite or a face index is out of range.
    """
    points = np.asarray(points, np.float32)
    points = points[None] if points.ndim == 2 else points
    faces = np.asarray(faces)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"{source}: points must have shape (T, V, 3) or (V, 3), got {points.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{source}: faces must be integers of shape (F, 3), got {faces.dtype} {faces.shape}")
    count = points.shape[1]
    if 0 in points.shape or not len(faces):
        raise ValueError(f"{source}: empty mesh, {len(points)} frames, {count} vertices and {len(faces)} faces")
    for t, frame in enumerate(points):
        _check_finite(frame, source, t)
    bad = ((faces < 0) | (faces >= count)).any(axis=1)
    if bad.any():
        face = int(np.argmax(bad))
        value = next(int(i) for i in faces[face] if not 0 <= i < count)
        raise ValueError(f"{source}: face {face} has vertex index {value} counted from 0, but there are {count}")
    if uv is not None:
        uv = np.ascontiguousarray(uv, np.float32)
        if uv.shape != (count, 2):
            raise ValueError(f"{source}: uv must have shape ({count}, 2), got {uv.shape}")
    if normals is not None:
        normals = np.ascontiguousarray(normals, np.float32)
        normals = normals[None] if normals.ndim == 2 else normals
        if normals.shape != points.shape:
            raise ValueError(f"{source}: normals must have shape {points.shape}, got {normals.shape}")
    points, faces = np.ascontiguousarray(points), np.ascontiguousarray(faces, np.int32)
    return MeshFrames(name, points, faces, uv, normals, np.zeros(len(faces), np.int32), [(name, "default")])
