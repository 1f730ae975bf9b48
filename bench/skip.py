"""What each skip saves and costs: the same frames with it and without it, in turns; also atlas size and stillness.

Fox "Run" of a glossy metal, 1280×720, an atlas of 1200². Every row compares two renderers, or two stretches of one:
``texels`` shaded and ``evaluations`` a frame (means) and ``ms`` (the median), each beside the peer's. ``left_out`` is
what the skip's own counter says, ``spent`` the evaluations over the peer's, ``ratio`` the peer's time over ours.

``cost_ms`` is what deciding costs: of the shading time that the spared evaluations should save, by the peer's time for
one, what the frame did not become shorter by. It is negative where more is saved than shading: marking and listing.

``flip`` is the mean between both pictures: 0 unless a skip approximates (``rate``, ``carry``), whose ``error`` and
``peer_error`` against per-pixel shading are there as well. The first four skips nest: ``offscreen`` is compared where
``occluded`` is off, ``backfacing`` where both are, and ``unowned`` where all three are.

``atlas`` compares sides of 2400 and 1200 at the same view; ``still`` the end of a still stretch with the moving frames
before it: ``settled`` is how many still frames passed until one shaded nothing, -1 if none did, and ``error`` that of
the last picture, ``peer_error`` that of the policy ``every``.
"""

import dataclasses
import math

import numpy as np

from bench._schedule_lab import Scene, Taken, judged, material_path, open_scene, take_turns
from warp_neumat import metrics
from warp_neumat.materials.base import load
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import bounding_sphere
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.tonemap import tonemap

COLUMNS = [
    *("skip", "setting", "peer", "left_out", "texels", "peer_texels", "evaluations", "peer_evaluations", "spent"),
    *("ms", "peer_ms", "ratio", "cost_ms", "flip", "error", "peer_error", "settled"),
]

_NESTED = ("occluded", "offscreen", "backfacing", "unowned")  # outer to inner
_STILL = 48
"""Still frames: twice the age at which ``adaptive`` shades what it thinks unchanged."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: a shot, and the options of the renderer with what is judged and of that without it.

    ``frames`` are rendered by both, the first ``leave`` of them unjudged; ``error`` asks for those against per-pixel
    shading; ``sides`` are the atlases' where they are not the default one.
    """

    skip: str
    setting: str
    scene: Scene
    on: dict
    off: dict
    frames: list[int]
    leave: int = 1
    error: bool = False
    peer: str = "without"
    sides: tuple[int, int] | None = None


def rows(*, device: str, quick: bool, frames: int = 24, size=(1280, 720)):
    """Yield a row per skip, then those of the atlas and of stillness."""
    side, still = 1200, _STILL
    if quick:
        side, still, frames, size = 200, 3, 3, (160, 90)
    scene = open_scene("fox", size)
    material = load(material_path("glossy", quick=quick, device=device), device=device)
    atlases = {s: Atlas.build(scene.sequence, s, device=device) for s in (side, 2 * side)}

    def make(shot: Scene, s: int, options: dict) -> Renderer:
        return shot.renderer(material, atlases[s], device, **options)

    for case in cases(scene, frames, side):
        sides = case.sides or (side, side)
        pair = {"on": make(case.scene, sides[0], case.on), "off": make(case.scene, sides[1], case.off)}
        yield _compared(case, pair)
    for policy in ("every", "fixed", "staggered", "adaptive"):
        pair = [make(scene, side, {"policy": name}) for name in (policy, "every")]
        yield _stillness(scene, policy, *pair, frames, still)


def cases(scene: Scene, frames: int, side: int) -> list[Case]:
    """Return what is compared, of one scene."""
    default = scene.camera.distance
    near, far = scene.seen_from(distance=0.55 * default), scene.seen_from(distance=4.0 * default)
    lit = dataclasses.replace(scene, lights=local_lights(*scene.sequence.bounds()))
    every, shown = {"policy": "every"}, list(range(frames))

    def without(*names):
        return {"skip": [name for name in SKIPS if name not in names]}

    found = []
    for k, name in enumerate(_NESTED):
        on, off = every | without(*_NESTED[:k]), every | without(*_NESTED[: k + 1])
        found.append(Case(name, "near view, every", near, on, off, shown))
    found.append(Case("rate", "far view, every", far, every, every | without("rate"), shown, error=True))
    adaptive = {"policy": "adaptive"}
    found.append(Case("rate", "adaptive", scene, adaptive, adaptive | without("rate"), shown, error=True))
    still = [0, 1, *[2] * (frames + 1)]
    for policy in ("every", "fixed", "staggered"):
        on = {"policy": policy, "interval": 1}
        found.append(Case("unchanged", f"still, {policy}", scene, on, on | without("unchanged"), still, leave=5))
    for name in ("range", "spot", "horizon"):
        found.append(Case(name, "12 lights, every", lit, every, every | without(name), shown))
        found.append(Case(name, "3 lights, every", scene, every, every | without(name), shown))
    staggered = {"policy": "staggered", "carry": True}
    found.append(Case("carry", "staggered", scene, staggered, staggered | {"carry": False}, shown, error=True))
    for view, shot in (("", scene), ("far view, ", far)):
        for policy in (every, adaptive):
            setting, sides = f"{view}{policy['policy']}", (2 * side, side)
            more = {"error": True, "peer": f"side {side}", "sides": sides}
            found.append(Case("atlas", setting, shot, policy, policy, shown, **more))
    return found


