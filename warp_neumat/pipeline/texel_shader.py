"""Shades the listed quads of a sample image: the work list, and one shading job per material."""

import dataclasses

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.shade import Lights, Surface, Viewer, make_shade_kernel, words
from warp_neumat.kernels.worklist import list_kernel
from warp_neumat.materials.base import Material, Shader
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.surface_mesh import SurfaceMesh


@dataclasses.dataclass(frozen=True)
class ListCounts:
    """What a work list holds: texels that will be read, and texels to be shaded."""

    seen: int
    shaded: int


class TexelShader:
    """Work list and shading for one sample image of ``width`` × ``height`` texels.

    All buffers are allocated here, once. An epoch begins with :meth:`begin`; each of its frames writes :attr:`seen`,
    and calls :meth:`list` and :meth:`shade`.

    Args:
        mesh: The mesh the samples lie on.
        materials: Materials by index.
        triangle: Triangle of each texel, −1 = none, int32, shape (height, width), on the device.
        barycentric: Weights of the second and third vertex, float32, shape (height, width, 2).
        texel_material: Material index + 1 of each texel, 0 = none, uint8, flat.
        light_capacity: Most lights that will shine.
        least_lod: Mip level of one texel on each triangle, float32, shape (F,), where a texel is more than a point;
            read for textured materials only.
    """

    def __init__(
        self,
        mesh: SurfaceMesh,
        materials: list[Material],
        triangle: wp.array,
        barycentric: wp.array,
        texel_material: wp.array,
        light_capacity: int,
        least_lod: np.ndarray | None = None,
    ):
        self.height, self.width = triangle.shape
        self.device, self.materials = mesh.device, materials
        columns, self.rows = -(-self.width // 2), -(-self.height // 2)
        kinds = len(materials)

        def zeros(count, dtype):
            return wp.zeros(count, dtype=dtype, device=self.device)

        texels = self.width * self.height
        self.seen = zeros(texels, wp.uint8)
        self.radiance = zeros(4 * texels, wp.float16)
        self._done = zeros(texels, wp.uint8)
        self._cursor = zeros(kinds * self.rows, wp.int32)
        self._seen_count, self._shaded_count = zeros(self.rows, wp.int32), zeros(self.rows, wp.int32)
        # A quad whose four texels have different materials is listed under each.
        self._quads = zeros(columns * self.rows * min(4, kinds), wp.int32)
        common = [self.seen, texel_material, self.width, self.height, self.rows, 0, self._done]
        common += [self._cursor, self._seen_count, self._shaded_count, self._quads]
        self._list_job = dispatch.Job(list_kernel, self.rows, common, device=self.device, grain=16)

        surface = Surface()
        surface.width = self.width
        surface.triangle, surface.barycentric = triangle.flatten(), barycentric.flatten()
        surface.faces, surface.side = mesh.faces, mesh.side
        surface.points, surface.normals = mesh.points.flatten(), mesh.normals.flatten()
        surface.tangents = mesh.tangents.flatten()
        if mesh.uv_gradient is not None:
            surface.uv, surface.uv_gradient = mesh.uv.flatten(), mesh.uv_gradient
            if least_lod is None:
                least_lod = np.full(mesh.face_count, NO_LOD, np.float32)
            surface.least_lod = wp.array(least_lod, dtype=wp.float32, device=self.device)
        self._keep = (triangle, barycentric, texel_material, surface)

        self._lights = Lights()
        self._lights.count = 0
        self._lights.position = zeros(3 * light_capacity, wp.float32)
        self._lights.intensity = zeros(3 * light_capacity, wp.float32)
        self._capacity = light_capacity

        self._lanes = dispatch.lanes(self.device)
        shaders = _shared([material.shader() for material in materials])
        blocks = dispatch.blocks(4 * self._quads.shape[0], self._lanes) + 1
        self._evaluations = zeros(blocks, wp.int32)
        most = max(words(s.layout, self._lanes, s.texels is not None) for s in shaders)
        self._scratch_words = most if self._lanes > 1 else 0
        self._workers = dispatch.worker_count()
        self._scratch = zeros(max(1, self._workers * self._scratch_words), wp.float32)
        self._jobs = [
            dispatch.Job(
                make_shade_kernel(s.functions, s.layout, self._lanes, s.texels is not None),
                1,
                inputs=[s.arguments, self._quads, 1, surface, self._lights, Viewer(), self._scratch],
                outputs=[self.radiance, self._evaluations],
                device=self.device,
                grain=1,
            )
            for s in shaders
        ]
        self._segments: list[tuple[int, int]] = [(0, 0)] * kinds

    def share_seen(self, seen: wp.array) -> None:
        """Read ``seen``, flat uint8, in place of the own :attr:`seen`."""
        self.seen = seen
        self._list_job.set(0, seen)

    def begin(self, camera: Camera, position: np.ndarray, intensity: np.ndarray) -> None:
        """Begin an epoch: nothing is shaded yet, and viewer and lights are these until the next one.

        Args:
            camera: The viewer, whose pixels are the footprints that textures are filtered for.
            position: Positions of the lights, shape (L, 3).
            intensity: Radiant intensities [W/sr], shape (L, 3).
        """
        count = len(position)
        if count > self._capacity:
            raise ValueError(f"at most {self._capacity} lights were announced, got {count}")
        for target, values in ((self._lights.position, position), (self._lights.intensity, intensity)):
            padded = np.zeros(3 * self._capacity, np.float32)
            padded[: 3 * count] = np.asarray(values, np.float32).ravel()
            target.assign(padded)
        self._lights.count = count
        viewer = Viewer()
        viewer.eye = wp.vec3(*map(float, camera.eye))
        viewer.forward, viewer.right, viewer.down = (wp.vec3(*map(float, v)) for v in camera.pixel_steps())
        for job in self._jobs:
            job.set(4, self._lights)
            job.set(5, viewer)
        self._done.zero_()

    def list(self) -> ListCounts:
        """Compact the quads with texels that are seen and not shaded in this epoch, sorted by material."""
        self._list_job.set(5, 0)
        self._cursor.zero_()
        self._list_job.run()
        counts = self._cursor.numpy()  # [material][row]; on the CPU a view
        ends = np.cumsum(counts, dtype=np.int64)
        starts = ends - counts
        totals = counts.reshape(len(self.materials), self.rows).sum(axis=1)
        self._segments = [(int(s), int(n)) for s, n in zip(starts[:: self.rows], totals, strict=True)]
        if self.device.is_cpu:
            counts[...] = starts
        else:
            self._cursor.assign(starts.astype(np.int32))
        self._list_job.set(5, 1)
        self._list_job.run()
        return ListCounts(int(self._seen_count.numpy().sum()), int(self._shaded_count.numpy().sum()))

    def shade(self) -> int:
        """Shade the listed texels into :attr:`radiance`; return the number of material evaluations."""
        if dispatch.worker_count() > self._workers:
            self._workers = dispatch.worker_count()
            self._scratch = wp.zeros(self._workers * self._scratch_words, dtype=wp.float32, device=self.device)
            for job in self._jobs:
                job.set(6, self._scratch)
        evaluations = 0
        for job, (start, quads) in zip(self._jobs, self._segments, strict=True):
            if quads == 0:
                continue
            listed = wp.array(ptr=self._quads.ptr + 4 * start, shape=(quads,), dtype=wp.int32, device=self.device)
            job.set(1, listed)
            job.set(2, quads)
            blocks = dispatch.blocks(4 * quads, self._lanes)
            job.run(blocks)
            evaluations += int(self._evaluations[:blocks].numpy().sum(dtype=np.int64))
        return evaluations


def _shared(shaders: list[Shader]) -> list[Shader]:
    """Return ``shaders`` where those of one layout have their buffers in common, if their kind knows how."""
    groups: dict = {}
    for k, shader in enumerate(shaders):
        if shader.share is not None:
            groups.setdefault((shader.share, shader.layout), []).append(k)
    result = list(shaders)
    for (share, layout), members in groups.items():
        for k, arguments in zip(members, share(layout, [shaders[k].arguments for k in members]), strict=True):
            result[k] = dataclasses.replace(shaders[k], arguments=arguments)
    return result
