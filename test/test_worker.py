"""The process beside a node: pieces as they come, and an end to time and memory."""

import itertools
import os
import signal

import numpy as np
import pytest

from parallel_cal.nodes.worker import OverBudget, Worker, WorkError


@pytest.fixture(scope="module")
def worker():
    worker = Worker(256, __name__)
    yield worker
    worker.end()


def count(n):
    yield from range(n)


def count_for_ever():
    yield from itertools.count()


def raise_one(n):
    yield n
    raise ValueError("it went wrong")


def take_memory(megabytes):
    yield np.ones(megabytes << 17).size


def crash():
    yield 1
    os.kill(os.getpid(), signal.SIGSEGV)


def test_pieces_come_in_order(worker):
    assert list(worker.work(10, count, 5)) == [0, 1, 2, 3, 4]


def test_what_was_done_is_there_when_the_time_is_over(worker):
    done = []
    with pytest.raises(OverBudget):  # noqa: PT012 - the pieces before it are what counts
        for piece in worker.work(0.2, count_for_ever):
            done.append(piece)
    assert done[:3] == [0, 1, 2]
    assert list(worker.work(10, count, 2)) == [0, 1]


@pytest.mark.parametrize(
    ("what", "given", "reason"),
    [
        (raise_one, (1,), "it went wrong"),
        (take_memory, (4000,), "more memory than it may"),
        (crash, (), "crashed"),
    ],
)
def test_what_goes_wrong_there_is_a_sentence_here_and_the_next_work_is_done(
    worker, what, given, reason
):
    with pytest.raises(WorkError, match=reason):
        list(worker.work(10, what, *given))
    assert list(worker.work(10, count, 2)) == [0, 1]


def test_an_ended_worker_says_so():
    worker = Worker(64)
    worker.end()
    with pytest.raises(WorkError, match="the node ends"):
        list(worker.work(10, count, 2))
