"""Two eyes: a picture for each, with what they have in common shaded once where that is wanted.

The eyes stand half the eye distance to the left and to the right of the path's camera, along its right axis, and look
the same way as it does: parallel, with the same symmetric frustum. What is at infinity has no parallax then. (Eyes that
converge on a screen at finite distance differ from that by a horizontal shift of each picture and are not needed to
judge shading.)

Each eye has a radiance texture of its own. With a *tolerance*, a tile whose proxies differ by less than it between the
eyes, in √Y of what a display shows (``materials/proxy.py``), is *shared*: it is shaded once, for a viewer midway, and
both eyes read that. Either eye is then off by half the difference or so. Where textures hold ratios to the proxies
(``kernels/carry.py``), each eye's pixels get the proxy for their own viewer, and what sharing loses is only what that
does not follow, which counts as :data:`FOLLOWED` of the difference.

One texel speaks for a tile in each of its quadrants; the largest of their differences counts, because highlights are
small. A tile that a picture has read is judged every frame, of the others a part in turn. A shared tile stays so up to
the tolerance, one that is not becomes it below :data:`RETURN` of that. A tile that changes sides is shaded anew at
once, as if it came into view.

Shared tiles have a schedule of their own, so there are three with sharing and two without. A budget holds for all of
them together: without sharing each eye has half; with it each has a part as large as its part of what was seen. A
target for FLIP each eye holds by itself, and none is held with sharing, whose error it does not know of.
"""

import copy

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, stereo
from warp_neumat.kernels.arrays import write
from warp_neumat.kernels.tiles import TILE
from warp_neumat.materials.proxy import Proxy
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.clock import Clock
from warp_neumat.pipeline.lights import LightState
from warp_neumat.pipeline.look import Look
from warp_neumat.pipeline.policy import Policy
from warp_neumat.pipeline.sheet import samples
from warp_neumat.pipeline.texture import RadianceTexture, unshaded
from warp_neumat.pipeline.view import ScreenView, TextureView

EYE_SHARE = 1.0 / 30.0
"""Default eye distance, as a share of the distance from the camera to the scene's centre: a stereographer's rule."""

RETURN = 2.0 / 3.0
"""Share of the tolerance below which a tile is shared again."""

FOLLOWED = 0.5
"""What of a proxy's difference counts where radiance is carried by proxies: what they are presumed not to follow."""

_PER_BLOCK = 64  # tiles
_TURNS = 16  # frames in which the tiles that were not read are judged once


def eye_distance_of(distance: float | None, camera: Camera, centre: np.ndarray, radius: float) -> float:
    """Return the eye distance [scene unit]: ``distance``, or by default :data:`EYE_SHARE` of that to the scene.

    Args:
        distance: What was asked for, or None.
        camera: Of the shot's first frame.
        centre, radius: Sphere around the scene, all frames.

    Raises: ValueError: If it is not positive and finite.
    """
    if distance is None:
        return EYE_SHARE * max(float(np.linalg.norm(camera.eye - centre)), radius)
    if not 0 < distance < float("inf"):
        raise ValueError(f"eye distance must be a positive number of scene units, got {distance!r}")
    return float(distance)


class StereoView:
    """Two views that share nothing but the mesh.

    Args:
        left, right: The views, of one kind.
        offset: Half the eye distance [scene unit].
    """

    def __init__(self, left, right, offset: float):
        self.left, self.right, self.offset = left, right, offset

    @property
    def image(self) -> np.ndarray:
        """The left eye's picture, read-only; the next frame overwrites it."""
        return self.left.image

    def restart(self) -> None:
        """Make the next frame start a new epoch, as the first one does."""
        self.left.restart()
        self.right.restart()

    def begins_epoch(self) -> bool:
        """Return whether the next frame takes pose, viewers and lights as they are then."""
        return self.left.begins_epoch()

    def cameras(self, camera: Camera) -> tuple[Camera, Camera]:
        """Return the eyes' cameras, left and right."""
        return camera.moved(-self.offset), camera.moved(self.offset)

    def render(self, camera: Camera, lights: LightState, *rest) -> dict:
        """Make both pictures; return their statistics: the sums, and each eye's own in ``eyes``.

        Args:
            camera: Midway between the eyes.
            lights: The present ones.
            rest: What else the views take.
        """
        left, right = self.cameras(camera)
        eyes = [self.left.render(left, lights, *rest), self.right.render(right, lights, *rest)]
        return {**total(eyes), "eyes": eyes}


