"""A contact sheet of fitted BRDFs: for each material the source, ours, GGX, and ten times ours' difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SIDE = 160
"""Pixels of a sphere."""

_ACROSS = 2
"""Materials side by side."""


def draw(path: Path, spheres: dict[tuple[str, str], np.ndarray], method: str, errors: dict[str, float]) -> None:
    """Write the sheet as a PNG.

    Args:
        path: File to write.
        spheres: (material, ``"source"``, ``"ggx"`` or ``method``) → linear picture (SIDE, SIDE, 3); what is missing
            stays blank.
        method: Which of ours.
        errors: Material → MAE, in the order to show.
    """
    from matplotlib.figure import Figure

    from warp_neumat.training.sphere import tone_map

    across = min(_ACROSS, len(errors))
    down = -(-len(errors) // across)
    size = (across * (4 * SIDE + 16) / 100, down * (SIDE + 60) / 100)
    figure = Figure(figsize=size, dpi=100, facecolor="white", layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat:
        axes.axis("off")
    for axes, (material, error) in zip(grid.flat, errors.items(), strict=False):
        blank = np.ones((SIDE, SIDE, 3), np.float32)
        found = {name: spheres.get((material, name)) for name in ("source", method, "ggx")}
        shown = [blank if sphere is None else tone_map(sphere) for sphere in found.values()]
        whole = found["source"] is not None and found[method] is not None
        shown.append(np.minimum(10.0 * np.abs(shown[0] - shown[1]), 1.0) if whole else blank)
        axes.imshow(np.concatenate(shown, axis=1), interpolation="nearest")
        name = material.rsplit("/", 1)[-1]
        axes.set_title(f"{name}   MAE {error:.4f}\nsource | {method} | ggx | difference × 10", fontsize=9)
    figure.savefig(path)
