"""Error against evaluations and time: every policy over its budgets, on three sequences, glossy and matt.

``python -m bench pareto [SEQUENCE]``: ``fox``, ``helmet``, ``cloth`` (``_schedule_lab.py``), or what ``neumat render``
takes; all three by default. 1280×720, an atlas of 1200², per-pixel shading of every frame as the reference. A frame is
rendered by all settings of a scene and material in turns, so all are in memory at once: 3 GiB.

``every`` and ``fixed`` are the policies of MobileVR: they shade every texel that is seen, so have no skip ``rate``; the
others have all skips. Budgets are evaluations a frame: those that ``fixed`` spends on the average with its interval
("N = 4"), and shares of them. ``staggered+carry`` and ``adaptive`` carry stale radiance by the materials' proxies,
``staggered`` and ``adaptive plain`` do not.

``evaluations`` is the mean over all frames, the first one too, in which everybody shades all that is seen; ``later``
leaves it out. Times leave it out too (it is ``first_ms``), and come from passes of their own in which no error is
measured: of each frame the median over the passes, then over frames the mean (``shade_ms``, ``schedule_ms``, ``ms``),
or the 95th percentile over the median (``spread``). Animation is in nobody's time. ``flip`` and ``flip_p95`` are means
over every third frame (``_schedule_lab.judged``), the latter of the 95th percentile over the pixels that show the mesh;
``psnr`` is that of the mean squared error of all frames. ``flicker``, the mean of
|(test − test before) − (reference − reference before)| in steps of an 8-bit display, needs no FLIP. ``alike`` says
whether all passes spent the same evaluations.

Verdicts come last: at how many ``evaluations`` a policy's line reaches the FLIP of ``fixed`` N = 4 (``bound`` "at most"
where its cheapest setting is better, "never" where none is as good), and the ``share`` of that one's evaluations; the
largest ratio of its FLIP to that of ``staggered`` at the same budget (``over_staggered``), and its largest ``spread``.
Where a FLIP was aimed for, ``over_target`` is what it ended at over that; it cannot reach more than the scene loses
when nothing at all is shaded anew.
The JSON also has ``share_later``, which leaves out the first frame, ``over_carried``, beside ``staggered+carry``,
``schedule_share`` (of the shading time), and what the means are of.
"""

import itertools
import math
import sys
from pathlib import Path

import numpy as np

from bench._schedule_lab import (
    FRAMES,
    MEASURED,
    SCENES,
    Errors,
    Scene,
    Taken,
    judged,
    material_path,
    open_scene,
    take_turns,
)
from warp_neumat import metrics
from warp_neumat.materials.base import load
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.renderer import SKIPS
from warp_neumat.pipeline.tonemap import tonemap

COLUMNS = [
    *("table", "scene", "material", "policy", "setting", "evaluations", "later"),
    *("shade_ms", "schedule_ms", "ms", "first_ms", "spread", "flip", "flip_p95", "psnr", "flicker", "alike"),
    *("bound", "share", "over_staggered", "over_target"),
]

INTERVALS = (2, 4)
SHARES = (1, 3, 6)
"""Budgets: the evaluations of ``fixed`` N = 4 over these."""
TARGETS = (0.005, 0.01, 0.02)
PASSES = 1
"""Passes that are timed."""

PAPER = tuple(name for name in SKIPS if name != "rate")
_MARK = "N = 4"
_BUDGETED = {
    "staggered": {"policy": "staggered"},
    "staggered+carry": {"policy": "staggered", "carry": True},
    "adaptive": {"policy": "adaptive"},
    "adaptive plain": {"policy": "adaptive", "carry": False},
}


def rows(
    *,
    device: str,
    quick: bool,
    sequence: str | None = None,
    plot: Path | None = None,
    frames: int = FRAMES,
    size=(1280, 720),
):
    """Yield a row per scene, material and setting, then the verdicts.

    Args:
        device: Warp device.
        quick: Bundled materials, a tiny picture, few frames and settings.
        sequence: What to render; default: all scenes.
        plot: Where to draw, less the suffix; None draws nothing.
        frames: Most frames of each scene.
        size: (width, height) of the pictures [px].
    """
    scenes, side, passes = (sequence,) if sequence else SCENES, 1200, PASSES
    if quick:
        scenes, side, passes, size, frames = scenes[:1], 200, 1, (160, 90), 6
    if plot is not None:
        plot.parent.mkdir(parents=True, exist_ok=True)  # before minutes of measuring
    done: list[dict] = []
    for spec in scenes:
        scene = open_scene(spec, size, frames)
        atlas = Atlas.build(scene.sequence, side, device=device)
        for name in MEASURED:
            material = load(material_path(name, quick=quick, device=device), device=device)
            for row in _measure(scene, material, atlas, device, passes, quick):
                row = {"table": "pareto", "scene": scene.name, "material": name, **row}
                done.append(row)
                yield row
    yield from verdicts(done)
    if plot is not None:
        for file in draw(done, plot):
            print(f"plot: {file}", file=sys.stderr)


