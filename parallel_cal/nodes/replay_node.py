"""Publishes a recording on its topics as the robot and the device did, faster if wanted."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from std_srvs.srv import SetBool

from parallel_cal.base.errors import BagError, ParallelCalError
from parallel_cal.nodes.conversions import message_class
from parallel_cal.nodes.parameters import Setting, declare
from parallel_cal.nodes.run import ros_context
from parallel_cal.recordings.bag import list_topics, raw_messages
from parallel_cal.recordings.mcap_files import ROS_2
from parallel_cal.recordings.recording import TopicInfo

PARAMETERS = {
    "bag": Setting("", "recording to publish: a bag directory, .mcap or .db3"),
    "rate": Setting(1.0, "speed as a multiple of the recorded speed"),
    "topics": Setting("", "topics to publish, separated by commas; empty = all"),
    "loop": Setting(False, "start again at the end"),
    "start_paused": Setting(
        False, "stay paused until the service ~/pause is called with data: false"
    ),
    "wait_for_subscribers": Setting(
        -1, "subscriptions to wait for; -1 = wait for one, but publish without it"
    ),
    "patience": Setting(15.0, "maximum time to wait for subscriptions, s"),
    "ack_patience": Setting(60.0, "maximum time to wait at the end for acknowledgements, s"),
}
MAX_LATCHED_MESSAGES = 10  # a topic with so few messages is latched for late subscribers
DEPTH = 20_000  # unacknowledged messages of a topic at which replay waits for the slowest reader
# s without a new subscription after which all subscribers count as found. A participant announces
# itself every 3 s: one whose first announcement was lost on a busy computer is found only then.
STEADY = 4.0
POLL_INTERVAL_S = 0.05  # s between two checks of whether to go on


class ReplayNode(Node):
    """Publishes every message: late ones at once, and it waits for slow subscribers."""

    def __init__(self, go_on: Callable[[], bool], **overrides: Any):
        given = [Parameter(name, value=value) for name, value in overrides.items()]
        super().__init__("replay_node", parameter_overrides=given)
        declare(self, PARAMETERS)
        self.bag, self.rate = self._value("bag"), float(self._value("rate"))
        if not self.bag:
            raise ParallelCalError("no bag given: set the parameter bag")
        if not self.rate > 0:
            raise ParallelCalError(f"rate {self.rate}: expected a positive number")
        found, self.duration = list_topics(self.bag)
        topics = tuple(topic for topic in found if topic.encoding == ROS_2)
        chosen = _select_topics(self.bag, topics, self._value("topics"))
        self.count, self.sent = sum(topic.count for topic in chosen), 0
        self._senders = {topic.name: self._make_publisher(topic) for topic in chosen}
        self._unacknowledged = dict.fromkeys(self._senders, 0)
        self._go_on, self._running = go_on, Event()
        (self._running.clear if self._value("start_paused") else self._running.set)()
        self.create_service(SetBool, "~/pause", self._pause)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _make_publisher(self, topic: TopicInfo) -> Any:
        """Use a relative name, so that namespaces and remapping work as with any node."""
        try:
            message = message_class(topic.type)
        except (ImportError, AttributeError):
            raise BagError(
                f"{self.bag}: {topic.name} has the type {topic.type}, which is not installed here; "
                "name the topics to publish"
            ) from None
        latched = topic.count <= MAX_LATCHED_MESSAGES
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=MAX_LATCHED_MESSAGES if latched else DEPTH, durability=durability)
        return self.create_publisher(message, topic.name.lstrip("/"), qos)

    def _pause(self, request: Any, response: Any) -> Any:
        (self._running.clear if request.data else self._running.set)()
        response.success, response.message = True, "paused" if request.data else "running"
        return response

    # ------------------------------------------------------------------ playing

    def play(self) -> int:
        """Wait for subscribers, publish, wait until they received it all; return the status."""
        self._wait_for_subscribers()
        self._play_once()
        while self._value("loop") and self._go_on():
            self._play_once()
        if not self._go_on():
            _say(f"ended after {self.sent} messages; the bag holds {self.count}")
            return 0
        limit = self._ack_patience()
        senders = self._senders.items()
        missing = [name for name, sender in senders if not sender.wait_for_all_acked(limit)]
        if missing:
            _say(f"a subscriber has not acknowledged every message on {', '.join(missing)}")
            return 1
        _say(
            f"{self.sent} messages published and received, at {self.rate:g} times the recorded "
            "speed"
        )
        return 0

    def _play_once(self) -> None:
        """Publish every message at its time divided by the rate; stamps stay as recorded."""
        begin, first, reported = time.monotonic(), None, time.monotonic()
        for message in raw_messages(self.bag):
            if message.topic not in self._senders:
                continue
            first = message.time if first is None else first
            pause = time.monotonic()
            while not self._running.is_set() and self._go_on():
                self._running.wait(POLL_INTERVAL_S)
            begin += time.monotonic() - pause
            since = (message.time - first) * 1e-9
            if not self._sleep_until(begin + since / self.rate):
                return
            sender = self._senders[message.topic]
            if self._unacknowledged[message.topic] >= DEPTH - 1:
                sender.wait_for_all_acked(self._ack_patience())
                self._unacknowledged[message.topic] = 0
            sender.publish(message.data)
            self._unacknowledged[message.topic] += 1
            self.sent += 1
            if time.monotonic() - reported > 1.0:
                reported = time.monotonic()
                late = reported - begin - since / self.rate
                behind = f", {late:.1f} s behind" if late > 0.5 else ""
                _say(f"{since:.1f} of {self.duration:.1f} s, {self.sent} messages{behind}")

    def _sleep_until(self, due: float) -> bool:
        """Return whether to go on at that time; immediately if it has passed."""
        while (remaining := due - time.monotonic()) > 0:
            time.sleep(min(remaining, POLL_INTERVAL_S))
            if not self._go_on():
                return False
        return self._go_on()

    def _ack_patience(self) -> Duration:
        return Duration(seconds=self._value("ack_patience"))

    # ------------------------------------------------------------------ waiting

    def _wait_for_subscribers(self) -> None:
        """Wait until enough subscribe and no new ones appear: earlier messages would be lost."""
        wanted = self._value("wait_for_subscribers")
        if wanted == 0:
            return
        begin = steady = time.monotonic()
        before = 0
        while self._go_on() and time.monotonic() - begin < self._value("patience"):
            matched = sum(s.get_subscription_count() for s in self._senders.values())
            if matched != before:
                before, steady = matched, time.monotonic()
            if before >= max(wanted, 1) and time.monotonic() - steady > STEADY:
                return
            time.sleep(POLL_INTERVAL_S)
        if before < wanted and self._go_on():
            names = ", ".join(self._senders)
            raise ParallelCalError(f"{before} subscriptions to {names}; expected {wanted}")
        if not before:
            _say("no subscribers; the recording is published all the same")


def _select_topics(bag: str, topics: Sequence[TopicInfo], names: str) -> list[TopicInfo]:
    """Return the topics with these names, with or without slash; all for an empty text."""
    wanted = {name.strip().strip("/") for name in names.split(",") if name.strip()}
    unknown = wanted - {topic.name.strip("/") for topic in topics}
    if unknown:
        have = ", ".join(topic.name for topic in topics)
        raise BagError(f"{bag}: no topic {', '.join(sorted(unknown))}; there are {have}")
    return [topic for topic in topics if not wanted or topic.name.strip("/") in wanted]


def _say(text: str) -> None:
    sys.stderr.write(f"replay: {text}\n")
    sys.stderr.flush()


@contextmanager
def _spin_in_thread(node: Node) -> Iterator[None]:
    """Answer services in a second thread while this one publishes."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    thread = Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield
    finally:
        executor.shutdown()
        thread.join(5.0)


