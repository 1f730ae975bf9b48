"""`neumat fit`: a source in, an asset out.

Opens the source, trains the model that the registry names, stores it, and measures what was stored. Interrupted fits
leave a checkpoint beside the output and go on from there with ``resume=True``.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import torch

from warp_neumat import models
from warp_neumat.io import svbrdf
from warp_neumat.io.asset import write_asset
from warp_neumat.io.atomic import check_writable
from warp_neumat.io.brdf import open_brdf
from warp_neumat.simulation.open_btf import is_btf_spec
from warp_neumat.training import losses, samplers, spatial
from warp_neumat.training.block_maps import BlockMapData
from warp_neumat.training.btf import BTFData
from warp_neumat.training.evaluate import brdf_metrics
from warp_neumat.training.loop import Plan, Trainer
from warp_neumat.training.maps import MapData
from warp_neumat.training.presets import PRESETS, length_of
from warp_neumat.training.threads import all_threads

MOST_EXCESS, ENERGY_ROUNDS = 1.01, 4
"""Largest ratio of the fit's albedo to max(1, the source's own), and how often a fit trains on to keep it."""

GRAZING = {"mixture": {"cosine": 0.2, "peak": 0.2, "grazing": 0.6}, "horizon": 6.0}
"""What the samples for that are drawn with."""


class BRDFData:
    """What a fit does with sources of kind ``brdf``, varying over a surface or not; the pattern for others."""

    OPTIONS = ("size", "crop", "overrides")
    """Keyword arguments of :func:`fit` that belong to the source."""
    loss = staticmethod(losses.LogCosine)

    @staticmethod
    def open(source, **opening):
        """Return the source that ``source`` names."""
        if str(source).startswith(svbrdf.PREFIX):
            return svbrdf.open_svbrdf(source, **opening)
        if opening:
            name = next(iter(opening))
            raise ValueError(f"{name} is for maps: {svbrdf.PREFIX}FOLDER, or model bcf; {source} has no {name}")
        return open_brdf(source)

    @staticmethod
    def configured(module, source, preset, options):
        """Return (length factor, batch, config of the model)."""
        if svbrdf.is_spatial(source):
            options = spatial.configured(source, options)
        elif options.get("texture") is not None:
            raise ValueError(f"texture is for what varies over a surface, as {svbrdf.PREFIX}FOLDER; leave it out")
        return length_of(preset), Plan.batch, module.configure(source, options)

    @staticmethod
    def sampler(source, texture=None):
        """Return ``sampler(rng, count)`` for :class:`warp_neumat.training.loop.Trainer`."""
        if svbrdf.is_spatial(source):
            return lambda rng, count: spatial.SpatialSampler(source, rng, texture).draw(count)
        return lambda rng, count: samplers.sampler(source, rng).draw(count)

    @staticmethod
    def opening(source, arguments: dict) -> dict:
        """Return what the header keeps of how the source was opened, JSON-able."""
        return dict(getattr(source, "opening", {}))

    @staticmethod
    def described(source, shape) -> str:
        """Return what was understood of the source and what will be made of it, for people; may be empty."""
        notes = "".join(f"note: {note}\n" for note in getattr(source, "notes", ()))
        if source.isotropic is False and shape.frame.endswith("isotropic"):
            notes += f"note: {source.name} is anisotropic; frame {shape.frame} leaves that out\n"
        if not svbrdf.is_spatial(source):
            return notes.rstrip()
        made = "none" if shape.texture is None else "×".join(map(str, shape.texture))
        return f"{notes}{source.name}: {source.width}×{source.height} texels; neural texture: {made}"

    @classmethod
    def trainer(cls, module, source, shape, plan, device, **more):
        """Return what ``run`` and ``resume`` are called on."""
        trained = module.build(shape, plan.seed).to(device)
        if getattr(source, "samples", None) is not None:
            trained.support = tuple(torch.from_numpy(d).to(device) for d in source.samples[:2])
        return Trainer(trained, cls.sampler(source, shape.texture), cls.loss(), plan, **more)

    @classmethod
    def stored(cls, module, source, trainer) -> tuple[dict, dict, dict]:
        """Return (tensors, header, metrics) of the trained model, measured on what will be stored.

        Where it gives back over 1 % more light than it gets and its source does not, it first trains on with more
        grazing samples. (A list of samples says nothing of what lies between.)
        """
        trainer.model.cpu()
        trainer.device = torch.device("cpu")
        found, rounds = cls._measured(module, source, trainer.model), 0
        listed = getattr(source, "samples", None) is not None
        while rounds < ENERGY_ROUNDS and found[2].get("albedo_excess", 0.0) > MOST_EXCESS and not listed:
            rounds += 1
            steps = max(64, trainer.plan.steps // 4)
            trainer.polish("energy", lambda rng, count: samplers.BRDFSampler(source, rng, **GRAZING).draw(count), steps)
            found = cls._measured(module, source, trainer.model)
        if rounds:
            found[2]["energy_rounds"] = rounds
        return found

    @staticmethod
    def _measured(module, source, model) -> tuple[dict, dict, dict]:
        if model.has_file:
            tensors, header = model.to_asset()
            config, size = header["config"], sum(t.nbytes for t in tensors.values())
            evaluate, rate = module.from_asset(tensors, config).evaluate, {}
        else:
            config, size, tensors = dataclasses.asdict(model.config), model.bytes, {}
            header = {"kind": "neubrdf", "version": module.VERSION, "config": config}
            evaluate, rate = model.evaluate, {"bytes": size}
        if svbrdf.is_spatial(source):
            evaluate = spatial.on_source_levels(source, config["texture"], evaluate)
            rate["bits_per_texel"] = spatial.bits_per_texel(source, size)
        return tensors, header, {**brdf_metrics(source, evaluate), **rate}


DATA = {"brdf": BRDFData, "maps": MapData, "block_maps": BlockMapData, "btf": BTFData}


def default_model(source) -> str:
    """Return the model that a source is for: ``btf``, ``neubrdf`` for reflectance files and ``KIND:…``, or ``bcf``."""
    if is_btf_spec(source):
        return "btf"
    if str(source).startswith(svbrdf.PREFIX):
        return "neubrdf"
    if isinstance(source, dict) or str(source).lower().endswith(".json") or os.path.isdir(source):
        return "bcf"
    file = str(source).lower().partition("?")[0]
    return "neubrdf" if ":" in str(source) or file.endswith((".npz", ".binary", ".bsdf", ".csv")) else "bcf"


def presets(model: str) -> tuple[str, ...]:
    """Return the names that ``fit(…, preset=…)`` knows for ``model``."""
    return tuple({**getattr(models.find(model), "PRESETS", {}), **PRESETS})


def checkpoint_path(out: Path) -> Path:
    """Return where the checkpoint of a fit to ``out`` lies."""
    return out.with_name(out.name + ".checkpoint")


def fit(
    source: str | os.PathLike | dict,
    out: str | os.PathLike,
    *,
    model: str | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    preset: str | None = None,
    resume: bool = False,
    progress=None,
    announce=None,
    budget_seconds: float | None = None,
    checkpoint_seconds: float = Plan.checkpoint_seconds,
    **config,
) -> dict:
    """Fit ``model`` to ``source``, write the asset to ``out``, and return its header and how long it took.

    The returned ``header["training"]["seconds"]``, and ``"teacher_seconds"`` of a teacher, are not in the file.

    Args:
        source: As for :func:`warp_neumat.io.brdf.open_brdf`, or for model ``bcf`` as for
            :func:`warp_neumat.io.texture_set.open_texture_set`.
        out: The ``.neumat`` file to write; replaced if it exists. Its folder must exist. What is for comparison alone
            (``storage``, ``pixelation``) is fitted and measured, and nothing is written.
        model: Name in :data:`warp_neumat.models.REGISTRY`; default: :func:`default_model`.
        steps: Optimiser steps; default: the model's, times the preset's factor.
        seed: Same seed, same file (on one machine with the same number of threads).
        device: torch device.
        preset: One of :data:`PRESETS`; for ``bcf`` also one of :data:`warp_neumat.models.bcf.PRESETS`.
        resume: Go on from the checkpoint beside ``out`` where there is one.
        progress: ``progress(fraction, text)``.
        announce: ``announce(text)``, called before the training with what was understood of a texture set, and where
            there was nothing to resume.
        budget_seconds: Train for this time instead of ``steps``; then the tensors depend on the machine's speed.
        checkpoint_seconds: Longest stretch of work that an interruption can cost.
        config: Fields of the model's config, as ``nside=32`` or ``features=(256, 128, 64, 32)``; for ``bcf`` also
            ``batch`` and the keyword arguments of ``open_texture_set``.

    Raises:
        ValueError: If the source, an option or the checkpoint does not fit; names it and the nearest valid one.
        OSError: If ``out`` cannot be written; found out before the training starts.
        FloatingPointError: If the training diverges.
    """
    out = Path(out)
    model = default_model(source) if model is None else model
    module = models.find(model)
    kind = DATA[module.DATA]
    opening = {name: config.pop(name) for name in kind.OPTIONS if name in config}
    seed = _whole("seed", seed, 0)
    if budget_seconds is not None and not budget_seconds > 0:
        raise ValueError(f"budget_seconds must be above 0, got {budget_seconds}")
    if not checkpoint_seconds >= 0:
        raise ValueError(f"checkpoint_seconds must be at least 0, got {checkpoint_seconds}")
    opened = kind.open(source, **opening)
    factor, batch, shape = kind.configured(module, opened, preset, dict(config))
    steps = round(module.DEFAULT_STEPS * factor) if steps is None else _whole("steps", steps, 1)
    plan = Plan(steps, batch, seed, budget_seconds, checkpoint_seconds)
    check_writable(out)  # now, not after minutes of training
    if announce and (text := kind.described(opened, shape)):
        announce(text)
    with all_threads():
        settled = kind.opening(opened, opening)
        identity = {"source": _named(source), "opening": settled, "model": model, "config": repr(shape)}
        more = {"checkpoint": checkpoint_path(out), "identity": identity, "progress": progress}
        trainer = kind.trainer(module, opened, shape, plan, _device(device), **more)
        if resume and not trainer.resume() and announce:
            announce(f"note: {checkpoint_path(out)}: no such checkpoint to resume; starting anew")
        facts = trainer.run()
        tensors, header, metrics = kind.stored(module, opened, trainer)
        size = sum(tensor.nbytes for tensor in tensors.values())
        header["source"] = {"spec": _named(source), "name": opened.name}
        if notes := list(getattr(opened, "notes", ())):
            header["source"]["notes"] = notes
        if settled:
            header["source"]["opening"] = settled
        # Returned, but not stored: the same seed gives the same file.
        spent = {name: facts.pop(name) for name in ("seconds", "teacher_seconds") if name in facts}
        header["training"] = {**facts, **trainer.model.statistics()}
        header["metrics"] = {**metrics, "bytes": metrics.get("bytes", size)}
        if tensors:  # what is fitted for comparison alone has no file
            write_asset(out, tensors, header)
        header["training"] |= spent
    checkpoint_path(out).unlink(missing_ok=True)
    if progress:
        progress(1.0, f"wrote {out}" if tensors else "measured; for comparison alone, so nothing is written")
    return header


def _whole(name: str, value, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return value


def _named(source) -> str:
    """Return a source as text, for the header; manifests may come as dictionaries."""
    return source if isinstance(source, str) else os.fspath(source) if hasattr(source, "__fspath__") else "manifest"


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise ValueError(f"device {name!r} cannot be used ({str(error).splitlines()[0]}); use cpu") from None
    return device
