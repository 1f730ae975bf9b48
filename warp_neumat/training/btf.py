"""What a fit does with bidirectional texture functions: the teacher first, then the student that learns from it.

MobileVR §4.3, 4.4. A teacher depends on the source, its own shape, its length and the seed; it is kept in the cache, so
that a second student of the same source does not train it again, nor one whose fit was stopped.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError, read_asset, write_asset
from warp_neumat.io.btf_source import BTFSource
from warp_neumat.io.cache import cache_folder
from warp_neumat.materials.btf import BTF
from warp_neumat.models.btf import CORNERS, step_shape
from warp_neumat.models.btf_config import VARIANTS, BTFConfig
from warp_neumat.simulation.open_btf import open_btf
from warp_neumat.training.btf_slices import SliceSampler
from warp_neumat.training.loop import Trainer
from warp_neumat.training.presets import length_of

BATCH = 1024
"""Quads a step."""

MEAN_QUADS = 1 << 14
TEST_DRAWS, TEST_QUADS = 4, 1 << 14
"""Quads that a stored model's error is taken on: 4 × 2¹⁴, in 4 × 256 slices."""

TEACHER_SHARE = 0.5
"""Length of the teacher's training in that of the student's, by default."""


class NoLoss:
    """In place of a loss of the data's: a BTF model holds its own (Eq. 5)."""

    def target(self, samples) -> dict:
        """Return nothing: ``prepare`` keeps what is needed."""
        return {}


def mean_value(source: BTFSource) -> float:
    """Return the mean of the source's values [1/sr] over a few slices, the unit that models count in."""
    drawn = SliceSampler(source, 1, beyond=0.0)(np.random.default_rng(0), MEAN_QUADS)
    return max(float(drawn["value"].mean(dtype=np.float64)), 1e-6)


def btf_metrics(source: BTFSource, material: BTF) -> dict:
    """Return ``l1``, ``l1_relative`` and, with mips, ``levels``: the L1 error of each.

    Args:
        source: What was fitted.
        material: What is stored, at run time.

    ``l1`` is the mean |ŷ − y| [1/sr] over quads of texel centres of the finest level under random pairs of the
    measured directions (MobileVR Table 1); ``l1_relative`` is that over the mean of y. ``levels`` is taken on places
    between texels too, at all distances.
    """
    mips = material.config["mips"]
    found = {"l1": 0.0, "mean": 0.0}
    sampler = SliceSampler(source, mips, beyond=0.0, aligned=True)
    for draw in range(TEST_DRAWS):
        error, mean, _ = _errors(sampler, material, draw)
        found["l1"] += float(error.mean(dtype=np.float64)) / TEST_DRAWS
        found["mean"] += float(mean) / TEST_DRAWS
    found["l1_relative"] = found["l1"] / max(found.pop("mean"), 1e-30)
    if mips > 1:
        error, _, level = _errors(SliceSampler(source, mips, beyond=0.0), material, TEST_DRAWS)
        found["levels"] = [float(error[level == m].mean()) for m in range(mips) if (level == m).any()]
    return found


def _errors(sampler: SliceSampler, material: BTF, draw: int):
    samples = sampler(np.random.default_rng([7, draw]), TEST_QUADS)
    uv, level = quad_places(sampler.source, samples["place"])
    fitted = material.eval_quads(uv, samples["wi"], samples["wo"], level)
    value = samples["value"].reshape(-1, 4, 3)
    return np.abs(fitted - value).mean((1, 2)), value.mean(dtype=np.float64), level.astype(int)


