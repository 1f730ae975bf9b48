"""What the tables of ``bench.brdf`` are made of: sources opened, methods fitted, every combination measured once."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

TABLES = ("table1", "frame", "table3", "table4", "figure8")

SETS = {"merl80": "merl80_nbrdf.npz", "rgl51": "rgl51_nbrdf.npz"}
"""Name → file of functions in NEUMAT_DATA/brdf."""

MATERIALS = {
    "merl80": ("alum-bronze", "black-oxidized-steel", "blue-acrylic", "chrome", "gold-metallic-paint", "green-fabric",
               "red-plastic", "specular-white-phenolic"),
    "rgl51": ("acrylic_felt_orange_rgb", "irid_flake_paint1_rgb", "paper_blue_rgb", "satin_gold_rgb"),
}  # fmt: skip
"""Set → the materials of a run that names none: metals, paints, plastics and cloths."""

BASELINES = ("ggx", "two_lobe", "nbrdf")

OURS = {"absolute": {"frame": "absolute"}, "half-isotropic": {"frame": "half-isotropic"}}
"""Method → options of the fit."""

FIGURES = (
    "mae", "rmse", "ssim", "mse_raw", "mse_log", "albedo_max", "albedo_max_source", "albedo_excess", "reciprocity",
    "bytes", "seconds",
)  # fmt: skip
"""What a record holds, and a mean is taken of."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to measure.

    ``materials`` are names in the set, specifications with a colon as ``neumat fit`` takes them, or ``("all",)``;
    ``steps`` those of each of our fits, None for the fit's own; ``baseline_steps`` likewise; ``frame`` is that of Table
    4 and Figure 8, None for the fit's own; ``cache`` keeps records between runs; ``picture`` is a file to draw;
    ``pixels`` the directions of the frames.
    """

    only: tuple[str, ...] = TABLES
    set: str = "merl80"
    materials: tuple[str, ...] = ()
    methods: tuple[str, ...] = (*BASELINES, *OURS)
    steps: int | None = None
    baseline_steps: int | None = None
    frame: str | None = None
    seed: int = 0
    size: int = 256
    cache: Path | None = None
    picture: Path | None = None
    pixels: int = 1920 * 1080
    rounds: int = 7
    nside: int = 64

    def __post_init__(self):
        known = {"only": TABLES, "methods": (*BASELINES, *OURS)}
        for field, names in known.items():
            for name in getattr(self, field):
                if name not in names:
                    raise ValueError(f"{field} must be among {', '.join(names)}, got {name!r}")
        if self.set not in SETS:
            raise ValueError(f"set must be one of {', '.join(SETS)}, got {self.set!r}")


class Lab:
    """Opens sources, fits and measures each combination once, in this run and, with a cache, in all."""

    def __init__(self, choice: Choice, device: str):
        self.choice, self.device = choice, device
        self.records: dict[str, dict] = {}
        self.spheres: dict[tuple[str, str], np.ndarray] = {}
        self._sources: dict[str, object] = {}
        if choice.cache is not None:
            choice.cache.parent.mkdir(parents=True, exist_ok=True)
            self.records = dict(_read_cache(choice.cache))

    @property
    def materials(self) -> tuple[str, ...]:
        """The chosen materials, every name of the set for ``all``."""
        chosen = self.choice.materials or MATERIALS[self.choice.set]
        if chosen != ("all",):
            return chosen
        from warp_neumat.io.brdf import function_names

        return tuple(function_names(_file(self.choice.set)))

    def specification(self, material: str) -> str:
        """Return what ``open_brdf`` takes."""
        return material if ":" in material else f"{_file(self.choice.set)}:{material}"

    def source(self, material: str):
        """Return the BRDF source, opened once."""
        from warp_neumat.io.brdf import open_brdf

        if material not in self._sources:
            self._sources[material] = open_brdf(self.specification(material))
        return self._sources[material]

    def measure(self, material: str, method: str, options: dict | None = None) -> dict:
        """Return the record of a baseline, of one of :data:`OURS`, or of a fit with ``options``."""
        choice, source = self.choice, self.source(material)
        baseline = method in BASELINES
        options = {} if baseline else OURS.get(method, {}) if options is None else options
        request = {
            "source": material if ":" in material else f"{choice.set}:{material}",
            "method": method if baseline else "ours",
            "options": options,
            "steps": choice.baseline_steps if baseline else choice.steps,
            "seed": choice.seed,
            "size": choice.size,
            "fit": None if baseline else _defaults(source, options),
        }
        key = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:16]
        drawn = choice.picture is None or (material, method) in self.spheres or method not in (*BASELINES, *OURS)
        if key not in self.records or not drawn:
            if baseline:
                record, evaluate = self._baseline(source, method)
            else:
                record, evaluate = self._ours(material, source, options)
            if choice.picture is not None and evaluate is not None:
                self._draw(material, method, source, evaluate)
            # A record may stand in the cache already, where only its picture was missing.
            if key not in self.records:
                self.records[key] = record
                if choice.cache is not None:
                    _append(choice.cache, {"key": key, "request": request, "record": record})
        return dict(self.records[key])

    def _baseline(self, source, method: str):
        from warp_neumat.training.brdf_baselines import fit

        fitted = fit(method, source, seed=self.choice.seed, steps=self.choice.baseline_steps)
        record = {**self._metrics(source, fitted.eval), "bytes": fitted.bytes, "seconds": fitted.seconds}
        return record, fitted.eval

    def _ours(self, material: str, source, options: dict):
        """Fit and measure what the file holds; what has no file (plain features) is measured by the fit itself."""
        from warp_neumat.materials import load
        from warp_neumat.training.fit import fit

        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "fitted.neumat"
            start = time.perf_counter()
            plan = {"steps": self.choice.steps, "seed": self.choice.seed}
            spec = self.specification(material)
            header = fit(spec, out, model="neubrdf", device=self.device, **plan, **options)
            seconds = header["training"].get("seconds", time.perf_counter() - start)
            if not out.exists():
                found = header["metrics"]
                return {**dict.fromkeys(FIGURES), **found, "seconds": seconds}, None
            loaded = load(out, device=self.device)
            record = {**self._metrics(source, loaded.brdf), "bytes": loaded.bytes, "seconds": seconds}
            config = header["config"]
            return {**record, "config": {k: config.get(k) for k in ("nside", "features", "bits", "frame")}}, loaded.brdf

    def _metrics(self, source, evaluate) -> dict:
        from warp_neumat.training.evaluate import brdf_metrics

        return {**dict.fromkeys(FIGURES), **brdf_metrics(source, evaluate, size=self.choice.size)}

    def _draw(self, material: str, method: str, source, evaluate):
        from warp_neumat.training.sphere import render_sphere

        from ._brdf_picture import SIDE

        self.spheres[material, method] = render_sphere(evaluate, SIDE)
        if (material, "source") not in self.spheres:
            self.spheres[material, "source"] = render_sphere(source.eval, SIDE)

    def mean(self, records: list[dict]) -> dict:
        """Return the mean of every figure that all records have."""
        keys = [k for k in FIGURES if all(isinstance(r.get(k), (int, float)) for r in records)]
        return {k: float(np.mean([r[k] for r in records])) for k in keys}


def _defaults(source, options: dict) -> dict:
    """Return what a fit with ``options`` resolves to: records of other defaults are not those of today's."""
    from warp_neumat.models import neubrdf
    from warp_neumat.training.loop import Plan

    config = dataclasses.asdict(neubrdf.configure(source, options))
    return {"config": config, "steps": neubrdf.DEFAULT_STEPS, "batch": Plan.batch, "version": neubrdf.VERSION}


def _file(name: str) -> Path:
    path = Path(os.environ.get("NEUMAT_DATA", "../shared/data")) / "brdf" / SETS[name]
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; set NEUMAT_DATA to the folder of real inputs")
    return path


def _read_cache(path: Path):
    """Yield (key, record) of the lines of a cache; what a kill left of a last line is cut off."""
    if not path.exists():
        return
    text = path.read_bytes()
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        path.write_bytes(whole)
    for number, line in enumerate(whole.decode().splitlines()):
        try:
            entry = json.loads(line)
            yield entry["key"], entry["record"]
        except (json.JSONDecodeError, KeyError, TypeError):
            raise ValueError(f"{path}: line {number + 1} is no record; delete the line or the file") from None


def _append(path: Path, entry: dict):
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry, default=float) + "\n")
