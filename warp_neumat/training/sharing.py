"""`neumat fit --shared DIR`: materials that share one codebook and one decoder, each with indices of its own.

A group is ``DIR/group-N.neumat``; its members are ``DIR/NAME.neumat`` (:mod:`warp_neumat.io.shared_asset`). Where DIR
holds groups already, materials are added: each joins the group of the member that looks most like it, and no file that
is there is touched.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from warp_neumat import models
from warp_neumat.io.asset import read_asset, write_asset
from warp_neumat.io.atomic import check_writable
from warp_neumat.io.shared_asset import GROUP, digest, read_whole_asset
from warp_neumat.models.joined import JoinedNeuBRDF
from warp_neumat.training import losses, samplers
from warp_neumat.training.evaluate import brdf_metrics
from warp_neumat.training.grouping import groups, signature
from warp_neumat.training.loop import Plan, Trainer

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
    sources: dict[str, object],
    folder,
    *,
    count: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    resume: bool = False,
    progress=None,
    announce=None,
    **config,
) -> dict[str, dict]:
    """Fit all ``sources`` into ``folder``, in groups; return the header of every material by name.

    Args:
        sources: BRDF sources by the name of the file that each becomes.
        folder: Where groups and materials are written; made if missing. If it holds groups, the sources join them.
        count: Groups; default: one for about eight materials.
        steps: Optimiser steps of a group; default: the model's, times the root of its materials.
        seed: Same seed, same files (on one machine with the same number of threads).
        resume: Skip what is written, and go on from checkpoints.
        progress: ``progress(fraction, text)``.
        announce: ``announce(text)``, called with what was decided.
        config: Fields of the model's config.

    Raises:
        ValueError: If a source, a name or an option is wrong, or a file of that name is there and not to be resumed.
        OSError: If the folder cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    announce, progress = announce or (lambda text: None), progress or (lambda fraction, text: None)
    there = [name for name in sources if (folder / f"{name}.neumat").exists()]
    if there and not resume:
        raise ValueError(f"{folder / there[0]}.neumat: is there already; use another folder, remove it, or resume")
    for name in sources:
        if name.startswith("group-"):
            raise ValueError(f"{name!r}: no material can be called group-…: groups are; rename it")
    check_writable(folder / "x.neumat")
    known = sorted(folder.glob("group-*.neumat"))
    wanted = {name: source for name, source in sources.items() if name not in there}
    if known and not (resume and (folder / "groups.checkpoint").exists()):
        return _add(wanted, folder, known, steps, seed, progress, announce, config)
    return _fit_groups(sources, folder, count, steps, seed, resume, progress, announce, config)


def _fit_groups(sources, folder, count, steps, seed, resume, progress, announce, config):
    module, names = models.find("neubrdf"), list(sources)
    marker = folder / "groups.checkpoint"  # while it is there, the groups are not complete
    marker.touch()
    plan_of = groups([sources[n] for n in names], count, seed=seed)
    headers: dict[str, dict] = {}
    for number, member in enumerate(plan_of):
        chosen = {names[m]: sources[names[m]] for m in member}
        path = folder / f"group-{number}.neumat"
        announce(f"{path.name}: {', '.join(chosen)}")
        if resume and all((folder / f"{name}.neumat").exists() for name in chosen):
            headers |= {name: read_asset(folder / f"{name}.neumat")[1] for name in chosen}
            continue
        shape = module.configure(_Common(list(chosen.values())), dict(config))
        length = steps or round(module.DEFAULT_STEPS * len(chosen) ** 0.5)
        model = module.build(shape, seed, len(chosen))
        source_list = list(chosen.values())
        trainer = Trainer(
            model,
            lambda rng, n, s=source_list: SharedSampler(s, rng).draw(n),
            losses.LogCosine(),
            Plan(length, seed=seed),
            checkpoint=folder / f"group-{number}.checkpoint",
            identity={"materials": list(chosen), "config": repr(shape)},
            progress=lambda f, text, n=number: progress((n + f) / len(plan_of), f"group {n}: {text}"),
        )
        if resume:
            trainer.resume()
        facts = trainer.run()
        facts.pop("seconds")
        model.rounded = True
        headers |= _write_group(path, model, chosen, facts)
        (folder / f"group-{number}.checkpoint").unlink(missing_ok=True)
    marker.unlink()
    progress(1.0, f"wrote {len(headers)} materials in {len(plan_of)} groups to {folder}")
    return headers


