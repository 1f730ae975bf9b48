"""Materials that join groups which are there: each that of the compatible member that looks most like it."""

from __future__ import annotations

import dataclasses

from warp_neumat.io.brdf_source import SYMMETRIES
from warp_neumat.io.shared_asset import read_whole_asset
from warp_neumat.models import neubrdf
from warp_neumat.models.joined import JoinedNeuBRDF
from warp_neumat.training import losses, samplers
from warp_neumat.training.grouping import signature
from warp_neumat.training.loop import Trainer
from warp_neumat.training.shared_job import Job, write_member


@dataclasses.dataclass(frozen=True)
class Member:
    """A material that is in a group."""

    name: str
    tensors: dict
    header: dict
    signature: object

    @property
    def group(self) -> str:
        """Name of the group's file."""
        return self.header["group"]["file"]

    @property
    def isotropic(self) -> bool:
        """Whether the group takes isotropic materials alone."""
        return self.header["config"]["frame"].endswith("isotropic")

    @property
    def symmetry(self) -> str:
        """What the group takes for one."""
        return self.header["config"].get("symmetry", "none")

    def takes(self, source, symmetry: str) -> bool:
        """Return whether the group assumes nothing that does not hold for ``source``, of this symmetry."""
        within = SYMMETRIES.index(self.symmetry) <= SYMMETRIES.index(symmetry)
        return within and (bool(source.isotropic) or not self.isotropic)


def join(job: Job, names) -> dict[str, dict]:
    """Fit the sources ``names`` into the groups in the job's folder; return their headers by name.

    No file that is there is touched. What nobody can take is found out before the first fit.

    Raises:
        ValueError: If an option is given that the groups have decided, or a source fits no group.
    """
    options = dict(job.config)
    reciprocal = options.pop("reciprocal", False)
    if options:
        raise ValueError(f"a group's shape is fixed: it cannot be given {', '.join(options)}; use an empty folder")
    if job.count is not None:
        raise ValueError(
            f"{job.folder}: materials join the groups that are there; leave out groups, or use an empty folder"
        )
    members = _members(job)
    chosen = {name: _nearest(job, name, members, reciprocal) for name in names}
    job.announce_notes(chosen)
    sharers = {member.group: sum(other.group == member.group for other in members) for member in members}
    headers = {}
    for number, (name, member) in enumerate(chosen.items()):
        job.announce(f"{name}: joins {member.group}, as {member.name}")
        opened = job.sources[name]
        checkpoint = job.folder / f"{name}.neumat.checkpoint"
        like = neubrdf.from_asset(member.tensors, member.header["config"])
        trainer = Trainer(
            JoinedNeuBRDF(like, len(member.tensors["codebook"]), job.seed),
            lambda rng, n, s=opened.source: samplers.sampler(s, rng).draw(n),
            losses.LogCosine(),
            job.plan(0.5),
            checkpoint=checkpoint,
            identity={"source": opened.spec, "group": member.header["group"], "as": member.name},
            progress=lambda f, text, n=number, m=name: job.progress((n + f) / len(chosen), f"{m}: {text}"),
        )
        if job.resume:
            trainer.resume()
        facts = trainer.run()
        facts.pop("seconds")
        sharers[member.group] += 1
        shared = {key: value for key, value in member.tensors.items() if key not in ("indices", "live")}
        own = trainer.model.grids()
        headers[name] = write_member(job.path(name), opened, own, shared, member.header, facts, sharers[member.group])
        checkpoint.unlink(missing_ok=True)
    job.progress(1.0, f"added {len(headers)} materials to {job.folder}")
    return headers


def _members(job: Job) -> list[Member]:
    found = []
    for path in sorted(job.folder.glob("*.neumat")):
        if path.name.startswith("group-"):
            continue
        tensors, header = read_whole_asset(path)
        if "group" in header:
            model = neubrdf.from_asset(tensors, header["config"])
            found.append(Member(path.stem, tensors, header, signature(model.evaluate)))
    if not found:
        raise ValueError(f"{job.folder}: holds groups but no material of them; use an empty folder")
    return found


def _nearest(job: Job, name: str, members: list[Member], reciprocal: bool) -> Member:
    source = job.sources[name].source
    symmetry = getattr(source, "symmetry", "none")
    if reciprocal and symmetry == "none":
        symmetry = "reciprocal"
    compatible = [member for member in members if member.takes(source, symmetry)]
    if not compatible:
        kinds = sorted({_kind(member.isotropic, member.symmetry) for member in members})
        raise ValueError(
            f"{name}: can join no group in {job.folder}: it is {_kind(source.isotropic, symmetry)}, they are "
            f"{' or '.join(kinds)}; fit it by itself, or into an empty folder"
        )
    own = signature(source.eval)
    return min(compatible, key=lambda member: float(((member.signature - own) ** 2).sum()))


def _kind(isotropic: bool, symmetry: str) -> str:
    return f"{'isotropic' if isotropic else 'anisotropic'} with symmetry {symmetry}"
