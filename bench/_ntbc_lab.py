"""What the tables of ``bench.ntbc`` are made of: crops of sets, fits kept, references encoded, each measured once."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import os
import time
from pathlib import Path

import numpy as np

TABLES = ("table2", "figure4", "figure6", "table1", "step", "options")
"""All tables; the last one only runs where it is asked for."""

SETS = ("castle_white", "bishop_black", "knight_white", "chessboard", "boombox", "brick", "floor_tiles")

TIMED = "boombox"
"""The set that times are measured on: two BC1 and five BC4, nearest to the paper's MetalPlates013 (two and four)."""

REFERENCES = ("bc", "bc ours")
"""Block compression of the maps by the best encoders on PyPI, and by ``kernels/block_fit.py``."""

PAPER = {
    "rate": "paper",
    "endpoints": "network",
    "joint": 0.0,
    "quantised": 1 / 11,
    "rates": (0.01, 0.005),
}
"""Options that differ from the defaults in the paper."""

METHODS = {
    "naive aggressive": {"mode": "aggressive", "variant": "naive"},
    "naive conservative": {"mode": "conservative", "variant": "naive"},
    "ntbc aggressive": {"mode": "aggressive"},
    "ntbc conservative": {"mode": "conservative"},
    "paper aggressive": {"mode": "aggressive", **PAPER},
    "paper conservative": {"mode": "conservative", **PAPER},
}
"""Method → options of the fit."""

RATES = {
    "ntbc 20 %": {"mode": "aggressive", "rate": 0.2},
    "ntbc 45 %": {"mode": "conservative", "rate": 0.45},
    "ntbc 100 %": {"mode": "conservative", "rate": 1.0},
}
"""Further points of Figure 4."""

CAP = 20 * math.log10(255) + 10 * math.log10(12)
"""Greatest PSNR that counts [dB]: that of errors spread evenly over half an 8-bit step to either side, 58.9."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to measure.

    ``crop`` is the side of the square taken from each set, None for all of it; ``steps`` those of each fit, None for
    the fit's own; ``modes`` and ``lengths`` the curves of Figure 6 and their steps, ``modes`` also those of Table 1;
    ``rounds`` those of timings and ``workers`` the threads of a training step; ``options`` go to every fit beside the
    method's; ``out`` keeps fitted files and plots.
    """

    only: tuple[str, ...] = TABLES[:-1]
    sets: tuple[str, ...] = SETS
    methods: tuple[str, ...] = tuple(METHODS)
    rates: tuple[str, ...] = tuple(RATES)
    modes: tuple[str, ...] = ("conservative", "aggressive")
    lengths: tuple[int, ...] = (250, 500, 1000, 2000, 4000, 8000)
    crop: int | None = 1024
    steps: int | None = None
    seed: int = 0
    rounds: int = 9
    workers: tuple[int, ...] = (1, 2)
    options: dict = dataclasses.field(default_factory=dict)
    out: Path = Path("out/bench_ntbc")

    def __post_init__(self):
        known = {"only": TABLES, "methods": tuple(METHODS), "rates": tuple(RATES)}
        for field, names in known.items():
            for name in getattr(self, field):
                if name not in names:
                    raise ValueError(f"{field} must be among {', '.join(names)}, got {name!r}")
        if not self.sets:
            raise ValueError(f"sets must name at least one, as {', '.join(SETS)}")
        if self.crop is not None and self.crop < 16:
            raise ValueError(f"crop must be at least 16, or 0 for the whole set, got {self.crop}")

    @property
    def timed(self) -> str:
        """The set that times are measured on."""
        return TIMED if TIMED in self.sets else self.sets[0]


# --- measures ---------------------------------------------------------------------------------------------------------


