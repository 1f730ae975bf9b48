"""A mesh sequence on a device: topology once, the points that are shown, and the pose that is shaded."""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, worklist
from warp_neumat.kernels.arrays import write
from warp_neumat.kernels.lod import uv_gradient_kernel
from warp_neumat.materials.base import Material, load
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.sequence import MeshSequence

_FACES_PER_BLOCK = 4096


def open_materials(assignments: dict, *, device=None) -> dict[str, Material]:
    """Return ``assignments`` (name or glob → :class:`Material` or path) with each asset opened, once."""
    opened: dict[str, Material] = {}
    for value in assignments.values():
        if not isinstance(value, Material) and str(value) not in opened:
            opened[str(value)] = load(value, device=device)
    return {k: v if isinstance(v, Material) else opened[str(v)] for k, v in assignments.items()}


def bind_materials(sequence: MeshSequence, assignments: dict[str, Material]) -> tuple[list[Material], np.ndarray]:
    """Return the materials in use and the index of each face's.

    Args:
        sequence: Whose parts are named.
        assignments: Name or glob of meshes, nodes or materials → material; a later entry wins over an earlier one.

    Returns: Materials, and (F,) int32.
    Raises:
        ValueError: If a name matches nothing, a part is left without material, or there are more than 254 materials.
    """
    listed = list(dict.fromkeys(assignments.values()))
    chosen = np.full(len(sequence.mesh_names), -1, np.int32)
    for pattern, material in assignments.items():
        chosen[sequence.select(pattern)] = listed.index(material)
    if (chosen < 0).any():
        missing = ", ".join(repr(sequence.mesh_names[k]) for k in np.flatnonzero(chosen < 0)[:8])
        raise ValueError(f"{sequence.name}: no material for {missing}; name one, or cover the rest with '*'")
    used = np.unique(chosen)
    if len(used) > 254:
        raise ValueError(f"{sequence.name}: at most 254 materials can be in use, got {len(used)}; merge some")
    return [listed[k] for k in used], np.searchsorted(used, chosen)[sequence.face_mesh].astype(np.int32)


def map_sizes(sequence: MeshSequence, face_material: np.ndarray, materials: list[Material]) -> np.ndarray | None:
    """Return width and height [texel] of the maps on each face, (F, 2) float32, 0 where it has none; None = no maps.

    Raises: ValueError: If a face with maps has no texture coordinates.
    """
    sizes = [material.shader().texels for material in materials]
    if not any(sizes):
        return None
    known = np.isfinite(sequence.uv).all(axis=1)[sequence.faces].all(axis=1)
    lost = np.flatnonzero(~known & np.array([size is not None for size in sizes])[face_material])
    if len(lost):
        part, material = sequence.mesh_names[sequence.face_mesh[lost[0]]], materials[face_material[lost[0]]]
        raise ValueError(
            f"{sequence.name}: {part!r} has no texture coordinates on {len(lost)} faces, which the maps of "
            f"{material.name!r} need; unwrap it, or name a material without maps"
        )
    return np.array([size or (0, 0) for size in sizes], np.float32)[face_material]


class SurfaceMesh:
    """Device arrays of a sequence, updated in place.

    :attr:`shown` are the points the camera sees; :attr:`points`, :attr:`normals` and :attr:`tangents` are the pose that
    is shaded, which may stay as it is while radiance is reused.

    Args:
        sequence: The mesh sequence.
        face_material: Material index of each face, shape (F,).
        map_size: Of :func:`map_sizes`; None leaves :attr:`uv` out.
        device: Warp device.
    """

    def __init__(
        self, sequence: MeshSequence, face_material: np.ndarray, map_size: np.ndarray | None = None, *, device=None
    ):
        self.sequence, self.device = sequence, wp.get_device(device)
        count, faces = sequence.vertex_count, len(sequence.faces)
        self.face_count = faces

        def array(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self.faces = wp.array(sequence.faces.ravel(), dtype=wp.int32, device=self.device)
        self.face_material = wp.array(face_material, dtype=wp.int32, device=self.device)
        self.shown = array((count, 3), wp.float32)
        self.points, self.normals = array((count, 3), wp.float32), array((count, 3), wp.float32)
        self.tangents = array((count, 4), wp.float32)
        self.double_sided = sequence.face_double_sided
        self._frame = self._shaded = None
        self.uv = self.map_size = None
        if map_size is not None:
            self.uv = wp.array(np.nan_to_num(sequence.uv), dtype=wp.float32, device=self.device)
            self.map_size = wp.array(map_size.ravel(), dtype=wp.float32, device=self.device)

    def show(self, index: int) -> bool:
        """Move what the camera sees to frame ``index``; return whether that is another pose."""
        frame = self.sequence.frame(index)
        if frame is self._frame:
            return False
        write(self.shown, frame.points)
        self._frame = frame
        return True

    def freeze(self) -> None:
        """Take the shown frame as the pose that is shaded."""
        if self._frame is not self._shaded:
            for name in ("points", "normals", "tangents"):
                write(getattr(self, name), getattr(self._frame, name))
            self._shaded = self._frame


class Facing:
    """What of a mesh's shaded pose one eye may see.

    Attributes:
        side: Which side of each triangle it sees, int8: 1 front, −1 back of a double-sided one, 0 neither.
        on_screen: Whether any of it may be in view, uint8.
        uv_gradient: Of ``kernels.lod.uv_gradient_kernel``, for triangles that face it; None without textured materials.
    """

    def __init__(self, mesh: SurfaceMesh):
        count, device = mesh.face_count, mesh.device
        self.side = wp.zeros(count, dtype=wp.int8, device=device)
        self.on_screen = wp.zeros(count, dtype=wp.uint8, device=device)
        double = wp.array(mesh.double_sided.astype(np.uint8), dtype=wp.uint8, device=device)
        blocks, points = dispatch.blocks(count, _FACES_PER_BLOCK), mesh.points.flatten()
        self._facing = dispatch.Job(
            worklist.facing_kernel,
            blocks,
            inputs=[mesh.faces, count, double, points, wp.vec3(), wp.mat44(), _FACES_PER_BLOCK],
            outputs=[self.side, self.on_screen],
            device=device,
        )
        self.uv_gradient = None
        if mesh.uv is not None:
            self.uv_gradient = wp.zeros(6 * count, dtype=wp.float32, device=device)
            inputs = [mesh.faces, count, mesh.map_size, mesh.uv.flatten(), points, self.side, _FACES_PER_BLOCK]
            outputs = [self.uv_gradient]
            self._gradient = dispatch.Job(uv_gradient_kernel, blocks, inputs=inputs, outputs=outputs, device=device)

    def update(self, camera: Camera) -> None:
        """See the pose that is shaded through ``camera``."""
        self._facing.set(4, wp.vec3(*(float(c) for c in camera.eye)))
        self._facing.set(5, wp.mat44(camera.clip()))
        self._facing.run()
        if self.uv_gradient is not None:
            self._gradient.run()
