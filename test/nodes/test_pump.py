"""A subscription with a thread of its own: what the executor beside it notices of a stream."""

import threading
import time
from itertools import count
from threading import Event

import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")

from rcl_interfaces.msg import Log  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from parallel_cal.nodes.client import use_private_domain  # noqa: E402
from parallel_cal.nodes.pump import Pump  # noqa: E402

NODES = count()
QOS = QoSProfile(depth=1000)
TOLD_BEFORE = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class CountingExecutor(SingleThreadedExecutor):
    """Counts how often it looked at a timer: once for each wait set it built."""

    looks = 0

    def can_execute(self, entity):
        self.looks += isinstance(entity, rclpy.timer.Timer)
        return super().can_execute(entity)


@pytest.fixture
def node():
    # A namespace of its own: the middleware may still list what an earlier test subscribed to.
    context, namespace = rclpy.Context(), f"{use_private_domain()}_{next(NODES)}"
    rclpy.init(context=context)
    node = rclpy.create_node("listener", namespace=namespace, context=context)
    node.create_timer(3600.0, lambda: None)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def wait_until(executor, ready):
    end = time.monotonic() + 30
    while not ready():
        assert time.monotonic() < end
        executor.spin_once(timeout_sec=0.02)


def test_an_executor_sleeps_while_messages_come_in_beside_it(node):
    """500 messages, which it would otherwise wake and look through its entities for."""
    executor, taken = CountingExecutor(context=node.context), []
    executor.add_node(node)
    pump = Pump(node, JointState, "joint_states", QOS, taken.extend)
    publisher = node.create_publisher(JointState, "joint_states", QOS)
    wait_until(executor, lambda: publisher.get_subscription_count() == 1)
    for _ in range(5):  # what discovery wakes it for
        executor.spin_once(timeout_sec=0.02)
    before = executor.looks
    spun = 0
    while len(taken) < 500 and spun < 3000:
        publisher.publish(JointState(name=["joint1"], position=[0.5]))
        executor.spin_once(timeout_sec=0.002)  # returns when it is over, or when it was woken
        spun += 1
    pump.end()
    assert [info["publication_sequence_number"] for _, info in taken[:3]] == [1, 2, 3]
    assert executor.looks - before <= 1.5 * spun


def test_a_publisher_of_an_incompatible_quality_of_service_is_reported(node):
    """Heard on /rosout: what is printed may be cut away by a test that reads it meanwhile."""
    executor, told = SingleThreadedExecutor(context=node.context), []
    executor.add_node(node)
    node.create_subscription(Log, "/rosout", lambda log: told.append(log.msg), TOLD_BEFORE)
    pump = Pump(node, JointState, "joint_states", QOS, lambda messages: None)
    little = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_publisher(JointState, "joint_states", little)
    wait_until(executor, lambda: any("No messages will be received" in one for one in told))
    pump.end()
    assert any("RELIABILITY" in one for one in told)


def test_what_came_in_counts_as_read_only_once_it_was_handed_over(node):
    """Whoever waits for a message may conclude from `read_until` that none is on its way."""
    executor, taken, handing, go_on = SingleThreadedExecutor(context=node.context), [], [], Event()
    executor.add_node(node)

    def take(messages):
        handing.append(time.monotonic())
        assert go_on.wait(30)
        taken.extend(messages)

    pump = Pump(node, JointState, "joint_states", QOS, take)
    publisher = node.create_publisher(JointState, "joint_states", QOS)
    wait_until(executor, lambda: publisher.get_subscription_count() == 1)
    begin = time.monotonic()
    wait_until(executor, lambda: pump.read_until > begin)  # also while nothing comes
    publisher.publish(JointState(name=["joint1"], position=[0.5]))
    wait_until(executor, lambda: handing)
    before = pump.read_until
    time.sleep(0.3)
    assert pump.read_until == before < handing[0]
    assert not taken
    go_on.set()
    wait_until(executor, lambda: pump.read_until > handing[0])
    pump.end()
    assert len(taken) == 1


def test_a_process_that_ends_while_a_pump_starts_gets_no_traceback(node, monkeypatch):
    """As after Ctrl-C while a node is made; any other error is still raised."""
    uncaught, make = [], rclpy_implementation.WaitSet
    monkeypatch.setattr(threading, "excepthook", lambda error: uncaught.append(error.exc_type))

    def after_the_end(*arguments):
        rclpy.try_shutdown(context=node.context)
        return make(*arguments)

    monkeypatch.setattr(rclpy_implementation, "WaitSet", after_the_end)
    Pump(node, JointState, "joint_states", QOS, print).end()
    assert uncaught == []


def test_an_error_of_a_pump_in_a_process_that_goes_on_is_raised(node, monkeypatch):
    uncaught = []
    monkeypatch.setattr(threading, "excepthook", lambda error: uncaught.append(error.exc_type))
    monkeypatch.setattr(rclpy_implementation, "WaitSet", fail)
    Pump(node, JointState, "joint_states", QOS, print).end()
    assert uncaught == [rclpy_implementation.RCLError]


def fail(*arguments):
    raise rclpy_implementation.RCLError("no wait set")
