"""The directions under which the BTF databases of Bonn were measured, in this project's local frame.

Directions lie on rings about the normal: all samples of a ring have one inclination θ and equal steps of azimuth φ.
Lights and views come from the same set, so there are 81² and 151² pairs. x = sin θ cos φ, y = sin θ sin φ, z = cos θ.
Order: ring by ring from the zenith, φ ascending from the ring's first azimuth.
"""

from __future__ import annotations

import numpy as np

UBO2003_RINGS = ((0, 1, 0), (15, 6, 0), (30, 12, 0), (45, 18, 0), (60, 20, 0), (75, 24, 0))
"""(θ [°], samples, first φ [°]) of Sattler, Sarlette and Klein, "Efficient and Realistic Visualization of Cloth", 2003.
"""

UBO2014_RINGS = (
    (0, 1, 0),
    (11, 6, 15),
    (23.5, 12, 0),
    (30, 12, 15),
    (37.5, 12, 0),
    (45, 18, 0),
    (52.5, 18, 7.5),
    (60, 24, 0),
    (67.5, 24, 7.5),
    (75, 24, 0),
)
"""(θ [°], samples, first φ [°]) of the camera dome of Weinmann, Gall and Klein, "Material Classification Based on
Training Data Synthesized Using a BTF Database", 2014; the angles are those of the University of Bonn's own reader,
https://github.com/cgbonn/btflib, ``create_ubo_dome1_sampling``.
"""


def ring_directions(rings) -> np.ndarray:
    """Return the unit directions of ``rings`` of (θ [°], samples, first φ [°]), shape (n, 3), float32."""
    rows = []
    for theta, count, first in rings:
        theta, phi = np.radians(theta), np.radians(first + 360.0 * np.arange(count) / count)
        sine, cosine = np.full(count, np.sin(theta)), np.full(count, np.cos(theta))
        rows.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], 1))
    return np.concatenate(rows).astype(np.float32)


def ubo2003_directions() -> np.ndarray:
    """Return the 81 directions of the UBO2003 database, (81, 3) float32."""
    return ring_directions(UBO2003_RINGS)


def ubo2014_directions() -> np.ndarray:
    """Return the 151 directions of the UBO2014 database, (151, 3) float32."""
    return ring_directions(UBO2014_RINGS)
