"""A radiance texture: what one viewer shades of a sheet, and keeps until its policy wants it anew.

It knows nothing of pixels. Who reads it marks the texels in :attr:`RadianceTexture.shader` (``seen``) and counts its
pixels by tile in :attr:`RadianceTexture.schedule` (``pixels``); in between, a frame passes :meth:`arrives`,
:meth:`begin`, :meth:`plan`, :meth:`clear` and :meth:`shade`.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, worklist
from warp_neumat.materials.proxy import Proxy
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.clock import Clock
from warp_neumat.pipeline.lights import LightState
from warp_neumat.pipeline.look import Look
from warp_neumat.pipeline.policy import Policy
from warp_neumat.pipeline.schedule import Schedule
from warp_neumat.pipeline.surface_mesh import Facing
from warp_neumat.pipeline.texel_shader import TexelShader

CHART_COUNTS = ("charts", "seen", "resident", "streamed_in", "streamed_out", "coarser", "texels", "bytes")
"""What a frame's statistics say of a sheet that streams (``streaming.StreamingStats``)."""

_TEXELS = 4096  # per block


class RadianceTexture:
    """Shades a sheet as its policy plans.

    Args:
        look: What views have in common.
        sheet: A :class:`Sheet`, or another with its attributes.
        policy: When tiles are shaded anew.
        proxies: Of the materials, by index; None where neither policy nor carrying needs them.
        carried: Whether radiance is carried by them (``kernels/carry.py``).
        seed: Decides between equals.
        radiance: Texture to shade into (float16, flat RGBA); default: an own one.
    """

    def __init__(
        self,
        look: Look,
        sheet,
        policy: Policy,
        proxies: list[Proxy] | None,
        *,
        carried: bool = False,
        seed: int = 0,
        radiance: wp.array | None = None,
    ):
        self.sheet, self.policy, self.skips, self.device = sheet, policy, look.skips, look.mesh.device
        self.facing = Facing(look.mesh)
        self.shader = TexelShader(
            look.mesh,
            self.facing,
            look.materials,
            sheet.triangle,
            sheet.barycentric,
            sheet.material,
            look.light_capacity,
            sheet.least_lod,
            radiance=radiance,
            carried=proxies if carried else None,
            skip=look.skips.lights,
            gain=look.gain,
        )
        self.schedule = Schedule(
            sheet,
            self.shader,
            policy,
            proxies if policy.predicts else None,
            carried=carried,
            minified=look.skips.rate,
            smooth=look.skips.rate and policy.predicts,
            unchanged=look.skips.unchanged,
            gain=look.gain,
            seed=seed,
            picture=look.size[0] * look.size[1],
        )
        self._mark_all = dispatch.Job(
            worklist.mark_facing_kernel,
            dispatch.blocks(sheet.side**2, _TEXELS),
            inputs=[
                *[sheet.triangle.flatten(), sheet.material, self.facing.side, self.facing.on_screen],
                *[int(not look.skips.backfacing), int(not look.skips.offscreen), sheet.side, sheet.side**2],
                *[self.shader.rate, self.shader.columns, _TEXELS],
            ],
            outputs=[self.shader.seen],
            device=self.device,
            grain=2,
        )
        self.restart()

    def restart(self) -> None:
        """Make the next frame start a new epoch, and forget everything, as for the first one."""
        self.shader.blank()
        self.shader.tile_seen.zero_()  # by which the schedule plans
        self.schedule.reset()
        self._since = 0
        self._epoch: tuple | None = None  # what the running epoch shows
        self._last: tuple | None = None
        self._still = False

    def begins_epoch(self) -> bool:
        """Return whether the next frame takes pose, viewer and lights as they are then."""
        return self._since == 0 or self.policy.begins_epoch(self._since)

    def arrives(self, camera: Camera, lights: LightState, pose: int) -> bool:
        """Take note of the frame to be made; return whether it may differ from the last one.

        Args:
            camera, lights: The present ones.
            pose: Number that says which pose the mesh shows: equal numbers, equal poses.
        """
        self._begins, holds = self.begins_epoch(), self.policy.holds_pose
        self._since += 1
        self._present = (pose, camera.view.tobytes(), camera.fov_y, *(a.tobytes() for a in lights))
        self._moved = self._present != self._last
        self._renews = self._begins and (self._present != self._epoch or not self.skips.unchanged)
        return not self._still or self._moved or not self.skips.unchanged or (holds and self._renews)

    def begin(self, camera: Camera, lights: LightState) -> None:
        """See the frame as it arrived, or as the epoch holds it."""
        self._last = self._present
        if self.follows:
            self.facing.update(camera)
            self.shader.begin(camera, lights)
        self.forgot = self._renews and (self.policy.holds_pose or not self.policy.keeps)
        if self.forgot:
            self.shader.forget()
        if self._begins:
            self._epoch = self._present

    @property
    def follows(self) -> bool:
        """Whether the frame that arrived is shaded as of itself, not as of an earlier one."""
        return self._begins or not self.policy.holds_pose

    def plan(self) -> None:
        """Decide which tiles are due."""
        self.schedule.plan(self._moved)

    def clear(self) -> None:
        """Take nothing as seen, or all that the skips do not leave out."""
        self.shader.seen.zero_()
        self.schedule.pixels.zero_()
        if not self.skips.occluded and self.follows:
            self._mark_all.run()

    def shade(self, clock: Clock) -> None:
        """Shade what is seen, and due or not shaded yet."""
        self._counts = self.shader.list()
        clock.stage("list")
        before = clock.ms.get("shade", 0.0)
        self._shaded = self.shader.shade()
        clock.stage("shade")
        self.schedule.learn(self._shaded.evaluations, self._counts.shaded, clock.ms["shade"] - before)
        clock.stage("schedule")
        self._still = not self._counts.shaded and not self._moved and not self.schedule.pending

    def void(self, rectangles) -> None:
        """Forget what was shaded in ``rectangles`` (x, y, width, height) [texel] of the sheet."""
        side = self.sheet.side
        for target, blank in ((self.shader.done, 0), (self.shader.radiance, (0, 0, 0, -1))):
            grid = target.numpy().reshape(side, side, -1)
            for x, y, width, height in rectangles:
                grid[y : y + height, x : x + width] = blank
            if not self.device.is_cpu:
                target.assign(grid.ravel())
        self.schedule.void(rectangles)

    def statistics(self) -> dict:
        """Return what the frame took and left out."""
        sheet, side, counts = self.sheet, self.facing.side.numpy() != 0, self._counts
        facing = int(sheet.face_texels[side].sum())
        on_screen = int(sheet.face_texels[side & (self.facing.on_screen.numpy() != 0)].sum())
        tile_seen, rate = self.shader.tile_seen.numpy(), self.shader.rate.numpy()
        coarse = np.flatnonzero(rate)
        between = int((tile_seen[coarse].astype(np.int64) * ((1 << 2 * rate[coarse].astype(np.int64)) - 1)).sum())
        skipped = {
            "unowned": sheet.side**2 - sheet.owned,
            "backfacing": sheet.owned - facing,
            "offscreen": facing - on_screen,
            "occluded": max(0, on_screen - counts.seen - between),
            "rate": between,
            "unchanged": self.schedule.unchanged_texels,
            **light_skips(self._shaded),
        }
        texels = {"owned": sheet.owned, "facing": facing, "seen": counts.seen, "shaded": counts.shaded}
        result = {"texels": texels, "evaluations": self._shaded.evaluations, "skipped": skipped}
        if sheet.stats is not None:
            result["charts"] = {k: getattr(sheet.stats, k) for k in CHART_COUNTS}
        return {**result, "updated": self._begins}


def light_skips(shaded) -> dict:
    """Return the pairs of texel and light that were skipped, of a :class:`ShadeCounts`."""
    return {"range": shaded.range, "spot": shaded.spot, "horizon": shaded.horizon}


def unshaded(last: dict) -> dict:
    """Return the statistics of a frame that is the one of ``last`` over again."""
    texels = {**last["texels"], "shaded": 0}
    skipped = {**dict.fromkeys(last["skipped"], 0), "unchanged": texels["seen"]}
    last = {name: value for name, value in last.items() if name != "probe"}
    return {**last, "texels": texels, "skipped": skipped, "evaluations": 0, "updated": False}
