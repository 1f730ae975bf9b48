"""A small set of PBR maps with six channels, so that all tests that fit one share the compiled kernels."""

from pathlib import Path

import numpy as np

from warp_neumat.io.image import write_png


def tiny_values(width: int = 32, height: int = 32) -> dict[str, np.ndarray]:
    """Return base colour (h, w, 3), normal (h, w, 3) and roughness (h, w), values as they are stored, in [0, 1]."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = 2 * np.pi * (x + 0.5) / width, 2 * np.pi * (y + 0.5) / height
    bumps = np.sin(x) * np.cos(y) + 0.5 * np.sin(2 * x + y)
    normal = np.stack([0.4 * np.cos(x + y), 0.4 * np.sin(2 * y) + 0.2 * np.cos(x), np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    colour = 0.5 + 0.2 * bumps[..., None] * np.array([1.0, 0.5, -0.5]) + 0.1 * np.cos(y)[..., None] * [0, 0, 1]
    return {"base_color": colour, "normal_gl": 0.5 + 0.5 * normal, "roughness": 0.5 + 0.3 * np.sin(x - y)}


def tiny_maps(folder: Path, width: int = 32, height: int = 32) -> Path:
    """Write :func:`tiny_values` to ``folder`` as 8-bit PNG and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, picture in tiny_values(width, height).items():
        write_png(folder / f"tiny_{name}.png", picture)
    return folder
