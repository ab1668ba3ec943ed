"""A subscription with its own thread and wait set, for a stream of 1000 messages per second.

For each message, an executor rebuilds its wait set with all entities of its node, which takes half
a millisecond of Python. The wait set here contains one subscription, and all its waiting messages
are taken at once. It also contains the events of the subscription: in the executor's wait set they
would wake the executor at every message.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from threading import Thread
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

POLL_INTERVAL_NS = 100_000_000  # ns between two checks whether the node ends

Messages = list[tuple[Any, dict[str, int]]]


class UnexecutedGroup(CallbackGroup):
    """A group whose callbacks no executor calls."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return


class Pump:
    """Calls `take` with all waiting messages, in the order in which they arrived."""

    def __init__(
        self,
        node: Node,
        type: Any,
        topic: str,
        qos: QoSProfile,
        take: Callable[[Messages], None],
        **options: Any,
    ):
        self._node, self.take, self._ended = node, take, False
        # Time of time.monotonic(): every message that arrived before it was taken.
        self.read_until = -math.inf
        self._subscription = node.create_subscription(
            type, topic, lambda message: None, qos, callback_group=UnexecutedGroup(), **options
        )
        self._max_messages = qos.depth
        # No daemon: the interpreter waits for it, also where the making of the node was
        # interrupted. A thread that its end finds in the middleware would abort the process.
        self._thread = Thread(target=self._run, name=topic)
        self._thread.start()

    def end(self) -> None:
        """Take no more messages; call this before the node is destroyed."""
        self._ended = True
        self._thread.join()

    def destroy(self) -> None:
        """End, and remove the subscription from the node."""
        self.end()
        self._node.destroy_subscription(self._subscription)

    @property
    def topic(self) -> str:
        """The full name of the topic."""
        return str(self._subscription.topic_name)

    @property
    def type(self) -> Any:
        """The class of the messages."""
        return self._subscription.msg_type

    @property
    def is_reliable(self) -> bool:
        """Whether the subscription receives from reliable publishers only."""
        return bool(self._subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE)

    def _run(self) -> None:
        try:
            self._pump()
        except rclpy_implementation.RCLError:
            if self._node.context.ok():
                raise  # else the process ends, which nobody tells this thread beforehand

    def _pump(self) -> None:
        handle, type = self._subscription.handle, self._subscription.msg_type
        events, context = self._subscription.event_handlers, self._node.context
        with context.handle:
            waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, len(events), context.handle)
        while not self._ended and context.ok():
            messages: Messages = []
            with handle:
                waiting.clear_entities()
                waiting.add_subscription(handle)
                for event in events:
                    event.add_to_wait_set(waiting)
                waiting.wait(POLL_INTERVAL_NS)
                empty = self.read_until
                while len(messages) <= self._max_messages:
                    asked = time.monotonic()
                    one = handle.take_message(type, False)
                    if one is None:
                        empty = asked
                        break
                    messages.append(one)
            for event in events:
                if event.is_ready(waiting):
                    event.callback(event.take_data())
            if messages:
                self.take(messages)
            self.read_until = empty