def replay(bag: str | Path = "", args: list[str] | None = None, **options: Any) -> int:
    """Publish a recording with options as in PARAMETERS; return 0 if all of it was received."""
    overrides = options | ({"bag": str(bag)} if str(bag) else {})
    with ros_context(args) as go_on:
        try:
            node = ReplayNode(go_on, **overrides)
            with _spin_in_thread(node):
                return node.play()
        except ParallelCalError as error:
            sys.stderr.write(f"error: {error}\n")
            return 1


def main(args: list[str] | None = None) -> None:
    """`replay_node BAG --rate 20` or `--ros-args -p bag:=BAG`; status 0 if all was received."""
    args = sys.argv if args is None else args
    # Every parameter is an option; one that is not given keeps the value of the parameter.
    parser = argparse.ArgumentParser(prog="replay_node", description=__doc__)
    for name, (default, what, *_) in PARAMETERS.items():
        flag = f"--{name.replace('_', '-')}"
        if name == "bag":
            parser.add_argument(name, nargs="?", help=what)
        elif isinstance(default, bool):
            parser.add_argument(flag, action="store_const", const=True, help=what)
        else:
            parser.add_argument(flag, type=type(default), help=f"{what} (now {default})")
    given = vars(parser.parse_args(remove_ros_args(args)[1:]))
    sys.exit(replay(args=args, **{k: v for k, v in given.items() if v is not None}))
