"""A set of PBR maps as one picture of up to 16 channels: opened from a folder or manifest, understood, and told about.

Pixels are (H, W, C) float32 in [0, 1] in the encoded domain, row 0 on top; per channel, ``encoding`` and ``range`` say
what a value means: v = lo + (hi − lo)·y; ``linear``: value = v; ``srgb``: value = linear light of v; ``normal``: n =
2v − 1 for x and y, +Y up (OpenGL), z = sqrt(1 − x² − y²).

Rules: the largest map's size is the set's; smaller ones are brought to it, bilinearly (:mod:`warp_neumat.io.mipmaps`).
A map whose stored values span less than half a step of 8 bits (0.00196) is not learnt but kept in ``constants``, as
linear values; a map that is only nearly constant is learnt, with a note. Three-channel pictures whose channels are
within one step of 8 bits of each other give one channel, base colours and emissive maps only where they are exactly
grey throughout.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from .image import ImageInfo, read_image
from .map_fields import MapSource
from .map_names import kind_of
from .map_pixels import MapPixels, decode_map
from .map_sources import FORMAT, list_sources
from .mipmaps import mip_chain, resample, srgb_to_linear, unit_normals

MAX_CHANNELS = 16
"""Channels that a set may have, constants not counted."""


@dataclasses.dataclass(frozen=True)
class Channel:
    """One channel of a set: ``map``, ``component`` (``r g b a``, ``x y`` or ``value``), ``encoding``, ``range``."""

    map: str
    component: str
    encoding: str
    range: tuple[float, float] = (0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class MapRow:
    """What was understood of one map: a line of :meth:`TextureSet.table`.

    ``use`` is ``learnt`` or ``constant``; ``notes`` are those of this map alone. ``width``, ``height`` and ``dtype``
    are the file's.
    """

    map: str
    file: str
    components: tuple[str, ...]
    color_space: str
    width: int
    height: int
    dtype: str
    use: str
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class TextureSet:
    """A set of maps, opened by :func:`open_texture_set`.

    ``pixels`` is (height, width, C) float32 in the encoded domain; ``channels`` its C channels; ``constants`` maps with
    one value each, linear; ``files`` {map: "file.png:channels"}; ``rows`` the lines of the table; ``notes`` everything
    worth a look before training.
    """

    name: str
    width: int
    height: int
    channels: tuple[Channel, ...]
    constants: dict[str, tuple[float, ...]]
    pixels: np.ndarray
    rows: tuple[MapRow, ...]
    notes: tuple[str, ...]
    _manifest: dict

    @property
    def files(self) -> dict[str, str]:
        """Which file each map came from, with the channels taken: {"roughness": "x_orm.png:g"}."""
        return {row.map: row.file for row in self.rows}

    def mips(self, *, toksvig_roughness: bool = False) -> list[np.ndarray]:
        """Return all mip levels, (h, w, C) float32, encoded domain, from :attr:`pixels` itself to 1×1.

        See :func:`warp_neumat.io.mipmaps.mip_chain`.
        """
        return mip_chain(self.pixels, self.channels, toksvig_roughness=toksvig_roughness)

    def manifest(self, folder=None) -> dict:
        """Return a manifest that opens to this very set, JSON-able.

        Args:
            folder: Folder that the manifest will lie in; file paths are then relative to it, else absolute.
        """
        tree = {**self._manifest, "maps": {}}
        for name, fields in self._manifest["maps"].items():
            fields = dict(fields)
            if "file" in fields and folder is not None:
                fields["file"] = Path(os.path.relpath(fields["file"], Path(folder).resolve())).as_posix()
            tree["maps"][name] = fields
        return tree

    def table(self) -> str:
        """Return what was understood as text: a line per map, then the notes."""
        head = ("map", "file", "channels", "colour space", "size", "type", "use")
        lines = [head]
        for row in self.rows:
            use = row.use
            if use == "constant":
                use += " " + " ".join(f"{x:.4g}" for x in self.constants[row.map])
            size = f"{row.width}×{row.height}" if row.width else "-"
            parts = " ".join(row.components)
            lines.append((row.map, row.file, parts, row.color_space, size, row.dtype or "-", use))
        widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
        text = [f"{self.name}: {self.width}×{self.height}, {len(self.channels)} channels to learn"]
        text += ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
        text.insert(2, "  ".join("-" * w for w in widths))
        return "\n".join([*text, *(f"note: {note}" for note in self.notes)])


def open_texture_set(source, *, size=None, crop=None, overrides=None) -> TextureSet:
    """Open the maps of one material as a :class:`TextureSet`.

    Args:
        source: A folder of pictures, whose names tell the maps (:mod:`warp_neumat.io.map_names`); a JSON manifest, ours
            or that of ntc-cli (:mod:`warp_neumat.io.map_sources`); or such a manifest as a dictionary.
        size: Size of the set, (width, height) or the longer side; by default that of the largest map, or of the crop.
            Filtered by area in linear light and on vectors, see :mod:`warp_neumat.io.mipmaps`.
        crop: (x, y, width, height) in pixels of the set at its full size; taken before ``size``. What is constant is
            decided on the crop.
        overrides: What to do otherwise than the names say, by map: ``{"normal": {"orientation": "dx"}, "roughness":
            {"file": "x.png", "channel": "g", "color_space": "linear"}, "metallic": 0.0, "mask": None}``: fields of
            :data:`warp_neumat.io.map_fields.FIELDS`, a constant, or None to drop the map.

    Raises:
        FileNotFoundError: If the source or a file that it names does not exist.
        OSError: If a picture cannot be decoded; the line names the file.
        ValueError: If no picture is there, two files claim a map, values are not finite, there are more than 16
            channels, or an argument is wrong; one line with the way out.
    """
    found = list_sources(source, overrides)
    pictures = {file: read_image(file, stored=True) for file in {s.file: None for s in found.sources if s.file}}
    sizes = [(info.width, info.height) for _, info in pictures.values()]
    full = max(sizes, key=lambda wh: (wh[0] * wh[1], wh), default=(1, 1))
    crop = _checked_crop(crop if crop is not None else found.crop, full)
    own = crop[2:] if crop else full
    target = _checked_size(size if size is not None else found.size, own)
    maps = [_understood(entry, pictures, full, crop, target) for entry in found.sources]
    maps = [m for m in maps if not (m.source.how == "alpha" and m.constant == (1.0,))]  # an alpha that says nothing
    learnt = [m for m in maps if m.constant is None]
    channels = tuple(Channel(m.source.map, c, m.encoding, m.range) for m in learnt for c in m.row.components)
    _check_count(found.name, channels)
    notes = [*found.notes, *(f"{m.source.map}: {note}" for m in maps for note in m.row.notes)]
    if not channels:
        notes.append("every map is constant: nothing is left to learn")
    return TextureSet(
        name=found.name,
        width=target[0],
        height=target[1],
        channels=channels,
        constants={m.source.map: m.constant for m in maps if m.constant is not None},
        pixels=_side_by_side(learnt, target),
        rows=tuple(m.row for m in maps),
        notes=tuple(notes),
        _manifest=_manifest(found.name, [m.source for m in maps], target if target != own else None, crop),
    )


@dataclasses.dataclass
class _Map:
    """One map as the set keeps it: its planes, or one value where it is constant."""

    source: MapSource
    row: MapRow
    constant: tuple[float, ...] | None
    encoding: str = "linear"
    range: tuple[float, float] = (0.0, 1.0)
    planes: np.ndarray | None = None


def _understood(source: MapSource, pictures: dict, full, crop, target) -> _Map:
    if source.file is None:
        form = kind_of(source.map).form
        names = ("x", "y", "z") if form == "normal" else tuple("rgba"[: len(source.constant)])
        names = names if len(names) > 1 else ("value",)
        return _Map(source, MapRow(source.map, source.label, names, "linear", 0, 0, "", "constant"), source.constant)
    picture, info = pictures[source.file]
    decoded = _fitted(source, picture, info, full, crop, target)
    constant, notes = _constant(decoded), list(decoded.notes)
    if source.how == "alpha":
        notes.append("the alpha channel of the base colour")
    if constant is None and max(float(plane.std()) for plane in np.moveaxis(decoded.planes[::3, ::3], 2, 0)) < 1 / 255:
        notes.append(_nearly(decoded))
    row = MapRow(
        source.map,
        source.label,
        decoded.components,
        decoded.color_space,
        info.width,
        info.height,
        info.dtype,
        "learnt" if constant is None else "constant",
        tuple(notes),
    )
    if decoded.encoding != "normal":
        source = dataclasses.replace(source, color_space=decoded.color_space)
    planes = decoded.planes if constant is None else None
    return _Map(source, row, constant, decoded.encoding, decoded.range, planes)


def _fitted(source: MapSource, picture, info: ImageInfo, full, crop, target) -> MapPixels:
    """Return one map decoded, cropped and at the set's size."""
    own, whole = (info.width, info.height), (slice(None), slice(None))
    window = (slice(crop[1], crop[1] + crop[3]), slice(crop[0], crop[0] + crop[2])) if crop else whole
    decoded = decode_map(source, picture, info, window if own == full else whole)
    channels = [Channel(source.map, c, decoded.encoding) for c in decoded.components]
    if own != full:
        decoded.notes.append(f"{own[0]}×{own[1]} brought to the set's {full[0]}×{full[1]}")
        if own[0] * full[1] != own[1] * full[0]:
            decoded.notes.append("its aspect ratio is not that of the set")
        if crop:
            decoded.planes = resample(decoded.planes, channels, *full)[window]
    decoded.planes = resample(np.ascontiguousarray(decoded.planes), channels, *target)
    return decoded


