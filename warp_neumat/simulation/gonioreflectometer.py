"""A virtual gonioreflectometer: micro-geometry photographed under every pair of light and view, slice by slice.

``microgeometry:PATTERN?KEY=VALUE&…`` names a source: the pattern's parameters (:mod:`.height_fields`) and those of the
device,

- ``directions``: ``ubo2014`` (151 lights and views, the default) or ``ubo2003`` (81);
- ``samples``: rays and surface points of a texel, 4 or 16;
- ``bounces``: bounces of diffuse light, 0 to 8;
- ``rays``: directions of a bounce, 4 to 256.

A slice is what a camera far away sees, rectified to the mean plane of the height field as the measured databases are: a
texel is the part of that plane which its rays pass. Paths are traced with shadowing, masking and interreflection, and
what they share is traced once (:mod:`warp_neumat.kernels.height_field`): views keep which point each ray sees (4 bytes
a ray), lights what each point sends (8 bytes a point), and a slice is gathered from the two. Tables are made when a
slice first needs them, kept within ``memory``, and on disk.

Left out: light that highlights throw on other points and highlights of light from other points; transmission;
wavelengths. Points carry all detail, so an edge is as sharp as half a texel (a quarter, with 16 samples).
"""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections import OrderedDict

import numpy as np
import warp as wp

from warp_neumat.io.brdf_source import suggest
from warp_neumat.io.btf_directions import ubo2003_directions, ubo2014_directions
from warp_neumat.io.btf_source import checked_pairs
from warp_neumat.io.cache import cache_folder
from warp_neumat.kernels import height_field, height_field_light

from .height_fields import PATTERNS, MicroGeometry, make_pattern, parse_query
from .table_cache import TableCache

DIRECTIONS = {"ubo2014": ubo2014_directions, "ubo2003": ubo2003_directions}
"""Sets of directions by name."""

LOWEST = 0.01
"""Least z of a direction: nearer to the horizon, rays would run forever."""

_VERSION = b"gonioreflectometer 1"


class _Pool:
    """Tables of one length on a device, the longest unused given up first."""

    def __init__(self, rows: int, length: int, dtype, device):
        self.rows, self.length = rows, length
        self.table = wp.empty(rows * length, dtype=dtype, device=device)
        self.slots: OrderedDict[int, int] = OrderedDict()

    def missing(self, wanted) -> list[int]:
        """Return which of ``wanted`` (at most :attr:`rows`) are not there; those that are will stay."""
        for index in wanted:
            if index in self.slots:
                self.slots.move_to_end(index)
        return [index for index in wanted if index not in self.slots]

    def put(self, index: int, values: np.ndarray) -> None:
        """Keep the table of ``index``."""
        slot = len(self.slots) if len(self.slots) < self.rows else self.slots.popitem(last=False)[1]
        self.slots[index] = slot
        source = wp.array(values, dtype=self.table.dtype, device="cpu", copy=False)
        wp.copy(self.table, source, dest_offset=slot * self.length, count=self.length)


