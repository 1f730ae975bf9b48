"""The bundled demo: a procedural animation and two materials that ship with the package."""

from importlib import resources
from pathlib import Path

import numpy as np

from warp_neumat.pipeline.sequence import MeshSequence

FRAMES = 48
MATERIALS = {"knot": "bronze.neumat", "cloth": "lacquer.neumat"}
"""Part → bundled asset; both were fitted to analytic GGX functions by ``neumat fit`` (their headers say which)."""


def material_paths() -> dict[str, Path]:
    """Return the bundled materials by part name."""
    folder = resources.files("warp_neumat") / "assets"
    return {part: Path(str(folder / name)) for part, name in MATERIALS.items()}


def _grid_faces(rows: int, columns: int, row_stride: int) -> np.ndarray:
    """Return two triangles for each cell of a grid of vertices."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * row_stride + j).ravel()
    b, c, d = a + 1, a + row_stride, a + row_stride + 1
    return np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]).astype(np.int32)


def _knot(time: float, around: int = 360, across: int = 40):
    """Return a (2, 3) torus knot whose tube breathes: points [around + 1, across + 1, 3], seam vertices doubled."""
    t = np.linspace(0.0, 2.0 * np.pi, around + 1)[:, None]
    s = np.linspace(0.0, 2.0 * np.pi, across + 1)[None, :]

    def centre(t):
        r = 1.0 + 0.42 * np.cos(3.0 * t)
        return np.stack([r * np.cos(2.0 * t), 0.42 * np.sin(3.0 * t) + 0.15, r * np.sin(2.0 * t)], axis=-1)

    step = 1e-4
    tangent = centre(t + step) - centre(t - step)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    # The direction out of the torus' core varies smoothly along the knot and never runs along it.
    core = np.stack([np.cos(2.0 * t), np.zeros_like(t), np.sin(2.0 * t)], axis=-1)
    out = centre(t) - core * [1.0, 0.0, 1.0] - [0.0, 0.15, 0.0]
    normal = out - tangent * (out * tangent).sum(-1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    binormal = np.cross(tangent, normal)
    radius = 0.2 * (1.0 + 0.22 * np.sin(9.0 * t - 2.0 * np.pi * time))[..., None]
    ring = normal * np.cos(s)[..., None] + binormal * np.sin(s)[..., None]
    return centre(t) + radius * ring


def _cloth(time: float, cells: int = 120):
    """Return a waving square sheet, points [cells + 1, cells + 1, 3]."""
    v, u = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    phase = 2.0 * np.pi * time
    radius = np.sqrt(u * u + v * v)
    height = 0.11 * np.sin(6.0 * radius - phase) * np.exp(-0.6 * radius) + 0.05 * np.sin(4.0 * u + 3.0 * v + phase)
    return np.stack([1.9 * u, height - 0.95, 1.9 * v], axis=-1)


def sequence(frames: int = FRAMES) -> MeshSequence:
    """Return the demo's two-part animation: a breathing torus knot above a waving cloth, a seamless loop."""
    points, faces, uv, part = [], [], [], []
    for k, shape in enumerate((_knot, _cloth)):
        frames_of = np.stack([shape(frame / frames) for frame in range(frames)]).astype(np.float32)
        rows, columns = frames_of.shape[1] - 1, frames_of.shape[2] - 1
        v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
        faces.append(_grid_faces(rows, columns, columns + 1) + sum(len(c) for c in uv))
        part.append(np.full(len(faces[-1]), k, np.int32))
        points.append(frames_of.reshape(frames, -1, 3))
        uv.append(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32))
    return MeshSequence.from_arrays(
        np.concatenate(points, axis=1),
        np.concatenate(faces),
        np.concatenate(uv),
        fps=24.0,
        name="demo",
        double_sided=True,
        face_mesh=np.concatenate(part),
        mesh_names=list(MATERIALS),
    )
