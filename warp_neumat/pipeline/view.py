"""One eye's picture: its camera raster, the sample image it shades, and the picture that is gathered from it.

A :class:`ScreenView` shades the camera raster itself, every pixel of every frame: the reference. A
:class:`TextureView` shades a sheet in texture space, as its policy plans, and reads the picture from there.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import carry, dispatch, gather, worklist
from warp_neumat.kernels.visibility import CameraRaster
from warp_neumat.materials.proxy import Proxy
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.clock import Clock
from warp_neumat.pipeline.lights import LightState
from warp_neumat.pipeline.look import Look
from warp_neumat.pipeline.policy import Adaptive, Policy
from warp_neumat.pipeline.probe import Probe
from warp_neumat.pipeline.surface_mesh import Facing
from warp_neumat.pipeline.texel_shader import TexelShader
from warp_neumat.pipeline.texture import RadianceTexture, light_skips, unshaded

_PIXELS = 4096  # per block of the per-pixel kernels


class _View:
    """Raster and picture; what samples are shaded is the subclasses' matter."""

    def __init__(self, look: Look):
        self.look, self.mesh, self.device = look, look.mesh, look.mesh.device
        self.width, self.height = look.size
        sequence = look.mesh.sequence
        self.raster = CameraRaster(
            sequence.faces,
            sequence.vertex_count,
            self.width,
            self.height,
            double_sided=sequence.face_double_sided,
            device=self.device,
        )
        self._image = wp.zeros((self.height, self.width, 3), dtype=wp.float32, device=self.device)
        self._triangle, self._barycentric = self.raster.triangle.flatten(), self.raster.barycentric.flatten()

    @property
    def image(self) -> np.ndarray:
        """The picture, read-only; the next frame overwrites it."""
        image = self._image.numpy()
        image.flags.writeable = False  # blocks that stay empty are not written again
        return image

    def _job(self, kernel, count, inputs, outputs, per_block=_PIXELS, slots=None):
        blocks = dispatch.blocks(count, per_block)
        options = {"device": self.device, "grain": max(2, dispatch.blocks(blocks, 8)), "slots": slots}
        return dispatch.Job(kernel, blocks, inputs=inputs, outputs=outputs, **options)

    def _blank(self, per_block=_PIXELS) -> wp.array:
        blocks = dispatch.blocks(self.width * self.height, per_block)
        return wp.zeros(blocks, dtype=wp.uint8, device=self.device)


class ScreenView(_View):
    """Shades every pixel that shows the mesh."""

    def __init__(self, look: Look):
        super().__init__(look)
        self.facing = Facing(look.mesh)
        pixels = self.width * self.height
        material = wp.zeros(pixels, dtype=wp.uint8, device=self.device)
        self.shader = TexelShader(
            self.mesh,
            self.facing,
            look.materials,
            self.raster.triangle,
            self.raster.barycentric,
            material,
            look.light_capacity,
            skip=look.skips.lights,
            gain=look.gain,
        )
        inputs = [self._triangle, pixels, _PIXELS, self.mesh.face_material]
        self._mark = self._job(worklist.pixel_material_kernel, pixels, inputs, [material])
        self.shader.share_seen(material)
        inputs = [self._triangle, pixels, _PIXELS, self.shader.radiance, look.background]
        self._show = self._job(gather.resolve_kernel, pixels, inputs, [self._blank(), self._image.flatten()])

    def render(self, camera: Camera, lights: LightState, clock: Clock) -> dict:
        """Make the picture of the pose that the mesh shows and has frozen; return its statistics."""
        self.facing.update(camera)
        self.shader.begin(camera, lights)
        self.shader.forget()
        clock.stage("pose")
        self.raster.run(self.mesh.shown, camera.clip())
        clock.stage("visibility")
        self._mark.run()
        clock.stage("mark")
        counts = self.shader.list()
        clock.stage("list")
        shaded = self.shader.shade()
        clock.stage("shade")
        self._show.run()
        clock.stage("gather")
        texels = {"owned": counts.seen, "facing": counts.seen, "seen": counts.seen, "shaded": counts.shaded}
        return {"texels": texels, "evaluations": shaded.evaluations, "skipped": light_skips(shaded), "updated": True}


