"""`neumat fit`: a source in, an asset out.

Opens the source, trains the model that the registry names, stores it, and measures what was stored. Interrupted fits
leave a checkpoint beside the output and go on from there with ``resume=True``.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path

import torch

from warp_neumat import models
from warp_neumat.io.asset import write_asset
from warp_neumat.io.atomic import check_writable
from warp_neumat.io.brdf import open_brdf
from warp_neumat.training import losses, samplers
from warp_neumat.training.evaluate import brdf_metrics
from warp_neumat.training.loop import Plan, Trainer

PRESETS = {"quick": 0.3, "standard": 1.0, "fine": 4.0}
"""Length of a fit in multiples of the model's default number of steps."""


class BRDFData:
    """What a fit does with sources of kind ``brdf``; the pattern for other kinds."""

    open = staticmethod(open_brdf)
    loss = staticmethod(losses.LogCosine)
    metrics = staticmethod(brdf_metrics)

    @staticmethod
    def sampler(source):
        """Return ``sampler(rng, count)`` for :class:`warp_neumat.training.loop.Trainer`."""
        return lambda rng, count: samplers.BRDFSampler(source, rng).draw(count)


DATA = {"brdf": BRDFData}


def checkpoint_path(out: Path) -> Path:
    """Return where the checkpoint of a fit to ``out`` lies."""
    return out.with_name(out.name + ".checkpoint")


def fit(
    source: str,
    out: str | os.PathLike,
    *,
    model: str = "neubrdf",
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    preset: str | None = None,
    resume: bool = False,
    progress=None,
    budget_seconds: float | None = None,
    **config,
) -> dict:
    """Fit ``model`` to ``source``, write the asset to ``out``, and return its header and how long it took.

    The returned ``header["training"]["seconds"]`` is not in the file.

    Args:
        source: As for :func:`warp_neumat.io.brdf.open_brdf`.
        out: The ``.neumat`` file to write; replaced if it exists. Its folder must exist.
        model: Name in :data:`warp_neumat.models.REGISTRY`.
        steps: Optimiser steps; default: the model's, times the preset's factor.
        seed: Same seed, same file (on one machine with the same number of threads).
        device: torch device.
        preset: One of :data:`PRESETS`.
        resume: Go on from the checkpoint beside ``out`` where there is one.
        progress: ``progress(fraction, text)``.
        budget_seconds: Train for this time instead of ``steps``; then the tensors depend on the machine's speed.
        config: Fields of the model's config, as ``nside=32``.

    Raises:
        ValueError: If the source, an option or the checkpoint does not fit; names it and the nearest valid one.
        OSError: If ``out`` cannot be written; found out before the training starts.
        FloatingPointError: If the training diverges.
    """
    out = Path(out)
    module = models.find(model)
    kind = DATA[module.DATA]
    opened = kind.open(source)
    shape = module.configure(opened, config)
    plan = Plan(steps=_step_count(module, steps, preset), seed=_whole("seed", seed, 0), budget_seconds=budget_seconds)
    if budget_seconds is not None and not budget_seconds > 0:
        raise ValueError(f"budget_seconds must be above 0, got {budget_seconds}")
    check_writable(out)  # now, not after minutes of training
    threads = torch.get_num_threads()
    torch.set_num_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    try:
        trained = module.build(shape, seed).to(_device(device))
        trainer = Trainer(
            trained,
            kind.sampler(opened),
            kind.loss(),
            plan,
            checkpoint=checkpoint_path(out),
            identity={"source": source, "model": model, "config": repr(shape)},
            progress=progress,
        )
        if resume and not trainer.resume() and progress:
            progress(0.0, "no checkpoint to resume: starting anew")
        facts = trainer.run()
        tensors, header = trained.cpu().to_asset()
        size = sum(tensor.nbytes for tensor in tensors.values())
        stored = module.from_asset(tensors, header["config"])
        header["source"] = {"spec": source, "name": opened.name}
        seconds = facts.pop("seconds")  # returned, but not stored: the same seed gives the same file
        header["training"] = {**facts, **trained.statistics()}
        header["metrics"] = {**kind.metrics(opened, stored.evaluate), "bytes": size}
        write_asset(out, tensors, header)
        header["training"]["seconds"] = seconds
    finally:
        torch.set_num_threads(threads)
    checkpoint_path(out).unlink(missing_ok=True)
    if progress:
        progress(1.0, f"wrote {out}")
    return header


def _whole(name: str, value, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
    return value


def _step_count(module, steps, preset) -> int:
    if preset is not None and preset not in PRESETS:
        close = difflib.get_close_matches(preset, PRESETS, n=1, cutoff=0.0)[0]
        raise ValueError(f"no preset {preset!r}; nearest: {close}; known: {', '.join(PRESETS)}")
    if steps is not None:
        return _whole("steps", steps, 1)
    return round(module.DEFAULT_STEPS * PRESETS[preset or "standard"])


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise ValueError(f"device {name!r} cannot be used ({str(error).splitlines()[0]}); use cpu") from None
    return device
