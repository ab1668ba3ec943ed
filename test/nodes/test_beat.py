"""Periodic calls in a thread of their own: what the executor beside them notices."""

import time
from itertools import count

import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from test_pump import CountingExecutor  # noqa: E402
from waits import wait_until  # noqa: E402

from parallel_cal.nodes.beat import Beat  # noqa: E402
from parallel_cal.nodes.client import use_private_domain  # noqa: E402

NODES = count()


@pytest.fixture
def node():
    context, namespace = rclpy.Context(), f"{use_private_domain()}_{next(NODES)}"
    rclpy.init(context=context)
    node = rclpy.create_node("beating", namespace=namespace, context=context)
    node.create_timer(3600.0, lambda: None)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_an_executor_sleeps_while_a_beat_goes_on_and_none_comes_before_it_or_after_the_end(node):
    executor, calls = CountingExecutor(context=node.context), []
    beat = Beat(node, 0.001, lambda: calls.append(time.monotonic()))
    time.sleep(0.05)
    assert calls == []  # the node does not spin yet
    executor.add_node(node)
    wait_until(lambda: len(calls) > 100, "a hundred calls")
    executor.spin_once(timeout_sec=0.01)
    beat.end()
    reached = len(calls)
    time.sleep(0.02)
    assert len(calls) == reached
    assert executor.looks <= 10


def test_an_error_of_a_call_ends_the_node_as_one_of_a_callback_does(node):
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)

    def fail():
        raise ZeroDivisionError("a fault of the call")

    beat = Beat(node, 0.001, fail)

    def spin():
        while True:
            executor.spin_once(timeout_sec=60)

    with pytest.raises(ZeroDivisionError, match="a fault of the call"):
        spin()
    beat.end()


def test_a_beat_ends_before_its_node_spins(node):
    Beat(node, 0.001, lambda: None).end()