def _constant(decoded: MapPixels) -> tuple[float, ...] | None:
    """Return a map's linear values if it is constant: a unit vector for normals."""
    if not decoded.is_constant:
        return None
    y = decoded.planes[:1, :1]
    if decoded.encoding == "normal":
        return tuple(float(x) for x in unit_normals(y)[0, 0])
    low, high = decoded.range
    values = low + (high - low) * y
    values = srgb_to_linear(values) if decoded.encoding == "srgb" else values
    return tuple(float(x) for x in values[0, 0])


def _nearly(decoded: MapPixels) -> str:
    low, high = decoded.range
    least, most = (low + (high - low) * float(f(decoded.planes)) for f in (np.min, np.max))
    way_out = "[0, 0, 1]" if decoded.encoding == "normal" else "a number"
    return (
        f"nearly constant (stored values {least:.3g} … {most:.3g}) but learnt; set it to {way_out} in overrides to "
        "keep one value instead"
    )


def _side_by_side(maps: list[_Map], size: tuple[int, int]) -> np.ndarray:
    """Return the planes of ``maps`` as one array and let go of them."""
    pixels = np.empty((size[1], size[0], sum(m.planes.shape[2] for m in maps)), np.float32)
    for row in range(0, size[1], 8):  # so that a cache line is written once, not once per map
        np.concatenate([m.planes[row : row + 8] for m in maps] or [pixels[row : row + 8]], 2, out=pixels[row : row + 8])
    for m in maps:
        m.planes = None
    return pixels


