"""Renders mesh sequences with fitted materials, shading in texture space and reusing it over frames (MobileVR §4.2).

A frame passes the stages ``pose`` (animation and upload), ``visibility`` (camera raster), ``mark`` (which texels the
picture will read), ``list`` (compaction into 2×2 quads by material), ``shade``, and ``gather`` (the picture from the
radiance texture). With interval N, every (N + 1)th frame starts a new epoch: it freezes pose, viewer and lights, and
all that is seen from then on is shaded as of that frame, when it is first seen. So the radiance texture is the
paper's, evaluated lazily: what comes into view within an epoch is neither a hole nor newer than its neighbours.

In screen space, the same shading kernel runs on the camera raster itself, every pixel of every frame: the reference.
"""

import dataclasses
import operator
import time
from collections.abc import Iterable, Iterator

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, gather, worklist
from warp_neumat.kernels.lod import atlas_lod
from warp_neumat.kernels.visibility import CameraRaster
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import CameraPath, load_camera
from warp_neumat.pipeline.lights import PointLights, lights_from
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.surface_mesh import SurfaceMesh, bind_materials, map_sizes, open_materials
from warp_neumat.pipeline.texel_shader import TexelShader

SKIPS = ("unowned", "backfacing", "unseen")
"""Texels that are not shaded: of no chart, of triangles that face away, and those the picture does not read."""

SIDE_MAX = 16384
"""Largest side of a picture or an atlas [px]: a quad's word holds 13 bits for its column and 13 for its row."""

_PIXELS = 4096  # per block of the per-pixel kernels


@dataclasses.dataclass(frozen=True)
class RenderedFrame:
    """One picture and what it took.

    Attributes:
        index: Frame number in the sequence.
        image: Linear Rec. 709 radiance, shape (H, W, 3), float32, row 0 on top.
        stats: ``ms`` per stage, ``texels`` (owned; facing the viewer of the last update, or two-sided; seen; shaded),
            ``evaluations`` (material × light), ``updated`` (whether the frame started a new epoch).
    """

    index: int
    image: np.ndarray
    stats: dict


class _Clock:
    """Adds up milliseconds per stage."""

    def __init__(self, device):
        self.ms, self._device, self._last = {}, device, time.perf_counter()

    def stage(self, name: str) -> None:
        """End the stage ``name``."""
        if not self._device.is_cpu:
            wp.synchronize_device(self._device)
        now = time.perf_counter()
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now


