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
import functools
import itertools
import json
import os
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from ._bcf_lab import synthetic_set
from ._ntbc_lab import METHODS, RATES, REFERENCES, SETS, TABLES, Choice, Lab, against, mean
from .harness import interleave, machine, versions

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
    "no joint training": {"joint": 0.0},
    "quantised in the last 1/11": {"quantised": 1 / 11},
    "endpoints fitted at load": {"endpoints": "fitted"},
    "luminance and chrominance": {"metric": "luma"},
    "normals in BC1": {"normals": "bc1"},
    "colours in BC7": {"colours": "bc7"},
    "as the paper": {"rate": "paper", "joint": 0.0, "quantised": 1 / 11, "normals": "bc1"},
}
"""Method → what differs from an aggressive fit with the defaults; rates are shares of the bytes of its own formats."""

TRAINED = 300
"""Steps that the networks of ``table1`` and ``step`` are trained for at most: neither's time depends on it."""


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
        "as the paper": [m for m in points if m.startswith("as the paper")],
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


# --- speed ------------------------------------------------------------------------------------------------------------


def _trained(lab: Lab, source, mode: str):
    """Return (config, pairs) of networks that are trained a little, as a fit trains them."""
    import torch

    from warp_neumat.models import ntbc
    from warp_neumat.training.block_maps import BlockMapData
    from warp_neumat.training.loop import Plan

    choice = lab.choice
    config = ntbc.configure(source, {**choice.options, "mode": mode})
    plan = Plan(min(choice.steps or TRAINED, TRAINED), BlockMapData.batch(config), choice.seed)
    trainer = BlockMapData.trainer(ntbc, source, config, plan, torch.device("cpu"), checkpoint=None)
    trainer.run()
    return config, list(trainer.model.pairs), plan


def table1(lab: Lab):
    """Yield inference of both modes, all textures and those in BC1 alone, beside torch; then stages of loading."""
    name = lab.choice.timed
    opened = lab.source(name)[1]
    tree = opened.manifest()
    wide = {c.map for c in opened.channels if c.component == "g"}
    sources = {"BC1 & BC4": opened}
    if wide:
        from warp_neumat.io.texture_set import open_texture_set

        sources["BC1 only"] = open_texture_set({**tree, "maps": {m: f for m, f in tree["maps"].items() if m in wide}})
    for mode in lab.choice.modes:
        for what, source in sources.items():
            config, pairs, _ = _trained(lab, source, mode)
            for row in _inference(config, pairs, lab.choice.rounds):
                yield {"table": "table1", "set": name, "method": f"ntbc {mode}, {what}", **row}
    for mode in lab.choice.modes:
        known = [other for other in lab.choice.sets if len(lab.source(other)[1].channels) == 7]
        chosen = known[0] if known else name
        material, _, _ = lab.fitted(chosen, {"mode": mode})
        stages = {key: round(value, 2) for key, value in material.load_ms.items()}
        text = ", ".join(f"{key} {value:.4g}" for key, value in stages.items())
        row = {"ms": sum(stages.values()), "load_ms": stages, "maps": text}
        yield {"table": "table1", "set": chosen, "method": f"load, ntbc {mode}", **row}


