"""The sheet that a view shades: which point of the mesh each texel stands for, on the device.

A :class:`Sheet` is a whole atlas and never changes. A :class:`StreamedSheet` holds the charts that are seen.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels.atlas import FOOTPRINT, atlas_raster
from warp_neumat.kernels.lod import atlas_lod
from warp_neumat.kernels.tiles import TILE, rate_limits, tile_count
from warp_neumat.pipeline.atlas import Atlas, AtlasLayout
from warp_neumat.pipeline.streaming import StreamingAtlas


class Sheet:
    """A whole atlas.

    Args:
        atlas: The atlas.
        face_material: Material index of each face, shape (F,).
        lod: Mip level of an atlas texel on each face, shape (F,), or None where no material has maps.
        unowned_too: Let texels of no chart stand for face 0 of material 0: they can then be shaded, to no use.

    Attributes:
        side: Texels each way.
        triangle: Triangle of each texel, −1 = none, int32, shape (side, side), on the device.
        barycentric: Weights of its second and third corner, float32, shape (side, side, 2).
        material: Material index + 1 of each texel, 0 = none, uint8, flat.
        corner_uv: Corners of the faces [texel], float32, flat.
        least_lod: Mip level of a texel on each face, float32, on the device; or None.
        limit: Coarsest rate of each tile, uint8, flat, numpy.
        sample: Texel that speaks for each tile, −1 = none, int32, flat, numpy.
        face_texels: Texels of each face, int64, numpy.
        owned: Texels of any chart.
    """

    def __init__(
        self, atlas: Atlas, face_material: np.ndarray, lod: np.ndarray | None, *, unowned_too: bool = False, device=None
    ):
        self.side = side = atlas.resolution
        owned = atlas.triangle >= 0
        material = np.where(owned, face_material[np.maximum(atlas.triangle, 0)] + 1, 0)
        if unowned_too:
            material[~owned] = 1
        self.owned = int(owned.sum())
        self.face_texels = np.bincount(atlas.triangle[owned], minlength=len(atlas.corner_uv))
        self.triangle = wp.array(atlas.triangle, dtype=wp.int32, device=device)
        self.barycentric = wp.array(atlas.barycentric, dtype=wp.float32, device=device)
        self.material = wp.array(material.ravel(), dtype=wp.uint8, device=device)
        self.corner_uv = wp.array(atlas.corner_uv.ravel(), dtype=wp.float32, device=device)
        self.least_lod = None if lod is None else wp.array(lod, dtype=wp.float32, device=device)
        touched, _ = atlas_raster(atlas.corner_uv, atlas.chart, side, side, dilation=FOOTPRINT - 0.5, device=device)
        charts = [np.where(t >= 0, atlas.chart[np.maximum(t, 0)], -1) for t in (atlas.triangle, touched)]
        self.limit = rate_limits(*charts).ravel()
        self.sample = samples(touched).ravel()

    def update(self, *rasters) -> list[tuple[int, int, int, int]]:
        """Return the rectangles of texels that became others since the last frame: none ever do."""
        return []

    @property
    def stats(self) -> None:
        """Nothing streams."""

    def restart(self) -> None:
        """Be as before the first frame: it never is otherwise."""


class StreamedSheet:
    """The charts of a layout that are seen; attributes as of :class:`Sheet`.

    ``limit``, ``sample``, ``owned`` and ``face_texels`` follow what is resident; texels of a face are estimated from
    its area.

    Args:
        layout: An :class:`AtlasLayout`.
        side: Side of the sheet [texel].
        face_material: Material index of each face, shape (F,).
        lod: Mip level of a texel of the layout on each face, shape (F,), or None where no material has maps.
    """

    def __init__(
        self, layout: AtlasLayout, side: int, face_material: np.ndarray, lod: np.ndarray | None, *, device=None
    ):
        self._streaming = StreamingAtlas(layout, side, face_material, least_lod=lod, device=device)
        for name in ("side", "triangle", "barycentric", "material", "corner_uv"):
            setattr(self, name, getattr(self._streaming, name))
        self.least_lod = None if lod is None else self._streaming.least_lod
        self._chart = np.asarray(layout.chart)
        edges = np.diff(np.asarray(layout.corner_uv, np.float64), axis=1)
        self._area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
        self._blank()

    def _blank(self) -> None:
        grid = tile_count(self.side, self.side)[::-1]
        self.face_texels = np.zeros(len(self._area), np.int64)
        self._limit, self._sample = np.zeros(grid, np.uint8), np.full(grid, -1, np.int32)
        self._owned = np.zeros(grid, np.int16)

    def restart(self) -> None:
        """Hold no chart, as before the first frame."""
        self._streaming.reset()
        self._blank()

    @property
    def limit(self) -> np.ndarray:
        """Coarsest rate of each tile, uint8, flat."""
        return self._limit.ravel()

    @property
    def sample(self) -> np.ndarray:
        """Texel that speaks for each tile, −1 = none, int32, flat."""
        return self._sample.ravel()

    @property
    def owned(self) -> int:
        """Texels of any chart."""
        return int(self._owned.sum(dtype=np.int64))

    @property
    def stats(self):
        """The :class:`StreamingStats` of the last update."""
        return self._streaming.stats

    def update(self, *rasters) -> list[tuple[int, int, int, int]]:
        """Bring the charts that the rasters show onto the sheet; return the rectangles of texels that became others.

        Raises: ValueError: If they do not fit at the coarsest scale.
        """
        changed = self._streaming.update(*rasters)
        for x, y, width, height in changed:
            # A chart is alone in its rectangle, so what lies outside cannot matter.
            charts = self._streaming.chart_map[y : y + height, x : x + width]
            part = (slice(y // TILE, (y + height) // TILE), slice(x // TILE, (x + width) // TILE))
            self._limit[part] = rate_limits(charts, charts)
            inside = samples(charts)
            row, column = np.divmod(inside, width)
            self._sample[part] = np.where(inside >= 0, (row + y) * self.side + column + x, -1)
            owned = charts.reshape(height // TILE, TILE, width // TILE, TILE) >= 0
            self._owned[part] = owned.sum(axis=(1, 3))
        if changed:
            level = self._streaming.levels[self._chart]
            self.face_texels = np.where(level >= 0, self._area * 0.25 ** np.maximum(level, 0), 0).astype(np.int64)
        return changed


def sheet_lod(atlas: Atlas | AtlasLayout, sequence, map_size: np.ndarray | None) -> np.ndarray | None:
    """Return the mip level of an atlas texel on each face, (F,), or None without maps (``surface_mesh.map_sizes``)."""
    return None if map_size is None else atlas_lod(atlas.corner_uv, sequence.uv, sequence.faces, map_size)


def samples(triangle: np.ndarray, cell: int = TILE) -> np.ndarray:
    """Return the texel of each cell that is owned and nearest to its middle, −1 = none; int32, (rows, columns).

    Args:
        triangle: Owner of each texel, −1 = none, shape (height, width).
        cell: Side of a cell [texel]; those of whole tiles are counted, also where the last tiles are cut.
    """
    height, width = triangle.shape
    columns, rows = (n * TILE // cell for n in tile_count(width, height))
    owned = np.zeros((rows * cell, columns * cell), bool)
    owned[:height, :width] = triangle >= 0
    cells = owned.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3).reshape(rows, columns, cell * cell)
    j, i = np.divmod(np.arange(cell * cell), cell)
    middle = 0.5 * cell - 0.6  # a little off, so that none of the four in the middle are equals
    order = np.argsort((i - middle) ** 2 + (j - middle) ** 2, kind="stable")
    nearest = order[np.argmax(cells[..., order], axis=2)]
    y = cell * np.arange(rows)[:, None] + nearest // cell
    x = cell * np.arange(columns)[None, :] + nearest % cell
    return np.where(cells.any(axis=2), y * width + x, -1).astype(np.int32)
