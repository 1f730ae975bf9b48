"""What the config of kind ``ntbc`` holds: textures made of planes, and the models that write them.

``textures`` lists ``name``, ``format`` (a key of :data:`warp_neumat.io.block_formats.FORMATS`) and ``planes``, what one
kind of block holds: ``format`` bc1, bc4 or bc7, and ``channels``, the numbers of ``config["channels"]`` in its
components; a bc1 may have fewer than its three (behind a normal's x and y comes 0.5 + 0.5 z, which nothing here reads).
BC5 has two planes bc4, red first; BC3 a bc1 and a bc4, which is alpha.
``models`` lists ``planes`` ([texture, plane] each), ``endpoint`` and ``texel``: each network's ``levels``, (width,
height) of its grids, coarsest first, ``features`` a vertex (2 where it is not said) and their ``bits``, 1 to 8 (8);
``endpoint`` is null where ``endpoints`` is ``"fitted"``. ``hidden`` is the widths of every network's hidden layers.
"""

import dataclasses

from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import FORMATS, grid
from warp_neumat.kernels.filter import MOST_MIPS
from warp_neumat.kernels.ntbc import MOST_NUMBERS
from warp_neumat.materials.map_config import AGAIN, check_maps, check_object, one_of, whole_number

MODES = ("conservative", "aggressive")
"""One model for colours and one for single channels, or one for all (NTBC §4.1)."""

VARIANTS = ("ntbc", "naive")
"""Whether texels' colours are predicted (NTBC §3.2) or their weights (§3.1)."""

ENDPOINTS = ("network", "fitted")
"""Whether endpoints are predicted too, or fitted to the predicted colours."""

METRICS = ("rgb", "luma")
"""The squared difference of colours that training and writing look at."""

PLANES = {"bc1": ("bc1",), "bc3": ("bc1", "bc4"), "bc4": ("bc4",), "bc5": ("bc4", "bc4"), "bc7": ("bc7",)}
"""Families that an asset may have textures of, and the formats of their planes, sorted."""

COMPONENTS = {"bc1": (1, 3), "bc4": (1, 1), "bc7": (3, 4)}
"""Least and greatest number of channels of a plane."""


@dataclasses.dataclass(frozen=True)
class Plane:
    """Where a plane lies and what it holds.

    Attributes:
        texture: Number of its texture.
        number: Its number in the texture.
        format: ``"bc1"``, ``"bc4"`` or ``"bc7"``.
        channels: Numbers of the config's channels, component by component.
    """

    texture: int
    number: int
    format: str
    channels: tuple[int, ...]

    @property
    def components(self) -> int:
        """Components that its networks know: those of the format, whether or not there is a channel for each."""
        return 3 if self.format == "bc1" else len(self.channels)


def check_ntbc(config, path) -> dict:
    """Return ``config`` if everything in it can be read.

    Raises: FormatError: Naming the first field that cannot.
    """
    check_maps(config, path)
    for name in ("width", "height"):
        whole_number(config, name, 1, (1 << MOST_MIPS) - 1, path)
    fields = {"mode": MODES, "variant": VARIANTS, "endpoints": ENDPOINTS, "metric": METRICS}
    for name, known in fields.items():
        one_of(config, name, known, path)
    if config["variant"] == "naive" and config["endpoints"] == "fitted":
        raise FormatError(path, "config.endpoints", "must be network for variant naive, got 'fitted'", AGAIN)
    textures = _list(config, "textures", "config", path, 64)
    for t, texture in enumerate(textures):
        _check_texture(texture, f"config.textures[{t}]", config, path)
    names = [texture["name"] for texture in textures]
    if len(set(names)) < len(names):
        raise FormatError(path, "config.textures", f"must have different names, got {', '.join(names)}", AGAIN)
    held = sorted(k for plane in planes_of(config) for k in plane.channels)
    if held != list(range(len(config["channels"]))):
        rule = f"must hold each of the {len(config['channels'])} channels once, got {held}"
        raise FormatError(path, "config.textures", rule, AGAIN)
    hidden = _list(config, "hidden", "config", path, 8)
    for n, width in enumerate(hidden):
        whole_number({"width": width}, "width", 1, 512, path, f"config.hidden[{n}]")
    _check_models(config, path)
    _check_numbers(config, path)
    return config


def _check_numbers(config: dict, path) -> None:
    """Check that no model has more colours than can be numbered, before anything of that size is allocated."""
    rows, columns = grid(config["width"], config["height"])
    components = {(p.texture, p.number): p.components for p in planes_of(config)}
    for i, model in enumerate(config["models"]):
        count = 16 * rows * columns * sum(components[tuple(pair)] for pair in model["planes"])
        if count >= MOST_NUMBERS:
            rule = f"must write fewer than 2^31 numbers, got {count} at {config['width']}x{config['height']}"
            raise FormatError(path, f"config.models[{i}]", rule, AGAIN)