def _checked_crop(crop, full) -> tuple[int, int, int, int] | None:
    if crop is None:
        return None
    if not _whole(crop, 4):
        raise ValueError(f"crop must be (x, y, width, height) in whole pixels, got {crop!r}")
    x, y, width, height = (int(v) for v in crop)
    if x < 0 or y < 0 or width < 1 or height < 1 or x + width > full[0] or y + height > full[1]:
        raise ValueError(f"crop {x},{y} {width}×{height} must lie within the set's {full[0]}×{full[1]} pixels")
    return x, y, width, height


def _checked_size(size, full) -> tuple[int, int]:
    if size is None:
        return tuple(full)
    if _whole([size], 1) and size >= 1:
        longest = max(full)
        return tuple(max(1, round(side * int(size) / longest)) for side in full)
    if not _whole(size, 2) or min(size) < 1:
        raise ValueError(f"size must be (width, height) or the longer side, at least 1, got {size!r}")
    return int(size[0]), int(size[1])


def _whole(values, count: int) -> bool:
    if not isinstance(values, (list, tuple)) or len(values) != count:
        return False
    return all(isinstance(v, (int, np.integer)) and not isinstance(v, bool) for v in values)


def _check_count(name: str, channels) -> None:
    if len(channels) <= MAX_CHANNELS:
        return
    counts: dict[str, int] = {}
    for channel in channels:
        counts[channel.map] = counts.get(channel.map, 0) + 1
    listed = ", ".join(f"{m} ({n})" for m, n in counts.items())
    last = list(counts)[-1]
    raise ValueError(
        f"{name}: {len(channels)} channels, at most {MAX_CHANNELS} fit: {listed}; drop maps with "
        f'overrides={{"{last}": None, …}}'
    )


def _manifest(name: str, sources, size, crop) -> dict:
    maps = {}
    for entry in sources:
        fields = {}
        if entry.constant is not None:
            fields["constant"] = list(entry.constant)
        else:
            fields["file"] = entry.file.resolve().as_posix()
        if entry.channel is not None:
            fields["channel"] = entry.channel if isinstance(entry.channel, str) else list(entry.channel)
        for key in ("color_space", "orientation", "replace_nan"):
            if getattr(entry, key) is not None:
                fields[key] = getattr(entry, key)
        for key in ("invert", "flip"):
            if getattr(entry, key):
                fields[key] = True
        maps[entry.map] = fields
    tree = {"format": FORMAT, "version": 1, "name": name}
    if size:
        tree["size"] = list(size)
    if crop:
        tree["crop"] = list(crop)
    return {**tree, "maps": maps}
