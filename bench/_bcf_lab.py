"""What the tables of ``bench.bcf`` are made of: sets opened, fits kept, every combination measured once."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from pathlib import Path

import numpy as np

TABLES = ("table2", "figure8", "figure10", "options", "figure13")
"""All tables; the last one only runs where it is asked for."""

SETS = ("castle_white", "bishop_black", "knight_white", "chessboard", "boombox", "brick", "floor_tiles")

PRESETS = ("BCf-0.5k", "BCf-1k", "BCf-2k", "BCf-2k++", "BCf-66%")
"""Methods that are presets of the fit, with feature textures in proportion to the set (paper: for 2048²); the last one
takes at most 0.66 times the bytes of BC at half resolution, about what the paper's 1k takes."""

BASELINES = ("bc_half", "bc_full", "bc7_half", "bc7_full", "astc12_half", "astc12")


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to measure.

    ``crop`` is the side of the square taken from the middle of each set, None for all of it; ``steps`` those of each
    fit, None for the fit's own; ``out`` keeps fitted files and plots.
    """

    only: tuple[str, ...] = TABLES[:-1]
    sets: tuple[str, ...] = SETS
    presets: tuple[str, ...] = PRESETS
    baselines: tuple[str, ...] = BASELINES
    crop: int | None = 512
    steps: int | None = None
    seed: int = 0
    astc_quality: int = 100
    out: Path = Path("out/bench_bcf")

    def __post_init__(self):
        known = {"only": TABLES, "presets": PRESETS, "baselines": BASELINES}
        for field, names in known.items():
            for name in getattr(self, field):
                if name not in names:
                    raise ValueError(f"{field} must be among {', '.join(names)}, got {name!r}")


class Lab:
    """Opens sets, fits and measures each combination once."""

    def __init__(self, choice: Choice, device: str):
        self.choice, self.device = choice, device
        self.out = choice.out
        self.out.mkdir(parents=True, exist_ok=True)
        self.records: dict[tuple, dict] = {}

    @functools.cache  # noqa: B019  the lab lives as long as the run
    def source(self, name: str):
        """Return (manifest file, texture set, mips) of a set's centre; the name may be a folder."""
        from warp_neumat.io.texture_set import open_texture_set

        folder = Path(name)
        if not folder.is_dir():
            folder = Path(os.environ.get("NEUMAT_DATA", "../shared/data")) / "textures" / name
        opened, side = open_texture_set(folder), self.choice.crop
        if side is not None and (opened.width, opened.height) != (side, side):
            left, top = ((n - side) // 2 for n in (opened.width, opened.height))
            opened = open_texture_set(folder, crop=(left, top, side, side))
        manifest = self.out / f"{folder.name}-{opened.width}x{opened.height}.json"
        manifest.write_text(json.dumps(opened.manifest(self.out), indent=1) + "\n", encoding="utf-8")
        return manifest, opened, opened.mips()

    def material(self, name: str, preset: str, config: dict):
        """Return the fitted material and the seconds of its fit, None where the file was there."""
        from warp_neumat.materials import load
        from warp_neumat.training.fit import fit

        manifest, opened, _ = self.source(name)
        named = preset.removeprefix("BCf-")
        size = {"preset": named}
        if named.endswith("%"):
            size = {"bytes": self.baseline(name, "bc_half").bytes * int(named[:-1]) // 100}
        request = {
            **size,
            "steps": self.choice.steps,
            "seed": self.choice.seed,
            **config,
        }
        key = hashlib.sha256(json.dumps([opened.width, opened.height, request], sort_keys=True).encode()).hexdigest()
        path, seconds = self.out / f"{Path(name).name}-{key[:12]}.neumat", None
        if not path.exists():
            header = fit(str(manifest), path, model="bcf", device=self.device, resume=True, **request)
            seconds = header["training"].get("seconds")
        return load(path, device=self.device), seconds

    def baseline(self, name: str, method: str):
        """Return a set under a method of block compression."""
        from warp_neumat.training.baselines import Baseline

        _, opened, mips = self.source(name)
        quality = self.choice.astc_quality
        return Baseline(method, opened.channels, mips, wrap="repeat", astc_quality=quality)

    def measure(self, name: str, method: str, config: dict | None = None) -> dict:
        """Return a row's figures of a preset or baseline on a set; ``config`` makes another fit of BCf-1k."""
        from warp_neumat.training.evaluate_maps import compare, map_metrics

        if (name, method) not in self.records:
            _, opened, mips = self.source(name)
            if method in BASELINES:
                baseline = self.baseline(name, method)
                found = compare(opened.channels, mips, (baseline.level(m) for m in range(len(mips))))
                size, seconds = baseline.bytes, None
            elif config and "quantise" in config:
                from ._quantised import QuantisedFeatures

                channels, bits, scale = config["quantise"]
                plan = {"steps": self.choice.steps, "seed": self.choice.seed}
                material = QuantisedFeatures(opened, mips, channels=channels, bits=bits, scale=scale, **plan)
                found, size, seconds = map_metrics(opened, material.encoded), material.bytes, None
            else:
                material, seconds = self.material(name, method if config is None else "BCf-1k", config or {})
                found, size = map_metrics(opened, material.encoded), material.bytes
            row = {key: found[key] for key in ("psnr", "psnr_texels", "psnr_mip0", "ssim", "flip")}
            per_map = {entry: values["psnr"] for entry, values in found["maps"].items()}
            row |= {"bytes": size, "seconds": seconds, "psnr_maps": per_map}
            row["psnr_mips"] = [mip["psnr"] for mip in found["mips"]]
            self.records[name, method] = row
        return dict(self.records[name, method])

    def mean(self, method: str, config: dict | None = None) -> dict:
        """Return a method's figures over all sets: of the mean squared error for PSNR, else the mean."""
        rows = [self.measure(name, method, config) for name in self.choice.sets]
        return {key: _mean(key, [row[key] for row in rows]) for key in rows[0] if key not in ("psnr_maps", "psnr_mips")}


def _mean(key: str, values: list) -> float | None:
    if key.startswith("psnr"):
        error = np.mean([0.0 if value is None else 10 ** (-value / 10) for value in values])
        return None if error == 0 else float(-10 * np.log10(error))
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None


def synthetic_set(folder: Path, side: int = 64) -> Path:
    """Write a small set of maps (colour, normals, roughness) to ``folder`` and return it."""
    from warp_neumat.io.image import write_png

    rng = np.random.default_rng(4)
    folder.mkdir()
    y, x = np.mgrid[:side, :side] * (2 * np.pi / side)
    height = sum(np.sin(i * x + j * y + rng.uniform(0, 6.28)) / (i + j) for i in range(1, 5) for j in range(1, 5))
    slope = np.stack([-np.gradient(height, axis=1), np.gradient(height, axis=0), np.ones_like(height)], axis=-1)
    normal = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    tint = 0.5 + 0.12 * height[..., None] * np.array([1.0, 0.6, -0.4]) + 0.02 * rng.normal(size=(side, side, 3))
    write_png(folder / "quick_base_color.png", tint)
    write_png(folder / "quick_normal_gl.png", 0.5 + 0.5 * normal)
    write_png(folder / "quick_roughness.png", 0.5 + 0.1 * height)
    return folder
