"""Starting, spinning and ending a node; requests are never kept waiting by slow work."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any, TypeVar

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node
from rclpy.task import Task

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.base.threads import single_threaded

T = TypeVar("T")

PROMPT = 0.05  # s between two looks at whether a thread that waits is still wanted
SHUTDOWN_TIMEOUT_S = 0.8  # s from a signal to the end, whatever is still at work
SWITCH_INTERVAL_S = 5e-4  # s that a thread beside may keep the interpreter from the one that spins


class WorkerThreadGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that run one after the other in a thread beside the one that spins."""


class FrontExecutor(SingleThreadedExecutor):
    """Runs callbacks in the thread that spins, those of a node's default group and of every
    `Beside` in others.

    What must answer at once gets a callback group of its own; parameters, reloads and
    diagnostics stay in the default group. A MultiThreadedExecutor would hand over every single
    message to another thread, which costs a sixth of its time.
    """

    def __init__(self, **options: Any):
        super().__init__(**options)
        # One for each group that works at once; the last lets callbacks that must wait their turn
        # go back to the wait set.
        self._worker = ThreadPoolExecutor(4, thread_name_prefix="beside")
        self._handed_over: list[Task] = []

    def _spin_once_impl(
        self, timeout_sec: Any = None, wait_condition: Callable[[], bool] = lambda: False
    ) -> None:
        try:
            ready = self.wait_for_ready_callbacks(timeout_sec, None, wait_condition)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return
        handler, entity, node = ready
        group = entity and entity.callback_group
        if isinstance(group, WorkerThreadGroup) or (
            entity and group is node.default_callback_group
        ):
            self._hand_over(handler)
        else:
            handler()
            handler.result()

    def _hand_over(self, handler: Task) -> None:
        done = [task for task in self._handed_over if task.done()]
        self._handed_over = [t for t in self._handed_over if t not in done] + [handler]
        self._worker.submit(handler)
        for task in done:
            task.result()

    def finish(self) -> None:
        """Wait for slow work that has begun; what it raises no longer matters."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        for task in self._handed_over:
            task.exception()
        self.shutdown()


def run_in_spin_thread(
    node: Node,
    function: Callable[..., T],
    *args: Any,
    meanwhile: Callable[[], None] = lambda: None,
) -> T:
    """What a function gives or raises in the thread that spins, called from the second one, which
    calls `meanwhile` again and again while it waits: what that raises ends the waiting.

    ExternalShutdownException where that thread has ended.
    """
    answer: Future[T] = Future()

    def call() -> None:  # raising there would end the node
        try:
            answer.set_result(function(*args))
        except Exception as error:
            answer.set_exception(error)

    node.executor.create_task(call)
    while not wait([answer], timeout=PROMPT).done:
        if not node.context.ok():
            raise ExternalShutdownException
        meanwhile()
    return answer.result()


def create_steady_timer(
    seconds: float, node: Node, call: Callable[[], None], group: Any = None
) -> None:
    """Call again and again, also while a simulated clock stands still."""
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(seconds, call, callback_group=group, clock=clock)


def foreign_publishers(node: Node) -> list[str]:
    """What is published with another type than the node expects: it never arrives, and no one
    says so."""
    found = {
        (listening.topic_name, publisher.topic_type, type_name(listening.msg_type))
        for listening in node.subscriptions
        for publisher in node.get_publishers_info_by_topic(listening.topic_name)
    }
    return [
        KeyedWarning(f"{t} is published as {is_}, expected {be}", "foreign type", f"{t} {is_}")
        for t, is_, be in sorted(found)
        if is_ != be
    ]


def rival_publishers(node: Node, topics: Iterable[str]) -> list[str]:
    """Topics that more than one node publishes on: nobody can say whose numbers are right."""
    told = list[str]()
    for topic in map(node.resolve_topic_name, topics):
        found = node.get_publishers_info_by_topic(topic)
        names = ", ".join(sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in found))
        if len(found) > 1:
            words = f"{topic} has {len(found)} publishers: {names}"
            told.append(KeyedWarning(words, "several publishers", f"{topic} {names}"))
    return told


def type_name(message: type) -> str:
    return f"{message.__module__.split('.')[0]}/msg/{message.__name__}"


@contextmanager
def ros_context(args: list[str] | None = None) -> Iterator[Callable[[], bool]]:
    """ROS from start to end; yields a function that says whether to go on.

    SIGINT and SIGTERM end spinning through rclpy's own handler; Python's would raise
    KeyboardInterrupt in the middle of any callback.
    """
    asked: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    rclpy.init(args=args)
    try:
        yield lambda: bool(rclpy.ok() and not asked)
    finally:
        rclpy.try_shutdown()


@single_threaded()
def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT or SIGTERM ends it; its exit status."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with ros_context(args) as go_on:
        executor, node, ended = FrontExecutor(), None, Event()
        Thread(target=_insist, args=(ended,), daemon=True).start()
        try:
            node = make_node()
            executor.add_node(node)
            gc.freeze()  # what is there now stays: looking through it would take 12 ms and more
            while go_on():
                executor.spin_once()
        except ExternalShutdownException:
            pass
        except ParallelCalError as error:
            sys.stderr.write(f"error: {error}\n")
            return 1
        except Exception:
            if rclpy.ok():  # else it is what a callback meets while the ground is taken away
                raise
        finally:
            if node is not None and hasattr(node, "end_work"):
                node.end_work()
            executor.finish()
            if node is not None:
                node.destroy_node()
            ended.set()
    return 0


def _insist(ended: Event) -> None:
    """End the process where a callback that has begun does not end with ROS."""
    while rclpy.ok():
        if ended.wait(0.1):
            return
    if not ended.wait(SHUTDOWN_TIMEOUT_S):
        sys.stderr.flush()
        os._exit(0)
