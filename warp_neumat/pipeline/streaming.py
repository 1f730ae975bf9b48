"""The part of an atlas that is seen: charts come onto a sheet of fixed size when a picture reads them, and leave it.

The layout of a large *virtual* atlas says where each triangle would lie and is never rasterised. Its charts are
rasterised one by one, with their dilated borders, into rectangles of whole tiles on a smaller sheet; mark, list, shade
and gather work on the sheet as on a static atlas. As every chart is alone in its rectangle, the guarantee of
``pipeline/atlas.py`` holds at any scale: all four texels of any footprint belong to the footprint's own chart.

- **Scale.** A chart lies on the sheet at 2^-level of its layout, level 0 … 3, so that its texels are about as large as
  the pixels that show them, judged by the tenth of its pixels that see it finest. That is measured in half octaves,
  averaged over frames where few pixels tell, and believed anew only when it is off by nearly two of them: no chart
  flips between two levels from frame to frame.
- **Room.** What a picture no longer shows stays while there is room; then the charts seen longest ago leave first.
  Where the charts in view find no place among themselves they are placed anew, tallest first, with a fifth of the
  sheet left free for what comes next; if they do not fit so, all of them are taken half an octave coarser
  (:attr:`StreamingStats.coarser`), which is a level for those that lose least by it, until they do; and finer again
  once that takes a tenth less room than what was refused.
- **Cost.** A frame in which nothing changes runs the kernel that counts what is seen and some numpy over charts.

Texels of level 0 stand for the very points that the static atlas has them stand for, bit for bit. Where a pixel reads
them is found in float32 sheet coordinates, so its bilinear weights differ by their rounding.
"""

import dataclasses
import time

import numpy as np
import warp as wp

from warp_neumat.kernels import streaming
from warp_neumat.kernels.arrays import kind_of, take
from warp_neumat.kernels.atlas import drawable
from warp_neumat.kernels.dispatch import worker_count
from warp_neumat.kernels.lod import NO_LOD
from warp_neumat.kernels.streaming import COARSEST, FINEST, TILE, WORDS
from warp_neumat.pipeline.rectangles import Rectangles

LEVELS = 4
"""Scales of a chart: 1, 1/2, 1/4, 1/8 of its layout."""

_EVIDENCE = 24  # samples of a chart that weigh as much as all that was measured in earlier frames
_FULL = 0.8  # share of the sheet that is filled when everything is placed anew: the rest is for what comes into view
_SHARPEST = 0.1  # share of a chart's samples whose texels may be larger than its pixels


@dataclasses.dataclass(frozen=True)
class StreamingStats:
    """What one update found and did.

    Attributes:
        charts: Charts of the layout.
        seen: Charts that the pictures show.
        resident: Charts on the sheet.
        streamed_in: Charts that were rasterised: new ones, and those that changed their level or their place.
        streamed_out: Charts that left the sheet.
        coarser: Half octaves by which the charts in view are coarser than they should be, for want of room.
        texels: Texels of the rectangles in use.
        texels_streamed: Texels that were rasterised.
        bytes: Memory held by the residency, on device and host: see :attr:`StreamingAtlas.bytes`.
        ms: Milliseconds by part: ``look`` (which charts are seen, and how fine), ``plan``, ``raster``.
    """

    charts: int
    seen: int
    resident: int
    streamed_in: int
    streamed_out: int
    coarser: int
    texels: int
    texels_streamed: int
    bytes: int
    ms: dict[str, float]


