"""How many threads torch uses: all cores in a fit, one where its arrays are too small to share."""

from __future__ import annotations

import contextlib
import os

import torch


@contextlib.contextmanager
def torch_threads(count: int | None):
    """Give torch ``count`` threads inside, and what it had afterwards; None changes nothing."""
    before = torch.get_num_threads()
    if count is None or count == before:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def all_threads():
    """Give torch every core that this process may use inside, and what it had afterwards."""
    return torch_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
