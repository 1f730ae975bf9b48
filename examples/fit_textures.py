"""Fit a folder of PBR maps: maps in, one file out, maps back from it, and files for an engine.

The maps are made here, small, and the fit is far too short: give it your own folder and leave ``steps`` away.

Run: python examples/fit_textures.py [FOLDER] --out out/textures
"""

import argparse
from pathlib import Path

import numpy as np
import warp as wp

import warp_neumat as nm
from warp_neumat.io.image import write_png


def make_maps(folder: Path, side: int = 64) -> Path:
    """Write a tile of base colour, normal and roughness to ``folder`` and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    y, x = (np.mgrid[:side, :side] + 0.5) * (2 * np.pi / side)
    height = np.cos(2 * x) * np.cos(2 * y) + 0.3 * np.cos(5 * x + 3 * y)
    slope = np.stack([-np.gradient(height, axis=1), np.gradient(height, axis=0), np.full_like(x, 0.5)], axis=-1)
    normal = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    write_png(folder / "tile_base_color.png", 0.5 + 0.3 * height[..., None] * np.array([1.0, 0.6, -0.4]))
    write_png(folder / "tile_normal_gl.png", 0.5 + 0.5 * normal)
    write_png(folder / "tile_roughness.png", 0.6 - 0.3 * height)
    return folder


def main(arguments=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="a folder of maps; default: three that are made here")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", type=Path, default=Path("out/textures"))
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    folder = options.folder or make_maps(options.out / "maps")
    options.out.mkdir(parents=True, exist_ok=True)

    asset = options.out / "tile.neumat"
    header = nm.fit(folder, asset, preset="1k", steps=options.steps, batch=4096, announce=print)
    print(f"{header['metrics']['psnr']:.2f} dB over all mips in {header['metrics']['bytes']} bytes")

    material = nm.load(asset)
    centre = np.array([[0.5, 0.5]], np.float32)
    for lod in (0.0, 2.5):  # from the compressed bits, at any place and scale
        values = {
            name: np.round(value[0].astype(float), 3).tolist() for name, value in material.maps(centre, lod).items()
        }
        print(f"mip {lod}: {values}")
    files = nm.export_bcf(material, options.out / "engine", shaders=("glsl",))
    print("for an engine:", ", ".join(file.name for file in files))
    return header


if __name__ == "__main__":
    main()
