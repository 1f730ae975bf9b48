"""Command line of the benchmarks: ``python -m bench NAME [SEQUENCE] [--json FILE] [--device D] [--quick]``, ``--list``.

A benchmark declares what it takes by the parameters of its ``rows``: ``device`` and ``quick`` all of them, ``sequence``
those that can be told what to render, ``plot`` those that draw: the path, less its suffix, of pictures beside the JSON.
Exit code 0 ok, 1 the benchmark failed, 2 bad arguments. The JSON holds ``{bench, machine, versions, rows[]}`` and is
written once, when every row is measured.
"""

import argparse
import ast
import difflib
import importlib
import inspect
import json
import math
import os
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from warp_neumat.io.atomic import check_writable, replacing

from .harness import machine, versions

# Before torch and FLIP load their OpenMP: threads that spin while they wait cost a busy machine many times their gain.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_NOT_BENCHMARKS = {"__init__", "__main__", "harness"}


def available(folder: Path | None = None) -> dict[str, str]:
    """Return name → first docstring line of each benchmark in ``folder``, read without importing any."""
    found = {}
    for path in sorted((folder or Path(__file__).parent).glob("*.py")):
        if path.stem in _NOT_BENCHMARKS or path.stem.startswith("_"):
            continue
        lines = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines()
        found[path.stem] = lines[0] if lines else ""
    return found


def plain(value):
    """Return ``value`` as JSON can say it: NumPy numbers and arrays become Python's, NaN and infinities ``None``."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def cell(value) -> str:
    """Return ``value`` as the table shows it: four significant digits, a dash for what is not there."""
    if value is None:
        return "–"
    if isinstance(value, (float, np.floating)):
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"
    return str(value)


class Printer:
    """Prints rows of a table as they come; widths follow the column names and the first row."""

    def __init__(self, columns: list[str], console: Console):
        self.columns, self.console = columns, console
        self.widths: list[int] = []
        self.sides: list[str] = []

    def add(self, row: dict) -> None:
        """Print one row, and the header before the first one."""
        cells = [cell(row.get(name)) for name in self.columns]
        first = not self.widths
        if first:
            texts = [isinstance(row.get(name), str) for name in self.columns]
            self.sides = ["left" if text else "right" for text in texts]
            self.widths = [
                max(len(name), len(shown), 16 if text else 8)
                for name, shown, text in zip(self.columns, cells, texts, strict=True)
            ]
        table = Table(box=None, show_header=first, padding=(0, 2, 0, 0), header_style="bold")
        for name, width, side in zip(self.columns, self.widths, self.sides, strict=True):
            table.add_column(name, width=width, overflow="fold", justify=side)
        table.add_row(*cells)
        # A line that the terminal wraps reads better than columns squeezed to one letter.
        self.console.width = max(self.console.width, sum(self.widths) + 2 * len(self.widths))
        self.console.print(table)


def run(name: str, rows: Iterable[dict], columns: list[str], console: Console) -> dict:
    """Print ``rows`` as they come and return the benchmark's JSON document."""
    facts = machine()
    where = f"{facts['cpu']}, {facts['cores']} cores, {' '.join(facts['simd'][-2:])}"
    console.print(f"{name} on {where}", markup=False)
    printer, done = Printer(columns, console), []
    with console.status("measuring …"):
        for row in rows:
            printer.add(row)
            done.append(plain(row))
    return {"bench": name, "machine": facts, "versions": versions(), "rows": done}


def main(arguments: list[str] | None = None) -> int:
    """Run one benchmark as the command line asks and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench", description="Measure speed and error on this machine.")
    parser.add_argument("name", nargs="?", metavar="NAME", help="which benchmark; --list shows them")
    parser.add_argument("sequence", nargs="?", metavar="SEQUENCE", help="what to render, for those that can be told")
    parser.add_argument("--list", action="store_true", help="show the benchmarks and leave")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the rows, the machine and the versions here"
    )
    parser.add_argument(
        "--device", default="cpu", metavar="D", help="Warp device, as cpu or cuda:0 (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes and few rounds, to see that it runs")
    options = parser.parse_args(arguments)
    names = available()
    if options.list:
        for name, line in names.items():
            print(f"{name:<{max(map(len, names))}}  {line}")
        return 0
    if options.name is None:
        return _fail(f"say which benchmark: {', '.join(names) or 'there are none'}", 2)
    if options.name not in names:
        near = difflib.get_close_matches(options.name, names, n=3, cutoff=0.4) or sorted(names)
        hint = f"did you mean {', '.join(near)}?" if near else "there are none"
        return _fail(f"no benchmark is named {options.name!r}; {hint}", 2)
    try:
        if options.json:
            check_writable(options.json)  # before minutes of measuring
        import warp  # not at the top: --list and mistakes answer at once

        warp.config.log_level = warp.LOG_WARNING
        module = importlib.import_module(f"bench.{options.name}")
        takes, more = inspect.signature(module.rows).parameters, {}
        if options.sequence is not None:
            if "sequence" not in takes:
                return _fail(f"{options.name} takes no SEQUENCE, got {options.sequence!r}", 2)
            more["sequence"] = options.sequence
        if "plot" in takes:
            more["plot"] = options.json.with_suffix("") if options.json else Path("out") / options.name
        rows = module.rows(device=options.device, quick=options.quick, **more)
        document = run(options.name, rows, module.COLUMNS, Console(highlight=False))
        if options.json:
            with replacing(options.json) as temporary:
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except (ValueError, TypeError, OSError, ImportError) as error:
        return _fail(" ".join(str(error).split()), 1)
    except KeyboardInterrupt:
        return _fail("stopped; nothing was written", 130)
    return 0


def _fail(message: str, code: int) -> int:
    print(f"bench: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
