"""Shades the listed quads of a sample image: the work list, and one shading job per material."""

import dataclasses
from collections.abc import Iterable

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.carry import EPSILON
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.shade import (
    COUNTERS,
    LIGHT_SKIPS,
    Surface,
    Viewer,
    assign_lights,
    make_lights,
    make_shade_kernel,
    words,
)
from warp_neumat.kernels.tiles import tile_count
from warp_neumat.kernels.worklist import list_kernel
from warp_neumat.materials.base import Material, Shader
from warp_neumat.materials.proxy import Proxy, proxy_colors
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.lights import LightState
from warp_neumat.pipeline.surface_mesh import Facing, SurfaceMesh


@dataclasses.dataclass(frozen=True)
class ListCounts:
    """What a work list holds: texels that will be read, and texels to be shaded."""

    seen: int
    shaded: int


@dataclasses.dataclass(frozen=True)
class ShadeCounts:
    """Evaluations of materials, and the texel × light pairs that were skipped: out of range, of the cone, unlit."""

    evaluations: int
    range: int
    spot: int
    horizon: int


class TexelShader:
    """Work list and shading for one sample image of ``width`` × ``height`` texels.

    All buffers are allocated here, once. Each frame says from where it is seen (:meth:`begin`), writes :attr:`seen`,
    and calls :meth:`list` and :meth:`shade`. A texel that was shaded is left out until its tile is due or
    :meth:`forget` is called.

    Args:
        mesh: The mesh the samples lie on.
        facing: Which of its triangles the viewer sees.
        materials: Materials by index.
        triangle: Triangle of each texel, −1 = none, int32, shape (height, width), on the device.
        barycentric: Weights of the second and third vertex, float32, shape (height, width, 2).
        texel_material: Material index + 1 of each texel, 0 = none, uint8, flat.
        light_capacity: Most lights that will shine.
        least_lod: Mip level of one texel on each triangle, float32, shape (F,), on the device, where a texel is more
            than a point; read for textured materials only.
        radiance: Texture to shade into, float16, flat RGBA; default: an own one.
        carried: Proxies of the materials where the texture shall hold ratios to them (``kernels/carry.py``).
        skip: Light skips in force, of ``kernels.shade.LIGHT_SKIPS``.
        gain: What radiance is multiplied by before it is shown, which changes are measured with.

    Attributes:
        seen: Texels that the picture will read, uint8, flat.
        done: Texels that are shaded, likewise.
        rate, due: Rate of each tile, and whether all that is seen of it is shaded anew; uint8, flat.
        tile_seen, tile_shaded: Texels of each tile that were read and listed in this frame, uint8, flat.
    """

    def __init__(
        self,
        mesh: SurfaceMesh,
        facing: Facing,
        materials: list[Material],
        triangle: wp.array,
        barycentric: wp.array,
        texel_material: wp.array,
        light_capacity: int,
        least_lod: wp.array | None = None,
        *,
        radiance: wp.array | None = None,
        carried: list[Proxy] | None = None,
        skip: Iterable[str] = LIGHT_SKIPS,
        gain: float = 1.0,
    ):
        self.height, self.width = triangle.shape
        self.device, self.materials = mesh.device, materials
        self.columns, self.rows = tile_count(self.width, self.height)
        self.tiles = self.columns * self.rows
        kinds = len(materials)

        def zeros(count, dtype):
            return wp.zeros(count, dtype=dtype, device=self.device)

        texels = self.width * self.height
        self.seen, self.done = zeros(texels, wp.uint8), zeros(texels, wp.uint8)
        self.rate, self.due = zeros(self.tiles, wp.uint8), zeros(self.tiles, wp.uint8)
        self.tile_seen, self.tile_shaded = zeros(self.tiles, wp.uint8), zeros(self.tiles, wp.uint8)
        self.radiance = blank_radiance(texels, self.device) if radiance is None else radiance
        self._cursor = zeros(kinds * self.rows, wp.int32)
        self._seen_count, self._shaded_count = zeros(self.rows, wp.int32), zeros(self.rows, wp.int32)
        # A quad whose four texels have different materials is listed under each; a tile of a coarse rate may list
        # texels between its anchors besides, but never more quads than it has.
        self._quads = zeros(16 * self.tiles * min(4, kinds), wp.int32)
        common = [self.seen, texel_material, self.rate, self.due, self.width, self.height, self.rows, 0, self.done]
        common += [self._cursor, self._seen_count, self._shaded_count, self.tile_seen, self.tile_shaded, self._quads]
        # A chunk costs some 25 µs to launch, so there are few.
        self._list_job = dispatch.Job(
            list_kernel, self.rows, common, device=self.device, grain=max(4, dispatch.blocks(self.rows, 8))
        )

        self.surface = Surface()
        self.surface.width = self.width
        self.surface.triangle, self.surface.barycentric = triangle.flatten(), barycentric.flatten()
        self.surface.faces, self.surface.side = mesh.faces, facing.side
        self.surface.points, self.surface.normals = mesh.points.flatten(), mesh.normals.flatten()
        self.surface.tangents = mesh.tangents.flatten()
        if mesh.uv is not None:
            self.surface.uv, self.surface.uv_gradient = mesh.uv.flatten(), facing.uv_gradient
            if least_lod is None:
                least_lod = wp.full(mesh.face_count, NO_LOD, dtype=wp.float32, device=self.device)
            self.surface.least_lod = least_lod
        self._keep = (triangle, barycentric, texel_material, self.surface)

        self.lights, self.viewer = make_lights(light_capacity, self.device), Viewer()
        self._lanes = dispatch.lanes(self.device)
        shaders = _shared([material.shader() for material in materials])
        blocks = dispatch.blocks(4 * self._quads.shape[0], self._lanes) + 1
        self._counts = zeros(COUNTERS * blocks, wp.int32)
        most = max(words(s.layout, self._lanes, s.texels is not None) for s in shaders)
        self._scratch_words = most if self._lanes > 1 else 0
        self._workers = dispatch.worker_count()
        self._scratch = zeros(max(1, self._workers * self._scratch_words), wp.float32)
        bits = sum(1 << k for k, name in enumerate(LIGHT_SKIPS) if name in skip)
        self._jobs = []
        for k, s in enumerate(shaders):
            inputs = [s.arguments, self._quads, 1, self.surface, self.lights, self.viewer, self._scratch, bits, gain]
            inputs.append(proxy_colors(carried[k] if carried else None, EPSILON / gain))
            kernel = make_shade_kernel(s.functions, s.layout, self._lanes, s.texels is not None)
            outputs = [self.radiance, self._counts]
            self._jobs.append(dispatch.Job(kernel, 1, inputs=inputs, outputs=outputs, device=self.device, grain=1))
        self._segments: list[tuple[int, int]] = [(0, 0)] * kinds

    def share_seen(self, seen: wp.array) -> None:
        """Read ``seen``, flat uint8, in place of the own :attr:`seen`."""
        self.seen = seen
        self._list_job.set(0, seen)

    def begin(self, camera: Camera, lights: LightState) -> None:
        """Shade from here on as seen by ``camera``, whose pixels are the footprints that textures are filtered for.

        Raises: ValueError: If there are more lights than were announced.
        """
        assign_lights(self.lights, lights)
        viewer = self.viewer
        viewer.eye = wp.vec3(*map(float, camera.eye))
        viewer.forward, viewer.right, viewer.down = (wp.vec3(*map(float, v)) for v in camera.pixel_steps())
        for job in self._jobs:
            job.set(4, self.lights)
            job.set(5, viewer)

    def forget(self) -> None:
        """Take nothing as shaded."""
        self.done.zero_()

    def blank(self) -> None:
        """Take nothing as ever shaded: what the next shading changes is not known."""
        self.forget()
        self.radiance.assign(blank_radiance(self.width * self.height, self.device))

    def list(self) -> ListCounts:
        """Compact the quads with texels that are seen, and due or not shaded yet, sorted by material."""
        self._list_job.set(7, 0)
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
        self._list_job.set(7, 1)
        self._list_job.run()
        return ListCounts(int(self._seen_count.numpy().sum()), int(self._shaded_count.numpy().sum()))

    def shade(self) -> ShadeCounts:
        """Shade the listed texels into :attr:`radiance`; return what that took and what it left out."""
        if dispatch.worker_count() > self._workers:
            self._workers = dispatch.worker_count()
            self._scratch = wp.zeros(self._workers * self._scratch_words, dtype=wp.float32, device=self.device)
            for job in self._jobs:
                job.set(6, self._scratch)
        total = np.zeros(COUNTERS, np.int64)
        for job, (start, quads) in zip(self._jobs, self._segments, strict=True):
            if quads == 0:
                continue
            listed = wp.array(ptr=self._quads.ptr + 4 * start, shape=(quads,), dtype=wp.int32, device=self.device)
            job.set(1, listed)
            job.set(2, quads)
            blocks = dispatch.blocks(4 * quads, self._lanes)
            job.run(blocks)
            total += self._counts[: COUNTERS * blocks].numpy().reshape(-1, COUNTERS).sum(axis=0, dtype=np.int64)
        return ShadeCounts(*(int(n) for n in total))


def blank_radiance(texels: int, device) -> wp.array:
    """Return a radiance texture of black texels that were never shaded, float16, flat RGBA."""
    blank = np.zeros((texels, 4), np.float16)
    blank[:, 3] = -1.0
    return wp.array(blank.ravel(), dtype=wp.float16, device=device)


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
