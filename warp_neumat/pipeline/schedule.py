"""The state of a view's tiles, and the plan of a frame: which are due, and at which rate each is shaded.

For every tile it is remembered when it was shaded, what √Y its proxy had then, and what shading has taught:

- *follow* and *drift*: the change that shading found is follow · |proxy's change| + drift · age. Both are learned by
  each tile from its own refreshes, starting from what its neighbours in time have taught.
- *rough*: what its anchors differ from lying on straight lines, so how much a coarser rate would lose. Halving the
  step quarters that.

The age of a tile counts frames in which something moved. In a still scene nothing ages; what is stale is mended, what
is shaded coarsely becomes finer, and then nothing is due.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch, schedule, tile_plan
from warp_neumat.kernels.arrays import write
from warp_neumat.kernels.carry import EPSILON
from warp_neumat.kernels.shade import make_lights
from warp_neumat.kernels.tiles import RATE_MAX, TILE
from warp_neumat.materials.proxy import Proxy
from warp_neumat.pipeline.policy import Policy, Tiles
from warp_neumat.pipeline.sheet import Sheet
from warp_neumat.pipeline.texel_shader import TexelShader

RETURNED = 12
"""Age [frames] from which a tile that comes back into view is shaded anew at once, as if it were new."""

START_RATE = 1
"""Rate at which a tile is first shaded where the policy predicts, and its charts allow it."""

_PER_BLOCK, _LEARNT = 1024, 16  # tiles, of the light kernels and of the learning one
_GRAIN = 8192  # tiles worth a chunk of their own


class Schedule:
    """Plans the frames of one view.

    Args:
        sheet: What is shaded.
        shader: Shades it.
        policy: Chooses the tiles.
        proxies: Of the materials, by index; None where the policy does not predict.
        carried: Whether the texture holds ratios to the proxies.
        minified, smooth: Whether tiles of texels smaller than a pixel, and those that are smooth, are shaded coarsely.
        unchanged: Whether tiles that nothing has changed for are left out.
        gain: What radiance is multiplied by before it is shown.
        seed: Decides between equals.
        picture: Pixels of the picture.

    Attributes:
        slots: Workers that may count pixels.
        pixels: Pixels of the last picture that read each tile, [worker][tile], int32, on the device.
        change: Predicted change of each tile in the present picture, once the due ones are shaded [√Y].
        pending: Whether a tile that is not up to date was left for a later frame.
        unchanged_texels: Texels read by the last picture for which nothing has moved since they were shaded.
    """

    def __init__(
        self,
        sheet: Sheet,
        shader: TexelShader,
        policy: Policy,
        proxies: list[Proxy] | None,
        *,
        carried: bool = False,
        minified: bool = True,
        smooth: bool = False,
        unchanged: bool = True,
        gain: float = 1.0,
        seed: int = 0,
        picture: int = 1,
    ):
        self.sheet, self.shader, self.policy, self.picture = sheet, shader, policy, picture
        self._minified, self._smooth, self._skip_unchanged = minified, smooth, unchanged
        self._predicts, self._carried, self._device = proxies is not None, carried, shader.device
        tiles, lanes = shader.tiles, dispatch.lanes(shader.device)
        self._tie = np.random.default_rng(seed).random(tiles, dtype=np.float32)
        self._lanes = lanes
        # Of each tile; of each that is listed; and pixels, which every worker counts by itself.
        self._now, self._size, self._then = (self._zeros() for _ in range(3))
        self._changed, self._roughness, self._rough = (self._zeros() for _ in range(3))
        self._follow, self._drift = self._zeros(), self._zeros()
        self._shaded, self._listed = self._zeros(wp.int32), self._zeros(wp.int32)
        self._size_rate, self._smooth_rate, self._next_rate = (self._zeros(wp.uint8) for _ in range(3))
        self._texels, self._whole, self._age, self._change, self._kept = (self._zeros() for _ in range(5))
        self.slots = dispatch.worker_count()
        self.pixels = wp.zeros(self.slots * tiles, dtype=wp.int32, device=self._device)

        def job(kernel, inputs, outputs, per_block):
            # A second worker costs more to wake and to feed than a few thousand tiles take.
            options = {"device": self._device, "grain": max(1, _GRAIN // per_block), "slots": self.slots}
            return dispatch.Job(kernel, 1, inputs=[self._listed, 1, *inputs], outputs=outputs, **options)

        terms = [p.luminance_terms for p in proxies] if proxies else [(0.0, 0.0, 0.0, 1.0)] * len(shader.materials)
        table = wp.array(np.array(terms, np.float32).ravel(), dtype=wp.float32, device=self._device)
        words = self.slots * schedule.scratch_words(lanes) if lanes > 1 else 1
        scratch = wp.zeros(words, dtype=wp.float32, device=self._device)
        self._sample = wp.array(sheet.sample, dtype=wp.int32, device=self._device)
        self._no_lights = make_lights(1, self._device)
        place = [self._sample, sheet.material, sheet.corner_uv, table]
        scene = [shader.surface, shader.lights, shader.viewer, gain, scratch]
        self._predict = job(schedule.make_predict_kernel(lanes), [*place, *scene], [self._now, self._size], lanes)
        texture = [shader.width, shader.height, shader.rate, shader.done, shader.radiance]
        how = [self._now, gain, EPSILON / gain if carried else 0.0, _LEARNT]
        self._learn = job(schedule.learn_kernel, [*texture, *how], [self._changed, self._roughness], _LEARNT)
        told = [self._now, self._then, self._size, self._shaded, self._follow, self._drift, self._rough]
        told += [self._smooth_rate, self._next_rate, shader.rate, shader.tile_seen, _PER_BLOCK]
        outputs = [self._size_rate, self._texels, self._whole, self._age, self._change, self._kept]
        self._rank = job(
            tile_plan.rank_kernel, [0, int(unchanged), int(self._predicts), int(minified), *told], outputs, _PER_BLOCK
        )
        seen = [self._now, self._changed, self._roughness, self._smooth_rate, RATE_MAX if smooth else 0]
        outputs = [self._then, self._shaded, self._follow, self._drift, self._rough, self._next_rate]
        self._settle = job(tile_plan.settle_kernel, [0, 0, *seen, 0.0, 0.0, _PER_BLOCK], outputs, _PER_BLOCK)
        self.reset()

    def _zeros(self, dtype=wp.float32) -> wp.array:
        return wp.zeros(self.shader.tiles, dtype=dtype, device=self._device)

    def reset(self) -> None:
        """Know nothing of any tile, as before the first frame."""
        self._moved = 0  # frames so far in which something moved
        self._per_texel = 0.0  # evaluations
        self._new = 0.0  # evaluations of the last frame that were for texels seen for the first time
        self._due = np.zeros(0, np.int32)
        self._mean_follow, self._mean_drift = (0.5 if self._carried else 1.0), 0.0
        self.unchanged_texels, self.pending = 0, False
        self.change = np.zeros(self.shader.tiles, np.float32)
        for array in (self._then, self._follow, self._drift, self._size_rate, self.pixels):
            array.zero_()
        self.blank(slice(None))
        write(self._sample, self.sheet.sample)
        self.policy.reset()

    def blank(self, tiles) -> None:
        """Take ``tiles`` as never shaded.

        Args:
            tiles: Their numbers, or a slice.
        """
        for array, value in (
            (self._shaded, tile_plan.NEVER),
            (self._rough, schedule.UNKNOWN),
            (self._smooth_rate, START_RATE if self._smooth else 0),
            (self._next_rate, START_RATE if self._smooth else 0),
            (self._size_rate, 0),
        ):
            values = array.numpy()
            values[tiles] = value
            write(array, values)
        self._set_rates()

    def void(self, rectangles) -> None:
        """Forget what is known of the tiles in ``rectangles`` (x, y, width, height) [texel], which hold others now."""
        self.blank(self.tiles_of(rectangles))
        self._due = self._due[self._shaded.numpy()[self._due] != tile_plan.NEVER]
        write(self._sample, self.sheet.sample)

    def tiles_of(self, rectangles) -> np.ndarray:
        """Return the numbers of the tiles in ``rectangles`` (x, y, width, height) [texel], ascending."""
        inside = np.zeros((self.shader.rows, self.shader.columns), bool)
        for x, y, width, height in rectangles:
            inside[y // TILE : -(-(y + height) // TILE), x // TILE : -(-(x + width) // TILE)] = True
        return np.flatnonzero(inside)

    def plan(self, moved: bool) -> None:
        """Decide which tiles are due and set the rates, by what the last frame saw.

        Args:
            moved: Whether pose, viewer or lights are others than in the last frame.
        """
        self._moved += moved
        pixels = self.pixels.numpy().reshape(-1, self.shader.tiles)
        pixels = pixels[0] + pixels[1] if len(pixels) == 2 else pixels.sum(axis=0, dtype=np.int32)
        # A tile may be read through the right and lower texels of footprints alone, and then counts no pixel.
        known = (pixels > 0) | (self.shader.tile_seen.numpy() > 0)
        seen = np.flatnonzero(known)
        shaded = self._shaded.numpy()
        due = (~known & (shaded > tile_plan.NEVER) & (shaded < self._moved - RETURNED)).astype(np.uint8)
        self.unchanged_texels, self.pending = 0, False
        if not len(seen):
            self._new = 0.0
            self._measure_all()
        else:
            if self._predicts or self._minified:
                self._run_predict(seen)
            if self._smooth and not moved:  # at rest there is time for every texel
                wanted = self._next_rate.numpy()
                wanted[seen] = np.maximum(self._smooth_rate.numpy()[seen], 1) - 1
                write(self._next_rate, wanted)
            self._rank.set(2, self._moved)
            self._run(self._rank, seen, _PER_BLOCK)
            # What comes into view is guessed to be like what was seen, as the present camera sees it, but rather finer.
            rate = self._size_rate.numpy()
            write(self._size_rate, np.where(known, rate, np.partition(rate[seen], len(seen) // 4)[len(seen) // 4]))
            count = len(seen)
            texels, age, change = (a.numpy()[:count] for a in (self._texels, self._age, self._change))
            whole = self._per_texel * float(self._whole.numpy()[:count].sum())
            cost = self._per_texel * texels
            share = np.maximum(pixels[seen], 1).astype(np.float32)
            kept = self._kept.numpy()[:count]
            new = self._new if moved else 0.0  # a still picture shows nothing new
            tiles = Tiles(seen, share, cost, age, change - kept, new, whole, self.picture, moved, self._tie[seen])
            chosen = self.policy.choose(tiles) & (age > 0)
            due[seen[chosen]] = 1
            self.unchanged_texels = int(texels[(age == 0) & (shaded[seen] != tile_plan.NEVER)].sum())
            self.pending = self.policy.keeps and bool((~chosen & (age > 0)).any())
            if self._predicts:
                self.change[:] = 0.0
                self.change[seen] = np.where(chosen, kept, change)
        self._due = np.flatnonzero(due)
        if self._smooth:
            rate = self._smooth_rate.numpy()
            rate[self._due] = self._next_rate.numpy()[self._due]
            write(self._smooth_rate, rate)
        write(self.shader.due, due)
        self._set_rates()

    def _measure_all(self) -> None:
        """Set the rates by the size of the texels of all tiles: where the last picture says nothing of the next."""
        self._size_rate.zero_()
        tiles = np.flatnonzero(self.sheet.sample >= 0)
        if self._minified and len(tiles):
            self._run_predict(tiles)
            size, rate = self._size.numpy()[tiles], self._size_rate.numpy()
            step = float(tile_plan.STEP)
            rate[tiles] = (size > 0) * ((size <= step / 2).astype(np.uint8) + (size <= step / 4))
            write(self._size_rate, rate)

    def _set_rates(self) -> None:
        rate = np.maximum(self._smooth_rate.numpy(), self._size_rate.numpy())
        write(self.shader.rate, np.minimum(rate, self.sheet.limit))

    def learn(self, evaluations: int, texels: int, milliseconds: float) -> None:
        """Take note of what the frame has shaded.

        Args:
            evaluations: Of materials in this frame.
            texels: Shaded in this frame.
            milliseconds: That shading took.
        """
        self.policy.learn(milliseconds, evaluations)
        if not texels:
            self._new = 0.0
            return
        ratio = evaluations / texels
        self._per_texel = 0.7 * self._per_texel + 0.3 * ratio if self._per_texel else ratio
        shaded = self.shader.tile_shaded.numpy()
        due = self._due[shaded[self._due] > 0]
        self._new = self._per_texel * float(texels - int(shaded[due].sum(dtype=np.int64)))
        fresh = np.flatnonzero((shaded > 0) & (self._shaded.numpy() == tile_plan.NEVER))
        both = np.concatenate([due, fresh])
        if not len(both):
            return
        if self._predicts:
            if len(fresh):
                self._run_predict(fresh)
            self._run(self._learn, both, _LEARNT)
        for index, value in ((2, len(due)), (3, self._moved), (9, self._mean_follow), (10, self._mean_drift)):
            self._settle.set(index, value)
        self._run(self._settle, both, _PER_BLOCK)
        if len(due) and self._predicts:
            self._mean_follow = float(self._follow.numpy()[due].mean())
            self._mean_drift = float(self._drift.numpy()[due].mean())

    def _run_predict(self, tiles) -> None:
        self._predict.set(6, self.shader.surface)
        self._predict.set(7, self.shader.lights if self._predicts else self._no_lights)
        self._predict.set(8, self.shader.viewer)
        self._run(self._predict, tiles, self._lanes)

    def _run(self, job, tiles, per_block: int) -> None:
        if self._device.is_cpu:
            self._listed.numpy()[: len(tiles)] = tiles
        else:
            self._listed[: len(tiles)].assign(tiles.astype(np.int32))
        job.set(1, len(tiles))
        job.run(dispatch.blocks(len(tiles), per_block))
