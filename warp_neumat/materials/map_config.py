"""What the config of every kind with maps holds, and how it is checked: size, wrap mode, channels, constants.

``config["channels"]`` says what each number in [0, 1] of such a material stands for: ``map`` (a name), ``component``
(:data:`COMPONENTS`), ``encoding`` (:data:`ENCODINGS`), ``range`` [low, high]. ``config["constants"]`` holds the maps
that are one value everywhere, linear.
"""

from warp_neumat.io.asset import FormatError
from warp_neumat.kernels.filter import WRAPS

COMPONENTS = (("value",), ("x", "y"), ("r", "g"), ("r", "g", "b"), ("r", "g", "b", "a"))
"""Components that a map may have, in order; x and y are those of a normal map."""

ENCODINGS = ("linear", "srgb", "normal")
"""What a channel's number in [0, 1] stands for."""

MOST_CHANNELS = 16

AGAIN = "fit it again"
"""The way out of an asset that cannot be read."""


def check_maps(config, path) -> dict:
    """Return ``config`` if size, wrap mode, channels and constants can be read.

    Raises: FormatError: Naming the first field that cannot.
    """
    check_object(config, "config", path)
    for name in ("width", "height"):
        whole_number(config, name, 1, 1 << 20, path)
    one_of(config, "wrap", WRAPS, path)
    channels = config.get("channels")
    if not isinstance(channels, list) or not 1 <= len(channels) <= MOST_CHANNELS:
        raise FormatError(path, "config.channels", f"must list 1 to {MOST_CHANNELS} channels, got {channels!r}", AGAIN)
    for k, channel in enumerate(channels):
        _check_channel(channel, f"config.channels[{k}]", path)
    _check_members(channels, path)
    constants = check_object(config.get("constants", {}), "config.constants", path)
    for name, value in constants.items():
        field = f"config.constants.{name}"
        finite_numbers(value, field, path, (1, 2, 3, 4))
        if any(channel["map"] == name for channel in channels):
            raise FormatError(path, field, "is also a map of the channels", AGAIN)
    return config


def check_object(value, field: str, path) -> dict:
    """Return ``value`` if it is an object of JSON."""
    if not isinstance(value, dict):
        raise FormatError(path, field, f"must be an object, got {value!r}", AGAIN)
    return value


def one_of(config: dict, name: str, known, path, where="config") -> str:
    """Return field ``name`` of ``config`` if it is one of ``known``."""
    if config.get(name) not in known:
        rule = f"must be one of {', '.join(known)}, got {config.get(name)!r}"
        raise FormatError(path, f"{where}.{name}", rule, AGAIN)
    return config[name]


def whole_number(config: dict, name: str, least: int, most: int, path, where="config") -> int:
    """Return field ``name`` of ``config`` if it is a whole number from ``least`` to ``most``."""
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        rule = f"must be a whole number from {least} to {most}, got {value!r}"
        raise FormatError(path, f"{where}.{name}", rule, AGAIN)
    return value


def finite_numbers(value, field: str, path, counts) -> None:
    """Check that ``value`` lists so many finite numbers as one of ``counts`` says."""
    good = isinstance(value, (list, tuple)) and len(value) in counts
    if not good or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= 3e38
        for v in value  # a NaN fails
    ):
        length = " or ".join(map(str, counts))
        raise FormatError(path, field, f"must be {length} finite numbers, got {value!r}", AGAIN)


def _check_channel(channel, field: str, path) -> None:
    check_object(channel, field, path)
    if not isinstance(channel.get("map"), str) or not channel["map"]:
        raise FormatError(path, f"{field}.map", f"must be a name, got {channel.get('map')!r}", AGAIN)
    one_of(channel, "component", sorted({c for names in COMPONENTS for c in names}), path, field)
    one_of(channel, "encoding", ENCODINGS, path, field)
    finite_numbers(channel.get("range"), f"{field}.range", path, (2,))


def _check_members(channels: list[dict], path) -> None:
    """Check that the components of each map are complete, once each, and normals and only they are x and y."""
    members: dict[str, list[tuple[str, str]]] = {}
    for channel in channels:
        members.setdefault(channel["map"], []).append((channel["component"], channel["encoding"]))
    for name, found in members.items():
        names, encodings = sorted(c for c, _ in found), {e for _, e in found}
        if names not in [sorted(c) for c in COMPONENTS]:
            rule = f"components of {name} must be value, x y, or r g (b (a)), got {', '.join(names)}"
            raise FormatError(path, "config.channels", rule, AGAIN)
        if len(encodings) > 1 or (names == ["x", "y"]) != (encodings == {"normal"}):
            rule = f"{name} must have one encoding, normal for x and y alone, got {', '.join(sorted(encodings))}"
            raise FormatError(path, "config.channels", rule, AGAIN)
