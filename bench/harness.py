"""Timing that a noisy machine cannot tilt: contenders take turns, and each is judged by its median."""

import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping

from warp_neumat.machine import machine, versions

__all__ = ["interleave", "machine", "track", "versions"]


def interleave(functions: Mapping[str, Callable[[], object]], rounds: int, warmup: int = 1) -> dict[str, float]:
    """Return the median seconds of each function, called in turn so that noise hits all alike.

    Every round calls each function once, and starts one function further than the round before, so that none always
    follows the same neighbour's cache. A function that launches on a GPU has to wait for it itself.

    Args:
        functions: Name → function without arguments.
        rounds: Timed calls of each function, at least 1.
        warmup: Untimed calls of each function beforehand, at least 0: compilation and first touch belong there.
    """
    if rounds < 1 or warmup < 0:
        raise ValueError(f"rounds must be at least 1 and warmup at least 0, got {rounds} and {warmup}")
    order = list(functions)
    for name in order * warmup:
        functions[name]()
    seconds: dict[str, list[float]] = {name: [] for name in order}
    for turn in range(rounds):
        for k in range(len(order)):
            name = order[(turn + k) % len(order)]
            start = time.perf_counter()
            functions[name]()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(seconds[name]) for name in order}


def track(items: Iterable, text: str) -> Iterator:
    """Yield ``items`` while a bar on stderr, where that is a terminal, shows how far they are."""
    from rich.console import Console
    from rich.progress import track as rich_track

    console = Console(stderr=True)
    return iter(rich_track(items, text, console=console, transient=True, disable=not sys.stderr.isatty()))
