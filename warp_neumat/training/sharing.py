"""`neumat fit --shared DIR`: materials that share one codebook and one decoder, each with indices of its own.

A group is ``DIR/group-N.neumat``; its members are ``DIR/NAME.neumat`` (:mod:`warp_neumat.io.shared_asset`). Where DIR
holds groups already, materials are added: each joins the group of the compatible member that looks most like it
(:mod:`warp_neumat.training.joining`), and no file that is there is touched.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError, read_asset, write_asset
from warp_neumat.io.atomic import check_writable
from warp_neumat.io.brdf_set import Opened
from warp_neumat.io.brdf_source import SYMMETRIES
from warp_neumat.io.shared_asset import GROUP
from warp_neumat.models import neubrdf
from warp_neumat.training import losses, samplers
from warp_neumat.training.grouping import groups
from warp_neumat.training.joining import join
from warp_neumat.training.loop import Plan, Trainer
from warp_neumat.training.shared_job import PLAN, Job, finished, load_plan, save_plan, write_member
from warp_neumat.training.threads import all_threads

GROUP_VERSION = 1


class SharedSampler:
    """Draws from several sources in equal shares; every sample knows its ``material``."""

    def __init__(self, sources, rng: np.random.Generator):
        self.sources, self.rng = sources, rng

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """Return ``{"wi", "wo", "value", "material"}`` of ``count`` samples in random order."""
        share = np.diff(np.linspace(0, count, len(self.sources) + 1).round().astype(int))
        drawn = [samplers.sampler(s, self.rng).draw(n) for s, n in zip(self.sources, share, strict=True)]
        order = self.rng.permutation(count)
        found = {name: np.concatenate([d[name] for d in drawn])[order] for name in ("wi", "wo", "value")}
        return {**found, "material": np.repeat(np.arange(len(share), dtype=np.int32), share)[order]}


def fit_shared(
    sources: dict[str, Opened],
    folder,
    *,
    count: int | None = None,
    steps: int | None = None,
    length: float = 1.0,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    progress=None,
    announce=None,
    checkpoint_seconds: float = Plan.checkpoint_seconds,
    **config,
) -> dict[str, dict]:
    """Fit all ``sources`` into ``folder``, in groups; return the header of every material by name.

    Args:
        sources: Specifications and BRDF sources by the name of the file that each becomes, as
            :func:`warp_neumat.io.brdf_set.open_brdfs` returns.
        folder: Where groups and materials are written; made if missing. If it holds groups, the sources join them.
        count: Groups of each sort, isotropic and not; default: one for about eight materials.
        steps: Optimiser steps of a group; default: the model's, times the root of its materials, and half of it for a
            material that joins.
        length: Factor of the default number of steps.
        seed: Same seed, same files (on one machine with the same number of threads).
        device: ``"cpu"``; groups are fitted there alone.
        resume: Skip what is written, and go on from checkpoints, with the groups that were planned.
        progress: ``progress(fraction, text)``.
        announce: ``announce(text)``, called with what was noticed and decided.
        checkpoint_seconds: Longest stretch of work that an interruption can cost.
        config: Fields of the model's config; where the sources join, ``reciprocal`` alone: take them for such.

    Raises:
        ValueError: If a source, a name or an option is wrong, a file of that name is there and not to be resumed, or
            what is to be resumed had other settings.
        OSError: If the folder cannot be written.
    """
    folder = Path(folder)
    job = Job(
        dict(sources), folder, count, steps, length, seed, resume, progress or (lambda fraction, text: None),
        announce or (lambda text: None), checkpoint_seconds, config,
    )  # fmt: skip
    _check(job, device)
    there = [name for name in sources if job.path(name).exists()]
    if there and not resume:
        raise ValueError(f"{job.path(there[0])}: is there already; use another folder, remove it, or resume")
    known, interrupted = any(folder.glob("group-*.neumat")), (folder / PLAN).exists()
    if interrupted and known and not resume:
        raise FormatError(folder / PLAN, "fit", "was interrupted", "resume it, or use another folder")
    with all_threads():
        if interrupted and resume:
            return _fit_groups(job, load_plan(job))
        if known:
            for name in there:
                job.announce(f"note: {name}: is there already")
            added = [name for name in sources if name not in there]
            headers = {name: read_asset(job.path(name))[1] for name in there}
            return headers | (join(job, added) if added else {})
        if resume:
            job.announce(f"note: {folder}: nothing to resume; starting anew")
        plan = groups([opened.source for opened in sources.values()], count, seed=seed)
        return _fit_groups(job, plan, save=True)


def _check(job: Job, device: str) -> None:
    """Raise an error for what is wrong before anything is read or written."""
    if device != "cpu":
        raise ValueError(f"fits of neubrdf that share primitives run on the cpu, got device {device!r}; leave it out")
    if not job.sources:
        raise ValueError("no source is given; give at least one")
    for name in job.sources:
        if name.startswith("group-"):
            raise ValueError(f"{name!r}: no material can be called group-…: groups are; rename it")
    for field, value, least in (("count", job.count, 1), ("steps", job.steps, 1), ("seed", job.seed, 0)):
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < least):
            raise ValueError(f"{field} must be a whole number of at least {least}, got {value!r}")
    if not job.length > 0:
        raise ValueError(f"length must be above 0, got {job.length}")
    if not job.checkpoint_seconds >= 0:
        raise ValueError(f"checkpoint_seconds must be at least 0, got {job.checkpoint_seconds}")
    if job.config.get("texture") is not None:
        raise ValueError("texture is for what varies over a surface; materials that share primitives have none")
    if job.folder.exists() and not job.folder.is_dir():
        raise NotADirectoryError(f"{job.folder}: is a file; give a folder for the groups and their materials")


def _fit_groups(job: Job, plan: list[list[int]], save: bool = False) -> dict[str, dict]:
    names = list(job.sources)
    members = [{names[n]: job.sources[names[n]] for n in numbers} for numbers in plan]
    shapes = [_configured(chosen, job.config) for chosen in members]
    job.folder.mkdir(parents=True, exist_ok=True)
    check_writable(job.folder / PLAN)
    paths = [job.folder / f"group-{number}.neumat" for number in range(len(plan))]
    # Of every group before the first fit, so that nothing is found in the way after hours.
    done = [finished(job, path, chosen) for path, chosen in zip(paths, members, strict=True)]
    if save:
        save_plan(job, plan)
    job.announce_notes(names)
    headers: dict[str, dict] = {}
    for number, (path, chosen, shape) in enumerate(zip(paths, members, shapes, strict=True)):
        checkpoint = path.with_suffix(".checkpoint")
        job.announce(f"{path.name}: {', '.join(chosen)}")
        if done[number]:
            headers |= {name: read_asset(job.path(name))[1] for name in chosen}
        else:
            headers |= _fit_group(job, path, chosen, shape, checkpoint, number, len(plan))
        checkpoint.unlink(missing_ok=True)
    (job.folder / PLAN).unlink()
    job.progress(1.0, f"wrote {len(headers)} materials in {len(plan)} groups to {job.folder}")
    return headers


def _fit_group(job: Job, path: Path, chosen: dict[str, Opened], shape, checkpoint: Path, number: int, total: int):
    sources = [opened.source for opened in chosen.values()]
    model = neubrdf.build(shape, job.seed, len(chosen))
    specs = [opened.spec for opened in chosen.values()]
    trainer = Trainer(
        model,
        lambda rng, n: SharedSampler(sources, rng).draw(n),
        losses.LogCosine(),
        job.plan(len(chosen) ** 0.5),
        checkpoint=checkpoint,
        identity={"materials": list(chosen), "specs": specs, "config": repr(shape)},
        progress=lambda f, text: job.progress((number + f) / total, f"group {number}: {text}"),
    )
    if job.resume:
        trainer.resume()
    facts = trainer.run()
    facts.pop("seconds")
    tensors, header = model.to_asset(0)
    shared = {name: value for name, value in tensors.items() if name not in ("indices", "live")}
    training = {**facts, **model.statistics()}
    write_asset(
        path, shared, {"kind": GROUP, "version": GROUP_VERSION, "config": header["config"], "training": training}
    )
    header["group"] = {"file": path.name}
    return {
        name: write_member(job.path(name), opened, model.grids(place), shared, header, facts, len(chosen))
        for place, (name, opened) in enumerate(chosen.items())
    }


def _configured(chosen: dict[str, Opened], options: dict):
    """Return the config of a group, or raise a ValueError if it could not be stored."""
    shape = neubrdf.configure(_Common([opened.source for opened in chosen.values()]), dict(options))
    for field, only in (("storage", "codebook"), ("pixelation", "healpix")):
        if getattr(shape, field) != only:
            raise ValueError(f"{field} {getattr(shape, field)} is for comparison and has no file; use {only}")
    return shape


class _Common:
    """What all sources of a group have in common."""

    def __init__(self, sources):
        self.isotropic = all(source.isotropic for source in sources)
        self.symmetry = min((getattr(source, "symmetry", "none") for source in sources), key=SYMMETRIES.index)
