"""Neural BTFs: error and bytes beside NeuMIP and Lafortune lobes, test error over epochs, time over lights; and peers.

Paper [mobilevr], Tables 1 and 3 and Figures 7, 10, 11 and 13, on simulated micro-geometry or on any BTF of ``neumat
fit``. ``python -m bench.btf`` takes a choice (``--help``):

- ``table1``: every material × method, then the means. ``macs``: multiply-adds of a texel under one light, a quarter of
  the coarse network's (438 against NeuMIP's 3150: 7.2 times less); ``weights``: those stored, with biases;
  ``over_neumip``: the error over NeuMIP's; ``under_lafortune``: Lafortune's error over this one.
- ``figure7``: test L1 over the epochs of a fit, ours beside NeuMIP; ``figure11``: ours with and without distillation.
  Epoch 0 is before the first step.
- ``ablation``: the student without a teacher, and what it loses or gains by each choice: activation, half vector, where
  the layers are cut in two, mips, block-compressed features.
- ``figure13``: coarse-to-fine beside a single level of equal capacity, both distilled: error after equal steps, and
  time under 1 … 4 lights of fetches and networks alone, in turns in one process (``_btf_networks.py``).
- ``figure10``: the texel-space shading stage over 1 … 8 lights on a sheet of 1200² texels, the line through the times,
  what a light behind the surface costs, and the same over texels; ``table3``: over 1 … 4 materials of 1024² texels each
  (``_btf_shading.py``).
- ``peers``: the same networks in Dr.Jit and torch on the same cores (``_btf_peers.py``).

Methods: ``distilled`` is the coarse-to-fine network, ``alone`` the same without a teacher; ``neumip`` the paper's
modified one; ``lafortune`` four lobes a texel, with the choice of what carries the cosine that serves the material
best. ``l1`` is the mean error over texels of the finest level under random pairs of the measured directions, one
function and one set of samples for all (``training.btf.btf_metrics``). Teachers are kept in the cache of ``neumat
fit``, so ``teacher_seconds`` is there where one was trained. Times are the least of ``rounds``: see ``least``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from ._btf_lab import ABLATION, LAFORTUNE, MATERIALS, METHODS, NETWORKS, TABLES, Choice, Lab

_TIMES = ("lights", "texels", "ms", "error", "peer", "peer_ms", "ratio", "peer_error")
_STAGE = ("lights", "materials", "texels", "ms", "evaluations", "slope_ms", "r2")

SHOWN = {
    "table1": ("l1", "l1_relative", "over_neumip", "under_lafortune", "bytes", "weights", "macs", "seconds"),
    "figure7": ("epoch", "l1"),
    "figure11": ("epoch", "l1"),
    "ablation": ("l1", "over_first", "bytes", "weights", "macs", "seconds"),
    "figure13": ("l1", "weights", "macs", *_TIMES),
    "figure10": (*_STAGE, "peer", "peer_ms", "ratio"),
    "table3": _STAGE,
    "peers": _TIMES,
}
"""Table → columns beside its own, material and method."""


def columns(only: tuple[str, ...]) -> list[str]:
    """Return the columns of some tables, each once."""
    return list(dict.fromkeys(["table", "material", "method", *(name for table in only for name in SHOWN[table])]))


COLUMNS = columns(TABLES)


def table1(lab: Lab):
    """Yield every material × method, then the means."""
    methods = lab.choice.methods
    found: dict[str, list[dict]] = {method: [] for method in methods}
    for material in lab.choice.materials:
        records = {method: lab.measure(material, method) for method in methods}
        for method, record in records.items():
            found[method].append(record)
        yield from _compared(material, records)
    means = {method: lab.mean(records) for method, records in found.items()}
    yield from _compared(f"mean of {len(lab.choice.materials)}", means)


def _compared(material: str, records: dict[str, dict]):
    for method, record in records.items():
        shown = {name: value for name, value in record.items() if name != "test_l1"}
        row = {"table": "table1", "material": _short(material), "method": method, **shown}
        if "neumip" in records:
            row["over_neumip"] = record["l1"] / records["neumip"]["l1"]
            if records["neumip"].get("macs") and record.get("macs"):
                row["macs_under_neumip"] = records["neumip"]["macs"] / record["macs"]
        if LAFORTUNE in records:
            row["under_lafortune"] = records[LAFORTUNE]["l1"] / record["l1"]
        yield row


def _curves(lab: Lab, table: str, methods: tuple[str, ...]):
    """Yield test errors epoch by epoch, and plot them where a folder was named."""
    curves: dict[str, dict[str, list[float]]] = {}
    for material in lab.choice.materials:
        curves[material] = {method: lab.measure(material, method)["test_l1"] for method in methods}
        for method, values in curves[material].items():
            for epoch, value in enumerate(values):
                yield {"table": table, "material": _short(material), "method": method, "epoch": epoch, "l1": value}
    if lab.choice.plots is not None:
        _draw(lab.choice.plots / f"{table}.png", curves)


def figure7(lab: Lab):
    """Yield the test errors of ours and NeuMIP."""
    return _curves(lab, "figure7", ("distilled", "neumip"))


def figure11(lab: Lab):
    """Yield the test errors of ours with and without distillation."""
    return _curves(lab, "figure11", ("distilled", "alone"))


def ablation(lab: Lab):
    """Yield the student without one of its parts after the other."""
    for material in lab.choice.materials:
        first = None
        for method in ABLATION:
            record = lab.measure(material, method)
            first = first or record["l1"]
            row = {"table": "ablation", "material": _short(material), "method": method}
            shown = {name: value for name, value in record.items() if name != "test_l1"}
            yield {**row, "over_first": record["l1"] / first, **shown}


def figure13(lab: Lab):
    """Yield the errors of both designs, then their times."""
    from . import _btf_networks

    designs = ("distilled", "single-level")
    found: dict[str, list[dict]] = {method: [] for method in designs}
    for material in lab.choice.materials:
        for method in designs:
            found[method].append(lab.measure(material, method))
    names = [*map(_short, lab.choice.materials), f"mean of {len(lab.choice.materials)}"]
    for k, name in enumerate(names):
        ours, level = (r[k] if k < len(r) else lab.mean(r) for r in found.values())
        for method, record in zip(designs, (ours, level), strict=True):
            row = {"table": "figure13", "material": name, "method": method, "over_single": record["l1"] / level["l1"]}
            yield {**row, **{figure: record.get(figure) for figure in ("l1", "l1_relative", "weights", "macs")}}
    yield from _btf_networks.rows(lab.device, lab.choice.texels, lab.choice.rounds)


def figure10(lab: Lab):
    """Yield the shading stage over lights and texels."""
    from . import _btf_shading

    return _btf_shading.figure10(lab)


def table3(lab: Lab):
    """Yield the shading stage over materials."""
    from . import _btf_shading

    return _btf_shading.table3(lab)


def peers(lab: Lab):
    """Yield the networks beside those of Dr.Jit and torch."""
    from . import _btf_peers

    choice = lab.choice
    return _btf_peers.rows(lab.device, choice.texels, choice.rounds, compiled=choice.compiled)


def _short(material: str) -> str:
    return material.removeprefix("microgeometry:").rsplit("/", 1)[-1]


def _draw(path: Path, curves: dict[str, dict[str, list[float]]]) -> None:
    """Plot test L1 over epochs, a panel a material; without matplotlib only say so."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        print(f"no matplotlib, so no {path.name}: pip install matplotlib", file=sys.stderr)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(3.2 * len(curves) + 0.6, 3.2), dpi=120, layout="constrained")
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (material, methods) in zip(panels, curves.items(), strict=True):
        for method, values in methods.items():
            axes.plot(range(len(values)), values, ".-", label=method)
        axes.set(title=_short(material), xlabel="epoch", ylabel="test L1 [1/sr]", yscale="log")
        axes.grid(alpha=0.3, which="both")
        axes.legend()
    figure.savefig(path)