def planes_of(config: dict) -> list[Plane]:
    """Return the planes of all textures, in order."""
    return [
        Plane(t, p, plane["format"], tuple(plane["channels"]))
        for t, texture in enumerate(config["textures"])
        for p, plane in enumerate(texture["planes"])
    ]


def sources_of(config: dict) -> list[tuple[int, int]]:
    """Return (texture, component) of each channel, as ``BlockMaps`` takes them."""
    found = {}
    for plane in planes_of(config):
        family = FORMATS[config["textures"][plane.texture]["format"]].family
        first = plane.number if family == "bc5" else 3 if family == "bc3" and plane.format == "bc4" else 0
        found |= {channel: (plane.texture, first + n) for n, channel in enumerate(plane.channels)}
    return [found[k] for k in range(len(config["channels"]))]


def _list(config: dict, name: str, where: str, path, most: int) -> list:
    value = config.get(name)
    if not isinstance(value, list) or not 1 <= len(value) <= most:
        raise FormatError(path, f"{where}.{name}", f"must list 1 to {most} {name}, got {value!r}", AGAIN)
    return value


def _among(facts: dict, name: str, default: int, known, where: str, path) -> int:
    value = facts.get(name, default)
    if isinstance(value, bool) or value not in known:
        rule = f"must be one of {', '.join(map(str, known))}, got {value!r}"
        raise FormatError(path, f"{where}.{name}", rule, AGAIN)
    return value


def _check_texture(texture, field: str, config: dict, path) -> None:
    check_object(texture, field, path)
    name = texture.get("name")
    if not isinstance(name, str) or not name or any(letter in name for letter in "/\\\0"):
        raise FormatError(path, f"{field}.name", f"must be a name that files can have, got {name!r}", AGAIN)
    known = [f.name for f in FORMATS.values() if f.family in PLANES and not f.signed]
    family = FORMATS[one_of(texture, "format", known, path, field)].family
    formats = []
    for p, plane in enumerate(_list(texture, "planes", field, path, 2)):
        where = f"{field}.planes[{p}]"
        check_object(plane, where, path)
        formats.append(one_of(plane, "format", tuple(COMPONENTS), path, where))
        channels, (least, most) = plane.get("channels"), COMPONENTS[plane["format"]]
        if not isinstance(channels, list) or not least <= len(channels) <= most:
            counts = f"{least}" if least == most else f"{least} to {most}"
            raise FormatError(path, f"{where}.channels", f"must list {counts} channels, got {channels!r}", AGAIN)
        for n, number in enumerate(channels):
            last = len(config["channels"]) - 1
            whole_number({"channel": number}, "channel", 0, last, path, f"{where}.channels[{n}]")
    if sorted(formats) != list(PLANES[family]):
        rule = f"must be {' and '.join(PLANES[family])} for {texture['format']}, got {' and '.join(formats)}"
        raise FormatError(path, f"{field}.planes", rule, AGAIN)


def _check_models(config: dict, path) -> None:
    served = []
    for i, model in enumerate(_list(config, "models", "config", path, 64)):
        field = f"config.models[{i}]"
        check_object(model, field, path)
        for n, pair in enumerate(_list(model, "planes", field, path, 64)):
            if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(number, int) for number in pair):
                raise FormatError(path, f"{field}.planes[{n}]", f"must be [texture, plane], got {pair!r}", AGAIN)
            served.append(tuple(pair))
        if config["endpoints"] == "fitted" and model.get("endpoint") is not None:
            raise FormatError(path, f"{field}.endpoint", "must be null where endpoints are fitted", AGAIN)
        for network in ("texel",) if config["endpoints"] == "fitted" else ("endpoint", "texel"):
            where = f"{field}.{network}"
            facts = check_object(model.get(network), where, path)
            _among(facts, "features", 2, (1, 2, 4, 8), where, path)
            _among(facts, "bits", 8, tuple(range(1, 9)), where, path)
            levels = _list(facts, "levels", where, path, 16)
            for n, size in enumerate(levels):
                sides = {"width": size[0], "height": size[1]} if isinstance(size, list) and len(size) == 2 else {}
                for side in ("width", "height"):
                    whole_number(sides, side, 1, 1 << 16, path, f"{where}.levels[{n}]")
    planes = sorted((plane.texture, plane.number) for plane in planes_of(config))
    if sorted(served) != planes:
        raise FormatError(path, "config.models", f"must serve each of the planes {planes} once, got {served}", AGAIN)