class Renderer:
    """Renders frames of a mesh sequence.

    Args:
        sequence: The mesh sequence, or its path.
        materials: Name or glob of meshes, nodes or materials → :class:`Material` or path of an asset.
        space: ``"texture"`` shades the atlas and reuses it; ``"screen"`` shades every pixel of every frame.
        atlas: The atlas, or its resolution [texel]; unused in screen space.
        size: (width, height) of the pictures [px].
        camera: A camera path, ``"orbit"``, or the path of a camera file.
        lights: The lights, a number of default ones, or the path of a lights file.
        frame_count: Length of the shot, which orbits and default paths are spread over; default: the sequence's.
        interval: Frames that reuse the shading of the one before them; 0 shades every frame.
        skip: Which of :data:`SKIPS` are in force. They nest: what is unseen includes what faces away and what no chart
            owns, so switching off an inner one shows only where the outer ones are off too.
        background: Radiance where nothing is seen, 3 values.
        device: Warp device.
        progress: Passed to :meth:`Atlas.build`.

    Raises:
        ValueError, OSError, FormatError: As the parts it is made of; each message is one line.
    """

    def __init__(
        self,
        sequence,
        materials: dict,
        *,
        space: str = "texture",
        atlas: Atlas | int = 1200,
        size: tuple[int, int] = (1280, 720),
        camera: CameraPath | str = "orbit",
        lights: PointLights | int | str = 3,
        frame_count: int | None = None,
        interval: int = 4,
        skip: Iterable[str] = SKIPS,
        background=(0.0, 0.0, 0.0),
        device=None,
        progress=None,
    ):
        if space not in ("texture", "screen"):
            raise ValueError(f'space must be "texture" or "screen", got {space!r}')
        try:
            self.interval = operator.index(interval)
        except TypeError:
            self.interval = -1
        if self.interval < 0:
            raise ValueError(f"interval must be a whole number of frames, 0 or more, got {interval!r}")
        if not all(1 <= side <= SIDE_MAX for side in size):
            raise ValueError(f"size must be 1 to {SIDE_MAX} pixels each way, got {size[0]}x{size[1]}")
        self.skip = frozenset(skip)
        if self.skip - set(SKIPS):
            raise ValueError(f"skip must be among {', '.join(SKIPS)}, got {', '.join(sorted(self.skip - set(SKIPS)))}")
        self.device, self.space = wp.get_device(device), space
        self.sequence = sequence if isinstance(sequence, MeshSequence) else MeshSequence.load(sequence)
        self.assigned = open_materials(materials, device=self.device)
        self.materials, face_material = bind_materials(self.sequence, self.assigned)
        self.width, self.height = int(size[0]), int(size[1])
        frame_count = frame_count or self.sequence.frame_count
        lo, hi = self.sequence.bounds()
        if not isinstance(camera, CameraPath):
            picture = {"width": self.width, "height": self.height, "outline": self.sequence.outline()}
            camera = load_camera(camera, lo, hi, frame_count, **picture)
        first = camera.at(0)
        if (first.width, first.height) != (self.width, self.height):
            raise ValueError(
                f"camera must be made for {self.width}x{self.height} pixels, got {first.width}x{first.height}"
            )
        self.camera = camera
        self.lights = lights if isinstance(lights, PointLights) else lights_from(lights, lo, hi, frame_count)
        self.background = wp.vec3(*(float(c) for c in background))

        self._map_size = map_sizes(self.sequence, face_material, self.materials)
        self.mesh = SurfaceMesh(self.sequence, face_material, self._map_size, device=self.device)
        self.raster = CameraRaster(
            self.sequence.faces,
            self.sequence.vertex_count,
            self.width,
            self.height,
            double_sided=self.sequence.face_double_sided,
            device=self.device,
        )
        pixels = self.width * self.height
        self._image = wp.zeros((self.height, self.width, 3), dtype=wp.float32, device=self.device)
        blank = wp.zeros(dispatch.blocks(pixels, _PIXELS), dtype=wp.uint8, device=self.device)
        pixel_triangle, pixel_barycentric = self.raster.triangle.flatten(), self.raster.barycentric.flatten()

        def job(kernel, count, inputs, outputs):
            return dispatch.Job(
                kernel, dispatch.blocks(count, _PIXELS), inputs=inputs, outputs=outputs, device=self.device, grain=2
            )

        if space == "screen":
            self.atlas = None
            material = wp.zeros(pixels, dtype=wp.uint8, device=self.device)
            self.shader = self._shader(self.raster.triangle, self.raster.barycentric, material)
            self._mark = job(
                worklist.pixel_material_kernel,
                pixels,
                [pixel_triangle, pixels, _PIXELS, self.mesh.face_material],
                [material],
            )
            self.shader.share_seen(material)
            self._show = job(
                gather.resolve_kernel,
                pixels,
                [pixel_triangle, pixels, _PIXELS, self.shader.radiance, self.background],
                [blank, self._image.flatten()],
            )
        else:
            if not isinstance(atlas, Atlas):
                atlas = Atlas.build(self.sequence, atlas, progress=progress, device=self.device)
            if len(atlas.corner_uv) != len(self.sequence.faces):
                raise ValueError(
                    f"atlas must be built for this sequence of {len(self.sequence.faces)} faces, "
                    f"got one of {len(atlas.corner_uv)}; use Atlas.build"
                )
            self.atlas = atlas
            side = atlas.resolution
            owned = atlas.triangle >= 0
            material = np.where(owned, face_material[np.maximum(atlas.triangle, 0)] + 1, 0)
            if "unowned" not in self.skip:
                material[~owned] = 1
            self._face_texels = np.bincount(atlas.triangle[owned], minlength=len(self.sequence.faces))
            self._owned = int(owned.sum())
            triangle = wp.array(atlas.triangle, dtype=wp.int32, device=self.device)
            material = wp.array(material.ravel(), dtype=wp.uint8, device=self.device)
            corner_uv = wp.array(atlas.corner_uv.ravel(), dtype=wp.float32, device=self.device)
            barycentric = wp.array(atlas.barycentric, dtype=wp.float32, device=self.device)
            self.shader = self._shader(triangle, barycentric, material, atlas)
            pixel = [pixel_triangle, pixel_barycentric, pixels, _PIXELS, corner_uv]
            self._mark = job(worklist.mark_seen_kernel, pixels, [*pixel, side, side], [self.shader.seen])
            self._mark_all = job(
                worklist.mark_facing_kernel,
                side * side,
                [
                    triangle.flatten(),
                    material,
                    self.mesh.side,
                    int("backfacing" not in self.skip),
                    side * side,
                    _PIXELS,
                ],
                [self.shader.seen],
            )
            self._show = job(
                gather.gather_kernel,
                pixels,
                [*pixel, self.shader.radiance, side, side, self.background],
                [blank, self._image.flatten()],
            )
        self._since = 0

    def _shader(self, triangle, barycentric, material, atlas: Atlas | None = None) -> TexelShader:
        lod = None
        if atlas is not None and self._map_size is not None:
            lod = atlas_lod(atlas.corner_uv, self.sequence.uv, self.sequence.faces, self._map_size)
        return TexelShader(self.mesh, self.materials, triangle, barycentric, material, len(self.lights), lod)

    def per_pixel(self) -> "Renderer":
        """Return a renderer of the same shot that shades every pixel of every frame: the reference for this one."""
        return Renderer(
            self.sequence,
            self.assigned,
            space="screen",
            size=(self.width, self.height),
            camera=self.camera,
            lights=self.lights,
            background=self.background,
            device=self.device,
        )

    def render(self, frames: Iterable[int] | None = None) -> Iterator[RenderedFrame]:
        """Yield the pictures of ``frames`` (default: the whole sequence), in order.

        The first frame, and then every (interval + 1)th, shades anew all that it sees.
        """
        self.restart()
        for index in range(self.sequence.frame_count) if frames is None else frames:
            frame = self.frame(index)
            yield dataclasses.replace(frame, image=frame.image.copy())

    def restart(self) -> None:
        """Make the next frame start a new epoch, as the first one does."""
        self._since = 0

    def frame(self, index: int) -> RenderedFrame:
        """Render frame ``index`` as the next picture.

        Its image is read-only and is overwritten by the next frame; :meth:`render` hands out copies.
        """
        clock = _Clock(self.device)
        camera = self.camera.at(index)
        position, intensity = self.lights.at(index)
        self.mesh.show(index)
        updated = self.space == "screen" or self._since == 0
        if updated:
            self.mesh.freeze(camera.eye)
            self.shader.begin(camera, position, intensity)
        self._since = 0 if self._since == self.interval else self._since + 1
        clock.stage("pose")
        self.raster.run(self.mesh.shown, camera.clip())
        clock.stage("visibility")
        if self.space == "texture":
            self.shader.seen.zero_()
            if "unseen" not in self.skip and updated:
                self._mark_all.run()
        self._mark.run()
        clock.stage("mark")
        counts = self.shader.list()
        clock.stage("list")
        evaluations = self.shader.shade()
        clock.stage("shade")
        self._show.run()
        image = self._image.numpy()
        image.flags.writeable = False  # blocks that stay empty are not written again
        clock.stage("gather")
        texels = {"seen": counts.seen, "shaded": counts.shaded}
        if self.space == "texture":
            facing = int(self._face_texels[self.mesh.side.numpy() != 0].sum())
            texels = {"owned": self._owned, "facing": facing, **texels}
        else:
            texels = {"owned": counts.seen, "facing": counts.seen, **texels}
        return RenderedFrame(
            index, image, {"ms": clock.ms, "texels": texels, "evaluations": evaluations, "updated": bool(updated)}
        )