def local_lights(lo, hi) -> PointLights:
    """Return twelve lights that each light a part of what is within the bounds.

    They stand around it on two rings, a little outside its bounding sphere, and reach to its middle, nearly; every
    second one is a spot that shines at the axis.
    """
    centre, radius = bounding_sphere(lo, hi)
    k = np.arange(12)
    angle, height = 2.0 * math.pi * k / 12.0, np.where(k % 4 < 2, 0.45, -0.1)
    outward = np.stack([np.cos(angle), height, np.sin(angle)], axis=1)
    spot = k % 2 == 1
    return PointLights(
        centre + 1.1 * radius * outward,
        np.full((12, 3), 0.7 * math.pi * (0.6 * radius) ** 2),
        range=np.full(12, 1.1 * radius),
        direction=-outward * [1.0, 0.0, 1.0],
        inner=np.where(spot, math.radians(15.0), 0.0),
        outer=np.where(spot, math.radians(30.0), math.pi),
    )


def _compared(case: Case, pair: dict[str, Renderer]) -> dict:
    """Return the row of a case."""
    reference = pair["on"].per_pixel() if case.error else None
    asked = [k for k in judged(len(case.frames)) if k >= case.leave] or [len(case.frames) - 1]
    pictures: dict = {}
    flips: dict[str, list[float]] = {"flip": [], "error": [], "peer_error": []}

    def look(place, key, image):
        pictures[key] = tonemap(image)
        if len(pictures) < 2:
            return
        if place in asked:
            flips["flip"].append(metrics.flip(pictures["off"], pictures["on"])[0])
            if reference is not None:
                expected = tonemap(reference.frame(case.frames[place]).image)
                flips["error"].append(metrics.flip(expected, pictures["on"])[0])
                flips["peer_error"].append(metrics.flip(expected, pictures["off"])[0])
        pictures.clear()

    taken = take_turns(case.scene, pair, case.frames, f"{case.skip}, {case.setting}", look)
    row = {"skip": case.skip, "setting": case.setting, "peer": case.peer}
    if case.skip in SKIPS:
        row["left_out"] = float(np.mean([s["skipped"][case.skip] for s in taken["on"].stats[case.leave :]]))
    row |= _beside(*(_means(taken[key], slice(case.leave, None)) for key in ("on", "off")))
    return row | {name: _rounded(np.mean(values)) for name, values in flips.items() if values}


def _stillness(scene: Scene, policy: str, renderer: Renderer, every: Renderer, frames: int, still: int) -> dict:
    """Return the row that compares the last frames of a still stretch with moving ones."""
    shown = [*range(frames), *[frames - 1] * still]
    last = {}

    def look(place, key, image):
        if place == len(shown) - 1:
            last[key] = tonemap(image)

    taken = take_turns(scene, {policy: renderer}, shown, f"still, {policy}", look)[policy]
    for frame in range(frames):
        expected = every.frame(scene.posed(frame)).image
    expected, sharp = tonemap(every.per_pixel().frame(frames - 1).image), tonemap(expected)
    rests = np.flatnonzero(taken.evaluations[frames:] == 0)
    quarter = max(1, still // 4)
    return {
        "skip": "still",
        "setting": policy,
        "peer": "moving",
        **_beside(_means(taken, slice(-quarter, None)), _means(taken, slice(1, frames))),
        "settled": int(rests[0]) if len(rests) else -1,
        "error": _rounded(metrics.flip(expected, last[policy])[0]),
        "peer_error": _rounded(metrics.flip(expected, sharp)[0]),
    }


def _rounded(error: float) -> float:
    """Return three significant digits, which a column of the table can hold."""
    return float(f"{error:.2e}")


def _means(taken: Taken, part: slice) -> dict[str, float]:
    """Return texels, evaluations, milliseconds and those of shading, of a frame of ``part``."""
    return {
        "texels": float(np.mean([s["texels"]["shaded"] for s in taken.stats[part]])),
        "evaluations": float(taken.evaluations[part].mean()),
        "ms": float(np.median(taken.ms[part])),
        "shade": float(np.median(taken.stage("shade")[part])),
    }


def _beside(ours: dict[str, float], peer: dict[str, float]) -> dict:
    row = {}
    for name in ("texels", "evaluations", "ms"):
        row |= {name: ours[name], f"peer_{name}": peer[name]}
    spent = ours["evaluations"] / peer["evaluations"] if peer["evaluations"] else 1.0
    cost = peer["shade"] * (1.0 - spent) - (peer["ms"] - ours["ms"])
    return row | {"spent": spent, "ratio": peer["ms"] / ours["ms"], "cost_ms": cost}
