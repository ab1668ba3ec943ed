"""A subscription with a thread and a wait set of its own, for a stream of 1000 a second.

An executor builds its wait set anew, with every entity of its node, for each message: half a
millisecond of Python. This one holds one subscription, and takes all that waits in it at once. Its
events are waited for here, too: in an executor's wait set they wake it at every message.
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
from rclpy.qos import QoSProfile

POLL_INTERVAL_NS = 100_000_000  # ns between two looks at whether the node ends

Messages = list[tuple[Any, dict[str, int]]]


class UnexecutedGroup(CallbackGroup):
    """No executor calls what is in this group."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        return


class Pump:
    """Calls `take` with all messages that wait, in the order in which they came."""

    def __init__(
        self,
        node: Node,
        type: Any,
        topic: str,
        qos: QoSProfile,
        take: Callable[[Messages], None],
        **options: Any,
    ):
        self._node, self._take, self._ended = node, take, False
        self.read_until = -math.inf  # time.monotonic(); what came in before it has been taken
        self._subscription = node.create_subscription(
            type, topic, lambda message: None, qos, callback_group=UnexecutedGroup(), **options
        )
        self._most = qos.depth
        self._thread = Thread(target=self._run, name=topic, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Take no more; call it before the node is destroyed."""
        self._ended = True
        self._thread.join()

    def _run(self) -> None:
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
                while len(messages) <= self._most:
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
                self._take(messages)
            self.read_until = empty