def _inference(config, pairs, rounds: int):
    import torch
    import warp as wp

    from warp_neumat import metrics
    from warp_neumat.kernels.ntbc import ModelShape, ntbc_blocks

    from ._ntbc_peers import SPELLINGS, Inference

    models = []
    for pair in pairs:
        planes = tuple((plane.format, plane.components) for plane in config.planes(pair.model))
        arrays = [pair.endpoint_grid, pair.endpoint_net, pair.texel_grid, pair.texel_net]
        device = [wp.array(a.numpy(), dtype=wp.float32, device="cpu") for a in arrays]
        models.append((pair, planes, ModelShape(pair.shape.endpoint, pair.shape.texel, planes), device))

    def ours():
        return [ntbc_blocks(shape, config.rows, config.columns, *a) for _, _, shape, a in models]

    written = [plane.numpy().reshape(-1, 8) for planes in ours() for plane in planes]
    formats = [format for _, planes, _, _ in models for format, _ in planes]
    peers, calls = {}, {"ours": ours}
    # float16 is emulated where the CPU has none: once, by one spelling.
    for dtype, short, spellings in ((torch.float32, "fp32", SPELLINGS), (torch.float16, "fp16", SPELLINGS[1:])):
        for spelling in spellings:
            nets = [Inference(p, planes, config.rows, config.columns, spelling, dtype) for p, planes, _, _ in models]
            for write, suffix in ((False, "networks"), (True, "networks and blocks")):
                peers[short, suffix, spelling] = [(net, write) for net in nets]
    for key, nets in peers.items():
        calls[key] = lambda nets=nets: [blocks for net, write in nets for blocks in net.run(write)]
    fast = {key: call for key, call in calls.items() if key == "ours" or key[0] == "fp32"}
    seconds = interleave(fast, rounds)
    slow = {key: call for key, call in calls.items() if key not in fast}
    seconds |= interleave(slow, 1, warmup=0)
    for short in ("fp32", "fp16"):
        for suffix in ("networks", "networks and blocks"):
            key = min((k for k in peers if k[:2] == (short, suffix)), key=seconds.get)
            row = {"ms": 1e3 * seconds["ours"], "peer": f"torch {short}, {suffix} ({key[2]})"}
            row |= {"peer_ms": 1e3 * seconds[key], "ratio": seconds[key] / seconds["ours"]}
            if suffix != "networks":
                theirs = [blocks.numpy() for blocks in calls[key]()]
                differ, mse = zip(
                    *(_differing(*pair) for pair in zip(formats, written, theirs, strict=True)), strict=True
                )
                row |= {"differ": float(np.mean(differ)), "psnr_peer": metrics.psnr_of_mse(mse)}
            yield row