def _measure(scene: Scene, material, atlas: Atlas, device: str, passes: int, quick: bool):
    """Yield the rows of one scene and material."""
    frames, what = range(scene.frames), f"{scene.name}, {passes + 2} passes"

    def make(chosen):
        # Anew for every pass, so that the first frame pays what it pays at the start of a program.
        return {key: scene.renderer(material, atlas, device, **options) for key, options in chosen.items()}

    fixed = settings({}, quick)
    counted = take_turns(scene, make(fixed), frames, f"{what}: budgets")
    chosen = settings({key[1]: float(t.evaluations.mean()) for key, t in counted.items() if key[0] == "fixed"}, quick)
    renderers = make(chosen)
    reference = next(iter(renderers.values())).per_pixel()
    errors = {key: Errors() for key in chosen}
    asked, expected = judged(scene.frames), {}

    def look(place, key, image):
        if place not in expected:
            expected.clear()
            linear = reference.frame(place).image
            expected[place] = tonemap(linear), (linear > 0).any(axis=2) if place in asked else None
        picture, covered = expected[place]
        errors[key].add(picture, tonemap(image), covered)

    runs = [take_turns(scene, renderers, frames, f"{what}: errors", look)]
    del renderers
    for turn in range(passes):
        runs.append(take_turns(scene, make(chosen), frames, f"{what}: times, {turn + 1}"))
    for key, options in chosen.items():
        yield {"policy": key[0], "setting": key[1], **_figures([run[key] for run in runs], errors[key], options)}


def settings(spent: dict[str, float], quick: bool = False) -> dict[tuple[str, str], dict]:
    """Return (policy, setting) → options of its renderer.

    Args:
        spent: Setting of ``fixed`` → the evaluations a frame that it spends, which the others' budgets are made of;
            empty: only ``every`` and ``fixed``.
        quick: Few of them.
    """
    chosen: dict = {("every", "N = 0"): {"policy": "every", "skip": PAPER}}
    for interval in (4,) if quick else INTERVALS:
        chosen["fixed", f"N = {interval}"] = {"policy": "fixed", "interval": interval, "skip": PAPER}
    if not spent:
        return chosen
    budgets = {f"1/{k} of {_MARK}" if k > 1 else _MARK: spent[_MARK] / k for k in ((1, 3) if quick else SHARES)}
    for name, options in _BUDGETED.items():
        mine = {**spent, **budgets} if name == "staggered" else budgets
        for label, budget in mine.items():
            chosen[name, label] = {**options, "budget": budget}
    for target in TARGETS[1:2] if quick else TARGETS:
        chosen["adaptive target", f"FLIP {target:g}"] = {"policy": "adaptive", "target_flip": target}
    return chosen


def _figures(runs: list[Taken], errors: Errors, options: dict) -> dict:
    """Return the figures of one setting; the first run's pictures were measured, the others' times count."""
    evaluations = runs[0].evaluations

    def per_frame(pick):
        return np.median([pick(run) for run in runs[1:]], axis=0)

    ms, later = per_frame(lambda run: run.ms), slice(1, None)
    shade, schedule = (per_frame(lambda run, name=name: run.stage(name)) for name in ("shade", "schedule"))
    return {
        "budget": options.get("budget"),
        "evaluations": float(evaluations.mean()),
        "later": float(evaluations[later].mean()),
        "shade_ms": float(shade[later].mean()),
        "schedule_ms": float(schedule[later].mean()),
        "schedule_share": float(schedule[later].sum() / max(shade[later].sum(), 1e-9)),
        "ms": float(ms[later].mean()),
        "first_ms": float(ms[0]),
        "spread": float(np.percentile(ms[later], 95.0) / np.median(ms[later])),
        "flip": float(np.mean(errors.flip)),
        "flip_p95": float(np.mean(errors.flip_p95)),
        "flip_frame_p95": float(np.percentile(errors.flip, 95.0)),
        "flip_frames": errors.flip,
        "evaluations_frames": evaluations.tolist(),
        "psnr": metrics.psnr_of_mse(errors.mse),
        "flicker": 255.0 * float(np.mean(errors.flicker)),
        "alike": all(np.array_equal(run.evaluations, evaluations) for run in runs),
    }