class TextureView(_View):
    """Reads its picture from a radiance texture.

    Args:
        look: What views have in common.
        sheet: A :class:`Sheet`, or another with its attributes.
        policy: When tiles are shaded anew.
        proxies: Of the materials, by index; None where neither policy nor carrying needs them.
        carried: Whether radiance is carried by them (``kernels/carry.py``).
        seed: Decides between equals.

    Attributes:
        texture: What is shaded.
        probe: Measures error for a policy that holds a target; None for others.
    """

    def __init__(
        self, look: Look, sheet, policy: Policy, proxies: list[Proxy] | None, *, carried: bool = False, seed: int = 0
    ):
        super().__init__(look)
        self.sheet, self.policy = sheet, policy
        self.texture = RadianceTexture(look, sheet, policy, proxies, carried=carried, seed=seed)
        self.shader, self.schedule, self.facing = self.texture.shader, self.texture.schedule, self.texture.facing
        pixels, side = self.width * self.height, sheet.side
        shader, raster = self.shader, [self._triangle, self._barycentric, pixels]
        self._mark = self._job(
            worklist.mark_seen_kernel,
            pixels,
            [*raster, _PIXELS, sheet.corner_uv, side, side, shader.rate, shader.columns, shader.tiles],
            [shader.seen, self.schedule.pixels],
            slots=self.schedule.slots,
        )
        texture = [sheet.corner_uv, shader.radiance, side, side, shader.rate, shader.columns, look.background]
        if carried:
            lanes = dispatch.lanes(self.device)
            table = np.array([p.color_terms for p in proxies], np.float32).ravel()
            words = self.schedule.slots * carry.gather_words(lanes) if lanes > 1 else 1
            self._show = self._job(
                carry.make_gather_kernel(lanes),
                pixels,
                [
                    *[*raster, *texture, shader.surface, self.mesh.face_material],
                    *[wp.array(table, dtype=wp.float32, device=self.device), carry.EPSILON / look.gain, shader.lights],
                    *[wp.vec3(), wp.zeros(words, dtype=wp.float32, device=self.device)],
                ],
                [self._blank(lanes), self._image.flatten()],
                lanes,
                self.schedule.slots,
            )
        else:
            outputs = [self._blank(), self._image.flatten()]
            self._show = self._job(gather.gather_kernel, pixels, [*raster, _PIXELS, *texture], outputs)
        self._carried = carried
        self._statistics: dict = {}
        self.probe = None
        if isinstance(policy, Adaptive) and policy.target is not None:
            self.probe = Probe(look, self.raster, self.facing, self.schedule, policy.target, seed)

    def restart(self) -> None:
        """Make the next frame start a new epoch, as the first one does."""
        self.sheet.restart()
        self.texture.restart()
        if self.probe is not None:
            self.probe.reset()

    def begins_epoch(self) -> bool:
        """Return whether the next frame takes pose, viewer and lights as they are then."""
        return self.texture.begins_epoch()

    def render(self, camera: Camera, lights: LightState, pose: int, clock: Clock) -> dict:
        """Make the picture of the pose that the mesh shows; return its statistics.

        Args:
            camera, lights: The present ones.
            pose: Number that says which pose the mesh shows: equal numbers, equal poses.
            clock: Times the stages.
        """
        texture = self.texture
        if not texture.arrives(camera, lights, pose):
            self._statistics = unshaded(self._statistics)
            return self._statistics
        texture.begin(camera, lights)
        clock.stage("pose")
        texture.plan()
        clock.stage("schedule")
        self.see(camera, clock)
        changed = self.sheet.update(self.raster)
        if changed:
            texture.void(changed)
        clock.stage("stream")
        self.mark(clock)
        texture.shade(clock)
        self.show(clock)
        self._statistics = texture.statistics()
        if self.probe is not None:
            spent = self.probe.run(self.image, self.sheet.corner_uv.numpy(), camera, lights)
            self._statistics["evaluations"] += spent
            self._statistics["probe"] = spent
            clock.stage("probe")
        return self._statistics

    def see(self, camera: Camera, clock: Clock) -> None:
        """Find what is visible."""
        self.raster.run(self.mesh.shown, camera.clip())
        clock.stage("visibility")

    def mark(self, clock: Clock) -> None:
        """Mark the texels that the picture will read."""
        self.texture.clear()
        self._mark.run()
        clock.stage("mark")

    def show(self, clock: Clock) -> None:
        """Make the picture from the texture."""
        if self._carried:
            self._show.set(14, self.shader.lights)
            self._show.set(15, self.shader.viewer.eye)
        self._show.run()
        clock.stage("gather")
