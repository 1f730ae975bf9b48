"""What a render leaves out, and the switches for it."""

import dataclasses
from collections.abc import Iterable

from warp_neumat.kernels.shade import LIGHT_SKIPS

WHY = {
    "unowned": "texels of no chart",
    "backfacing": "texels of triangles that face away",
    "offscreen": "texels of triangles outside the picture",
    "occluded": "texels that no pixel reads",
    "rate": "texels between those shaded, of tiles that are smaller than the pixels, or smooth",
    "unchanged": "texels for which nothing has moved since they were shaded",
    "range": "lights too far from a texel",
    "spot": "lights whose cone a texel is outside of",
    "horizon": "lights below a texel's horizon",
}
"""Skip → what it leaves out. The last three leave out evaluations, one light for one texel; the others texels."""

SKIPS = tuple(WHY)


@dataclasses.dataclass(frozen=True)
class Skips:
    """Which skips are in force, one field each.

    The first four nest: what no pixel reads includes what is outside, faces away or is of no chart. So switching off
    an inner one shows only where the outer ones are off too.
    """

    unowned: bool = True
    backfacing: bool = True
    offscreen: bool = True
    occluded: bool = True
    rate: bool = True
    unchanged: bool = True
    range: bool = True
    spot: bool = True
    horizon: bool = True

    @classmethod
    def named(cls, names: Iterable[str]) -> "Skips":
        """Return the skips of these names in force, no others.

        Raises: ValueError: If a name is unknown.
        """
        if isinstance(names, str):
            raise ValueError(f"skip must be names in a list, as ['rate'], got {names!r}")
        names = set(names)
        unknown = names - set(SKIPS)
        if unknown:
            raise ValueError(f"skip must be among {', '.join(SKIPS)}, got {', '.join(sorted(unknown))}")
        return cls(**{name: name in names for name in SKIPS})

    @property
    def lights(self) -> tuple[str, ...]:
        """The light skips in force."""
        return tuple(name for name in LIGHT_SKIPS if getattr(self, name))
