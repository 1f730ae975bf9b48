"""Which picture gives which map: what a folder, a manifest and the user's overrides say, settled into one list.

Nothing is decoded here; file headers are read to tell one-channel pictures from packed ones. Three kinds of source:

- a folder of pictures, read by name (:mod:`warp_neumat.io.map_names`);
- our manifest, a JSON object ``{"format": "neumat-textures", "version": 1, "name": …, "size": [w, h], "crop": [x, y, w,
  h], "maps": {MAP: FIELDS, …}}``, of which only ``maps`` is required, FIELDS being an object with
  those of :data:`warp_neumat.io.map_fields.FIELDS`;
- the manifest of NVIDIA's ntc-cli (docs/Manifest.md of RTXNTC): ``{"textures": [{"fileName", "name", "semantics",
  "channelSwizzle", "isSRGB", "verticalFlip", "mipLevel", …}], "width", "height"}``, or the bare list of older versions.

Paths in a manifest are relative to its folder.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from .image import read_image_info
from .map_fields import MapSource, check_fields, checked_name, edited, existing_file, nearest
from .map_names import KINDS, kind_of, read_names

PICTURES = {".png", ".jpg", ".jpeg", ".tga", ".tif", ".tiff", ".bmp", ".exr", ".hdr", ".webp"}
FORMAT = "neumat-textures"

_NTC_MAPS = {
    "albedo": "base_color",
    "alpha": "opacity",
    "mask": "opacity",
    "alphamask": "opacity",
    "displ": "displacement",
    "displacement": "displacement",
    "emissive": "emissive",
    "emission": "emissive",
    "glossiness": "roughness",
    "metalness": "metallic",
    "metallic": "metallic",
    "normal": "normal",
    "occlusion": "occlusion",
    "ao": "occlusion",
    "roughness": "roughness",
    "specularcolor": "specular",
    "transmission": "transmission",
}


@dataclasses.dataclass
class SourceList:
    """The maps that a source offers, with what was noticed on the way."""

    name: str
    folder: Path
    sources: list[MapSource]
    notes: list[str] = dataclasses.field(default_factory=list)
    size: tuple[int, int] | None = None
    crop: tuple[int, int, int, int] | None = None


def list_sources(source, overrides=None) -> SourceList:
    """Return the maps that ``source`` offers once ``overrides`` are applied, at most one source each, in set order.

    Args:
        source: Folder, manifest file, or a manifest as a dictionary (paths relative to the working folder).
        overrides: {map: {field: value}}, {map: None} to drop a map, {map: number} for a constant.

    Raises:
        FileNotFoundError: If the source or a file that it names does not exist.
        ValueError: If nothing in it is a map, two files claim one map, or a field or value is wrong.
    """
    found = _open(source)
    if overrides is not None and not isinstance(overrides, dict):
        raise TypeError(f"overrides must be a dictionary of maps, got {type(overrides).__name__}")
    offered = found.sources
    found.sources = _settle(offered, found.notes, set(overrides or ()))
    for name, fields in (overrides or {}).items():
        found.sources = _override(found, offered, name, fields)
    _refuse_doubles(found.sources)
    if not found.sources:
        raise ValueError(f"{found.name}: every map is dropped; leave at least one")
    order = {name: i for i, name in enumerate(KINDS)}
    found.sources.sort(key=lambda s: (order.get(s.map, len(order)), s.map))
    return found


def _open(source) -> SourceList:
    if isinstance(source, dict):
        return _from_manifest(source, Path(), "manifest")
    path = Path(source)
    if path.is_dir():
        return _from_folder(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder or manifest")
    if path.suffix.lower() != ".json":
        raise ValueError(f"{path}: must be a folder of maps or a .json manifest")
    try:
        tree = json.loads(path.read_text(encoding="utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is no JSON manifest: {error}") from None
    return _from_manifest(tree, path.parent, path.stem, str(path))


# --- folder -----------------------------------------------------------------------------------------------------------


def _from_folder(folder: Path) -> SourceList:
    found = SourceList(folder.resolve().name, folder, [])
    files = []
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        if entry.suffix.lower() in PICTURES and entry.is_file():
            files.append(entry)
        else:
            found.notes.append(f"{entry.name}: {'a folder' if entry.is_dir() else 'no picture'}, ignored")
    if not files:
        kinds = " ".join(sorted(PICTURES))
        raise ValueError(f"{folder}: holds no pictures ({kinds}); give a folder of maps or a manifest")
    infos = [_info(file) for file in files]
    claims = read_names([file.stem for file in files], [len(info.channels) if info else 3 for info in infos])
    for file, info, group in zip(files, infos, claims, strict=True):
        for claim in group:
            if claim.how == "preview":
                found.notes.append(f"{file.name}: looks like a preview, ignored; name it in overrides to use it")
                continue
            entry = MapSource(
                claim.map, file, claim.channels, orientation=claim.orientation, invert=claim.invert, how=claim.how
            )
            found.sources.append(entry)
            found.notes += _guess_notes(entry)
            if claim.map == "base_color" and claim.channels is None and info and "A" in info.channels:
                found.sources.append(MapSource("opacity", file, "a", color_space="linear", how="alpha"))
    if not found.sources:
        raise ValueError(f"{folder}: holds previews only; name the maps in overrides or a manifest")
    return found


def _info(file: Path):
    try:
        return read_image_info(file)
    except OSError:
        return None  # decoding it will say why, unless an override drops it


def _guess_notes(entry: MapSource) -> list[str]:
    if entry.how == "letter":
        return [f"{entry.file.name}: taken as {entry.map} for its last letter"]
    if entry.how == "stem":
        return [f"{entry.file.name}: no map in its name; taken as base_color, the others share its stem"]
    if entry.how == "extra":
        return [f"{entry.file.name}: no known map in its name; kept as the extra map {entry.map}, linear"]
    return []


def _settle(sources: list[MapSource], notes: list[str], overridden: set[str]) -> list[MapSource]:
    """Return the sources without those that another makes superfluous, each with a note."""
    kept = list(sources)

    def drop(entry, why):
        kept.remove(entry)
        notes.append(f"{entry.label}: not used for {entry.map}, {why}")

    def others(entry):
        return [s for s in kept if s.map == entry.map and s is not entry]

    for entry in sources:
        rest = others(entry)
        if entry.how == "alpha" and (rest or entry.map in overridden):
            kept.remove(entry)
        elif entry.orientation == "dx" and any(s.orientation == "gl" for s in rest):
            drop(entry, "the OpenGL one is there")
        elif entry.invert and entry.how == "name" and any(not s.invert and s.how == "name" for s in rest):
            drop(entry, "a roughness map is there")
        elif entry.how == "packed" and any(s.how == "name" for s in rest):
            drop(entry, f"{next(s for s in rest if s.how == 'name').label} is a map of its own")
    if not any(s.map == "displacement" for s in kept):
        kept = [dataclasses.replace(s, map="displacement") if s.map == "bump" and s.how == "name" else s for s in kept]
    return kept


def _refuse_doubles(sources: list[MapSource]) -> None:
    seen: dict[str, MapSource] = {}
    for entry in sources:
        if entry.map in seen:
            first = seen[entry.map]
            raise ValueError(
                f"{first.label} and {entry.label} both claim the map {entry.map}; choose one with "
                f'overrides={{"{entry.map}": {{"file": "{first.file.name}"}}}} or in a manifest'
            )
        seen[entry.map] = entry


# --- manifests --------------------------------------------------------------------------------------------------------


def _from_manifest(tree, folder: Path, name: str, where: str = "manifest") -> SourceList:
    if isinstance(tree, list) or (isinstance(tree, dict) and "textures" in tree):
        return _from_ntc(tree if isinstance(tree, dict) else {"textures": tree}, folder, name, where)
    if not isinstance(tree, dict) or not isinstance(tree.get("maps"), dict) or not tree["maps"]:
        raise ValueError(f'{where}: must have an object "maps" with at least one map, or a list "textures" (ntc-cli)')
    known = ("format", "version", "name", "size", "crop", "maps")
    for key in tree:
        if key not in known:
            raise ValueError(f"{where}: unknown key {key!r}; {nearest(key, known)}")
    if tree.get("format", FORMAT) != FORMAT or tree.get("version", 1) != 1:
        raise ValueError(f'{where}: must have "format": "{FORMAT}" and "version": 1; update warp-neumat for newer ones')
    found = SourceList(str(tree.get("name", name)), folder, [])
    for key, count in (("size", 2), ("crop", 4)):
        if tree.get(key) is not None:
            setattr(found, key, _whole_numbers(tree[key], count, f"{where}: {key}"))
    for entry, fields in tree["maps"].items():
        if not isinstance(fields, dict):
            raise ValueError(f"{where}: map {entry} must be an object with a file or a constant, got {fields!r}")
        start = MapSource(checked_name(entry, where), how="manifest")
        found.sources.append(edited(start, fields, folder, f"{where}: map {entry}"))
    return found


def _whole_numbers(value, count: int, where: str) -> tuple[int, ...]:
    good = isinstance(value, (list, tuple)) and len(value) == count
    if not good or not all(isinstance(x, int) and not isinstance(x, bool) for x in value):
        raise ValueError(f"{where} must be {count} whole numbers, got {value!r}")
    return tuple(value)


def _from_ntc(tree: dict, folder: Path, name: str, where: str) -> SourceList:
    entries = tree["textures"]
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise ValueError(f'{where}: "textures" must be a list of objects, at least one')
    found = SourceList(name, folder, [])
    if isinstance(tree.get("width"), int) and isinstance(tree.get("height"), int):
        found.size = (tree["width"], tree["height"])
    used = []
    for i, entry in enumerate(entries):
        if not isinstance(entry.get("fileName"), str):
            raise ValueError(f'{where}: textures[{i}] must have a "fileName"')
        if entry.get("mipLevel", 0):
            found.notes.append(f"{entry['fileName']}: mip {entry['mipLevel']} is not used, mips are filtered here")
            continue
        if entry.get("lossFunctionScale", 1) != 1:
            found.notes.append(f"{entry['fileName']}: lossFunctionScale is not used")
        used.append((entry, existing_file(folder, entry["fileName"], f"{where}: textures[{i}]")))
    names = [str(entry.get("name") or file.stem) for entry, file in used]
    infos = [_info(file) for _, file in used]
    guesses = read_names(names, [len(info.channels) if info else 3 for info in infos])
    for (entry, file), guess in zip(used, guesses, strict=True):
        swizzle = str(entry.get("channelSwizzle") or "").lower()
        if set(swizzle) - set("rgba") or len(swizzle) > 4:
            raise ValueError(f"{where}: {file.name}: channelSwizzle must be 1 to 4 of R, G, B, A, got {swizzle!r}")
        shared = MapSource("", file, flip=bool(entry.get("verticalFlip")), how="manifest")
        semantics = entry.get("semantics") or {}
        for label, letters in semantics.items():
            if label.lower() not in _NTC_MAPS:
                raise ValueError(f"{where}: {file.name}: unknown semantic {label!r}; {nearest(label, _NTC_MAPS)}")
            letters = str(letters).lower()
            if not letters or letters not in "rgba" or (swizzle and "rgba".index(letters[-1]) >= len(swizzle)):
                raise ValueError(f"{where}: {file.name}: semantic {label} must name a run of RGBA, got {letters!r}")
            if swizzle:
                letters = "".join(swizzle["rgba".index(c)] for c in letters)
            target = _NTC_MAPS[label.lower()]
            space = "srgb" if entry.get("isSRGB") and letters != "a" and kind_of(target).form != "normal" else "linear"
            invert = label.lower() == "glossiness"
            new = dataclasses.replace(shared, map=target, channel=letters, color_space=space, invert=invert)
            found.sources.append(new)
        if not semantics:
            for claim in guess:
                srgb = bool(entry.get("isSRGB")) and kind_of(claim.map).form != "normal"
                new = dataclasses.replace(
                    shared,
                    map=claim.map,
                    channel=claim.channels or swizzle or None,
                    color_space="srgb" if srgb else "linear",
                    orientation=claim.orientation,
                    invert=claim.invert,
                )
                found.sources.append(new)
                found.notes.append(f"{file.name}: no semantics in the manifest; taken as {claim.map} for its name")
    return found


# --- overrides --------------------------------------------------------------------------------------------------------


def _override(found: SourceList, offered: list[MapSource], name: str, fields) -> list[MapSource]:
    where = f"overrides: {name}"
    mine = [s for s in found.sources if s.map == name]
    if not mine and not (isinstance(fields, dict) and ("file" in fields or "constant" in fields)):
        known = sorted({s.map for s in found.sources} | {s.map for s in offered})
        if name not in known and not isinstance(fields, (int, float, list, tuple)):
            raise ValueError(f"{where}: the set has no such map; {nearest(name, known)}, or give its file")
    rest = [s for s in found.sources if s.map != name]
    if fields is None:
        return rest
    if isinstance(fields, (int, float, list, tuple)) and not isinstance(fields, bool):
        fields = {"constant": fields}
    if not isinstance(fields, dict):
        raise ValueError(f"{where}: must be a dictionary of fields, a constant, or None to drop it, got {fields!r}")
    check_fields(fields, where)
    if "constant" in fields:
        return [*rest, edited(MapSource(checked_name(name, where), how="override"), fields, found.folder, where)]
    if "file" not in fields:
        if not mine:
            mine = [s for s in offered if s.map == name]
        return [*rest, *(edited(s, fields, found.folder, where) for s in mine)]
    file = existing_file(found.folder, fields["file"], where)
    start = next((s for s in offered if s.map == name and s.file == file), MapSource(checked_name(name, where)))
    # A picture that was kept only because nobody knew it has its place now.
    rest = [s for s in rest if not (s.file == file and s.how in ("extra", "stem", "alpha"))]
    return [*rest, edited(dataclasses.replace(start, how="override"), fields, found.folder, where)]