class SharedStereoView(StereoView):
    """Two texture views of one sheet that share the tiles in which they agree.

    Args:
        look: What views have in common.
        sheet: What is shaded, by all.
        policy: When tiles are shaded anew.
        proxies: Of the materials, by index.
        offset: Half the eye distance [scene unit].
        tolerance: Difference [√Y] up to which tiles are shared.
        carried: Whether radiance is carried by the proxies.
        seed: Decides between equals.

    Attributes:
        middle: The shared tiles' texture. It lies in the left eye's; the right eye's receives copies.
        shared: Which tiles are shared, uint8, flat, numpy.
    """

    def __init__(
        self,
        look: Look,
        sheet,
        policy: Policy,
        proxies: list[Proxy],
        offset: float,
        tolerance: float,
        *,
        carried: bool = False,
        seed: int = 0,
    ):
        known = proxies if carried or policy.predicts else None
        more = {"carried": carried, "seed": seed}
        self._policies = [copy.deepcopy(policy) for _ in range(3)]
        super().__init__(*(TextureView(look, sheet, p, known, **more) for p in self._policies[:2]), offset)
        radiance = self.left.shader.radiance
        self.middle = RadianceTexture(look, sheet, self._policies[2], known, radiance=radiance, **more)
        self._textures = [self.left.texture, self.right.texture, self.middle]
        self._whole = limits_of(policy)
        self._weights = np.array([1.0, 1.0, 0.0])
        self.tolerance, self._scale = tolerance, FOLLOWED if carried else 1.0
        self._last: dict = {}
        device, side = look.mesh.device, sheet.side
        middle, left, right = self.middle.shader, self.left.shader, self.right.shader
        self._sheet, self._samples = sheet, quadrant_samples(sheet.triangle.numpy())
        lanes = dispatch.lanes(device)

        def zeros(count, dtype):
            return wp.zeros(count, dtype=dtype, device=device)

        self._listed, self._difference = (zeros(self._samples.size, t) for t in (wp.int32, wp.float32))
        table = np.array([p.luminance_terms for p in proxies], np.float32).ravel()
        slots = self.middle.schedule.slots
        words = slots * stereo.scratch_words(lanes) if lanes > 1 else 1
        self._differ = dispatch.Job(
            stereo.make_difference_kernel(lanes),
            1,
            inputs=[
                *[self._listed, 1, sheet.material, wp.array(table, dtype=wp.float32, device=device), left.surface],
                *[right.surface.side, middle.lights, wp.vec3(), wp.vec3(), look.gain, zeros(words, wp.float32)],
            ],
            outputs=[self._difference],
            device=device,
            grain=1,
            slots=slots,
        )
        self._blank = dispatch.Job(
            stereo.clear_kernel,
            1,
            inputs=[self._listed, 1, _PER_BLOCK, side, side],
            outputs=[left.done, radiance],
            device=device,
        )
        self._shared, self._counts = zeros(middle.tiles, wp.uint8), zeros(middle.rows * stereo.COUNTERS, wp.int32)
        pixels = [t.schedule.pixels for t in self._textures]
        self._merge = dispatch.Job(
            stereo.merge_kernel,
            middle.rows,
            inputs=[self._shared, middle.rate, side, side, middle.tiles, slots],
            outputs=[left.seen, right.seen, middle.seen, *pixels, self._counts],
            device=device,
            grain=4,
        )
        self._spread = dispatch.Job(
            stereo.spread_kernel,
            middle.rows,
            inputs=[self._shared, middle.tile_shaded, side, side, radiance],
            outputs=[right.radiance],
            device=device,
            grain=4,
        )
        self.restart()

    def restart(self) -> None:
        """Make the next frame start a new epoch, as the first one does."""
        super().restart()
        self.middle.restart()
        self._samples = quadrant_samples(self._sheet.triangle.numpy())
        # Begun as shared, so that what is judged first need only be within the tolerance.
        self.shared = (self._samples >= 0).any(axis=1).astype(np.uint8)
        self._frame = 0

    def render(self, camera: Camera, lights: LightState, pose: int, clock: Clock) -> dict:
        """Make both pictures; return their statistics: the sums, each eye's own in ``eyes``, and what is ``shared``."""
        eyes, cameras = (self.left, self.right), (*self.cameras(camera), camera)
        arrived = [t.arrives(c, lights, pose) for t, c in zip(self._textures, cameras, strict=True)]
        if not any(arrived):
            self._last = {
                **unshaded(self._last),
                "eyes": [unshaded(s) for s in self._last["eyes"]],
                "shared": {**self._last["shared"], "shaded": 0, "evaluations": 0},
            }
            return self._last
        for texture, eye in zip(self._textures, cameras, strict=True):
            texture.begin(eye, lights)
        clock.stage("pose")
        if self.middle.follows:
            self._judge(cameras)
        for policy, part in zip(self._policies, self._weights / self._weights.sum(), strict=True):
            limit(policy, self._whole, part)
        for texture in self._textures:
            texture.plan()
        self._unify_rates()
        clock.stage("schedule")
        for view, eye in zip(eyes, cameras, strict=False):
            view.see(eye, clock)
        changed = self._sheet.update(*(view.raster for view in eyes))
        if changed:
            self._samples = quadrant_samples(self._sheet.triangle.numpy())
            for texture in self._textures:
                texture.void(changed)
            tiles = self.middle.schedule.tiles_of(changed)  # of other charts: judged from the next frame on
            self.shared[tiles] = (self._samples[tiles] >= 0).any(axis=1)
            write(self._shared, self.shared)
            self._unify_rates()
        clock.stage("stream")
        self.middle.shader.seen.zero_()
        self.middle.schedule.pixels.zero_()
        for view in eyes:
            view.mark(clock)
        self._merge.run()
        clock.stage("mark")
        for texture in self._textures:
            texture.shade(clock)
        self._spread.run()
        clock.stage("shade")
        for view in eyes:
            view.show(clock)
        self._last = self._statistics()
        return self._last

    def _judge(self, cameras) -> None:
        """Decide which tiles are shared from here on, and void those that change sides."""
        turn = np.arange(self._frame % _TURNS, len(self.shared), _TURNS) if self._frame else np.arange(len(self.shared))
        self._frame += 1
        read = np.zeros(len(self.shared), bool)
        for texture in self._textures:
            read |= texture.schedule.pixels.numpy().reshape(-1, len(self.shared)).any(axis=0)
        read[turn] = True
        tiles = np.flatnonzero(read & (self._samples >= 0).any(axis=1))
        judged = self._differences(tiles, cameras)
        before = self.shared[tiles]
        after = (judged < self.tolerance * np.where(before > 0, 1.0, RETURN)).astype(np.uint8)
        self.shared[tiles] = after
        changed = tiles[after != before]
        if self._frame > 1 and not self.middle.forgot:
            for texture in self._textures:
                mine = changed[self.shared[changed] == (texture is self.middle)]
                if len(mine):
                    self._clear(texture, mine)
        write(self._shared, self.shared)

    def _differences(self, tiles, cameras) -> np.ndarray:
        """Return what the eyes differ in, of each of ``tiles``, so far as it counts [√Y]."""
        listed = self._samples[tiles].ravel()
        self._list(listed)
        differ = self._differ
        differ.set(1, len(listed))
        differ.set(4, self.left.shader.surface)
        differ.set(6, self.middle.shader.lights)
        for k, camera in zip((7, 8), cameras, strict=False):
            differ.set(k, wp.vec3(*map(float, camera.eye)))
        differ.run(dispatch.blocks(len(listed), dispatch.lanes(self._listed.device)))
        difference = self._difference.numpy()[: len(listed)].reshape(self._samples[tiles].shape)
        return self._scale * np.where(self._samples[tiles] >= 0, difference, 0.0).max(axis=1)

    def _clear(self, texture: RadianceTexture, tiles) -> None:
        """Take ``tiles`` as never shaded in ``texture``."""
        self._list(tiles)
        for k, value in ((1, len(tiles)), (5, texture.shader.done), (6, texture.shader.radiance)):
            self._blank.set(k, value)
        self._blank.run(dispatch.blocks(len(tiles), _PER_BLOCK))
        texture.schedule.blank(tiles)

    def _list(self, values) -> None:
        if self._listed.device.is_cpu:
            self._listed.numpy()[: len(values)] = values
        elif len(values):
            self._listed[: len(values)].assign(values.astype(np.int32))

    def _unify_rates(self) -> None:
        """Give shared tiles the middle's rate in both eyes, whose marking and gathering read it."""
        ours = self.middle.shader.rate.numpy()
        for view in (self.left, self.right):
            write(view.shader.rate, np.where(self.shared > 0, ours, view.shader.rate.numpy()))

    def _statistics(self) -> dict:
        *eyes, middle = (texture.statistics() for texture in self._textures)
        counts = self._counts.numpy().reshape(-1, stereo.COUNTERS).sum(axis=0, dtype=np.int64)
        left, right, both, *between, tiles = (int(n) for n in counts)
        for eye, seen, skipped in zip(eyes, (left, right), between, strict=True):
            eye["texels"]["seen"] += seen
            eye["skipped"]["rate"] += skipped
            eye["skipped"]["occluded"] = max(0, eye["skipped"]["occluded"] - seen - skipped)
        result = total(eyes)
        result["texels"]["shaded"] += middle["texels"]["shaded"]
        result["evaluations"] += middle["evaluations"]
        for name in ("unchanged", "range", "spot", "horizon"):
            result["skipped"][name] += middle["skipped"][name]
        shared = {"tiles": tiles, "texels": both, "shaded": middle["texels"]["shaded"]}
        self._weights = np.array([*(e["texels"]["seen"] - s for e, s in zip(eyes, (left, right), strict=True)), 0.0])
        self._weights[2] = middle["texels"]["seen"]
        self._weights += 1.0
        return {**result, "eyes": eyes, "shared": {**shared, "evaluations": middle["evaluations"]}}


