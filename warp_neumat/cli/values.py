"""Arguments as people write them: sizes, ranges, names, assignments.

What is not written as it must be raises :class:`warp_neumat.cli.common.Usage`.
"""

import difflib
import json
import re
from collections.abc import Iterable
from pathlib import Path

from warp_neumat.cli.common import Usage


def parse_frames(text: str | None, count: int) -> range:
    """Read ``A:B`` as Python slices are read; one number N is ``0:N``."""
    if text is None:
        return range(count)
    try:
        numbers = [int(part) if part else None for part in text.split(":")]
    except ValueError:
        raise Usage(f"--frames must be A:B, as 0:48, got {text!r}") from None
    if len(numbers) > 2 or (len(numbers) == 1 and numbers[0] is None):
        raise Usage(f"--frames must be A:B, as 0:48, got {text!r}")
    first, last = (0, numbers[0]) if len(numbers) == 1 else (numbers[0] or 0, numbers[1])
    last = count if last is None else last
    if not 0 <= first < last:
        raise Usage(f"--frames must be A:B with 0 <= A < B, got {text!r}")
    return range(first, last)


def parse_budget(text: str) -> dict[str, float]:
    """Read ``250k`` or ``1.5M`` evaluations, or ``4ms``, as options of the renderer: budget or milliseconds."""
    match = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(k|m|ms)?", text.strip(), re.IGNORECASE)
    number, unit = (float(match[1]), (match[2] or "").lower()) if match else (0.0, "")
    if number <= 0:
        raise Usage(f"--budget must be evaluations, as 250k, or milliseconds of shading, as 4ms, got {text!r}")
    if unit == "ms":
        return {"milliseconds": number}
    return {"budget": number * {"": 1, "k": 1e3, "m": 1e6}[unit]}


MOST = 16384
"""Longest side of a picture [px]."""


def parse_size(text: str) -> tuple[int, int]:
    """Read ``WxH``."""
    numbers = _whole_numbers(text.lower(), "x")
    if len(numbers) != 2 or not all(0 < n <= MOST for n in numbers):
        raise Usage(f"--size must be WxH, as 1280x720, up to {MOST}, got {text!r}")
    return numbers


def parse_set_size(text: str) -> tuple[int, int] | int:
    """Read ``WxH``, or one number: the longer side."""
    numbers = _whole_numbers(text.lower(), "x")
    if len(numbers) not in (1, 2) or not all(0 < n <= MOST for n in numbers):
        raise Usage(f"--size must be WxH or the longer side, as 512x256 or 512, up to {MOST}, got {text!r}")
    return numbers if len(numbers) == 2 else numbers[0]


def parse_crop(text: str) -> tuple[int, int, int, int]:
    """Read ``X,Y,W,H``."""
    numbers = _whole_numbers(text, ",")
    if len(numbers) != 4 or min(numbers[2:]) < 1:
        raise Usage(f"--crop must be X,Y,W,H in whole pixels, as 0,0,512,512, got {text!r}")
    return numbers


def parse_features(text: str) -> tuple[int, ...]:
    """Read the longer sides of the feature textures, ``A,B,…``."""
    numbers = _whole_numbers(text, ",")
    if not numbers or min(numbers) < 1:
        raise Usage(f"--features must be whole numbers above 0, as 256,128,64,32, got {text!r}")
    return numbers


def _whole_numbers(text: str, separator: str) -> tuple[int, ...]:
    """Return the numbers of ``text``, or none where one is no whole number of at least 0."""
    parts = [part.strip() for part in text.split(separator)]
    return tuple(map(int, parts)) if all(p.isascii() and p.isdecimal() for p in parts) else ()


def one_of(option: str, value: str, known: Iterable[str]) -> str:
    """Return ``value`` if it is known."""
    known = list(known)
    if value not in known:
        close = difflib.get_close_matches(value.lower(), known, n=1, cutoff=0.4)
        nearest = f"; nearest: {close[0]}" if close else ""
        raise Usage(f"{option} must be one of {', '.join(known)}, got {value!r}{nearest}")
    return value


def parse_options(pairs: list[str], taken: Iterable[str]) -> dict:
    """Read ``NAME=VALUE`` pairs; a value is a number, true, false, numbers with commas, or text.

    Args:
        pairs: As written.
        taken: Names that have an option of their own.
    """
    found = {}
    for pair in pairs:
        name, sign, text = pair.partition("=")
        name = name.strip().replace("-", "_")
        if not (sign and name.isidentifier() and text.strip()):
            raise Usage(f"--option must be NAME=VALUE, as wrap=clamp or modes=single, got {pair!r}")
        if name in taken:
            raise Usage(f"--option {name}: has an option of its own; see neumat fit --help")
        found[name] = _value(text.strip())
    return found


def _value(text: str):
    for written in (text, f"[{text}]"):
        try:
            value = json.loads(written)
        except ValueError:
            continue
        return tuple(value) if isinstance(value, list) else value
    return text


def parse_overrides(pairs: list[str]) -> dict:
    """Read ``MAP.FIELD=VALUE``, ``MAP=NUMBERS`` and ``MAP=none`` into what ``open_texture_set`` takes."""
    from warp_neumat.io.map_fields import check_fields

    found: dict = {}
    for pair in pairs:
        key, sign, text = (part.strip() for part in pair.partition("="))
        name, dot, field = key.partition(".")
        where = f"--override {key}"
        if not (sign and name and text and bool(dot) == bool(field)):
            raise Usage(
                "--override must be MAP.FIELD=VALUE, MAP=NUMBER or MAP=none, as normal.orientation=dx, got "
                + repr(pair)
            )
        if not dot:
            if name in found:
                raise Usage(f"{where}: {name} is already overridden; a constant or none stands alone")
            found[name] = None if text.lower() == "none" else _numbers(text, where)
            continue
        if not isinstance(found.setdefault(name, {}), dict):
            raise Usage(f"{where}: {name} is already overridden; a constant or none stands alone")
        try:
            check_fields({field: text}, where)
        except ValueError as error:
            raise Usage(error) from None
        found[name][field] = _field(field, text, where)
    return found


def _field(field: str, text: str, where: str):
    if field in ("invert", "flip"):
        if text.lower() not in ("true", "false"):
            raise Usage(f"{where} must be true or false, got {text!r}")
        return text.lower() == "true"
    if field in ("constant", "replace_nan"):
        values = _numbers(text, where)
        return values[0] if len(values) == 1 else values
    if field == "channel" and (numbers := _whole_numbers(text, ",")):
        return list(numbers)
    return text


def _numbers(text: str, where: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise Usage(f"{where} must be a number or numbers with commas between them, got {text!r}") from None


def parse_assignments(pairs: list[str]) -> dict[str, Path]:
    """Read ``NAME=FILE`` pairs."""
    found = {}
    for pair in pairs:
        name, sign, file = pair.partition("=")
        if not (sign and name and file):
            raise Usage(f"--material must be NAME=FILE, as fox=bronze.neumat or '*=bronze.neumat', got {pair!r}")
        found[name] = Path(file)
    return found
