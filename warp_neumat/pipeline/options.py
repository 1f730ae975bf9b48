"""Values of render options that are written as text."""

import math

from warp_neumat.pipeline.skips import SKIPS


def parse_background(text: str) -> tuple[float, float, float]:
    """Return linear radiance from one value or ``R,G,B``.

    Raises: ValueError: If it is neither, or a value is negative or not finite.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 3) or not all(math.isfinite(v) and v >= 0 for v in values):
        raise ValueError(f"background must be one value or R,G,B of at least 0, got {text!r}")
    return tuple(values * 3 if len(values) == 1 else values)


def parse_skips(off: list[str]) -> frozenset[str]:
    """Return the skips in force when those named in ``off`` are switched off.

    Raises: ValueError: If a name is unknown.
    """
    unknown = set(off) - set(SKIPS)
    if unknown:
        raise ValueError(f"no-skip must be among {', '.join(SKIPS)}, got {', '.join(sorted(unknown))}")
    return frozenset(SKIPS) - set(off)
