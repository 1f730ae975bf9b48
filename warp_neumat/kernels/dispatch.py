"""The one place that decides how a kernel meets the machine: compiler flags, lanes per thread, and all cores.

Warp runs a CPU launch as one sequential loop over threads on one core, and does not vectorise across threads. So a
hot kernel here is written as a *lane loop*: thread ``b`` owns the :func:`lanes` items of block ``b`` and loops over
them with one-item code, which LLVM widens to the core's vector registers. On CUDA the same factory is called with one
lane, and a block is one item. The kernel's first argument is always ``first: int``, the block that thread 0 owns,
because :class:`Job` splits the blocks into chunks and lets every core claim the next one until none is left.

Rules for kernels that are launched from here:

- argument 0 is ``first: int``; if argument 1 is named ``slot: int`` it receives the index of the worker that runs the
  chunk, in ``range(worker_count())``, to address scratch memory that no other worker touches;
- two blocks never write the same address, or they write the same value to it: CPU atomics are not atomic across
  workers;
- no tile kernels (their shared memory is one static buffer per module).
"""

import atexit
import functools
import itertools
import os
import queue
import threading

import warp as wp

CPU_FLAGS = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4"
    # What turns a lane loop into vector code: fused multiply-adds from Warp's separate mul and add, the widest
    # registers, a stack aligned for spilled vectors, and alias checks that the vectoriser would decline to emit.
    " -mprefer-vector-width=512 -ffp-contract=fast -mframe-pointer=all -mstackrealign"
    " -mllvm=-runtime-memory-check-threshold=100000 -mllvm=-memory-check-merge-threshold=1000000"
)
"""Compiler flags of every kernel module: one string, because each distinct one costs a precompiled header."""

CPU_LANES = 256
"""Items that one CPU thread owns. Larger than Warp's ``max_unroll``, so that the lane loop stays a loop for LLVM."""

_CHUNKS_PER_WORKER = 16


