"""What fitting groups and joining them have in common: the request, its plan on disk, and the files of members.

``DIR/groups.checkpoint`` says, while it is there, that the groups of DIR are not complete: JSON with the settings of
the fit and ``plan``, which material is in which group.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

from warp_neumat.io.asset import FormatError, read_asset, write_asset
from warp_neumat.io.atomic import replacing
from warp_neumat.io.brdf_set import Opened
from warp_neumat.io.shared_asset import digest, read_whole_asset
from warp_neumat.models import neubrdf
from warp_neumat.training.evaluate import brdf_metrics
from warp_neumat.training.loop import Plan

PLAN = "groups.checkpoint"
_AGAIN = "use the same settings, or another folder"


@dataclasses.dataclass(frozen=True)
class Job:
    """What :func:`warp_neumat.training.sharing.fit_shared` was asked for; its arguments say what is what."""

    sources: dict[str, Opened]
    folder: Path
    count: int | None
    steps: int | None
    length: float
    seed: int
    resume: bool
    progress: Callable
    announce: Callable
    checkpoint_seconds: float
    config: dict

    def settings(self) -> dict:
        """Return what decides the result, JSON-able."""
        found = {
            "names": list(self.sources),
            "specs": [opened.spec for opened in self.sources.values()],
            "groups": self.count,
            "seed": self.seed,
            "steps": self.steps,
            "length": self.length,
            "config": self.config,
        }
        return json.loads(json.dumps(found, default=str))

    def plan(self, factor: float) -> Plan:
        """Return the plan of a training that is ``factor`` times as long as the model's default."""
        steps = self.steps or max(1, round(neubrdf.DEFAULT_STEPS * self.length * factor))
        return Plan(steps, seed=self.seed, checkpoint_seconds=self.checkpoint_seconds)

    def path(self, name: str) -> Path:
        """Return where material ``name`` is, or will be."""
        return self.folder / f"{name}.neumat"

    def announce_notes(self, names) -> None:
        """Say what was noticed of the sources ``names`` when they were opened."""
        for name in names:
            for note in _notes(self.sources[name].source):
                self.announce(f"note: {name}: {note}")


def save_plan(job: Job, plan: list[list[int]]) -> None:
    """Write down that the groups ``plan``, lists of numbers of sources, are being fitted."""
    with replacing(job.folder / PLAN) as temporary:
        temporary.write_text(json.dumps({**job.settings(), "plan": plan}), encoding="utf-8")


def load_plan(job: Job) -> list[list[int]]:
    """Return the plan of the fit that was interrupted in the job's folder.

    Raises:
        FormatError: If the file is none of :func:`save_plan`, or the fit had other settings.
    """
    path = job.folder / PLAN
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))
        plan = saved.pop("plan")
        complete = sorted(number for group in plan for number in group) == list(range(len(saved["names"])))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(path, "file", f"no readable plan of groups ({error})", "use another folder") from None
    if not complete:
        raise FormatError(path, "plan", "must name every material once", "use another folder")
    for key, now in job.settings().items():
        if saved.get(key) != now:
            raise FormatError(path, key, f"was {saved.get(key)!r} when the fit was interrupted, now {now!r}", _AGAIN)
    return plan


def finished(job: Job, group: Path, names) -> bool:
    """Return whether all materials ``names`` of the file ``group`` are written.

    Raises:
        FormatError: If a file of such a name belongs elsewhere, or the group is not what the materials were fitted to.
        FileNotFoundError: If the materials are there and the group is not.
    """
    written = [job.path(name) for name in names if job.path(name).exists()]
    for path in written:
        found = (read_asset(path)[1].get("group") or {}).get("file")
        if found != group.name:
            rule = f"must be {group.name}, which {path.stem} is planned for, got {found!r}"
            raise FormatError(path, "group.file", rule, "move the file away, or use another folder")
    if len(written) < len(names):
        return False
    for path in written:
        read_whole_asset(path)
    return True


def write_member(path: Path, opened: Opened, own, shared, header: dict, facts: dict, sharers: int) -> dict:
    """Write the file of one material of a group and return its header, with metrics of what the files hold.

    Args:
        path: The file.
        opened: What it was fitted to.
        own: Tensors that are the material's alone.
        shared: Tensors of its group.
        header: kind, version, config, and the file of the group.
        facts: Of the training.
        sharers: Materials that share the group, this one included, as this one is written.
    """
    spec, source = opened
    model = neubrdf.from_asset({**shared, **own}, header["config"])
    sizes = [sum(tensor.nbytes for tensor in tensors.values()) for tensors in (own, shared)]
    header = {
        "kind": header["kind"],
        "version": header["version"],
        "config": header["config"],
        "group": {"file": header["group"]["file"], "digest": digest(shared)},
        "source": {"spec": spec, "name": source.name},
        "training": {**facts, **model.statistics()},
        "metrics": {
            "bytes": sum(sizes),
            "bytes_own": sizes[0],
            "bytes_shared": sizes[1],
            "sharers": sharers,
            **brdf_metrics(source, model.evaluate),
        },
    }
    if notes := _notes(source):
        header["source"]["notes"] = notes
    write_asset(path, own, header)
    return header


def _notes(source) -> list[str]:
    return list(getattr(source, "notes", ()))
