"""What the tables of ``bench.btf`` are made of: every material × method fitted once, measured by one function."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from ._brdf_lab import _append, _read_cache

TABLES = ("table1", "figure7", "figure11", "ablation", "figure13", "figure10", "table3", "peers")

MATERIALS = ("weave", "leather", "carpet", "wood")
"""Micro-geometries of a run that names no material."""

NETWORKS = {
    "distilled": {"variant": "coarse-to-fine"},
    "alone": {"variant": "coarse-to-fine", "teacher": "none"},
    "single-level": {"variant": "single-level"},
    "neumip": {"variant": "neumip"},
    "neumip-max": {"variant": "neumip-max"},
}
"""Method → options of the fit."""

_ALONE = {"teacher": "none"}
ABLATION = {
    "as it is": {},
    "ReLU": {"activation": "relu"},
    "no half vector": {"half_vector": False},
    "half of the layers coarse": {"coarse": (8, 8), "hidden": (8,) * 5},
    "most layers coarse": {"coarse": (8,) * 6, "hidden": (8,)},
    "all mips": {"mips": 0},
    "BC6H features": {"features": "bc6h"},
}
"""Row of the ablation → options of a coarse-to-fine fit without a teacher, with the weights of the first but for h."""

LAFORTUNE = "lafortune"

METHODS = ("distilled", "alone", "single-level", "neumip", LAFORTUNE)
"""Methods of a run that names none."""

FIGURES = ("l1", "l1_relative", "bytes", "weights", "macs", "seconds", "teacher_seconds")
"""What a record holds and a mean is taken of."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """What to measure.

    ``materials`` are micro-geometries, or specifications with a colon or a dot as ``neumat fit`` takes them; ``size``
    is the texels along a side of the former, ``directions`` their set; ``steps``, ``epochs`` and ``mips`` are those of
    each fit, None for the fit's own; ``pairs`` are what lobes are fitted to, ``iterations`` their steps; ``cache``
    keeps records between runs; ``plots`` is a folder for the figures; ``atlas`` the side of Figure 10's sheet, ``tile``
    of each of Table 3's, ``texels`` of the networks' runs, ``rounds`` the times each is timed; ``compiled`` lets torch
    compile.
    """

    only: tuple[str, ...] = TABLES
    materials: tuple[str, ...] = MATERIALS
    methods: tuple[str, ...] = METHODS
    size: int = 64
    directions: str = "ubo2014"
    steps: int | None = None
    epochs: int | None = None
    mips: int | None = None
    seed: int = 0
    pairs: int = 2114
    iterations: int = 60
    cache: Path | None = None
    plots: Path | None = None
    atlas: int = 1200
    tile: int = 1024
    texels: int = 1 << 18
    rounds: int = 15
    compiled: bool = True

    def __post_init__(self):
        for field, names in (("only", TABLES), ("methods", (*NETWORKS, LAFORTUNE))):
            for name in getattr(self, field):
                if name not in names:
                    raise ValueError(f"{field} must be among {', '.join(names)}, got {name!r}")


class Lab:
    """Opens sources, and fits and measures each combination once, in this run and, with a cache, in all."""

    def __init__(self, choice: Choice, device: str):
        self.choice, self.device = choice, device
        self.records: dict[str, dict] = {}
        self._sources: dict[str, object] = {}
        if choice.cache is not None:
            choice.cache.parent.mkdir(parents=True, exist_ok=True)
            self.records = dict(_read_cache(choice.cache))

    def specification(self, material: str) -> str:
        """Return what ``open_btf`` takes."""
        if any(mark in material for mark in ":./"):
            return material
        return f"microgeometry:{material}?size={self.choice.size}&directions={self.choice.directions}"

    def source(self, material: str):
        """Return the BTF source, opened once."""
        from warp_neumat.simulation.open_btf import open_btf

        if material not in self._sources:
            self._sources.clear()  # a source keeps its tables in memory: one at a time
            self._sources[material] = open_btf(self.specification(material))
        return self._sources[material]

    def measure(self, material: str, method: str) -> dict:
        """Return the record of one method: :data:`FIGURES` as far as it has them, ``test_l1`` and ``cosine``."""
        choice, source = self.choice, self.source(material)
        request = {"source": self.specification(material), "method": method, "seed": choice.seed}
        if method == LAFORTUNE:
            request |= {"pairs": choice.pairs, "iterations": choice.iterations}
        else:
            request |= {"plan": choice.steps, "fit": _defaults(source, self._options(method))}
        key = hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()[:16]
        if key not in self.records:
            record = self._lobes(source) if method == LAFORTUNE else self._network(material, method)
            self.records[key] = record = {**dict.fromkeys(FIGURES), **record}
            if choice.cache is not None:
                _append(choice.cache, {"key": key, "request": request, "record": record})
        return dict(self.records[key])

    def _options(self, method: str) -> dict:
        given = {name: getattr(self.choice, name) for name in ("epochs", "mips")}
        if method in ABLATION:
            given = {name: value for name, value in given.items() if value is not None}
            return {**_ALONE, **given, **ABLATION[method]}
        return {**NETWORKS[method], **{name: value for name, value in given.items() if value is not None}}

    def _network(self, material: str, method: str) -> dict:
        """Fit as ``neumat fit`` does; a teacher that an earlier fit of this source left in the cache is used again."""
        from warp_neumat.materials import load
        from warp_neumat.training.fit import fit

        choice = self.choice
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "fitted.neumat"
            plan = {"steps": choice.steps, "seed": choice.seed}
            header = fit(self.specification(material), out, model="btf", **plan, **self._options(method))
            fitted = load(out, device="cpu")
        training, metrics = header["training"], header["metrics"]
        return {
            "l1": metrics["l1"],
            "l1_relative": metrics["l1_relative"],
            "bytes": fitted.bytes,
            "weights": fitted.weights,
            "macs": multiply_adds(fitted.layout),
            "seconds": training["seconds"],
            "teacher_seconds": training.get("teacher_seconds"),
            "teacher_l1": training.get("teacher", {}).get("l1"),
            "test_l1": training["test_l1"],
        }

    def _lobes(self, source) -> dict:
        """Fit four lobes with every choice of what carries the cosine, and keep the one with the least error."""
        from warp_neumat.kernels.lafortune import COSINES
        from warp_neumat.training.btf import btf_metrics
        from warp_neumat.training.lafortune import fit_lafortune

        choice, found, start = self.choice, [], time.perf_counter()
        for cosine in COSINES:
            plan = {"pairs": choice.pairs, "iterations": choice.iterations, "seed": choice.seed}
            lobes = fit_lafortune(source, cosine=cosine, **plan)
            record = {**btf_metrics(source, TexelLobes(lobes)), "bytes": lobes.bytes, "cosine": cosine}
            found.append({**record, "seconds": lobes.seconds})
        best = min(found, key=lambda record: record["l1"])
        return {**best, "all_seconds": time.perf_counter() - start}

    def mean(self, records: list[dict]) -> dict:
        """Return the mean of every figure that all records have."""
        keys = [k for k in FIGURES if all(isinstance(r.get(k), (int, float)) for r in records)]
        return {k: float(np.mean([r[k] for r in records])) for k in keys}


class TexelLobes:
    """Lobes as ``btf_metrics`` asks for a material: quads of texel centres."""

    config = {"mips": 1}
    SLICES = 16

    def __init__(self, fit):
        self.fit = fit

    def eval_quads(self, uv, wi, wo, lod) -> np.ndarray:
        """Return the values (n, 4, 3) at the texels that hold ``uv`` (n, 4, 2), whose pairs repeat; ``lod`` is 0."""
        height, width, _ = self.fit.parameters.shape
        pairs, number = np.unique(np.concatenate([wi, wo], 1), axis=0, return_inverse=True)
        number = number.reshape(-1)  # NumPy 2.0 gives it two axes
        x, y = (np.floor(uv[..., k] * n).astype(int) % n for k, n in enumerate((width, height)))
        result = np.empty((len(uv), 4, 3), np.float32)
        for first in range(0, len(pairs), self.SLICES):
            part = pairs[first : first + self.SLICES]
            mine = np.flatnonzero((number >= first) & (number < first + len(part)))
            slices = self.fit.value(part[:, :3], part[:, 3:])
            result[mine] = slices[(number[mine] - first)[:, None], y[mine], x[mine]]
        return result


def multiply_adds(layout) -> float:
    """Return the multiply-adds of the networks for a texel and a light, those of the coarse one over a quad's four."""
    shares = {"coarse": 4, "fine": 1}
    layers = {name: sum(i * o for i, o in zip(w[:-1], w[1:], strict=True)) for name, w in layout.widths.items()}
    return sum(macs / shares[name] for name, macs in layers.items())


def _defaults(source, options: dict) -> dict:
    """Return what a fit with ``options`` resolves to: records of other defaults are not those of today's."""
    from warp_neumat.models import btf
    from warp_neumat.training.btf import BATCH

    config = dataclasses.asdict(btf.configure(source, options))
    return {"config": config, "steps": btf.DEFAULT_STEPS, "batch": BATCH, "version": btf.VERSION}
