"""NTBC beside block compression: PSNR, SSIM and bytes, training time, inference and training step beside torch.

Paper [ntbc], Sec. 4, on squares of real sets: of each set the one with the most detail, as a flat background is exact
in every method. The tables, of which ``python -m bench.ntbc`` takes a choice (``--help``):

- ``table2``: every set and method, then the means over sets. ``psnr`` and ``ssim`` are of mip 0, the means over maps
  (of decibels, as in the paper; each map in ``maps``, and in the JSON), ``psnr_mips`` is the PSNR of the squared error
  over all mips and channels. The networks' grids and weights are ``bytes``, ``share`` is their part of the bytes of the
  textures with all mips, ``share_mip0`` without; ``bytes_file`` (JSON) counts the header, too. The ratios of PSNR and
  SSIM are to block compression by the best encoders on PyPI (``bc``: quicktex, level 18), those with ``_ours`` to that
  of this package's own (``bc ours``, which the networks are trained on). No PSNR counts for more than 58.9 dB, that of
  rounding to 8 bits: a map that is exact would have no mean.
- ``figure4``: the means as points of both ratios over bytes, with further rates, and a plot.
- ``figure6``: training time against PSNR: every point a fit of its own, as the schedule depends on its length. One set.
- ``table1``: inference, networks to blocks, beside torch (``eval``, ``no_grad``, batches of 65,536 rows, look-ups ready
  made) in float32 and float16, the networks alone and with the writing of blocks; ours always writes them. ``differ``
  is the share of blocks that are not the same bit by bit, ``psnr_peer`` compares what they decode to. Then how long a
  material of seven channels takes to load, stage by stage.
- ``step``: a training step with its optimisers beside torch, which gets its look-ups ready made. ``floor_ms`` is the
  time of all matrix products at the measured peak of fused multiply-adds, ``error`` the largest over the four arrays of
  the gradient's relative error (2-norm) against torch in float64.
- ``options``: what each step past the paper gains; with the error of base colours (ΔE 1976, and in a and b alone). Runs
  only if chosen.

Fits and references stay in the output folder and are used again while their options are the same (not where the code
has changed: take another folder); ``seconds`` are those of the machine and the day that they were made on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import tempfile
from pathlib import Path

from ._bcf_lab import synthetic_set
from ._ntbc_lab import METHODS, PAPER, RATES, REFERENCES, SETS, TABLES, Choice, Lab, against, mean
from ._ntbc_speed import step, table1
from .harness import machine, versions

COLUMNS = [
    "table", "set", "method", "bytes", "share", "psnr", "ssim", "psnr_ratio", "ssim_ratio", "seconds", "ms", "peer",
    "peer_ms", "ratio", "error", "maps",
]  # fmt: skip

_QUALITY = [
    "set", "method", "bytes", "share", "share_mip0", "psnr", "ssim", "psnr_mips", "psnr_ratio", "ssim_ratio",
    "psnr_ratio_ours", "ssim_ratio_ours", "seconds",
]  # fmt: skip
_SPEED = ["set", "method", "ms", "peer", "peer_ms", "ratio"]
_VIEWS = {
    "table2": [*_QUALITY, "maps"],
    "figure4": _QUALITY[1:-1],
    "figure6": ["set", "method", "steps", "seconds", "psnr", "ssim", "psnr_ratio", "ssim_ratio", "maps"],
    "table1": [*_SPEED, "differ", "psnr_peer", "maps"],
    "step": [*_SPEED, "workers", "floor_ms", "error", "peer_error"],
    "options": [*_QUALITY, "delta_e", "delta_ab", "maps"],
}
"""Table → columns that are shown; all are in the JSON."""

_WIDE = {"set": 12, "method": 32, "peer": 46}
"""Column → letters that its texts take at least."""

PAPER_POINTS = ((0.32, 0.80, 0.90), (0.64, 0.85, 0.95))
"""Share of bytes, ratios of PSNR and SSIM that the paper gives NTBC, aggressive and conservative (§4.3)."""

OPTIONS = {
    "defaults": {},
    "endpoints predicted": {"endpoints": "network"},
    "endpoints predicted, no joint training": {"endpoints": "network", "joint": 0.0},
    "quantised in the last 1/11": {"quantised": 1 / 11},
    "luminance and chrominance": {"metric": "luma"},
    "normals in BC1": {"normals": "bc1"},
    "colours in BC7": {"colours": "bc7"},
    "as the paper": {**PAPER, "normals": "bc1"},
}
"""Method → what differs from an aggressive fit with the defaults; rates are shares of the bytes of its own formats."""


def _shown(row: dict) -> dict:
    """Return a row with the figures of its maps as text."""
    texts = (f"{name} {psnr:.1f} dB {row['ssim_maps'][name]:.3f}" for name, psnr in row["psnr_maps"].items())
    return {**row, "maps": ", ".join(texts)}


def _methods(lab: Lab, name: str, methods: dict[str, dict]) -> dict[str, dict]:
    """Return the rows of a set by method, references first."""
    references = lab.references(name)
    found = {kind: {**references[kind], **against(references[kind], references)} for kind in REFERENCES}
    for method, options in methods.items():
        row = lab.measure(name, options)
        found[method] = {**row, **against(row, references)}
    return found


def _means(rows: list[dict[str, dict]]) -> dict[str, dict]:
    """Return the means over sets by method; ratios are those of the means."""
    means = {method: mean([row[method] for row in rows]) for method in rows[0]}
    references = {kind: means[kind] for kind in REFERENCES}
    return {method: {**row, **against(row, references)} for method, row in means.items()}


def table2(lab: Lab):
    """Yield every set × method, then the means."""
    methods = {name: METHODS[name] for name in lab.choice.methods}
    every = []
    for name in lab.choice.sets:
        every.append({})
        for method, row in _each(lab, name, methods):
            every[-1][method] = row
            yield {"table": "table2", "set": name, "method": method, **_shown(row)}
    for method, row in _means(every).items():
        yield {"table": "table2", "set": "mean", "method": method, **row}


def _each(lab: Lab, name: str, methods: dict[str, dict]):
    """Yield (method, row) of a set as they are measured, references first."""
    for count in range(len(methods) + 1):
        part = dict(list(methods.items())[:count])
        found = _methods(lab, name, part)  # what was measured is at hand
        yield from found.items() if count == 0 else [list(found.items())[-1]]


def figure4(lab: Lab):
    """Yield the means of methods and further rates, and plot them over bytes."""
    methods = {name: METHODS[name] for name in lab.choice.methods} | {name: RATES[name] for name in lab.choice.rates}
    points = _means([_methods(lab, name, methods) for name in lab.choice.sets])
    families = {
        "naive": [m for m in points if m.startswith("naive")],
        "ntbc": [m for m in points if m.startswith("ntbc") and not m.endswith("grids")],
        "as the paper": [m for m in points if m.startswith("paper")],
        "bc ours": ["bc ours"],
    }
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), dpi=120, layout="constrained")
    for axes, key, which in zip(figure.subplots(1, 2), ("psnr_ratio", "ssim_ratio"), (1, 2), strict=True):
        for family, members in families.items():
            shown = sorted((100 * points[m]["share"], 100 * points[m][key], m) for m in members)
            if not shown:
                continue
            line = axes.plot([x for x, _, _ in shown], [y for _, y, _ in shown], "o-", label=family)
            for x, y, method in shown if family == "ntbc" else ():
                text = method.removeprefix("ntbc ")
                axes.annotate(
                    text, (x, y), textcoords="offset points", xytext=(5, -11), fontsize=8, color=line[0].get_color()
                )
        marks = [(100 * point[0], 100 * point[which]) for point in PAPER_POINTS]
        axes.plot(*zip(*marks, strict=True), "kx--", alpha=0.6, label="ntbc in the paper")
        axes.margins(0.12)
        axes.set(xlabel="share of the bytes of block compression [%]", ylabel=f"{key[:4].upper()}, % of bc's")
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(lab.out / "figure4.png")
    for method, row in points.items():
        yield {"table": "figure4", "set": "mean", "method": method, **row}


def figure6(lab: Lab):
    """Yield PSNR over training time in both modes, and plot it."""
    from matplotlib.figure import Figure

    name = lab.choice.timed
    figure = Figure(figsize=(7, 5), dpi=120, layout="constrained")
    axes = figure.subplots()
    references = lab.references(name)
    for mode in lab.choice.modes:
        curve = []
        for steps in lab.choice.lengths:
            row = lab.measure(name, {"mode": mode}, steps)
            row |= against(row, references)
            curve.append((row["seconds"], row["psnr"]))
            yield {"table": "figure6", "set": name, "method": f"ntbc {mode}", "steps": steps, **_shown(row)}
        axes.plot([x for x, _ in curve], [y for _, y in curve], "o-", label=mode)
        for (x, y), steps in zip(curve, lab.choice.lengths, strict=True):
            axes.annotate(str(steps), (x, y), textcoords="offset points", xytext=(5, -10), fontsize=8)
    axes.set(xlabel="training time [s]", ylabel=f"PSNR [dB], mean over maps of {Path(name).name}", xscale="log")
    for axis in ("major", "minor"):
        getattr(axes.xaxis, f"set_{axis}_formatter")("{x:g}")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(lab.out / "figure6.png")


def options(lab: Lab):
    """Yield what each step past the paper gains, over all sets."""
    every: dict[str, list] = {method: [] for method in OPTIONS}
    for name in lab.choice.sets:
        for method, own in OPTIONS.items():
            references = lab.references(name, own, colour=True)
            row = lab.measure(name, {"mode": "aggressive", **own}, colour=True)
            row |= against(row, references)
            every[method].append((row, references))
            yield {"table": "options", "set": name, "method": method, **_shown(row)}
    for method, pairs in every.items():
        row = mean([row for row, _ in pairs])
        references = {kind: mean([found[kind] for _, found in pairs]) for kind in REFERENCES}
        yield {"table": "options", "set": "mean", "method": method, **row, **against(row, references)}


# --- the command ------------------------------------------------------------------------------------------------------


def rows(*, device: str, quick: bool, **choices):
    """Yield the rows of the chosen tables; ``choices`` are fields of :class:`bench._ntbc_lab.Choice`."""
    if device != "cpu":
        raise ValueError(f"device must be cpu, where the fused training runs, got {device}")
    if not quick:
        yield from _rows(Choice(**choices), device)
        return
    with tempfile.TemporaryDirectory() as folder:
        source = str(synthetic_set(Path(folder) / "quick", 96))
        small = {"sets": (source,), "methods": ("naive aggressive", "ntbc aggressive"), "rates": ()}
        small |= {
            "crop": 64,
            "steps": 20,
            "lengths": (10, 20),
            "rounds": 3,
            "workers": (1,),
            "options": {"hidden": (8,)},
        }
        yield from _rows(Choice(**{**small, "out": Path(folder) / "out", **choices}), device)


_TABLES = {
    "table2": table2,
    "figure4": figure4,
    "figure6": figure6,
    "table1": table1,
    "step": step,
    "options": options,
}


def _rows(choice: Choice, device: str):
    lab = Lab(choice, device)
    for table in TABLES:
        if table in choice.only:
            for row in _TABLES[table](lab):
                yield {**row, "set": Path(row["set"]).name}


def _show(found) -> list[dict]:
    """Print rows as they come, each table with its own columns, and return them as JSON can say them."""
    from rich.console import Console

    from bench.__main__ import Printer, plain

    console, done = Console(highlight=False), []
    for table, members in itertools.groupby(found, key=lambda row: row["table"]):
        console.print(f"\n{table}", style="bold")
        printer = Printer(_VIEWS[table], console)
        for row in members:
            texts = {key: row[key].ljust(width) for key, width in _WIDE.items() if key in row}
            printer.add({**row, **texts})
            done.append(plain(row))
    return done


def main(arguments: list[str] | None = None) -> int:
    """Run chosen tables: the command line of ``python -m bench.ntbc``."""

    def names(text):
        return tuple(text.split(","))

    parser = argparse.ArgumentParser(prog="python -m bench.ntbc", description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=names, default=Choice.only, help=f"tables, of {','.join(TABLES)}")
    parser.add_argument("--sets", type=names, default=SETS, help="names in NEUMAT_DATA/textures, or folders")
    parser.add_argument(
        "--methods", type=names, default=Choice.methods, help=f"of {','.join(METHODS)}".replace("%", "%%")
    )
    parser.add_argument("--rates", type=names, default=Choice.rates, help="further points of figure4")
    parser.add_argument("--crop", type=int, default=1024, help="side of the square; 0 for the whole set")
    parser.add_argument("--steps", type=int, help="of each fit; default: the fit's own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Choice.out, help="fitted files and plots (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    # Threads of FLIP and torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    chosen = vars(parser.parse_args(arguments))
    chosen["rates"] = tuple(name for name in chosen["rates"] if name)
    file = chosen.pop("json")
    import warp

    warp.config.log_level = warp.LOG_WARNING
    try:
        found = rows(device="cpu", quick=False, **{**chosen, "crop": chosen["crop"] or None})
        document = {"bench": "ntbc", "machine": machine(), "versions": versions(), "rows": _show(found)}
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"bench: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    if file:
        file.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
