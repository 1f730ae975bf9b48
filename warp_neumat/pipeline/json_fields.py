"""Checked reading of small JSON files that people write by hand: complaints name file, field and rule."""

import difflib
import json
import math
from pathlib import Path

import numpy as np

_REQUIRED = object()


def load_json(path):
    """Return the content of the JSON file ``path``.

    Raises:
        OSError: If it cannot be read; one line that names it.
        ValueError: If it is not JSON; names line and column.
    """
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: is not text in UTF-8; it must be a JSON file") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: is not JSON, line {error.lineno} column {error.colno}: {error.msg}") from None


class Fields:
    """One JSON object whose keys are known beforehand.

    Args:
        value: What the file holds there.
        where: How messages call it, as ``"cam.json: keys[2]"``.
        allowed: The keys it may have; any other one is an error that names the nearest.
    """

    def __init__(self, value, where: str, allowed):
        if not isinstance(value, dict):
            raise ValueError(f"{where} must be an object {{…}}, got {_shown(value)}")
        for key in value:
            if key not in allowed:
                near = difflib.get_close_matches(key, allowed, n=1, cutoff=0)
                raise ValueError(f"{where} has an unknown key {key!r}; the nearest known one is {near[0]!r}")
        self.value, self.where = value, where

    def __contains__(self, name: str) -> bool:
        return name in self.value

    def name(self, field: str) -> str:
        """Return how messages call ``field``."""
        return f"{self.where}.{field}" if ": " in self.where else f"{self.where}: {field}"

    def number(self, field: str, default=_REQUIRED, *, low: float = -math.inf, high: float = math.inf, open_low=False):
        """Return a finite number in [low, high], or (low, high] with ``open_low``."""
        value = self._get(field, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError(f"{self.name(field)} must be a finite number, got {_shown(value)}")
        if value < low or value > high or (open_low and value == low):
            rule = f"more than {low:g}" if open_low else f"at least {low:g}"
            rule += f" and at most {high:g}" if math.isfinite(high) else ""
            raise ValueError(f"{self.name(field)} must be {rule}, got {value:g}")
        return float(value)

    def vector(self, field: str, default=_REQUIRED) -> np.ndarray:
        """Return three finite numbers as float64."""
        value = self._get(field, default)
        good = isinstance(value, (list, tuple)) and len(value) == 3
        good = good and all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value)
        if not good:
            raise ValueError(f"{self.name(field)} must be three finite numbers [x, y, z], got {_shown(value)}")
        return np.array(value, dtype=np.float64)

    def choice(self, field: str, choices: tuple[str, ...], default: str) -> str:
        """Return one of ``choices``."""
        value = self._get(field, default)
        if value not in choices:
            raise ValueError(f"{self.name(field)} must be one of {', '.join(choices)}, got {_shown(value)}")
        return value

    def items(self, field: str) -> list:
        """Return a list that is not empty."""
        value = self._get(field, _REQUIRED)
        if not isinstance(value, list) or not value:
            raise ValueError(f"{self.name(field)} must be a list […] of at least one, got {_shown(value)}")
        return value

    def _get(self, field, default):
        if field in self.value:
            return self.value[field]
        if default is _REQUIRED:
            raise ValueError(f"{self.name(field)} is missing")
        return default


def _shown(value) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "…"