def quad_places(source, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return uv (n, 4, 2) of the places of quads, and their level (n,), of ``place`` (n, 4) as samplers draw it."""
    level = place[:, 3]
    sizes = np.stack(
        [np.maximum(1, source.width >> level.astype(int)), np.maximum(1, source.height >> level.astype(int))], 1
    )
    corner = np.array(CORNERS, np.float32)
    return place[:, None, :2] + corner * (place[:, 2:3] / sizes)[:, None].astype(np.float32), level


class BTFData:
    """What :func:`warp_neumat.training.fit.fit` does with sources of kind ``btf``."""

    OPTIONS = ()
    """Keyword arguments of a fit that belong to the source: none, its specification holds them."""

    @staticmethod
    def open(source, **opening) -> BTFSource:
        """Return the source that ``source`` names."""
        return open_btf(source, **opening)

    @staticmethod
    def configured(module, source, preset, options):
        """Return (length factor, batch, config); a preset names the length."""
        batch = options.pop("batch", BATCH)
        if isinstance(batch, bool) or not isinstance(batch, int) or batch < 64 or batch % 64:
            raise ValueError(f"batch must be a multiple of 64, got {batch!r}")
        try:
            return length_of(preset), batch, module.configure(source, options)
        except TypeError as error:
            given = ", ".join(f"{name}={value!r}" for name, value in options.items())
            raise ValueError(f"an option is of the wrong type: {given} ({error})") from None

    @staticmethod
    def opening(source, arguments: dict) -> dict:
        """Return what the header keeps of how the source was opened, JSON-able."""
        return dict(source.opening)

    @staticmethod
    def described(source, shape: BTFConfig) -> str:
        """Return what was understood of the source and what will be made of it, for people."""
        notes = "".join(f"note: {note}\n" for note in source.notes)
        coarse = f", coarse {shape.coarse_channels} features, {shape.coarse}" if shape.coarse else ""
        fewer = shape.channels > shape.hidden[0] or bool(shape.coarse) and shape.coarse_channels > shape.coarse[0]
        stored = "; stored with no more features than first layers have units" if fewer else ""
        return (
            f"{notes}{source.name}: {source.width}×{source.height} texels, {len(source.lights)} lights × "
            f"{len(source.views)} views; fine {shape.channels} features, {shape.hidden}{coarse}; "
            f"{shape.mips} mips{stored}"
        )

    @staticmethod
    def trainer(module, source, shape: BTFConfig, plan, device, **more):
        """Return what ``run`` and ``resume`` are called on."""
        return Distillation(module, source, shape, plan, device, **more)

    @staticmethod
    def stored(module, source, trainer) -> tuple[dict, dict, dict]:
        """Return (tensors, header, metrics) of the trained model, measured on what will be stored."""
        tensors, header = trainer.model.cpu().to_asset()
        material = BTF(tensors, header, path=Path(source.name), device="cpu")
        return tensors, header, {**btf_metrics(source, material), "weights": material.weights}


class Distillation:
    """Trains a teacher, unless one is at hand, and then the model that was asked for.

    Arguments as :class:`warp_neumat.training.loop.Trainer`'s; ``shape`` says how and from whom it learns.
    """

    def __init__(self, module, source, shape: BTFConfig, plan, device, *, checkpoint, identity, progress=None):
        self.module, self.source, self.shape, self.plan, self.device = module, source, shape, plan, device
        self.checkpoint, self.identity, self.progress = checkpoint, identity, progress or (lambda fraction, text: None)
        self._resume, self._data = False, None
        self._trainer: Trainer | None = None
        self.scale = None

    @property
    def model(self):
        """The model that was asked for."""
        return self._trainer.model

    def resume(self) -> bool:
        """Go on from the checkpoint, if there is one, when :meth:`run` comes to it. The teacher has one of its own."""
        self._resume = True
        trains = self.shape.distilled and self.shape.teacher == "auto"
        teacher = trains and (self._teacher_checkpoint().is_file() or self._cached().is_file())
        return teacher or Path(self.checkpoint).is_file()

    def run(self) -> dict:
        """Train; return the training facts of the model, and of its teacher ``teacher``, its file and error, and
        ``teacher_seconds``, how long it took, None where it was at hand."""
        self.scale = mean_value(self.source)
        taught, facts, share = None, {}, 0.0
        if self.shape.distilled:
            taught, facts = self._teacher()
            share = facts.get("share", 0.0)
        model = self.module.build(self.shape, self.plan.seed, self.scale, taught).to(self.device)
        self._trainer = Trainer(
            model, SliceSampler(self.source, self.shape.mips), NoLoss(), self.plan, checkpoint=self.checkpoint,
            identity=self.identity, progress=lambda done, text: self.progress(share + (1 - share) * done, text),
        )  # fmt: skip
        if self._resume:
            self._trainer.resume()
        found = self._trainer.run()
        return {**found, "teacher": facts["teacher"], "teacher_seconds": facts["seconds"]} if facts else found

    # --- the teacher ---

    def _teacher_config(self) -> BTFConfig:
        shape = {"variant": "teacher", **VARIANTS["teacher"], "hidden": self.shape.teacher_hidden, "teacher": "none"}
        kept = ("width", "height", "mips", "half_vector", "schedule", "epochs")
        return BTFConfig(**{name: getattr(self.shape, name) for name in kept}, **shape)

    def _teacher_plan(self):
        steps = self.shape.teacher_steps or max(1, round(self.plan.steps * TEACHER_SHARE))
        budget = self.plan.budget_seconds
        return dataclasses.replace(self.plan, steps=steps, budget_seconds=budget and budget * TEACHER_SHARE)

    def _facts(self) -> dict:
        plan = dataclasses.asdict(self._teacher_plan())
        del plan["checkpoint_seconds"]
        source = {name: self.identity.get(name) for name in ("source", "opening")}
        spread = np.random.default_rng(0).integers(0, (len(self.source.lights), len(self.source.views)), (16, 2))
        if self._data is None:  # asked for several times, and slices of a large file cost
            self._data = hashlib.sha256(self.source.slices(spread).tobytes()).hexdigest()
        return {
            "config": repr(self._teacher_config()),
            "plan": plan,
            "version": self.module.VERSION,
            "data": self._data,
            **source,
        }

    def _cached(self) -> Path:
        if self.shape.teacher not in ("auto", "none"):
            return Path(self.shape.teacher)
        digest = hashlib.sha256(json.dumps(self._facts(), sort_keys=True).encode()).hexdigest()[:24]
        return cache_folder() / f"teacher-{digest}.neumat"

    def _teacher_checkpoint(self) -> Path:
        return self._cached().with_name(self._cached().name + ".checkpoint")

    def _teacher(self) -> tuple:
        """Return (the model, its facts), from the file where there is one that can be read."""
        path = self._cached()
        given = self.shape.teacher != "auto"
        if given or path.is_file():
            try:
                model, header = self._read_teacher(path)
                l1 = header.get("metrics", {}).get("l1")
                return model, {"teacher": {"file": path.name, "l1": l1}, "seconds": None}
            except FormatError:
                if given:
                    raise  # one of ours that is damaged is made again
        plan = self._teacher_plan()
        cost = _cost(self._teacher_config()) * plan.steps
        share = cost / (cost + (_cost(self.shape) + _cost(self._teacher_config()) / 12) * self.plan.steps)
        model = self.module.build(self._teacher_config(), plan.seed, self.scale).to(self.device)
        trainer = Trainer(
            model, SliceSampler(self.source, self.shape.mips), NoLoss(), plan, checkpoint=self._teacher_checkpoint(),
            identity=self._facts(), progress=lambda done, text: self.progress(share * done, text),
        )  # fmt: skip
        path.parent.mkdir(parents=True, exist_ok=True)
        if self._resume:
            trainer.resume()
        facts = trainer.run()
        seconds = facts.pop("seconds")
        tensors, header, metrics = BTFData.stored(self.module, self.source, trainer)
        header["training"], header["metrics"] = {**facts, **model.statistics()}, metrics
        header["metrics"]["bytes"] = sum(t.nbytes for t in tensors.values())
        write_asset(path, tensors, header)
        self._teacher_checkpoint().unlink(missing_ok=True)
        model = self.module.from_asset(tensors, header["config"]).to(self.device)  # as one out of the cache
        return model, {"teacher": {"file": path.name, "l1": metrics["l1"]}, "seconds": seconds, "share": share}

    def _read_teacher(self, path: Path) -> tuple:
        """Return (model, header) of a teacher's file.

        Raises:
            FormatError: If it is none, or one of a texture of another size or of fewer mips.
        """
        tensors, header = read_asset(path)
        if header["kind"] != "btf":
            raise FormatError(path, "kind", f"a teacher must be of kind btf, got {header['kind']}", "fit one")
        BTF(tensors, header, path=path, device="cpu")  # checks all of it
        model, student = self.module.from_asset(tensors, header["config"]).to(self.device), self.shape
        size, wanted = ((c.width, c.height, c.mips) for c in (model.config, student))
        if size[:2] != wanted[:2] or size[2] < wanted[2]:
            rule = "a teacher must be {}×{} with {} mips, as what it teaches, got {}×{} with {}".format(*wanted, *size)
            raise FormatError(path, "config", rule, "fit one to this source")
        return model, header


def _cost(config: BTFConfig) -> float:
    """Return what a training step costs, in multiply-adds and in units of a batch, roughly."""
    return 3.0 * step_shape(config).products + 2e4
