"""A periodic call in a thread of its own, a hundred times a second.

For each call of a timer, an executor rebuilds its wait set twice with all entities of its node,
which takes longer than the work of the call.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event, Thread

from rclpy.node import Node

START_INTERVAL_S = 0.01  # s between two checks of whether the node spins


class Beat:
    """Calls a function every `period` seconds once the node spins; late calls are not made up for.

    An exception ends the node, as one of a callback does, unless ROS is shutting down.
    """

    def __init__(self, node: Node, period: float, call: Callable[[], None]):
        self._node, self._period, self._call = node, period, call
        self._ended = Event()
        # No daemon: a thread that the end of the interpreter finds in the middleware would abort
        # the process.
        self._thread = Thread(target=self._run, name="beat")
        self._thread.start()

    def end(self) -> None:
        """Call no more; do this before the node is destroyed."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while self._node.executor is None:
            if self._ended.wait(START_INTERVAL_S):
                return
        due = time.monotonic()
        while self._node.context.ok():
            try:
                self._call()
            except Exception as error:
                if self._node.context.ok():
                    self._node.executor.create_task(_raise, error)
                return
            due = max(due + self._period, time.monotonic())
            if self._ended.wait(due - time.monotonic()):
                return


def _raise(error: Exception) -> None:
    raise error
