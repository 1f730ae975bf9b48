"""Where one map comes from, and the fields in which manifests and overrides say so.

Every field is checked as it is put in; a wrong one is a single line with map, field, rule and the nearest valid word.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from pathlib import Path

from .map_names import kind_of

FIELDS = {
    "file": "picture, relative to the folder or manifest",
    "channel": 'its channels: letters as "r" or "rgb", a number, or a list of numbers',
    "color_space": '"srgb" or "linear"',
    "orientation": '"gl" (+Y up) or "dx" (+Y down) of a normal map',
    "invert": "true: the value is 1 − what is stored (gloss for roughness)",
    "flip": "true: row 0 of the picture is the bottom",
    "constant": "a number, or a list of them, linear, instead of a picture",
    "replace_nan": "a number to put in place of NaN and infinite values",
}
"""What a manifest or an override can say of a map."""


@dataclasses.dataclass(frozen=True)
class MapSource:
    """Where one map comes from. ``file`` or ``constant`` is set; the other fields are those of :data:`FIELDS`.

    ``how`` says what the claim rests on: the ways of :class:`warp_neumat.io.map_names.Claim`, ``alpha`` (the alpha
    channel of the base colour), ``manifest`` or ``override``.
    """

    map: str
    file: Path | None = None
    channel: str | tuple[int, ...] | None = None
    color_space: str | None = None
    orientation: str | None = None
    invert: bool = False
    flip: bool = False
    constant: tuple[float, ...] | None = None
    replace_nan: float | None = None
    how: str = "name"

    @property
    def label(self) -> str:
        """File name and channels, as ``x_orm.png:g``."""
        if self.file is None:
            return "(given)"
        channel = self.channel if isinstance(self.channel, str) else ",".join(map(str, self.channel or ()))
        return f"{self.file.name}:{channel}" if channel else self.file.name


def checked_name(name, where: str) -> str:
    """Return ``name`` if it can name a map; ValueError otherwise, starting with ``where``, as in all checks here."""
    if not isinstance(name, str) or not name.isidentifier() or name != name.lower():
        raise ValueError(f"{where}: a map's name must be lower-case letters, digits and _, got {name!r}")
    return name


def check_fields(fields: dict, where: str) -> None:
    """Refuse a field that :data:`FIELDS` does not have, naming the nearest."""
    for key in fields:
        if key not in FIELDS:
            raise ValueError(f"{where}: unknown field {key!r}; {nearest(key, FIELDS)}")


def edited(start: MapSource, fields: dict, folder: Path, where: str) -> MapSource:
    """Return ``start`` with ``fields`` put in, each checked."""
    check_fields(fields, where)
    new = {}
    for key, value in fields.items():
        if key == "file":
            new[key] = existing_file(folder, value, where)
        elif key == "channel":
            new[key] = _channel(value, where)
        elif key == "constant":
            new[key] = _numbers(value, f"{where}: constant")
        elif key == "replace_nan":
            (new[key],) = _numbers(value, f"{where}: replace_nan", counts=(1,))
        elif key in ("invert", "flip"):
            if not isinstance(value, bool):
                raise ValueError(f"{where}: {key} must be true or false, got {value!r}")
            new[key] = value
        else:
            allowed = ("srgb", "linear") if key == "color_space" else ("gl", "dx")
            if value not in allowed:
                raise ValueError(
                    f"{where}: {key} must be {' or '.join(allowed)}, got {value!r}; {_hint(value, allowed)}"
                )
            new[key] = value
    result = dataclasses.replace(start, **new)
    normal = kind_of(result.map).form == "normal"
    if result.file is None and result.constant is None:
        raise ValueError(f"{where}: needs a file or a constant")
    if result.file is not None and result.constant is not None:
        raise ValueError(f"{where}: has both a file and a constant; give one")
    if "orientation" in new and not normal:
        raise ValueError(f"{where}: orientation is for normal maps")
    if new.get("color_space") == "srgb" and normal:
        raise ValueError(f"{where}: a normal map is never sRGB; leave color_space out")
    if normal and result.constant is not None and len(result.constant) != 3:
        raise ValueError(f"{where}: the constant of a normal map is a vector of 3 numbers, got {len(result.constant)}")
    return result


def _hint(value, allowed) -> str:
    return nearest(str(value).lower(), allowed)


def _numbers(value, where: str, counts=(1, 2, 3, 4)) -> tuple[float, ...]:
    values = value if isinstance(value, (list, tuple)) else [value]
    good = len(values) in counts and all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in values)
    if not good or not all(abs(x) < 1e30 for x in values):  # false for NaN too
        raise ValueError(
            f"{where} must be a finite number{' or a list of up to 4' if counts != (1,) else ''}, got {value!r}"
        )
    return tuple(float(x) for x in values)


def _channel(value, where: str) -> str | tuple[int, ...]:
    if isinstance(value, str) and re.fullmatch("[rgbaRGBA]{1,4}", value):
        return value.lower()
    numbers = [value] if isinstance(value, int) else value
    if isinstance(numbers, (list, tuple)) and numbers and all(type(x) is int and 0 <= x < 1024 for x in numbers):
        return tuple(numbers)
    raise ValueError(
        f'{where}: channel must be letters of "rgba", a number from 0, or a list of numbers, got {value!r}'
    )


def existing_file(folder: Path, name, where: str) -> Path:
    """Return the path of ``name`` in ``folder``; FileNotFoundError, with the nearest name there, if it is no file."""
    if not isinstance(name, str | Path) or not str(name):
        raise ValueError(f"{where}: file must be a path, got {name!r}")
    path = folder / name
    if not path.is_file():
        parent = path.parent
        near = [entry.name for entry in parent.iterdir()] if parent.is_dir() else []
        raise FileNotFoundError(f"{where}: {path}: no such file; {nearest(path.name, near)}")
    return path


def nearest(key: str, known) -> str:
    """Return "nearest: …" with up to three of ``known`` that look like ``key``, else "known: …" with the first."""
    close = difflib.get_close_matches(str(key), list(known), n=3, cutoff=0.4)
    return f"nearest: {', '.join(close)}" if close else f"known: {', '.join(sorted(known)[:12])}"
