"""How long a fit trains, by name."""

import difflib

PRESETS = {"quick": 0.3, "standard": 1.0, "fine": 4.0}
"""Length of a fit in multiples of the model's default number of steps."""


def length_of(preset: str | None, known: dict = PRESETS) -> float:
    """Return the length that ``preset`` stands for; None, and names that are in ``known`` only, are the standard one.

    Raises:
        ValueError: If it is none of ``known``; names the nearest.
    """
    if preset is not None and preset not in known:
        close = difflib.get_close_matches(preset, known, n=1, cutoff=0.0)[0]
        raise ValueError(f"no preset {preset!r}; nearest: {close}; known: {', '.join(known)}")
    return PRESETS.get(preset or "standard", 1.0)