class StreamingAtlas:
    """A sheet that holds the charts in view.

    Args:
        layout: An :class:`AtlasLayout` (or an :class:`Atlas`, whose texels are not read).
        side: Side of the sheet [texel], a multiple of 8, 16 … 16384.
        face_material: Material index of each face, shape (F,), 0 … 253.
        least_lod: Mip level of an atlas texel on each face at scale 1 (:func:`kernels.lod.atlas_lod`), shape (F,);
            None = points.
        dilation: Rings of texels around a chart, at every level. The guarantee needs 1.
        device: Warp device.

    Attributes:
        triangle: Face of each texel, (side, side) int32 on the device; −1 = unowned.
        barycentric: Its weights of the second and third corner, (side, side, 2) float32.
        material: Material index + 1 of each texel, 0 = unowned, flat uint8.
        corner_uv: Corners of the faces on the sheet [texel], flat float32, 6 per face; meaningless, but on the sheet,
            for faces of charts that are not resident.
        least_lod: Mip level of a texel on each face at the scale it has now, float32.
        chart_map: Chart of each texel, −1 = unowned, (side, side) int32, numpy.
        stats: The :class:`StreamingStats` of the last update, None before the first.

    Raises:
        ValueError: On a wrong shape, side or dilation, and corners that are not finite.
    """

    def __init__(self, layout, side: int, face_material, *, least_lod=None, dilation: int = 2, device=None):
        if not (16 <= side <= 16384 and side % TILE == 0):
            raise ValueError(f"side must be a multiple of {TILE} in 16 … 16384 texels, got {side}")
        if not 1 <= dilation <= 64:
            raise ValueError(f"dilation must be in 1 … 64 texels, got {dilation}")
        self.side, self.dilation, self.device = int(side), int(dilation), wp.get_device(device)
        corner_uv = np.ascontiguousarray(layout.corner_uv, np.float32)
        self._chart = np.ascontiguousarray(layout.chart, np.int32)
        faces = len(self._chart)
        if corner_uv.shape != (faces, 3, 2) or not np.isfinite(corner_uv).all() or self._chart.min(initial=0) < 0:
            raise ValueError(f"layout must have finite corners for {faces} faces, each in a chart; use Atlas.layout")
        self._charts = int(self._chart.max(initial=-1)) + 1
        kind = kind_of(corner_uv, self.device)
        material = take(face_material, "face_material", (faces,), wp.int32, kind).numpy()
        if material.min(initial=0) < 0 or material.max(initial=0) > 253:
            raise ValueError(f"face_material must be in 0 … 253, got {material.min()} … {material.max()}")
        lod = np.full(faces, NO_LOD, np.float32) if least_lod is None else least_lod
        self._base_lod = wp.clone(take(lod, "least_lod", (faces,), wp.float32, kind))

        def put(values, dtype):
            return wp.array(values, dtype=dtype, device=self.device)

        self._corners = put(corner_uv.ravel(), wp.float32)
        self._face_chart = put(self._chart, wp.int32)
        self._face_material = put((material + 1).astype(np.uint8), wp.uint8)
        self._low, self._high = corner_uv.min(axis=1), corner_uv.max(axis=1)
        self._drawable = drawable(corner_uv, self._chart)
        self._order = np.argsort(self._chart, kind="stable").astype(np.int32)  # ascending faces in each chart
        self._first = np.searchsorted(self._chart[self._order], np.arange(self._charts + 1))
        edges = (corner_uv[:, 1:] - corner_uv[:, :1]).astype(np.float64)
        area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
        self._area = np.bincount(self._chart, weights=area, minlength=self._charts)
        self._origin, size = self._boxes()
        self._residency = _Residency(size, self.side // TILE)
        self._fineness = np.zeros(self._charts, np.int64)  # half octaves of texels per pixel, as believed
        self._average = np.zeros(self._charts)  # the same, as measured over the last frames
        self._before = np.zeros((self._charts, WORDS), np.int32)  # samples when last seen
        self._held = np.full((self._charts, 3), -1, np.int32)  # column, row [tile] and level of what is on the device

        self.triangle = wp.full((side, side), -1, dtype=wp.int32, device=self.device)
        self.barycentric = wp.zeros((side, side, 2), dtype=wp.float32, device=self.device)
        self.material = wp.zeros(side * side, dtype=wp.uint8, device=self.device)
        self.corner_uv = wp.full(6 * faces, 1.0, dtype=wp.float32, device=self.device)
        self.least_lod = wp.clone(self._base_lod)
        self.chart_map = np.full((side, side), -1, np.int32)
        self._tile_chart = np.full((side // TILE, side // TILE), -1, np.int32)
        self._seen = wp.zeros(self._charts, dtype=wp.uint8, device=self.device)
        self._workers, self._samples, self._jobs = 0, None, {}
        self.stats: StreamingStats | None = None

    def reset(self) -> None:
        """Hold nothing, as before the first update."""
        self._residency = _Residency(self._residency.size, self.side // TILE)
        for values, blank in (
            *[(self._fineness, 0), (self._average, 0), (self._before, 0), (self._held, -1)],
            *[(self.chart_map, -1), (self._tile_chart, -1)],
        ):
            values[...] = blank
        self.triangle.fill_(-1)
        self.material.zero_()
        self.corner_uv.fill_(1.0)
        wp.copy(self.least_lod, self._base_lod)
        self.stats = None

    @property
    def bytes(self) -> int:
        """Memory held [byte]: a texel takes 13 on the device and 4 on the host, a face some 90 in all, a chart 200."""
        return sum(
            a.capacity if isinstance(a, wp.array) else a.nbytes
            for a in vars(self).values()
            if isinstance(a, wp.array | np.ndarray)
        )

    @property
    def levels(self) -> np.ndarray:
        """Level of each chart on the sheet, −1 = not resident, shape (charts,), int32."""
        return self._held[:, 2].copy()

    def rectangle(self, chart: int) -> tuple[int, int, int, int] | None:
        """Return (x, y, width, height) [texel] of a chart on the sheet, or None if it is not resident."""
        x, y, level = self._held[chart].tolist()
        return None if level < 0 else (TILE * x, TILE * y, *(TILE * self._residency.size[chart, level]).tolist())

    def update(self, *rasters) -> list[tuple[int, int, int, int]]:
        """Bring the charts that the rasters show onto the sheet; return the rectangles that changed.

        Args:
            rasters: :class:`CameraRaster` of each eye, after its run; the same ones every frame.

        Returns:
            (x, y, width, height) [texel] of rectangles in which every shaded value is void: some may overlap.

        Raises:
            ValueError: If the charts in view do not fit the sheet at the coarsest level.
        """
        clock = [time.perf_counter()]
        seen, fineness = self._look(rasters)
        clock.append(time.perf_counter())
        changed = self._residency.request(seen, fineness)
        clock.append(time.perf_counter())
        rectangles, streamed, gone, texels = self._stream() if changed else ([], 0, 0, 0)
        clock.append(time.perf_counter())
        ms = dict(zip(("look", "plan", "raster"), (1e3 * np.diff(clock)).tolist(), strict=True))
        side, room = self.side // TILE, self._residency
        resident = int(np.count_nonzero(self._held[:, 2] >= 0))
        used = (side * side - room.rectangles.free_tiles) * TILE * TILE
        self.stats = StreamingStats(
            self._charts, len(seen), resident, streamed, gone, room.coarser, used, texels, self.bytes, ms
        )
        return rectangles

    def _boxes(self):
        """Return each chart's origin in its scaled layout [texel] and its size [tile], shapes [charts, LEVELS, 2]."""
        low = np.full((self._charts, 2), np.inf)
        high = np.full((self._charts, 2), -np.inf)
        np.minimum.at(low, self._chart, self._low)
        np.maximum.at(high, self._chart, self._high)
        scale = 0.5 ** np.arange(LEVELS)[:, None]
        # Footprints reach 1 + 1/64 texel from a corner to a texel's centre: at most one texel beyond the corner's own.
        origin = np.floor(low[:, None] * scale) - self.dilation
        texels = np.floor(high[:, None] * scale) + self.dilation + 1 - origin
        return origin.astype(np.int64), np.ceil(texels / TILE).astype(np.int64)

    def _look(self, rasters):
        """Return the charts in view, ascending, and the half octaves by which they may be coarser than the layout."""
        workers = worker_count() if self.device.is_cpu else 1
        if self._workers != workers:
            self._workers = workers
            self._samples = wp.zeros(self._workers * self._charts * WORDS, dtype=wp.int32, device=self.device)
            self._jobs = {}
        self._seen.zero_()
        self._samples.zero_()
        for raster in rasters:
            if raster not in self._jobs:
                arrays = (raster.triangle, raster.barycentric, self._face_chart, self._corners)
                self._jobs[raster] = streaming.seen_charts_job(*arrays, self._charts, self._seen, self._samples)
            self._jobs[raster].run()
        seen = np.flatnonzero(self._seen.numpy())
        samples = self._samples.numpy().reshape(self._workers, self._charts, WORDS)[:, seen].sum(axis=0)
        below = np.cumsum(samples[:, 1:], axis=1)
        finest = (below >= _SHARPEST * below[:, -1:]).argmax(axis=1) + COARSEST
        # Without one: half of the chart's texels, as if half of it faced the viewer, over its pixels, 16 a sample.
        ratio = 0.5 * self._area[seen] / np.maximum(16 * samples[:, 0], 8)
        rough = np.clip(np.floor(np.log2(np.maximum(ratio, 1e-9))), COARSEST, FINEST).astype(np.int64)
        finest = np.where(below[:, -1] > 0, finest, rough)
        # Few samples jump about from frame to frame, so what they say is averaged over frames, unless nothing moved.
        news = (samples != self._before[seen]).any(axis=1) | (self._held[seen, 2] < 0)
        self._before[seen] = samples
        weight = np.where(self._held[seen, 2] >= 0, (below[:, -1] + 1) / (below[:, -1] + _EVIDENCE), 1.0)
        self._average[seen] += news * weight * (finest - self._average[seen])
        average, believed = self._average[seen], self._fineness[seen]
        off = (np.abs(average - believed) >= 1.75) | (self._held[seen, 2] < 0)
        self._fineness[seen] = np.where(off, np.rint(average), believed)
        return seen, self._fineness[seen]

    def _stream(self):
        """Make the device hold what the residency says; return (changed rectangles, charts in, charts out, texels)."""
        place, size = self._residency.place, self._residency.size
        changed = np.flatnonzero((place != self._held).any(axis=1))
        if not len(changed):
            return [], 0, 0, 0
        before, after = self._held[changed], place[changed]
        rectangles = []
        cleared = []
        for chart, (column, row, level) in zip(changed, before.tolist(), strict=True):
            if level >= 0:
                w, h = size[chart, level].tolist()
                self._tile_chart[row : row + h, column : column + w] = -1
                cleared.append((column, row, w, h))
        new = after[:, 2] >= 0
        charts, at = changed[new], after[new].astype(np.int64)
        grid = size[charts, at[:, 2]]
        for chart, (column, row, _), (w, h) in zip(charts, at.tolist(), grid.tolist(), strict=True):
            self._tile_chart[row : row + h, column : column + w] = chart
            rectangles.append((TILE * column, TILE * row, TILE * w, TILE * h))
        tiles, offsets, members = self._tiles(charts, at, grid)
        free = [np.zeros((0, 2), np.int64)]
        for column, row, w, h in cleared:
            y, x = np.nonzero(self._tile_chart[row : row + h, column : column + w] < 0)
            free.append(np.stack([x + column, y + row], axis=1))
            rectangles.append((TILE * column, TILE * row, TILE * w, TILE * h))
        free = TILE * np.concatenate(free)
        tiles = np.concatenate([tiles, np.pad(free, ((0, 0), (0, 3)))])
        offsets = np.concatenate([offsets, np.full(len(free), offsets[-1], np.int32)])
        outputs = [self.triangle.flatten(), self.barycentric.flatten(), self.material]
        arrays = (self._corners, self._face_material, self.side, self.dilation)
        streaming.raster_charts(tiles, offsets, members, *arrays, outputs)
        host = self.triangle.numpy() if self.device.is_cpu else None  # a view
        for x, y, w, h in rectangles:
            part = (slice(y, y + h), slice(x, x + w))
            owner = self.triangle[part].numpy() if host is None else host[part]
            self.chart_map[part] = np.where(owner >= 0, self._chart[owner], -1)
        self._held[...] = place
        gone = int(np.count_nonzero((before[:, 2] >= 0) & ~new))
        return rectangles, len(charts), gone, int(grid.prod(axis=1).sum()) * TILE * TILE

    def _tiles(self, charts, at, grid):
        """Move the corners of ``charts`` to their places ``at``; return their tiles and each one's triangles."""
        level = at[:, 2]
        origin = self._origin[charts, level]
        count = self._first[charts + 1] - self._first[charts]
        which = np.repeat(np.arange(len(charts)), count)
        start = np.repeat(self._first[charts] - np.cumsum(count) + count, count)
        faces = self._order[start + np.arange(len(which))]
        places = np.concatenate([TILE * at[:, :2] - origin, level[:, None]], axis=1)
        arrays = (self._corners, self._base_lod, self.corner_uv, self.least_lod)
        streaming.place_charts(faces, which, places, *arrays)
        own = self._drawable[faces]
        faces, which = faces[own], which[own]
        scale, corner = 0.5 ** level[which, None], origin[which]
        first = np.concatenate([[0], np.cumsum(grid.prod(axis=1))])
        box = (self._low[faces] * scale - corner, self._high[faces] * scale - corner)
        offsets, members = streaming.tile_members(*box, which, first, grid, self.dilation + 0.5)
        of = np.repeat(np.arange(len(charts)), np.diff(first))
        row, column = np.divmod(np.arange(first[-1]) - first[of], grid[of, 0])
        inside = TILE * np.stack([column, row], axis=1)
        tiles = np.concatenate([inside + TILE * at[of, :2], inside + origin[of], level[of, None]], axis=1)
        return tiles, offsets, faces[members]


class _Residency:
    """Which chart holds which rectangle: the plan only, no texels.

    Args:
        size: Width and height of each chart at each level [tile], shape [charts, LEVELS, 2].
        side: Side of the sheet [tile].
    """

    def __init__(self, size: np.ndarray, side: int):
        self.size, self.side = size, side
        self.rectangles = Rectangles(side, side)
        self.place = np.full((len(size), 3), -1, np.int32)  # column, row [tile], level; −1 = not resident
        self.coarser = 0
        self._tiles = size.prod(axis=2)
        # A level that takes no fewer tiles than a finer one only blurs; one that is wider than the sheet cannot be.
        self._coarsest = (self._tiles > self._tiles[:, -1:]).sum(axis=1)
        self._finest = np.minimum((size.max(axis=2) > side).sum(axis=1), LEVELS - 1)
        self._most = _FULL * side * side
        self._limit = np.inf  # tiles in view that are worth another try at a finer level
        self._stamp = np.full(len(size), -1, np.int64)
        self._frame = 0

    def request(self, seen: np.ndarray, fineness: np.ndarray) -> bool:
        """Give the charts ``seen`` (ascending) rectangles, at the levels of ``fineness`` [half octave] if they fit.

        Returns whether :attr:`place` changed.
        Raises: ValueError: If they do not fit at any level.
        """
        self._frame += 1
        self._stamp[seen] = self._frame
        while self.coarser > 0 and self._needs(seen, self._levels(seen, fineness + self.coarser - 1)) <= self._limit:
            self.coarser -= 1
        level = self._levels(seen, fineness + self.coarser)
        if (self.place[seen, 2] == level).all():
            return False
        coarsest = self._levels(seen, np.full(len(seen), 2 * LEVELS))
        while not self._fit(seen, level):
            needs = self._needs(seen, level)
            if (level == coarsest).all():
                raise ValueError(
                    f"the {len(seen)} charts in view need {needs * TILE * TILE} texels at the coarsest scale and do "
                    f"not fit a sheet of {self.side * TILE}² = {(self.side * TILE) ** 2}; use a larger sheet"
                )
            self._limit = 0.9 * min(needs, self._most)
            refused = level
            while (level == refused).all():
                self.coarser += 1
                level = self._levels(seen, fineness + self.coarser)
        return True

    def _levels(self, seen, fineness) -> np.ndarray:
        return np.maximum(np.minimum(np.minimum(fineness // 2, LEVELS - 1), self._coarsest[seen]), self._finest[seen])

    def _needs(self, seen, level) -> int:
        return int(self._tiles[seen, level].sum())

    def _fit(self, seen, level) -> bool:
        """Place the charts whose level is not right yet; say whether all found a place."""
        if self._needs(seen, level) > self.side * self.side:
            return False
        late = self.place[seen, 2] != level
        for chart in seen[late & (self.place[seen, 2] >= 0)].tolist():
            self._drop(chart)
        charts, levels = self._tallest_first(seen[late], level[late])
        for chart, its_level in zip(charts, levels, strict=True):
            while not self._take(chart, its_level):
                if not self._forget(self._tiles[chart, its_level]):
                    return self._place_anew(seen, level)
        return True

    def _tallest_first(self, charts, levels) -> tuple[list[int], list[int]]:
        width, height = self.size[charts, levels].T
        order = np.lexsort((charts, -width, -height))
        return charts[order].tolist(), levels[order].tolist()

    def _take(self, chart: int, level: int) -> bool:
        at = self.rectangles.take(*self.size[chart, level].tolist())
        if at is not None:
            self.place[chart] = (*at, level)
        return at is not None

    def _drop(self, chart: int) -> None:
        column, row, level = self.place[chart].tolist()
        self.rectangles.give(column, row, *self.size[chart, level].tolist())
        self.place[chart] = -1

    def _forget(self, tiles: int) -> bool:
        """Drop charts that are not in view, longest ago first, until ``tiles`` are free; one at least, or say no."""
        unseen = np.flatnonzero((self.place[:, 2] >= 0) & (self._stamp < self._frame))
        if not len(unseen):
            return False
        unseen = unseen[np.argsort(self._stamp[unseen], kind="stable")]
        missing = max(tiles - self.rectangles.free_tiles, 1)
        held = np.cumsum(self._tiles[unseen, self.place[unseen, 2]])
        for chart in unseen[: np.searchsorted(held, missing) + 1].tolist():
            self._drop(chart)
        return True

    def _place_anew(self, seen, level) -> bool:
        """Empty the sheet and place all charts in view, tallest first."""
        self.rectangles.clear()
        self.place[:] = -1
        if self._needs(seen, level) > self._most and (level < self._coarsest[seen]).any():
            return False
        charts, levels = self._tallest_first(seen, level)
        return all(self._take(chart, its_level) for chart, its_level in zip(charts, levels, strict=True))
