"""What a bidirectional texture function is to the rest: slices of texels under pairs of directions.

Conventions: ω_i to the light, ω_o to the viewer, both unit and away from the surface, in the frame whose x runs along
+u, y along −v (up in the picture) and z along the normal. A slice holds value × cos θ_i [1/sr] (MobileVR Eq. 1: the
foreshortening is part of the function), row 0 on top, linear Rec. 709. The texture repeats.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class BTFSource(Protocol):
    """A BTF measured, or simulated, under every pair of a set of lights and a set of views."""

    name: str
    width: int
    """Texels along u."""
    height: int
    """Texels along v."""
    lights: np.ndarray
    """Directions ω_i, (L, 3) float32."""
    views: np.ndarray
    """Directions ω_o, (V, 3) float32."""
    notes: tuple[str, ...]
    """Readable lines about the data: what was left out, converted or assumed."""
    opening: dict
    """Keyword arguments that open it again, JSON-able."""

    def slices(self, pairs: np.ndarray) -> np.ndarray:
        """Return the slices of ``pairs`` (N, 2), indices (light, view): (N, height, width, 3) float32, ≥ 0, finite."""


def is_btf(source) -> bool:
    """Return whether ``source`` is a :class:`BTFSource`."""
    return hasattr(source, "slices") and hasattr(source, "lights")


def checked_pairs(pairs, lights: int, views: int) -> np.ndarray:
    """Return ``pairs`` as (N, 2) int64.

    Raises:
        ValueError: If the shape is wrong or an index lies outside.
    """
    pairs = np.asarray(pairs)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        raise ValueError(f"pairs must be whole numbers of shape (N, 2), got {pairs.dtype} {pairs.shape}")
    pairs = pairs.astype(np.int64)
    if len(pairs) and (pairs.min() < 0 or (pairs >= (lights, views)).any()):
        raise ValueError(f"pairs must be below ({lights}, {views}), the numbers of lights and views")
    return pairs