def reached(line: list[tuple[float, float]], flip: float) -> tuple[float | None, str]:
    """Return the evaluations at which a line of (evaluations, FLIP) first reaches ``flip``, and how sure that is.

    Between settings FLIP is linear in the logarithm of the evaluations. The second value is "" where the line crosses
    ``flip``, "at most" where its cheapest setting is below it, and "never", with None, where all settings are above.
    """
    line = sorted(line)
    if line[0][1] <= flip:
        return line[0][0], "at most"
    for (cheap, above), (dear, below) in itertools.pairwise(line):
        if below <= flip:
            part = (above - flip) / (above - below)
            low, high = (math.log(max(count, 1.0)) for count in (cheap, dear))
            return math.exp(low + part * (high - low)), ""
    return None, "never"


def verdicts(done: list[dict]):
    """Yield, from rows of the pareto table, one row per scene, material and policy with a budget."""
    panels = dict.fromkeys((row["scene"], row["material"]) for row in done)
    for scene, material in panels:
        found = {(r["policy"], r["setting"]): r for r in done if (r["scene"], r["material"]) == (scene, material)}
        mark = found["fixed", _MARK]
        for policy in _BUDGETED:
            mine = {setting: row for (name, setting), row in found.items() if name == policy}
            verdict = {"table": "verdict", "scene": scene, "material": material, "policy": policy}
            verdict |= {"setting": f"FLIP of {_MARK}", "flip": mark["flip"]}
            for name, share in (("later", "share_later"), ("evaluations", "share")):  # the bound is the latter's
                count, bound = reached([(row[name], row["flip"]) for row in mine.values()], mark["flip"])
                verdict |= {name: count, share: None if count is None else count / max(mark[name], 1.0), "bound": bound}
            for peer, name in (("staggered", "over_staggered"), ("staggered+carry", "over_carried")):
                if peer != policy:
                    pairs = [(row["flip"], found[peer, s]["flip"]) for s, row in mine.items() if (peer, s) in found]
                    verdict[name] = max(flip / max(other, 1e-9) for flip, other in pairs)
            for name in ("spread", "schedule_share"):
                verdict[name] = max(row[name] for row in mine.values())
            verdict["alike"] = all(row["alike"] for row in mine.values())
            yield verdict
        for (policy, setting), row in found.items():
            if policy == "adaptive target":
                aim = float(setting.removeprefix("FLIP "))
                part = {name: row[name] for name in ("scene", "material", "policy", "setting", "flip", "evaluations")}
                yield {"table": "verdict", **part, "over_target": row["flip"] / aim, "alike": row["alike"]}


_COLORS = {
    "every": "#000000",
    "fixed": "#d55e00",
    "staggered": "#56b4e9",
    "staggered+carry": "#0072b2",
    "adaptive": "#009e73",
    "adaptive plain": "#e69f00",
    "adaptive target": "#cc79a7",
}


def draw(done: list[dict], plot: Path) -> list[Path]:
    """Draw error against evaluations (top) and time (below), a column per scene and material; return the files.

    Without matplotlib it only says so.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter
    except ImportError:
        print(f"no matplotlib, so no {plot.name}.png: pip install matplotlib", file=sys.stderr)
        return []

    panels = list(dict.fromkeys((row["scene"], row["material"]) for row in done))
    figure = Figure(figsize=(1.2 + 3.4 * len(panels), 6.8), dpi=110, facecolor="white", layout="constrained")
    grid = figure.subplots(2, len(panels), squeeze=False, sharey="col")
    for column, panel in enumerate(panels):
        mine = [row for row in done if (row["scene"], row["material"]) == panel]
        for policy, color in _COLORS.items():
            line = [row for row in mine if row["policy"] == policy]
            for axes, key in zip(grid[:, column], ("evaluations", "ms"), strict=True):
                points = sorted((row[key], row["flip"]) for row in line)
                if points:
                    style = {"color": color, "marker": "o", "markersize": 3.5, "linewidth": 1.3, "label": policy}
                    axes.plot(*zip(*points, strict=True), **style)
        mark = next(row["flip"] for row in mine if (row["policy"], row["setting"]) == ("fixed", _MARK))
        for axes in grid[:, column]:
            axes.axhline(mark, color="#d55e00", linewidth=0.7, linestyle=":")
            axes.set_ylim(bottom=0.0)
            axes.grid(color="#dddddd", linewidth=0.6)
        grid[0, column].set(xscale="log", xlabel="evaluations a frame", title=f"{panel[0]}, {panel[1]}")
        grid[0, column].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        grid[0, column].xaxis.set_major_formatter(EngFormatter(sep=""))
        grid[0, column].xaxis.set_minor_formatter(NullFormatter())
        grid[1, column].set(xlabel="milliseconds a frame")
    for axes in grid[:, 0]:
        axes.set_ylabel("mean FLIP")
    names, across = grid[0, 0].get_legend_handles_labels(), min(2 * len(panels), len(_COLORS))
    figure.legend(*names, loc="outside lower center", ncols=across, frameon=False)
    files = [plot.parent / f"{plot.name}{suffix}" for suffix in (".png", ".svg")]
    for file in files:
        figure.savefig(file)
    return files