class _Common:
    """What all sources of a group have in common."""

    def __init__(self, sources):
        self.isotropic = all(source.isotropic for source in sources)
        order = ("none", "reciprocal", "bilateral")
        self.symmetry = min((getattr(source, "symmetry", "none") for source in sources), key=order.index)


def _write_group(path: Path, model, chosen, facts) -> dict[str, dict]:
    tensors, header = model.to_asset(0)
    shared = {name: value for name, value in tensors.items() if name not in ("indices", "live")}
    group = {"file": path.name, "digest": digest(shared)}
    size = sum(tensor.nbytes for tensor in shared.values())
    statistics = model.statistics()
    write_asset(
        path,
        shared,
        {"kind": GROUP, "version": GROUP_VERSION, "config": header["config"], "training": {**facts, **statistics}},
    )
    headers = {}
    for number, (name, source) in enumerate(chosen.items()):
        own = model.grids(number)
        bytes_own = sum(tensor.nbytes for tensor in own.values())
        metrics = brdf_metrics(source, lambda wi, wo, n=number: model.evaluate(wi, wo, material=n))
        headers[name] = {
            **header,
            "group": group,
            "source": {"spec": getattr(source, "spec", source.name), "name": source.name},
            "training": facts,
            "metrics": {**metrics, "bytes": bytes_own, "bytes_shared": size, "sharers": len(chosen)},
        }
        write_asset(path.parent / f"{name}.neumat", own, headers[name])
    return headers


def _add(sources, folder, known, steps, seed, progress, announce, config):
    if config:
        raise ValueError(f"a group's shape is fixed: it cannot be given {', '.join(config)}; use an empty folder")
    module = models.find("neubrdf")
    members = {}
    for path in sorted(folder.glob("*.neumat")):
        if path not in known:
            tensors, header = read_whole_asset(path)
            model = module.from_asset(tensors, header["config"])
            members[path] = (model, header, signature(model.evaluate))
    if not members:
        raise ValueError(f"{folder}: holds groups but no material of them; use an empty folder")
    headers = {}
    for number, (name, source) in enumerate(sources.items()):
        own_signature = signature(source.eval)
        nearest = min(members, key=lambda path: float(((members[path][2] - own_signature) ** 2).sum()))
        like, header, _ = members[nearest]
        announce(f"{name}: joins {header['group']['file']}, as {nearest.stem}")
        isotropic = like.config.frame.endswith("isotropic")
        if isotropic and not source.isotropic:
            raise ValueError(f"{name}: is anisotropic, the groups in {folder} are not; fit it by itself")
        trainer = Trainer(
            JoinedNeuBRDF(like, seed),
            lambda rng, n, s=source: samplers.sampler(s, rng).draw(n),
            losses.LogCosine(),
            Plan(steps or module.DEFAULT_STEPS // 2, seed=seed),
            progress=lambda f, text, n=number: progress((n + f) / len(sources), f"{sources and text}"),
        )
        facts = trainer.run()
        facts.pop("seconds")
        model = trainer.model
        model.rounded = True
        own = model.grids()
        metrics = brdf_metrics(source, model.evaluate)
        size = sum(tensor.nbytes for tensor in own.values())
        headers[name] = {
            **{key: header[key] for key in ("kind", "version", "config", "group")},
            "source": {"spec": getattr(source, "spec", source.name), "name": source.name},
            "training": facts,
            "metrics": {**metrics, "bytes": size, "bytes_shared": header["metrics"]["bytes_shared"]},
        }
        write_asset(folder / f"{name}.neumat", own, headers[name])
    progress(1.0, f"added {len(headers)} materials to {folder}")
    return headers


def set_threads() -> int:
    """Give torch every core this process may use; return how many it had."""
    import os

    before = torch.get_num_threads()
    torch.set_num_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    return before
