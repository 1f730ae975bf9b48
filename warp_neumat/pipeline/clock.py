"""Milliseconds per stage of a frame."""

import time

import warp as wp


class Clock:
    """Adds up milliseconds per stage, in :attr:`ms`."""

    def __init__(self, device):
        self.ms: dict[str, float] = {}
        self._device, self._last = device, time.perf_counter()

    def stage(self, name: str) -> None:
        """End the stage ``name``."""
        if not self._device.is_cpu:
            wp.synchronize_device(self._device)
        now = time.perf_counter()
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - self._last)
        self._last = now