def screen_stereo(look: Look, offset: float) -> StereoView:
    """Return both eyes, every pixel of every frame shaded: the reference."""
    return StereoView(ScreenView(look), ScreenView(look), offset)


def texture_stereo(look: Look, sheets, policy: Policy, proxies, offset: float, **more) -> StereoView:
    """Return two texture views that share nothing, with half of the policy's budget each.

    Args:
        sheets: One per eye; the same one twice where it never changes.
        offset: Half the eye distance [scene unit].
    """
    views = []
    for sheet in sheets:
        half = copy.deepcopy(policy)
        limit(half, limits_of(policy), 0.5)
        views.append(TextureView(look, sheet, half, proxies, **more))
    return StereoView(*views, offset)


def limits_of(policy: Policy) -> dict:
    """Return what the policy may spend, so far as that does not grow with what is seen."""
    budget = getattr(policy, "budget", None)
    return {name: getattr(budget, name, None) for name in ("evaluations", "milliseconds")}


def limit(policy: Policy, whole: dict, part: float) -> None:
    """Let the policy spend ``part`` of ``whole``."""
    for name, value in whole.items():
        if value is not None:
            setattr(policy.budget, name, part * value)


def total(eyes: list[dict]) -> dict:
    """Return the sums of two views' statistics."""
    result: dict = {"evaluations": sum(e["evaluations"] for e in eyes), "updated": any(e["updated"] for e in eyes)}
    for group in ("texels", "skipped"):
        result[group] = {name: sum(e[group][name] for e in eyes) for name in eyes[0][group]}
    return result


def quadrant_samples(triangle: np.ndarray) -> np.ndarray:
    """Return the owned texel of each quadrant of each tile that is nearest to its middle, −1 = none; (tiles, 4) int32.

    Args:
        triangle: Owner of each texel, −1 = none, shape (height, width).
    """
    quarters = samples(triangle, TILE // 2)
    rows, columns = (n // 2 for n in quarters.shape)
    return quarters.reshape(rows, 2, columns, 2).transpose(0, 2, 1, 3).reshape(-1, 4)