def module_options() -> dict:
    """Return the Warp module options of every kernel file: forward only, project-wide compiler flags."""
    return {"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS, "max_unroll": 16}


def lanes(device) -> int:
    """Return the number of items a thread owns on ``device``: :data:`CPU_LANES` on the CPU, 1 on CUDA."""
    return CPU_LANES if wp.get_device(device).is_cpu else 1


def blocks(count: int, per_block: int) -> int:
    """Return how many blocks of ``per_block`` items hold ``count`` items."""
    return -(-count // per_block)


@functools.cache
def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


_threads: int | None = None


def worker_count() -> int:
    """Return how many workers share a launch: :func:`set_worker_count`, else ``NEUMAT_THREADS``, else every core."""
    if _threads is not None:
        return _threads
    text = os.environ.get("NEUMAT_THREADS")
    if text is None:
        return _cores()
    if not text.isdigit() or int(text) < 1:
        raise ValueError(
            f"NEUMAT_THREADS must be a whole number of at least 1, got {text!r}; unset it to use all cores"
        )
    return int(text)


def set_worker_count(count: int | None) -> None:
    """Set the number of workers that share a launch; ``None`` returns to ``NEUMAT_THREADS`` or all cores."""
    global _threads
    if count is not None and count < 1:
        raise ValueError(f"count must be at least 1, got {count}; pass None to use all cores")
    _threads = count


class _Pool:
    """Persistent helper threads; the calling thread always works too, as slot 0."""

    def __init__(self):
        self._inboxes: list[queue.SimpleQueue] = []
        self._guard = threading.Lock()
        atexit.register(self.close)

    def run(self, work, helpers: int) -> None:
        """Call ``work(slot)`` on this thread (slot 0) and on ``helpers`` others; raise the first error of any."""
        with self._guard:  # one job at a time: two interleaved jobs would share slots
            while len(self._inboxes) < helpers:
                inbox = queue.SimpleQueue()
                slot = len(self._inboxes) + 1
                threading.Thread(target=self._loop, args=(inbox, slot), name=f"neumat-{slot}", daemon=True).start()
                self._inboxes.append(inbox)
            done = queue.SimpleQueue()
            errors, running = [], 0
            try:
                for inbox in self._inboxes[:helpers]:
                    inbox.put((work, done))
                    running += 1
                work(0)
            except BaseException as error:
                errors.append(error)
            while running:  # the helpers hold our arrays and slots: even an interrupt waits for them
                try:
                    error = done.get()
                except KeyboardInterrupt as interrupt:
                    errors.append(interrupt)
                    continue
                running -= 1
                if error is not None:
                    errors.append(error)
            if errors:
                raise errors[0]

    @staticmethod
    def _loop(inbox, slot):
        while True:
            item = inbox.get()
            if item is None:
                return
            work, done = item
            try:
                work(slot)
            except BaseException as error:
                done.put(error)
            else:
                done.put(None)
            work = done = item = None  # do not keep a finished job's arrays alive while waiting for the next

    def close(self):
        for inbox in self._inboxes:
            inbox.put(None)
        self._inboxes = []


_pool = _Pool()


def _after_fork() -> None:
    """Give a forked child a pool of its own: the threads of its parent's do not exist there."""
    global _pool
    _pool = _Pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class Job:
    """A kernel launch recorded once and replayed over all cores without allocation.

    Args:
        kernel: Warp kernel that follows the rules of this module.
        count: Number of blocks (:func:`blocks`), at most 2³¹ − 1.
        inputs: Kernel arguments after ``first`` (and ``slot``); arrays are kept alive by the job.
        outputs: Further kernel arguments, as in ``wp.launch``.
        device: Warp device; defaults to the current one.
        grain: Fewest blocks worth a chunk of their own: waking a worker costs about 60 µs, a chunk should take longer.
        slots: Most workers that may run it, where an array holds a part for each; default: any number.
    """

    def __init__(
        self, kernel, count: int, inputs, outputs=(), *, device=None, grain: int = 4, slots: int | None = None
    ):
        self.kernel, self.count, self.grain, self._slots = kernel, int(count), max(1, int(grain)), slots
        self.device = wp.get_device(device)
        self._has_slot = len(kernel.adj.args) > 1 and kernel.adj.args[1].label == "slot"
        self._offset = 2 if self._has_slot else 1
        self._arguments = [*inputs, *outputs]
        self._commands: list = []
        self._grow(
            1
        )  # compiles and loads the module on this thread: a worker would pay a precompiled header of its own

    def _grow(self, workers: int) -> None:
        while len(self._commands) < workers:  # a recorded launch is mutable, so each worker has its own
            head = [0, len(self._commands)] if self._has_slot else [0]
            self._commands.append(
                wp.launch(
                    self.kernel,
                    dim=max(1, self.count),
                    inputs=[*head, *self._arguments],
                    device=self.device,
                    record_cmd=True,
                    record_tape=False,
                )
            )

    def set(self, index: int, value) -> None:
        """Set kernel argument ``index``, counted after ``first`` (and ``slot``), for the next :meth:`run`."""
        self._arguments[index] = value
        for command in self._commands:
            command.set_param_at_index(self._offset + index, value)

    def run(self, count: int | None = None) -> None:
        """Launch blocks 0 … ``count`` − 1 (default: the count the job was made with) and wait on the CPU."""
        count = self.count if count is None else int(count)
        if count < 1:
            return
        if not self.device.is_cpu:
            self._commands[0].set_dim(count)
            self._commands[0].launch()
            return
        workers = min(worker_count(), -(-count // self.grain), self._slots or count)
        if workers == 1:
            self._chunk(0, 0, count)
            return
        self._grow(workers)
        size = max(self.grain, -(-count // (workers * _CHUNKS_PER_WORKER)))
        claim = itertools.count(0, size)  # next() on a count is one bytecode: no two workers get the same chunk

        def work(slot):
            while (first := next(claim)) < count:
                self._chunk(slot, first, min(size, count - first))

        _pool.run(work, workers - 1)

    def _chunk(self, slot: int, first: int, size: int) -> None:
        command = self._commands[slot]
        command.set_param_at_index(0, first)
        command.set_dim(size)
        command.launch()


def launch(kernel, count: int, inputs, outputs=(), *, device=None, grain: int = 4) -> None:
    """Run ``kernel`` once over ``count`` blocks on all cores; arguments as for :class:`Job`."""
    if count > 0:
        Job(kernel, count, inputs, outputs, device=device, grain=grain).run()
