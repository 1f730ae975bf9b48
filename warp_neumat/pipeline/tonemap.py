"""Tone mapping: from linear Rec. 709 pictures of any range to display values in [0, 1], sRGB-encoded.

In this order: exposure (a gain of 2**stops), the operator's curve, clip to [0, 1], the sRGB transfer function
(IEC 61966-2-1). Operators:

- ``"srgb"`` (default): no curve; what is above 1 clips.
- ``"filmic"``: Narkowicz's rational fit of the ACES reference transform (K. Narkowicz, "ACES Filmic Tone Mapping
  Curve", 2015), y = x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14), for each channel by itself.
"""

import functools

import numpy as np

OPERATORS = ("srgb", "filmic")

# The table is indexed by a float's leading bits: exponent and 11 bits of mantissa, so its steps are relative ones.
_DROPPED_BITS = 12
_LOWEST = np.float32(2.0**-20)  # encodes to 1.2e-5: shown as 0
_HIGHEST = np.float32(8.0)  # the filmic curve reaches 1 at 7.2
_CHUNK = 1 << 16  # values at a time: temporaries stay in cache


def srgb_encode(linear) -> np.ndarray:
    """Return sRGB-encoded values of linear ones in [0, 1] (IEC 61966-2-1), float64."""
    x = np.asarray(linear, dtype=np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1.0 / 2.4) - 0.055)


def srgb_decode(encoded) -> np.ndarray:
    """Return linear values of sRGB-encoded ones in [0, 1] (IEC 61966-2-1), float64."""
    y = np.asarray(encoded, dtype=np.float64)
    return np.where(y <= 0.04045, y / 12.92, ((np.maximum(y, 0.04045) + 0.055) / 1.055) ** 2.4)


def curve(linear, operator: str) -> np.ndarray:
    """Return what :func:`tonemap` computes at exposure 0, by the formulas in float64: slow and exact."""
    x = np.maximum(np.asarray(linear, dtype=np.float64), 0.0)
    if operator == "filmic":
        x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    elif operator != "srgb":
        raise ValueError(f"operator must be one of {', '.join(OPERATORS)}, got {operator!r}")
    return srgb_encode(np.minimum(x, 1.0))


@functools.cache
def _table(operator: str) -> np.ndarray:
    first, last = (int(edge.view(np.uint32)) >> _DROPPED_BITS for edge in (_LOWEST, _HIGHEST))
    values = (np.arange(first, last + 1, dtype=np.uint32) << _DROPPED_BITS).view(np.float32)
    table = curve(values, operator).astype(np.float32)
    table[0] = 0.0
    table.flags.writeable = False
    return table


def check_operator(operator: str, exposure: float = 0.0) -> None:
    """Raise ValueError unless ``operator`` is one there is and ``exposure`` lies within −60 … 60 stops."""
    if operator not in OPERATORS:
        raise ValueError(f"operator must be one of {', '.join(OPERATORS)}, got {operator!r}")
    if not abs(exposure) <= 60:
        raise ValueError(f"exposure must be between -60 and 60 stops, got {exposure}")


def tonemap(linear, exposure: float = 0.0, operator: str = "srgb", *, out=None) -> np.ndarray:
    """Return display values in [0, 1], float32, of a linear picture.

    Negative values become 0; infinite ones and NaN become 1, so that they are seen.

    Args:
        linear: Linear Rec. 709, any shape, as (H, W, 3).
        exposure: Gain in stops, −60 … 60.
        operator: ``"srgb"`` or ``"filmic"``.
        out: Written in place when given: float32, C-contiguous, of the same shape.

    Error: at most 8.1e-5, a fiftieth of an 8-bit step, against :func:`curve`; held by
    test_tonemap_matches_the_formulas.
    """
    linear = np.ascontiguousarray(linear, dtype=np.float32)
    check_operator(operator, exposure)
    if out is None:
        out = np.empty_like(linear)
    elif out.shape != linear.shape or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise ValueError(f"out must be float32, C-contiguous, of shape {linear.shape}, got {out.dtype} {out.shape}")
    table = _table(operator)
    first = int(_LOWEST.view(np.uint32)) >> _DROPPED_BITS
    gain = np.float32(2.0**exposure)
    source, result = linear.reshape(-1), out.reshape(-1)
    value = np.empty(min(_CHUNK, source.size), dtype=np.float32)
    index = np.empty(value.size, dtype=np.intp)
    for start in range(0, source.size, _CHUNK):
        part = source[start : start + _CHUNK]
        v, k = value[: part.size], index[: part.size]
        bits = v.view(np.uint32)
        with np.errstate(over="ignore"):
            np.multiply(part, gain, out=v)
        np.clip(v, _LOWEST, _HIGHEST, out=v)
        bits += np.uint32(1 << (_DROPPED_BITS - 1))  # to the nearest entry
        bits >>= np.uint32(_DROPPED_BITS)
        np.subtract(bits, first, out=k, dtype=np.intp, casting="unsafe")
        np.take(table, k, out=result[start : start + _CHUNK], mode="clip")  # clip: a NaN's bits lie beyond the end
    return out
