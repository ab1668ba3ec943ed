"""The process beside: what it tells as it comes, and an end to time, memory and patience."""

import itertools
import os
import signal
import time

import numpy as np
import pytest

from parallel_cal.base.worker import TimeBudgetExceeded, WorkCancelled, Worker, WorkError


def nothing():
    """Done first, so that what this file imports is no part of the work's memory."""


@pytest.fixture(scope="module")
def worker():
    worker = Worker(256, nothing)
    yield worker
    worker.end()


def count(n, tell):
    for i in range(n):
        tell(i)
    return n


def count_for_ever(tell):
    for i in itertools.count():
        tell(i)


def raise_one(n):
    raise ValueError("it went wrong")


def take_memory(megabytes):
    return np.ones(megabytes << 17).size


def crash():
    os.kill(os.getpid(), signal.SIGSEGV)


def never_return():
    while True:
        time.sleep(3600)


def told(worker, n):
    told = []
    assert worker.work(count, n, seconds=10, tell=told.append) == n
    return told


def test_progress_comes_in_order_and_then_the_result(worker):
    assert told(worker, 5) == [0, 1, 2, 3, 4]


def test_the_last_progress_is_available_after_a_timeout(worker):
    done = []
    with pytest.raises(TimeBudgetExceeded):
        worker.work(count_for_ever, seconds=0.2, tell=done.append)
    assert done[:3] == [0, 1, 2]
    assert told(worker, 2) == [0, 1]


@pytest.mark.parametrize(
    ("what", "given", "reason"),
    [
        (raise_one, (1,), "it went wrong"),
        (take_memory, (4000,), "more memory than its limit"),
        (crash, (), "crashed"),
    ],
)
def test_an_error_in_the_worker_is_reported_and_the_worker_goes_on(worker, what, given, reason):
    with pytest.raises(WorkError, match=reason):
        worker.work(what, *given, seconds=10)
    assert told(worker, 2) == [0, 1]


def test_abandoned_work_is_ended_though_it_would_never_return(worker):
    asked = iter([True, True, False])
    with pytest.raises(WorkCancelled):
        worker.work(never_return, wanted=lambda: next(asked))
    assert told(worker, 2) == [0, 1]


def test_an_ended_worker_says_so():
    worker = Worker(64)
    worker.end()
    with pytest.raises(WorkError, match="the node is shutting down"):
        worker.work(nothing)


def test_a_process_that_starts_late_is_reported_and_does_the_next_work(monkeypatch):
    from parallel_cal.base import worker as module

    late = Worker(first=nothing)
    try:
        with monkeypatch.context() as busy:
            busy.setattr(module, "STARTUP_TIMEOUT_S", 0.0)
            with pytest.raises(WorkError, match="did not start within 0 s: the computer is busy"):
                late.work(count, 3, tell=lambda i: None)
        assert told(late, 3) == [0, 1, 2]
        assert late.ended_early == 0  # the process that started late did the work
    finally:
        late.end()