class Gonioreflectometer:
    """A :class:`~warp_neumat.io.btf_source.BTFSource` of a :class:`MicroGeometry`.

    Args:
        geometry: The surface.
        lights, views: Unit directions, shape (n, 3); z is raised to at least :data:`LOWEST`.
        sub: Rays and surface points along the side of a texel, even.
        bounces: Bounces of diffuse light.
        rays: Directions of a bounce, rounded up to a multiple of 4.
        cache: ``True`` = ``btf`` in :func:`~.table_cache.default_folder`; a folder; or ``False``.
        cache_limit: Bytes on disk.
        memory: Bytes of tables in memory.
        device: Warp device.

    Raises:
        ValueError: If directions or numbers are out of range.

    Error: a slice against paths traced one by one in float64, on the same sub-squares: at most 2e-6 + 2e-5 of the value
        but for texels with a ray that meets the line between two sub-squares or the edge of a shadow, at most 1 in 500;
        held by test_slices_match_paths_traced_one_by_one.
    """

    def __init__(
        self, geometry: MicroGeometry, lights=None, views=None, *, sub=2, bounces=3, rays=32, cache=True,
        cache_limit=4 << 30, memory=2 << 30, device=None,
    ):  # fmt: skip
        self.geometry, self.sub, self.bounces = geometry, int(sub), int(bounces)
        self.height, self.width = geometry.height.shape
        self.name, self.opening = geometry.name, {}
        if self.bounces < 0 or rays < 1:
            raise ValueError(f"bounces must be at least 0 and rays at least 1, got {bounces} and {rays}")
        self.lights = _directions("lights", ubo2014_directions() if lights is None else lights)
        self.views = _directions("views", ubo2014_directions() if views is None else views)
        self._ways = height_field_light.cosine_directions(rays)
        self._device, self._guard = wp.get_device(device), threading.RLock()
        points = self.width * self.height * self.sub**2
        most = len(self.lights) * 8 * points + len(self.views) * 4 * points
        share = min(1.0, memory / most)
        self._rows = tuple(
            max(1, min(n, max(height_field_light.LIGHTS, int(n * share)))) for n in (len(self.lights), len(self.views))
        )
        folder = cache_folder() / "btf" if cache is True else cache
        self._cache = TableCache(folder, cache_limit) if folder else None
        digest = hashlib.sha256(_VERSION)
        for field in dataclasses.fields(geometry)[1:]:
            digest.update(np.ascontiguousarray(getattr(geometry, field.name)).tobytes())
        digest.update(repr((geometry.height.shape, self.sub)).encode())
        self._digest, self._surface = digest.digest(), None

    @property
    def notes(self) -> tuple[str, ...]:
        """What is left out, and why nothing is cached where that failed."""
        notes = [
            f"simulated: {self.sub**2} rays a texel, {self.bounces} diffuse bounces over {len(self._ways)} directions;"
            " light that highlights throw on other points is left out"
        ]
        if self._cache is not None and self._cache.trouble:
            notes.append(f"tables are not cached: {self._cache.trouble}")
        return tuple(notes)

    def slices(self, pairs: np.ndarray) -> np.ndarray:
        """Return value × cos θ_i [1/sr] of ``pairs`` (N, 2) of indices (light, view), (N, height, width, 3) float32."""
        pairs = checked_pairs(pairs, len(self.lights), len(self.views))
        if not len(pairs):
            return np.zeros((0, self.height, self.width, 3), np.float32)
        with self._guard:
            self._prepare()
            used, group = [], []
            for column, rows in enumerate(self._rows):
                indices, rank = np.unique(pairs[:, column], return_inverse=True)
                used.append(indices)
                group.append(rank.ravel() // rows)
            tile = group[0] * (group[1].max() + 1) + group[1]
            tiles = np.unique(tile)
            if len(tiles) == 1:  # everything fits into memory at once
                return self._tile(pairs)
            out = np.empty((len(pairs), self.height, self.width, 3), np.float32)
            for number in tiles:
                rows = np.flatnonzero(tile == number)
                out[rows] = self._tile(pairs[rows])
            return out

    def _tile(self, pairs: np.ndarray) -> np.ndarray:
        lights, views = (np.unique(pairs[:, k]).tolist() for k in (0, 1))
        self._fetch(self._light_pool, "light", lights, height_field_light.LIGHTS, self._make_lights)
        self._fetch(self._view_pool, "view", views, 16, self._make_views)
        at_light, at_view = self._light_pool.slots, self._view_pool.slots
        slots = np.array([(at_light[i], at_view[j]) for i, j in pairs.tolist()], np.int32)
        by_slot = [np.zeros((pool.rows, 3), np.float32) for pool in (self._light_pool, self._view_pool)]
        by_slot[0][[at_light[i] for i in lights]] = self.lights[lights]
        by_slot[1][[at_view[j] for j in views]] = self.views[views]
        return self._optics.slices(slots, *by_slot, self._light_pool.table, self._view_pool.table)

    def _prepare(self) -> None:
        """Lay out the surface and its tables, at the first slice."""
        if self._surface is not None:
            return
        g, sub = self.geometry, self.sub
        surface = height_field.surface(g.height, g.fibre, sub, device=self._device)
        albedo = height_field.interpolated(g.albedo, sub)[0]
        alpha, f0 = np.repeat(g.alpha.reshape(-1, 2), sub * sub, 0), np.repeat(g.f0.ravel(), sub * sub)
        self._optics = height_field_light.Optics(surface, albedo, alpha, f0)
        self._light_pool = _Pool(self._rows[0], surface.points, wp.uint64, self._device)
        self._view_pool = _Pool(self._rows[1], surface.points, wp.int32, self._device)
        self._seen = None
        self._surface = surface

    def _fetch(self, pool: _Pool, kind: str, wanted: list[int], step: int, make) -> None:
        """Bring the tables of ``wanted`` into ``pool``: from disk where they are, else made ``step`` at a time."""
        directions = self.lights if kind == "light" else self.views
        dtype, left = wp.dtype_to_numpy(pool.table.dtype), []
        missing = pool.missing(wanted)
        for index in missing:
            key = self._key(kind, directions[index])
            found = self._cache.load(key, dtype, pool.length) if self._cache is not None else None
            if found is None:
                left.append(index)
            else:
                pool.put(index, found)
        for start in range(0, len(left), step):
            part = left[start : start + step]
            for index, table in zip(part, make(directions[part]), strict=True):
                pool.put(index, table)
                if self._cache is not None:
                    self._cache.store(self._key(kind, directions[index]), table)
        if left and self._cache is not None:
            self._cache.trim()

    def _make_lights(self, directions: np.ndarray) -> np.ndarray:
        if self._seen is None and self.bounces:
            found = height_field.trace_bounces(self._surface, self._ways)
            self._seen = wp.array(found.ravel(), dtype=wp.int32, device=self._device)
        seen = self._seen if self.bounces else wp.zeros(1, dtype=wp.int32, device=self._device)
        lit = height_field.trace_lights(self._surface, directions)
        return self._optics.light_tables(directions, lit, seen, len(self._ways), self.bounces)

    def _make_views(self, directions: np.ndarray) -> np.ndarray:
        return height_field.trace_views(self._surface, directions)

    def _key(self, kind: str, direction: np.ndarray) -> str:
        key = hashlib.sha256(self._digest + kind.encode() + direction.tobytes())
        if kind == "light":
            key.update(repr((self.bounces, len(self._ways))).encode())
        return f"{kind}-{key.hexdigest()[:40]}"


def _directions(name: str, values) -> np.ndarray:
    values = np.array(values, np.float64)
    if values.ndim != 2 or values.shape[1] != 3 or not len(values) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite directions of shape (n, 3), got {values.shape}")
    length = np.linalg.norm(values, axis=1, keepdims=True)
    if (length < 1e-12).any() or (values[:, 2] < 0).any():
        raise ValueError(f"{name} must be directions of the upper hemisphere, z ≥ 0 and not all zero")
    values /= length
    values[:, 2] = np.maximum(values[:, 2], LOWEST)
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


_DEVICE = {"samples": (4, 16), "bounces": (0, 8), "rays": (4, 256)}


def open_microgeometry(spec: str, **options) -> Gonioreflectometer:
    """Return the source that ``microgeometry:PATTERN?KEY=VALUE&…`` names; the prefix may be missing.

    Args:
        spec: What to simulate, as the module says.
        options: Further arguments of :class:`Gonioreflectometer`, as ``cache`` and ``memory``.

    Raises:
        ValueError: If pattern, key or value is wrong; one line, with the nearest name or the range.
    """
    spec = spec.removeprefix("microgeometry:")
    name, _, query = spec.partition("?")
    if name not in PATTERNS:
        raise ValueError(f"microgeometry:{spec}: no pattern {name!r}; {suggest(name, PATTERNS)}")
    parts = [part for part in query.split("&") if part]
    chosen = [part.partition("=")[2] for part in parts if part.partition("=")[0] == "directions"]
    if len(chosen) > 1 or (chosen and chosen[0] not in DIRECTIONS):
        raise ValueError(f"microgeometry:{spec}: directions must be one of {', '.join(DIRECTIONS)}, got {chosen[-1]!r}")
    query = "&".join(part for part in parts if not part.startswith("directions="))
    parameters = parse_query(f"microgeometry:{spec}", query)
    device = {key: parameters.pop(key) for key in _DEVICE if key in parameters}
    for key, value in device.items():
        low, high = _DEVICE[key]
        if isinstance(value, tuple) or value != int(value) or not low <= value <= high:
            raise ValueError(f"microgeometry:{spec}: {key} must be a whole number in [{low}, {high}], got {value}")
    if device.get("samples", 4) not in (4, 16):
        raise ValueError(f"microgeometry:{spec}: samples must be 4 or 16, got {device['samples']:g}")
    try:
        geometry = make_pattern(name, **parameters)
    except ValueError as error:
        raise ValueError(f"microgeometry:{spec}: {error}") from None
    directions = DIRECTIONS[chosen[0] if chosen else "ubo2014"]()
    settings = {"lights": directions, "views": directions, "sub": int(device.get("samples", 4) ** 0.5)}
    settings |= {key: int(device[key]) for key in ("bounces", "rays") if key in device}
    source = Gonioreflectometer(geometry, **(settings | options))
    source.name, source.opening = f"microgeometry:{spec}", {"spec": f"microgeometry:{spec}"}
    return source
