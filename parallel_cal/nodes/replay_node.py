"""Publishes a recording on its topics as the robot and the device did, faster if wanted."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from importlib import import_module
from itertools import chain
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from parallel_cal.bag import RawMessage, list_topics, raw_messages
from parallel_cal.errors import BagError, ParallelCalError
from parallel_cal.nodes.parameters import declare

PARAMETERS: dict[str, tuple[Any, str]] = {
    "bag": ("", "recording to publish: a bag directory, .mcap or .db3"),
    "rate": (1.0, "how many times faster than it was recorded"),
    "patience": (15.0, "s to wait for a first subscription before publishing all the same"),
}
STEADY = 1.0  # s without a new subscription: all that will listen have been found
SAID_ONCE = 10  # messages: a topic with fewer is kept for late subscribers, as if latched
NANO = 1e9


class ReplayNode(Node):
    """Reads ahead by nothing and drops nothing: a slow subscriber slows the replay down."""

    def __init__(self) -> None:
        super().__init__("replay_node")
        declare(self, PARAMETERS)
        self.bag, self.rate = self._value("bag"), float(self._value("rate"))
        if not self.rate > 0:
            raise ParallelCalError(f"rate {self.rate}: expected a positive number")
        if not self.bag:
            raise ParallelCalError("no bag given: set the parameter bag")
        topics, self.duration = list_topics(self.bag)
        self.count = sum(topic.count for topic in topics)
        self._senders = {t.name: self._sender(t.name, t.type, t.count) for t in topics}

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _sender(self, topic: str, type: str, count: int) -> Any:
        """Names are relative, so that a namespace and remapping work as with any node."""
        package, _, name = type.split("/")
        try:
            message = getattr(import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError):
            raise BagError(
                f"{self.bag}: {topic} has the type {type}, which is not installed here"
            ) from None
        return self.create_publisher(message, topic.lstrip("/"), _keep_all(count <= SAID_ONCE))

    def wait_for_subscribers(self, wait: Callable[[float], None]) -> bool:
        """Until somebody listens and nobody new has come for a second; False if nobody came."""
        begin = steady = time.monotonic()
        before = 0
        while time.monotonic() - begin < self._value("patience"):
            matched = sum(s.get_subscription_count() for s in self._senders.values())
            if matched != before:
                before, steady = matched, time.monotonic()
            if before and time.monotonic() - steady > STEADY:
                return True
            wait(0.05)
        return before > 0

    def play(self, wait: Callable[[float], None], show: Callable[[int], None]) -> int:
        """Publish every message at its time divided by the rate; how many were published."""
        messages = raw_messages(self.bag)
        first = next(messages)
        begin, sent = time.monotonic(), 0
        for message in chain([first], messages):
            due = begin + (message.time - first.time) / NANO / self.rate
            ahead = due - time.monotonic()
            if ahead > 1e-3:  # shorter waits cost more than they last
                show(sent)
                wait(ahead)
            self._send(message)
            sent += 1
        show(sent)
        return sent

    def _send(self, message: RawMessage) -> None:
        self._senders[message.topic].publish(message.data)

    def wait_until_received(self, seconds: float = 60.0) -> bool:
        """True when every subscriber has acknowledged every message."""
        limit = Duration(seconds=seconds)
        return all(sender.wait_for_all_acked(limit) for sender in self._senders.values())


def _keep_all(latched: bool) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


def _wait(seconds: float) -> None:
    """Sleep, but wake for a shutdown."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        if not rclpy.ok():
            raise ExternalShutdownException
        time.sleep(min(left, 0.1))


def _played(node: ReplayNode) -> int:
    """Wait, publish, wait again; the exit status."""
    from parallel_cal import console

    log = node.get_logger()
    if not node.wait_for_subscribers(_wait):
        log.warning("nobody listens; publishing all the same")
    sent = node.play(_wait, lambda n: console.progress("replay", n / node.count))
    if not node.wait_until_received():
        log.error("a subscriber has not acknowledged every message")
        return 1
    log.info(f"{sent} messages of {node.duration:.0f} s published at {node.rate:g} times the speed")
    return 0


def main(args: list[str] | None = None) -> None:
    """`replay_node --ros-args -p bag:=DIR -p rate:=20.0`; exit status 0 when all was received."""
    rclpy.init(args=args)
    node = None
    try:
        node = ReplayNode()
        status = _played(node)
    except ParallelCalError as error:
        sys.stderr.write(f"error: {error}\n")
        status = 1
    except (ExternalShutdownException, KeyboardInterrupt):
        status = 0  # ended from outside
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)
