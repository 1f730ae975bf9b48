"""How many threads torch has while a fit runs."""

from __future__ import annotations

import contextlib
import os

import torch


@contextlib.contextmanager
def all_threads():
    """Give torch every core that this process may use for the length of a ``with`` block, and what it had after it."""
    before = torch.get_num_threads()
    torch.set_num_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