QUICK = {
    "materials": ("weave",),
    "methods": METHODS,
    "size": 16,
    "directions": "ubo2003",
    "steps": 16,
    "epochs": 2,
    "pairs": 162,
    "iterations": 4,
    "atlas": 96,
    "tile": 64,
    "texels": 1 << 13,
    "rounds": 2,
    "compiled": False,
}
"""What ``--quick`` chooses."""


def _tables(device: str, quick: bool, choices: dict):
    """Yield (name, rows) of the chosen tables."""
    lab = Lab(Choice(**({**QUICK, **choices} if quick else choices)), device)
    for table in TABLES:
        if table in lab.choice.only:
            yield table, globals()[table](lab)


def rows(*, device: str, quick: bool, **choices):
    """Yield the rows of the chosen tables; ``choices`` are fields of :class:`Choice`."""
    for _, found in _tables(device, quick, choices):
        yield from found


def main(arguments: list[str] | None = None) -> int:
    """Run chosen tables: the command line of ``python -m bench.btf``."""
    from rich.console import Console

    from bench.__main__ import run
    from warp_neumat.io.atomic import check_writable, replacing

    def names(text):
        return tuple(text.split(","))

    parser = argparse.ArgumentParser(prog="python -m bench.btf", description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=names, default=TABLES, help=f"tables, of {','.join(TABLES)}")
    parser.add_argument(
        "--materials", type=names, default=MATERIALS,
        help="micro-geometries, or specifications and files as of `neumat fit` (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--methods", type=names, default=METHODS, help=f"of table1: {','.join((*NETWORKS, LAFORTUNE))}")
    parser.add_argument("--size", type=int, default=Choice.size, help="texels along a side (default: %(default)s)")
    parser.add_argument("--steps", type=int, help="of each fit; default: the fit's own")
    parser.add_argument("--epochs", type=int, help="test errors taken in each fit; default: the fit's own")
    parser.add_argument("--mips", type=int, help="of each fit, the paper's 1; default: the fit's own")
    parser.add_argument("--pairs", type=int, default=Choice.pairs, help="that lobes are fitted to")
    parser.add_argument("--rounds", type=int, default=Choice.rounds, help="times each is timed (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, metavar="FILE", help="JSON lines of what was fitted; used again")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw figure7 and figure11")
    parser.add_argument("--quick", action="store_true", help="small sizes and few rounds, to see that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--device", default="cpu")
    # Threads of torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    defaults = vars(parser.parse_args([]))
    chosen = vars(parser.parse_args(arguments))
    quick, file, device = chosen.pop("quick"), chosen.pop("json"), chosen.pop("device")
    if quick:  # only what was asked for replaces the quick choice
        chosen = {name: value for name, value in chosen.items() if value != defaults[name]}
    import warp

    warp.config.log_level = warp.LOG_WARNING
    try:
        for path in (file, chosen.get("cache")):
            if path is not None:
                check_writable(path)
        console, document, found = Console(highlight=False), {}, []
        for table, made in _tables(device, quick, chosen):
            document = run(f"btf {table}", made, columns((table,)), console)
            found += document["rows"]
        document |= {"bench": "btf", "rows": found}
        if file:
            with replacing(file) as temporary:
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"bench: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        kept = f"; {chosen['cache']} holds what was fitted" if chosen.get("cache") else ""
        print(f"bench: stopped{kept}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
