"""How far a device's messages are read and processed, in constant time."""

import time

import pytest

from parallel_cal.nodes.inflow import Inflow


class Reader:
    def __init__(self, read_until):
        self.read_until = read_until


def test_measurements_are_unprocessed_until_samples_are_made_of_them():
    inflow = Inflow()
    for _ in range(3):
        inflow.receive("measured_pose", time.time_ns())
    inflow.receive("distance", time.time_ns())
    inflow.process("measured_pose")
    assert inflow.unprocessed == 3


def test_a_measurement_that_is_read_late_came_in_when_it_was_received():
    inflow = Inflow()
    assert inflow.latest is None
    now = time.monotonic()
    inflow.receive("measured_pose", time.time_ns() - 5_000_000_000)
    assert inflow.latest == pytest.approx(now - 5.0, abs=1.0)
    inflow.receive("distance", time.time_ns())
    assert inflow.latest == pytest.approx(now, abs=1.0)


def test_all_is_read_up_to_where_the_slowest_reader_has_come():
    inflow = Inflow()
    inflow.add_reader(Reader(10.0))
    inflow.add_reader(Reader(4.0))
    assert inflow.has_read_until(4.0)
    assert not inflow.has_read_until(5.0)
