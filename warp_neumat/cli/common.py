"""What all commands share: the application, its errors, progress bars, and how Warp is started."""

import contextlib
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="neumat",
    help="Neural materials on NVIDIA Warp: fit them, look at them, render mesh sequences with them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help starts in half the time
    context_settings={"help_option_names": ["-h", "--help"]},
)

Device = Annotated[str, typer.Option(help="Warp device: cpu or cuda:0.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; made where it is missing.")]


class Usage(ValueError):
    """An argument that is not written as it must be: exit code 2."""


@app.callback()
def _globals(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False):
    pass  # the option is listed here, and taken by main() wherever it stands


@contextlib.contextmanager
def progress_bar(title: str):
    """Yield ``progress(fraction, text)`` that draws a bar on stderr, or nothing where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = [
        "{task.description}",
        BarColumn(),
        "{task.percentage:>3.0f}%",
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    ]
    columns.append(TextColumn("{task.fields[text]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=1.0, text="")
        yield lambda fraction, text="": bar.update(task, completed=fraction, text=text)


def start_warp(device: str = "cpu"):
    """Import Warp without its banner, and for the CPU without its warning that there is no GPU driver."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # no banner, no line for each kernel module
    if device == "cpu":
        sys.stderr.flush()
        saved, silent = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(silent, 2)  # the warning is written by native code
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(silent)
    wp.get_device(device)  # an unknown device is an error before any work


def write_json(record: dict, target: str | None) -> None:
    """Write ``record`` to a file, whole or not at all, or with ``-`` to standard output."""
    import json

    from warp_neumat.io.atomic import replacing

    if target is None:
        return
    text = json.dumps(record, indent=1) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    with replacing(Path(target)) as temporary:
        temporary.write_text(text, encoding="utf-8")
