"""The texture-space sheet of a mesh sequence: where each triangle lies, and which triangle each texel shades.

[mobilevr], Sec. 4.2: the sheet is laid out and rasterised once; at run time a texel fetches its triangle's data by id.
Corners are in texels (texel i centred at i + 0.5, x right, y down). The layout holds one guarantee, checked by
rasterising it: for every point of every triangle of a chart, all four texels of its bilinear footprint are owned by
that chart, so a plain bilinear fetch reads neither another chart nor an unowned texel.

How a layout is found, best first:

- ``authored``: the only part's own UVs, where charts do not overlap and lie far enough apart;
- ``repacked``: the part's own charts, placed anew together with those of other parts at one texel density;
- ``xatlas``: charts made by xatlas, for parts without usable UVs;
- ``fallback``: pairs of triangles as right triangles in square cells, where xatlas fails or runs out of time.

A chart is a connected set of faces that share edges in position and in UV and have the same winding in UV, so that
mirrored halves, which artists like to lay on top of each other, are two charts and can be placed apart.
"""

import dataclasses
import functools
import hashlib
import os
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np

from warp_neumat.io.cache import cache_folder
from warp_neumat.kernels.atlas import FOOTPRINT, atlas_folds, atlas_leaks, atlas_raster
from warp_neumat.pipeline.unwrap import (
    UnwrapError,
    connected,
    face_edges,
    right_triangle_cells,
    shelf_pack,
    triangle_areas,
    xatlas_unwrap,
)

CACHE_VERSION = 1  # raise it whenever the same request would give another layout

_MODES = ("auto", "authored", "xatlas", "fallback")
_LOST = 1e-3  # share of a part's surface that may have no place of its own on the sheet: specks and needles


@dataclasses.dataclass(frozen=True)
class AtlasLayout:
    """Where the triangles of a mesh sequence lie on a sheet that nobody has rasterised: no array has its texels.

    A :class:`StreamingAtlas` rasterises chart by chart, each into a rectangle of its own. So charts may overlap here,
    and how far they lie apart does not matter.

    Attributes:
        resolution, corner_uv, chart, sources, notes: As of :class:`Atlas`.
    """

    resolution: int
    corner_uv: np.ndarray
    chart: np.ndarray
    sources: dict[str, str]
    notes: list[str]


@dataclasses.dataclass(frozen=True)
class Atlas:
    """A square sheet of texels, its triangles and their owners.

    Attributes:
        resolution: Side of the sheet [texel], even.
        corner_uv: Corners [texel], shape [faces, 3, 2], float32. A triangle without area on the mesh is collapsed onto
            a corner of a neighbour, so that its values are always finite and on the sheet.
        chart: Chart of each triangle, shape [faces], int32, 0 … ``chart_count`` − 1.
        triangle: Owner of each texel, shape [resolution, resolution], int32; −1 = unowned.
        barycentric: Weights of the owner's second and third corner at the texel centre, clamped to the triangle, shape
            [resolution, resolution, 2], float32.
        sources: Part name → ``"authored"``, ``"repacked"``, ``"xatlas"`` or ``"fallback"``.
        notes: What did not go as asked, one sentence each.
    """

    resolution: int
    corner_uv: np.ndarray
    chart: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    sources: dict[str, str]
    notes: list[str]

    @property
    def owned(self) -> int:
        """Number of texels that a triangle owns, dilated borders included."""
        return int(np.count_nonzero(self.triangle >= 0))

    @property
    def chart_count(self) -> int:
        """Number of charts."""
        return int(self.chart.max()) + 1

    @property
    def utilisation(self) -> float:
        """Share of the sheet's area that triangles cover; borders do not count."""
        return float(np.abs(triangle_areas(self.corner_uv.astype(np.float64))).sum() / self.resolution**2)

    @classmethod
    def build(
        cls,
        sequence,
        resolution: int = 1200,
        *,
        padding: int = 4,
        uv: str = "auto",
        time_limit: float = 60.0,
        cache=True,
        progress=None,
        device=None,
    ) -> "Atlas":
        """Lay out and rasterise the sheet of a mesh sequence.

        Args:
            sequence: The :class:`MeshSequence`; texel density follows the surface areas of frame 0.
            resolution: Side of the sheet [texel], even, 16 … 16384.
            padding: Texels between two charts, 2 … 64, half of them dilated from either. The fallback keeps
                footprints apart and no more, because padding would take most of its small cells.
            uv: ``"auto"``; ``"authored"`` = fail where a part's UVs are unusable; ``"xatlas"`` = ignore authored UVs;
                ``"fallback"`` = cells of right triangles at once.
            time_limit: Seconds for xatlas, which runs in a child process.
            cache: ``True`` = ``$NEUMAT_CACHE`` or ``~/.cache/warp_neumat``; a folder; or ``False``.
            progress: Called as ``progress(fraction, text)`` while xatlas works.
            device: Warp device that rasterises; the result is numpy.

        Raises:
            ValueError: On a bad option, with ``uv="authored"`` on a part whose UVs are unusable, and if there are too
                many triangles for the resolution.
        """
        layout, raster = _lay_out(sequence, resolution, padding, uv, time_limit, cache, progress, device, True)
        return cls(resolution, layout.corner_uv, layout.chart, *raster, layout.sources, layout.notes)

    @staticmethod
    def layout(
        sequence,
        resolution: int,
        *,
        padding: int = 4,
        uv: str = "auto",
        time_limit: float = 60.0,
        cache=True,
        progress=None,
        device=None,
    ) -> AtlasLayout:
        """Lay out the sheet of a mesh sequence without rasterising it; arguments and errors as for :meth:`build`.

        A part's own UVs are kept as they are more often than by :meth:`build`, which needs space between charts.
        """
        layout, _ = _lay_out(sequence, resolution, padding, uv, time_limit, cache, progress, device, False)
        return AtlasLayout(resolution, layout.corner_uv, layout.chart, layout.sources, layout.notes)