def _differing(format: str, ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """Return the share of blocks that differ, and the mean squared difference of what they decode to."""
    from warp_neumat.kernels.bc1 import bc1_decode
    from warp_neumat.kernels.bc4 import bc4_decode

    decode = {"bc1": bc1_decode, "bc4": bc4_decode}[format]
    pair = [decode(np.ascontiguousarray(blocks)).astype(np.float64) / 255 for blocks in (ours, theirs)]
    return float((ours != theirs).any(1).mean()), float(np.square(pair[0] - pair[1]).mean())


def step(lab: Lab):
    """Yield training steps of the paper's losses and of the joint ones, of all planes in one model, beside torch."""
    import torch
    import warp as wp

    from bench.mlp import peak_kernel
    from warp_neumat.kernels import dispatch
    from warp_neumat.models.ntbc import block_colours
    from warp_neumat.training.block_maps import reference_endpoints
    from warp_neumat.training.ntbc_loop import APART, JOINT

    name = lab.choice.timed
    opened = lab.source(name)[1]
    config, (pair,), plan = _trained(lab, opened, "aggressive")
    planes = config.planes(pair.model)
    problem = SimpleNamespace(
        config=config,
        pair=pair,
        batch=min(plan.batch, config.rows * config.columns // 8 * 8),
        colours=block_colours(planes, opened.pixels),
        endpoints=reference_endpoints(planes, opened.pixels),
    )
    order = torch.randperm(len(problem.colours), generator=torch.Generator().manual_seed(1))
    blocks = order[: problem.batch].int()
    threads, most = torch.get_num_threads(), dispatch.worker_count()
    turns = 1 << 21
    try:
        for losses, weights in (("paper's losses", APART), ("joint losses", JOINT)):
            errors = _gradient_errors(problem, blocks, weights)
            for workers in sorted({min(n, most) for n in lab.choice.workers}):
                dispatch.set_worker_count(workers)
                torch.set_num_threads(workers)
                calls = _steps(problem, blocks, weights, workers)
                sums = wp.zeros((workers, 16), dtype=wp.float32, device="cpu")
                inputs = [wp.array([0.5, 1.0], dtype=wp.float32, device="cpu"), sums, turns]
                calls["peak"] = dispatch.Job(peak_kernel, workers, inputs=inputs, device="cpu", grain=1).run
                seconds = interleave(calls, lab.choice.rounds, warmup=2)
                peak = float(sums.numpy()[:, 1].sum()) / seconds["peak"]
                peer = min((key for key in calls if key not in ("ours", "peak")), key=seconds.get)
                yield {
                    "table": "step",
                    "set": name,
                    "method": f"{losses}, {problem.batch} blocks",
                    "workers": workers,
                    "ms": 1e3 * seconds["ours"],
                    "peer": f"torch ({peer})",
                    "peer_ms": 1e3 * seconds[peer],
                    "ratio": seconds[peer] / seconds["ours"],
                    "floor_ms": 1e3 * pair.shape.flops * problem.batch / peak,
                    "error": errors[0],
                    "peer_error": errors[1],
                }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)


def _values(pair) -> list:
    return [v.detach().clone() for v in (pair.endpoint_grid, pair.endpoint_net, pair.texel_grid, pair.texel_net)]


def _steps(problem, blocks, weights, workers: int) -> dict:
    """Return whole steps, ours and torch's, by name."""
    import torch

    from warp_neumat.ops.grid_update import GridAdam
    from warp_neumat.ops.ntbc import NTBCStep

    from ._ntbc_peers import SPELLINGS, Step

    config, shape = problem.config, problem.pair.shape
    place = config.rows, config.columns
    adams = []
    for number, values in enumerate(_values(problem.pair)):
        gradients = torch.zeros(workers, values.numel())
        network = (shape.endpoint, shape.texel)[number // 2]
        more = {"bits": None, "lazy": False} if number % 2 else {"offsets": network.grid_offsets}
        adams.append(GridAdam(values, gradients, **more))
    fused = NTBCStep(
        shape, *place, problem.colours, problem.endpoints, *(adam.used for adam in adams), batch=problem.batch,
        parts=workers, gradients=[adam.gradients for adam in adams],
    )  # fmt: skip
    fused.weights.copy_(torch.tensor(weights))
    taken = 0

    def ours():
        nonlocal taken
        taken += 1
        fused.run(blocks)
        for number, adam in enumerate(adams):
            adam.step((0.01, 0.005)[number % 2], taken)

    calls = {"ours": ours}
    for spelling in SPELLINGS:
        peer = Step(shape, *place, problem.colours, problem.endpoints, _values(problem.pair), weights, spelling)
        calls[spelling] = functools.partial(peer.run, blocks, peer.taps(blocks))
    return calls


def _gradient_errors(problem, blocks, weights) -> tuple[float, float]:
    """Return the relative errors of the fused gradients and of torch's in float32, against torch in float64."""
    import torch

    from warp_neumat.models.ntbc import layers
    from warp_neumat.ops.ntbc import NTBCStep

    from ._ntbc_peers import Step

    config, shape = problem.config, problem.pair.shape
    place, values = (config.rows, config.columns), _values(problem.pair)
    arguments = (shape, *place, problem.colours, problem.endpoints)
    exact, single = (
        Step(*arguments, values, weights, "embedding_bag", dtype).gradients(blocks)
        for dtype in (torch.float64, torch.float32)
    )
    fused = NTBCStep(*arguments, *values, batch=problem.batch, parts=2)
    fused.weights.copy_(torch.tensor(weights))
    fused.run(blocks)
    ours = []
    for network, name in ((shape.endpoint, "endpoint"), (shape.texel, "texel")):
        ours.append(getattr(fused, f"{name}_grid_gradient"))
        packed = layers(network, getattr(fused, f"{name}_net_gradient"))
        ours.append(torch.cat([part.reshape(-1) for layer in packed for part in layer]))

    def error(found):
        pairs = zip(found, exact, strict=True)
        return max(float((f.double() - e).norm() / e.norm()) for f, e in pairs if e.norm() > 0)

    return error(ours), error(single)


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


def _rows(choice: Choice, device: str):
    lab = Lab(choice, device)
    for table in TABLES:
        if table in choice.only:
            for row in globals()[table](lab):
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
