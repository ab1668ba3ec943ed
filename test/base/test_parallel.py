"""Parts of a computation run on all cores, in order, and end when their caller ends."""

import threading
import time

import pytest

from parallel_cal.base import parallel


def add(shared, item):
    return shared + item


@pytest.mark.parametrize("cores", [1, 2, 7])
def test_results_come_in_the_order_of_the_parts_whatever_the_number_of_cores(monkeypatch, cores):
    monkeypatch.setenv("OMP_NUM_THREADS", str(cores))
    assert list(parallel.run_on_cores(add, 100, range(50))) == list(range(100, 150))


def test_parts_run_at_the_same_time_on_several_cores(monkeypatch):
    """Each part waits for the other: one after the other they would never end."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    meeting = threading.Barrier(2, timeout=30)

    def meet(_, number):
        meeting.wait()
        return number

    assert list(parallel.run_on_cores(meet, None, range(4))) == [0, 1, 2, 3]


@pytest.mark.parametrize("cores", [1, 2])
def test_an_error_of_the_caller_ends_the_work_and_one_of_a_part_reaches_the_caller(
    monkeypatch, cores
):
    monkeypatch.setenv("OMP_NUM_THREADS", str(cores))
    begun = []

    def work(_, number):
        begun.append(number)
        time.sleep(0.001)
        if number == 900:
            raise ValueError("the part failed")

    def stop_after_the_first():
        with parallel.running(parallel.run_on_cores, work, None, range(1000)) as results:
            next(iter(results))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop_after_the_first()
    assert len(begun) < 20
    with pytest.raises(ValueError, match="the part failed"):
        list(parallel.run_on_cores(work, None, range(890, 1000)))
    assert 900 in begun
    assert 999 not in begun


def answer(shared, item):
    """None where there is nothing to answer, and as late as the item is small."""
    time.sleep(0.01 * (5 - item))
    return None if item == 2 else shared + item


@pytest.mark.wide
def test_a_cluster_answers_in_the_order_of_the_parts_and_says_what_a_worker_cannot_do():
    pytest.importorskip("distributed")
    from parallel_cal.fleet.cluster import cluster, run_on_cluster
    from parallel_cal.fleet.jobs import FleetError

    with cluster(None, 2) as client:
        run = run_on_cluster(client)
        assert list(run(answer, 100, range(5))) == [100, 101, None, 103, 104]
        with pytest.raises(FleetError, match="TypeError"):
            list(run(answer, "no number", range(5)))