@dataclasses.dataclass
class _Layout:
    corner_uv: np.ndarray
    chart: np.ndarray
    sources: dict[str, str]
    notes: list[str]
    timed_out: bool = False  # a longer limit may give a better layout
    keep: bool = True  # worth caching


def _raster(layout: _Layout | None, resolution: int, padding: int, device):
    """Return ``(triangle, barycentric)``, or ``None`` without a layout or if it does not hold the guarantee."""
    if layout is None:
        return None
    rings = max(1, padding // 2)
    raster = atlas_raster(layout.corner_uv, layout.chart, resolution, resolution, dilation=rings, device=device)
    return None if atlas_leaks(layout.corner_uv, layout.chart, raster[0], device=device).any() else raster


def _lay_out(sequence, resolution, padding, uv, time_limit, cache, progress, device, raster: bool):
    """Return ``(layout, (triangle, barycentric))``, from the cache if it has them, or ``(layout, ())`` unrasterised."""
    if not (16 <= resolution <= 16384 and resolution % 2 == 0):
        raise ValueError(f"resolution must be even and in 16 … 16384, got {resolution}")
    if not 2 <= padding <= 64:
        raise ValueError(f"padding must be in 2 … 64 texels, got {padding}")
    if uv not in _MODES:
        raise ValueError(f"uv must be one of {', '.join(_MODES)}, got {uv!r}")
    if not time_limit > 0:
        raise ValueError(f"time_limit must be a positive number of seconds, got {time_limit}")
    rasterise = (
        functools.partial(_raster, resolution=resolution, padding=padding, device=device) if raster else _unchecked
    )
    file = _cache_file(sequence, resolution, padding, uv if raster else f"{uv}|layout", cache)
    layout = None if file is None else _read_layout(file, len(sequence.faces), time_limit)
    made = rasterise(layout)
    if made is not None:
        return layout, made
    layout, made = _Maker(sequence, resolution, padding, uv, time_limit, progress, device, rasterise).make()
    if file is not None and layout.keep:
        try:
            _write_layout(file, layout, time_limit)
        except OSError as error:
            notes = [*layout.notes, f"the layout was not cached: {error}"]
            layout = dataclasses.replace(layout, notes=notes)
    return layout, made


def _unchecked(layout: _Layout | None):
    """Stand in for :func:`_raster` where charts are rasterised one by one: any layout will do."""
    return None if layout is None else ()


class _Maker:
    """One request to lay out a sequence: the mesh, seen as parts and charts, and the steps from best to safest."""

    def __init__(self, sequence, resolution, padding, uv, time_limit, progress, device, raster):
        self.resolution, self.padding, self.mode = resolution, padding, uv
        self.time_limit, self.progress, self.device = time_limit, progress, device
        self._raster = raster
        self.names = list(sequence.mesh_names)
        self.part = np.asarray(sequence.face_mesh)
        points = np.asarray(sequence.frame(0).points, np.float32) + np.float32(0)  # −0 becomes 0: equal when compared
        self.points, weld = np.unique(points, axis=0, return_inverse=True)
        self.faces = weld.reshape(-1)[np.asarray(sequence.faces)]
        self.area = np.nan_to_num(triangle_areas(self.points[self.faces].astype(np.float64)), nan=0.0, posinf=0.0)
        self.uv = np.asarray(sequence.uv, np.float64)[np.asarray(sequence.faces)]
        if not (self.area > 0).any():
            raise ValueError(
                f"none of the {len(self.faces)} triangles has an area in frame 0; there is nothing to lay out"
            )

    def make(self):
        """Return ``(layout, (triangle, barycentric))`` of the best layout that holds the guarantee."""
        chart = np.full(len(self.faces), -1, np.int32)
        surface_uv = np.zeros(self.uv.shape)
        unusable = {}
        for p in np.unique(self.part):
            mine = np.flatnonzero(self.part == p)
            reason = f"uv is {self.mode!r}" if self.mode in ("xatlas", "fallback") else None
            reason = reason or self._authored(mine, chart, surface_uv)
            if reason is not None:
                chart[mine] = -1
                unusable[int(p)] = reason
        if self.mode == "authored" and unusable:
            p, reason = next(iter(unusable.items()))
            raise ValueError(f"the UVs of {self.names[p]!r} cannot be kept: {reason}; use uv='auto' to unwrap it anew")
        if len(np.unique(self.part)) == 1 and not unusable:
            layout = self._keep(chart)
            raster = self._raster(layout)
            if raster is not None:
                return layout, raster
        made = np.isin(self.part, list(unusable))
        notes = [f"{self.names[p]}: {reason}" for p, reason in unusable.items() if self.mode == "auto"]
        failure = None
        packed = self.mode == "fallback" or (self._raster is _unchecked and not made.any())  # xatlas only packs tighter
        if not packed:
            try:
                layout = self._xatlas(made, surface_uv, chart, notes)
                raster = self._raster(layout)
                if raster is not None:
                    return layout, raster
                failure = UnwrapError("xatlas' charts overlap or lie too close")
            except UnwrapError as error:
                failure = error
            notes = [*notes, f"packed without xatlas: {failure}"]
        layout = self._fallback(made, surface_uv, chart, notes)
        layout.timed_out = failure is not None and failure.timed_out
        layout.keep = failure is None or failure.timed_out  # a crash or a missing library may be mended: try again
        raster = self._raster(layout)
        if raster is None:
            raise RuntimeError("the fallback layout breaks the footprint guarantee; please report this mesh")
        return layout, raster

    def _authored(self, mine, chart, surface_uv) -> str | None:
        """Find the charts of one part's own UVs and write them to ``chart`` and ``surface_uv``, or say why not."""
        uv, area = self.uv[mine], self.area[mine]
        finite = np.isfinite(uv).all(axis=(1, 2))
        if not finite.all():
            return f"{np.count_nonzero(~finite)} of {len(mine)} triangles have no UVs"
        signed = triangle_areas(uv)
        density = np.abs(signed).sum() / max(area.sum(), 1e-300)
        flat = np.abs(signed) <= 1e-6 * density * area  # a thousandth of the usual texels per length, or none
        if area[flat].sum() > _LOST * area.sum() or flat.all():
            return f"{np.count_nonzero(flat)} of {len(mine)} triangles are collapsed in UV"
        rows = mine[~flat]
        keys = np.concatenate(
            [
                self.faces[rows].reshape(-1, 1),
                self.uv[rows].reshape(-1, 2),
                np.repeat(signed[~flat] > 0, 3)[:, None],
            ],
            axis=1,
        )
        corners = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1, 3)
        charts = connected(len(rows), *face_edges(corners))
        low = uv.min(axis=(0, 1))
        size = max(1024, self.resolution)
        on_test_sheet = ((self.uv[rows] - low) * (size / (uv.max(axis=(0, 1)) - low).max())).astype(np.float32)
        folded = atlas_folds(on_test_sheet, charts, size, size, device=self.device)
        if self.area[rows[folded]].sum() > _LOST * area.sum():
            return f"{np.count_nonzero(folded)} of {len(mine)} triangles overlap others of their chart"
        chart[mine] = -1
        chart[rows] = charts + chart.max() + 1
        surface_uv[rows] = self.uv[rows] * np.sqrt(self.area[rows].sum() / np.abs(signed[~flat]).sum())
        return None

    def _keep(self, chart) -> _Layout | None:
        """Return the only part's own layout, ``None`` where it leaves [0, 1]; the caller checks for leaks."""
        uv = self.uv[chart >= 0]
        if uv.min() < -1e-3 or uv.max() > 1 + 1e-3:
            return None
        size, rim = self.resolution, FOOTPRINT - 0.5 + 1 / 64
        corners = self.uv * size
        if uv.min() * size < rim or uv.max() * size > size - rim:  # UVs up to the border: shrink by the rim
            low, high = min(uv.min(), 0.0), max(uv.max(), 1.0)
            corners = rim + (self.uv - low) * ((size - 2 * rim) / (high - low))
        return self._layout(corners, chart, np.zeros(len(chart), bool), "authored", [])

    def _xatlas(self, made, surface_uv, chart, notes) -> _Layout:
        """Return the layout of xatlas: new charts for the triangles ``made``, all charts packed."""
        new, kept = np.flatnonzero(made & (self.area > 0)), np.flatnonzero(chart >= 0)
        corners, charts, finished = xatlas_unwrap(
            self.points,
            self.faces[new],
            self.part[new],
            surface_uv[kept],
            chart[kept],
            resolution=self.resolution,
            padding=self.padding,
            time_limit=self.time_limit,
            progress=self.progress,
        )
        rows = np.concatenate([new, kept])
        lost = np.bincount(self.part[rows], weights=self.area[rows] * (charts < 0), minlength=len(self.names))
        share = lost / np.maximum(np.bincount(self.part, weights=self.area, minlength=len(self.names)), 1e-300)
        if share.max() > _LOST:
            raise UnwrapError(f"xatlas left out {100 * share.max():.1f} % of {self.names[share.argmax()]!r}")
        all_corners, all_charts = np.full(self.uv.shape, np.nan), np.full(len(self.faces), -1, np.int32)
        all_corners[rows], all_charts[rows] = corners, charts
        if not finished:
            notes = [*notes, f"xatlas was stopped after {self.time_limit:g} s; its best packing so far is used"]
        layout = self._layout(all_corners, all_charts, made, "xatlas", notes)
        layout.timed_out = not finished
        return layout

    def _fallback(self, made, surface_uv, chart, notes) -> _Layout:
        """Return our own layout: the authored charts' boxes and, for the triangles ``made``, cells."""
        surface_uv, chart = surface_uv.copy(), chart.copy()
        cells, numbers = right_triangle_cells(self.points, self.faces[made], self.part[made])
        surface_uv[made] = cells
        chart[made] = np.where(numbers >= 0, numbers + chart.max() + 1, -1)
        corners = shelf_pack(surface_uv, chart, self.resolution)
        if corners is not None:
            return self._layout(corners, chart, made, "fallback", notes)
        least = 2 * int(np.ceil(np.sqrt(chart.max() + 1)))
        raise ValueError(
            f"{len(self.faces)} triangles in {chart.max() + 1} charts do not fit a resolution of {self.resolution};"
            f" the smallest that holds them is {least}"
        )

    def _layout(self, corners, chart, made, how: str, notes) -> _Layout:
        """Return a layout in which triangles without a chart collapse onto a corner of a neighbour."""
        placed = np.flatnonzero(chart >= 0)
        corner_of = np.full(len(self.points), -1)  # for each position, a corner that lies on the sheet
        corner_of[self.faces[placed][::-1]] = 3 * placed[::-1, None] + np.arange(3)
        homeless = np.flatnonzero(chart < 0)
        near = corner_of[self.faces[homeless]].max(axis=1, initial=-1)
        near = np.where(near < 0, 3 * placed[0], near)
        corners, chart = corners.copy(), np.asarray(chart, np.int32).copy()
        corners[homeless] = corners[near // 3, near % 3][:, None]
        chart[homeless] = chart[near // 3]
        chart = np.unique(chart, return_inverse=True)[1].astype(np.int32)
        sources = {}
        for p in np.unique(self.part):
            own = "authored" if how == "authored" else "repacked"
            sources[self.names[p]] = how if made[self.part == p].any() else own
        return _Layout(np.ascontiguousarray(corners, np.float32), chart, sources, list(notes))


def _cache_file(sequence, resolution, padding, uv, cache) -> Path | None:
    if cache is False or cache is None:
        return None
    folder = cache_folder() if cache is True else Path(cache)
    request = f"{CACHE_VERSION}|{sequence.digest()}|{resolution}|{padding}|{uv}"
    return folder / f"atlas-{hashlib.sha256(request.encode()).hexdigest()[:32]}.npz"


def _read_layout(file: Path, face_count: int, time_limit: float) -> _Layout | None:
    """Return the cached layout; ``None`` if there is none, it is damaged, or more time is allowed than made it."""
    try:
        with np.load(file, allow_pickle=False) as data:
            corners, chart = data["corner_uv"], data["chart"]
            names, how, notes = (data[key].tolist() for key in ("names", "sources", "notes"))
            limit = float(data["time_limit"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    sound = corners.shape == (face_count, 3, 2) and corners.dtype == np.float32 and chart.shape == (face_count,)
    if not sound or chart.dtype != np.int32 or chart.min() < 0 or time_limit > limit:
        return None
    return _Layout(corners, chart, dict(zip(names, how, strict=True)), notes)


def _write_layout(file: Path, layout: _Layout, time_limit: float) -> None:
    """Write the layout to a temporary file beside ``file``, then rename it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=file.stem, suffix=".tmp", dir=file.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            np.savez(
                stream,
                corner_uv=layout.corner_uv,
                chart=layout.chart,
                names=np.array(list(layout.sources), dtype=str),
                sources=np.array(list(layout.sources.values()), dtype=str),
                notes=np.array(layout.notes, dtype=str),
                time_limit=time_limit if layout.timed_out else np.inf,
            )
        os.replace(temporary, file)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