def most_detailed(pixels: np.ndarray, side: int) -> tuple[int, int]:
    """Return (x, y) of the square of ``side`` with the largest mean standard deviation of 4×4 blocks and channels.

    Squares begin at multiples of a quarter of their side, of whole blocks, and at the last whole block that still
    leaves room; of equal ones the first, row by row. The deviation, not the variance: detail all over is worth more
    than a few sharp edges.
    """
    height, width, channels = pixels.shape
    if side > min(height, width):
        raise ValueError(f"crop must be at most {min(height, width)} for a set of {width}x{height}, got {side}")
    rows, columns, inner = height // 4, width // 4, side // 4
    blocks = pixels[: 4 * rows, : 4 * columns].reshape(rows, 4, columns, 4, channels)
    detail = np.concatenate([row.std(axis=(0, 2), dtype=np.float64).mean(-1)[None] for row in blocks])
    sums = np.zeros((rows + 1, columns + 1))
    sums[1:, 1:] = detail.cumsum(0).cumsum(1)
    step = max(1, side // 16)
    best, found = -1.0, (0, 0)
    for y in _starts((height - side) // 4, step):
        for x in _starts((width - side) // 4, step):
            value = sums[y + inner, x + inner] - sums[y, x + inner] - sums[y + inner, x] + sums[y, x]
            if value > best * (1 + 1e-9):  # sums of the same numbers differ in their last digits
                best, found = value, (4 * x, 4 * y)
    return found


def _starts(last: int, step: int) -> list[int]:
    return sorted({*range(0, last + 1, step), last})


def capped(mse) -> float:
    """Return the PSNR of the mean of squared errors [dB], at most :data:`CAP`."""
    from warp_neumat.metrics import psnr_of_mse

    found = psnr_of_mse(mse)
    return CAP if found is None else min(found, CAP)


def figures(channels, mips, levels) -> dict:
    """Return ``psnr, ssim`` of mip 0 by map and their means over maps, and ``psnr_mips`` of all mips and channels.

    The mean over maps is one of decibels, as in the paper; the last is the PSNR of the mean squared error, each mip
    counting the same. None is above :data:`CAP`.

    Args:
        channels: The set's channels.
        mips: Reference from the finest mip on, each (h, w, C) float32 in [0, 1], encoded.
        levels: What to judge, one picture of the same shape for each mip; read once.
    """
    from warp_neumat.metrics import channel_mse, map_ssim
    from warp_neumat.training.evaluate_maps import map_channels

    maps, errors, ssim = map_channels(channels), [], {}
    for reference, level in zip(mips, levels, strict=True):
        if not errors:
            for each in maps:
                ours, theirs = (np.ascontiguousarray(x[..., each.indices]) for x in (reference, level))
                ssim[each.name] = map_ssim(ours, theirs)
        errors.append(channel_mse(reference, level))
    psnr = {each.name: capped(errors[0][list(each.indices)]) for each in maps}
    return {
        "psnr": float(np.mean(list(psnr.values()))),
        "ssim": float(np.mean(list(ssim.values()))),
        "psnr_mips": capped(errors),
        "psnr_maps": psnr,
        "ssim_maps": ssim,
    }


def colour_errors(channels, reference: np.ndarray, level: np.ndarray) -> dict:
    """Return mean CIE 1976 ``delta_e`` and its share of chroma alone, ``delta_ab``, of the sRGB maps of three channels.

    None where there is no such map.
    """
    from skimage.color import rgb2lab

    from warp_neumat.training.evaluate_maps import map_channels

    found = []
    for each in map_channels(channels):
        if each.encoding == "srgb" and len(each.indices) >= 3:
            pair = (np.clip(x[..., each.indices[:3]], 0, 1) for x in (reference, level))
            ours, theirs = (rgb2lab(x) for x in pair)
            difference = theirs - ours
            found.append([np.linalg.norm(difference[..., k:], axis=-1).mean() for k in (0, 1)])
    delta_e, delta_ab = np.mean(found, axis=0).tolist() if found else (None, None)
    return {"delta_e": delta_e, "delta_ab": delta_ab}


def against(row: dict, references: dict[str, dict]) -> dict:
    """Return a row's figures as ratios: of the bytes, and of PSNR and SSIM, to those of the references."""
    first = references["bc"]
    found = {"share": row["bytes"] / first["bytes"], "share_mip0": row["bytes"] / first["bytes_mip0"]}
    for name, suffix in (("bc", ""), ("bc ours", "_ours")):
        for key in ("psnr", "ssim"):
            found[f"{key}_ratio{suffix}"] = row[key] / references[name][key]
    return found


def mean(rows: list[dict]) -> dict:
    """Return the means of numbers that all rows have; bytes are summed, so that their ratio is that of the sums."""
    found = {}
    for key, value in rows[0].items():
        values = [row[key] for row in rows]
        if isinstance(value, (int, float)) and all(isinstance(v, (int, float)) for v in values):
            found[key] = sum(values) if key.startswith("bytes") else float(np.mean(values))
    return found


# --- references -------------------------------------------------------------------------------------------------------


def peer_round_trip(format: str, texels: np.ndarray) -> np.ndarray:
    """Return a plane (H, W, k) after the best encoder on PyPI: quicktex at level 18 for BC1 and BC4, etcpak for BC7."""
    from warp_neumat.training.baselines import THOROUGH, _round_trip

    return _round_trip(format, "plane", THOROUGH)(texels)


def own_round_trip(format: str, texels: np.ndarray) -> np.ndarray:
    """Return a plane (H, W, k) after the encoders of this package."""
    from warp_neumat.io.block_formats import from_blocks, to_blocks
    from warp_neumat.kernels.bc1 import bc1_decode
    from warp_neumat.kernels.bc4 import bc4_decode
    from warp_neumat.kernels.bc7 import bc7_decode
    from warp_neumat.kernels.block_fit import bc1_encode, bc4_encode, bc7_encode

    height, width, count = texels.shape
    blocks = to_blocks(texels).reshape(-1, 4, 4, count)
    if format == "bc4":
        decoded = bc4_decode(bc4_encode(np.ascontiguousarray(blocks[..., 0])))[..., None]
    else:
        encode, decode = {"bc1": (bc1_encode, bc1_decode), "bc7": (bc7_encode, bc7_decode)}[format]
        decoded = decode(encode(np.ascontiguousarray(blocks)))[..., :count]
    return from_blocks(decoded, width, height).astype(np.float32) / np.float32(255)


ROUND_TRIPS = {"bc": peer_round_trip, "bc ours": own_round_trip}


class Lab:
    """Opens sets, fits and measures each combination once."""

    def __init__(self, choice: Choice, device: str):
        self.choice, self.device, self.out = choice, device, choice.out
        self.out.mkdir(parents=True, exist_ok=True)
        self._records: dict[tuple, dict] = {}
        self._warm: set[tuple[str, str]] = set()

    @functools.cache  # noqa: B019  the lab lives as long as the run
    def folder(self, name: str) -> Path:
        """Return the folder of a set; the name may be one."""
        folder = Path(name)
        return folder if folder.is_dir() else Path(os.environ.get("NEUMAT_DATA", "../shared/data")) / "textures" / name

    @functools.cache  # noqa: B019
    def source(self, name: str):
        """Return (crop or None, texture set, mips) of a set's most detailed square."""
        from warp_neumat.io.texture_set import open_texture_set

        folder, side = self.folder(name), self.choice.crop
        opened, crop = open_texture_set(folder), None
        if side is not None and side < max(opened.width, opened.height):
            crop = (*most_detailed(opened.pixels, side), side, side)
            opened = open_texture_set(folder, crop=crop)
        return crop, opened, opened.mips()

    def fitted(self, name: str, options: dict, steps: int | None = None):
        """Return (material, seconds of the fit, bytes of the file); the file is used again where it is there."""
        from warp_neumat.materials import load
        from warp_neumat.models.ntbc import DEFAULT_STEPS
        from warp_neumat.training.fit import fit

        crop = self.source(name)[0]
        steps = steps or self.choice.steps or DEFAULT_STEPS
        request = {"steps": steps, "seed": self.choice.seed, **self.choice.options, **options}
        path = self._kept(name, "fit", [crop, request], "neumat")
        facts = path.with_suffix(".json")
        if not path.exists() or not facts.exists():
            more = {"model": "ntbc", "device": self.device, **({} if crop is None else {"crop": crop})}
            if (name, json.dumps(options)) not in self._warm:  # its kernels are compiled before time counts
                self._warm.add((name, json.dumps(options)))
                once = self.out / "warm-up.neumat"
                fit(self.folder(name), once, **more, **{**request, "steps": 1})
                once.unlink()
            header = fit(self.folder(name), path, resume=True, **more, **request)
            told = {"request": request, "crop": crop, "seconds": header["training"]["seconds"]}
            facts.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        seconds = json.loads(facts.read_text(encoding="utf-8"))["seconds"]
        return load(path, device=self.device), seconds, path.stat().st_size

    def _kept(self, name: str, what: str, facts: list, suffix: str) -> Path:
        """Return the path that what was made of a set with such facts is kept at."""
        text = json.dumps([what, *facts], sort_keys=True)
        return self.out / f"{self.folder(name).name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.{suffix}"

    def measure(self, name: str, options: dict, steps: int | None = None, colour: bool = False) -> dict:
        """Return a row's figures of a fit with ``options`` of a set, with those of colours if asked for."""
        from warp_neumat.training.evaluate_maps import sample_grid

        key = name, json.dumps(options, sort_keys=True), steps, colour
        if key not in self._records:
            _, opened, mips = self.source(name)
            material, seconds, size = self.fitted(name, options, steps)
            levels = (sample_grid(material.encoded, *mip.shape, float(lod)) for lod, mip in enumerate(mips))
            found = {"bytes": material.bytes, "bytes_file": size, **figures(opened.channels, mips, levels)}
            if colour:
                level = sample_grid(material.encoded, *mips[0].shape, 0.0)
                found |= colour_errors(opened.channels, mips[0], level)
            self._records[key] = {**found, "seconds": seconds}
        return dict(self._records[key])

    def reference(self, name: str, kind: str, options: dict | None = None, colour: bool = False) -> dict:
        """Return a row's figures of block compression, in the formats that a fit with ``options`` writes."""
        from warp_neumat.io.atomic import replacing
        from warp_neumat.io.block_formats import mip_bytes
        from warp_neumat.models.ntbc import configure

        formats = {key: value for key, value in (options or {}).items() if key in ("normals", "colours")}
        key = name, kind, json.dumps(formats, sort_keys=True), colour
        if key not in self._records:
            crop, opened, mips = self.source(name)
            # The rate says nothing of the formats, and the paper's grids always fit.
            config = configure(opened, {**formats, "rate": "paper"})
            mip0 = sum(mip_bytes(t.format, opened.width, opened.height, 0) for t in config.textures)
            path = self._kept(name, "reference", [kind, crop, opened.width, opened.height, formats], "npz")
            if not path.exists():
                start = time.perf_counter()
                levels = [compressed(config.textures, mip, ROUND_TRIPS[kind]) for mip in mips]
                seconds = time.perf_counter() - start
                levels = {
                    f"mip{number:02}": np.rint(255 * level).astype(np.uint8) for number, level in enumerate(levels)
                }
                with replacing(path) as temporary, open(temporary, "wb") as file:
                    np.savez_compressed(file, seconds=seconds, **levels)
            with np.load(path) as kept:
                levels = [kept[f"mip{number:02}"].astype(np.float32) / np.float32(255) for number in range(len(mips))]
                seconds = float(kept["seconds"])
            found = figures(opened.channels, mips, levels)
            if colour:
                found |= colour_errors(opened.channels, mips[0], levels[0])
            self._records[key] = {"bytes": config.block_bytes, "bytes_mip0": mip0, **found, "seconds": seconds}
        return dict(self._records[key])

    def references(self, name: str, options: dict | None = None, colour: bool = False) -> dict[str, dict]:
        """Return both references of a set."""
        return {kind: self.reference(name, kind, options, colour) for kind in REFERENCES}


def compressed(textures, pixels: np.ndarray, round_trip) -> np.ndarray:
    """Return a set's pixels (H, W, C) after ``round_trip(format, plane)`` of every plane of its textures."""
    from warp_neumat.models.ntbc import plane_colours

    result = np.empty_like(pixels)
    for texture in textures:
        for plane in texture.planes:
            decoded = round_trip(plane.format, plane_colours(plane, pixels))
            result[..., plane.channels] = decoded[..., : len(plane.channels)]
    return result
