"""The dispatcher: every block once, on as many workers as asked for, errors to the caller."""

import os
import signal

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch


@wp.kernel
def count_kernel(first: int, slot: int, hits: wp.array(dtype=wp.int32), slots: wp.array(dtype=wp.int32)):
    b = first + wp.tid()
    hits[b] = hits[b] + 1
    slots[b] = slot


@pytest.fixture
def workers():
    yield dispatch.set_worker_count
    dispatch.set_worker_count(None)


@pytest.mark.parametrize("count", [1, 2, 7, 1000, 4099])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_block_runs_once(workers, count, threads):
    workers(threads)
    hits, slots = wp.zeros(count, dtype=wp.int32, device="cpu"), wp.zeros(count, dtype=wp.int32, device="cpu")
    dispatch.launch(count_kernel, count, inputs=[hits, slots], device="cpu", grain=2)
    assert (hits.numpy() == 1).all()
    assert slots.numpy().min() >= 0
    assert slots.numpy().max() < threads


def test_a_job_is_replayed_with_new_arguments_and_counts(workers):
    workers(3)
    first, second = (wp.zeros(64, dtype=wp.int32, device="cpu") for _ in range(2))
    slots = wp.zeros(64, dtype=wp.int32, device="cpu")
    job = dispatch.Job(count_kernel, 64, inputs=[first, slots], device="cpu", grain=1)
    job.run()
    job.set(0, second)
    job.run(10)
    job.run(0)
    assert (first.numpy() == 1).all()
    assert np.array_equal(second.numpy(), np.arange(64) < 10)


def test_an_error_in_a_worker_reaches_the_caller_and_leaves_the_pool_usable(workers):
    workers(2)

    def work(slot):
        if slot == 1:
            raise RuntimeError("from the worker")

    with pytest.raises(RuntimeError, match="from the worker"):
        dispatch._pool.run(work, 1)
    test_every_block_runs_once(workers, 100, 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_has_a_pool_of_its_own(workers):
    workers(2)
    dispatch._pool.run(lambda slot: None, 1)  # the parent's helper thread exists now
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # a child that waits for its parent's threads would wait for ever
        dispatch._pool.run(lambda slot: None, 1)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_worker_count_is_checked(monkeypatch, workers):
    with pytest.raises(ValueError, match="count must be at least 1"):
        workers(0)
    workers(None)
    monkeypatch.setenv("NEUMAT_THREADS", "3")
    assert dispatch.worker_count() == 3
    monkeypatch.setenv("NEUMAT_THREADS", "many")
    with pytest.raises(ValueError, match="NEUMAT_THREADS must be a whole number"):
        dispatch.worker_count()
