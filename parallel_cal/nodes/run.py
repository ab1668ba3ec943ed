"""Start, spin and end a node; slow work never delays requests."""

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

POLL_INTERVAL_S = 0.05  # s between two checks of whether a waiting thread should go on waiting
SHUTDOWN_TIMEOUT_S = 0.8  # s from a signal to the end of the process, whatever still runs
SWITCH_INTERVAL_S = 5e-4  # s for which another thread may block the one that spins


class WorkerThreadGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that run one after the other in a worker thread, not in the one that spins."""


class FrontExecutor(SingleThreadedExecutor):
    """Runs fast callbacks in the thread that spins and slow ones in worker threads.

    Slow are the callbacks of a node's default group, such as parameters, reloads and diagnostics,
    and those of every WorkerThreadGroup. What must answer at once gets another callback group. A
    MultiThreadedExecutor would pass every single message to another thread, which costs a sixth of
    the time of a message.
    """

    def __init__(self, **options: Any):
        super().__init__(**options)
        # One thread for each group that works at the same time, and one that returns callbacks
        # which must wait for their turn to the wait set.
        self._workers = ThreadPoolExecutor(4, thread_name_prefix="worker")
        self._slow_tasks: list[Task] = []

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
            done = [task for task in self._slow_tasks if task.done()]
            self._slow_tasks = [t for t in self._slow_tasks if t not in done] + [handler]
            self._workers.submit(handler)
            for task in done:
                task.result()  # raises what the callback raised
        else:
            handler()
            handler.result()

    def finish(self) -> None:
        """Wait for slow callbacks that have begun; ignore what they raise."""
        self._workers.shutdown(wait=True, cancel_futures=True)
        for task in self._slow_tasks:
            task.exception()
        self.shutdown()


def run_in_spin_thread(
    node: Node,
    function: Callable[..., T],
    *args: Any,
    meanwhile: Callable[[], None] = lambda: None,
) -> T:
    """Call a function in the thread that spins, from another one; return or raise its result.

    While it waits, the calling thread calls `meanwhile` repeatedly; an exception of `meanwhile`
    ends the wait. ExternalShutdownException if the thread that spins has ended.
    """
    answer: Future[T] = Future()

    def call() -> None:  # raising there would end the node
        try:
            answer.set_result(function(*args))
        except Exception as error:
            answer.set_exception(error)

    node.executor.create_task(call)
    while not wait([answer], timeout=POLL_INTERVAL_S).done:
        if not node.context.ok():
            raise ExternalShutdownException
        meanwhile()
    return answer.result()


def create_steady_timer(
    seconds: float, node: Node, call: Callable[[], None], group: Any = None
) -> None:
    """Call a function periodically, also while a simulated clock stands still."""
    clock = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(seconds, call, callback_group=group, clock=clock)


def foreign_publishers(node: Node) -> list[str]:
    """Return a warning for each topic that is published with a type the node does not expect.

    ROS does not deliver such messages and does not report them.
    """
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
    """Return a warning for each topic with several publishers: they may contradict each other."""
    warnings = list[str]()
    for topic in map(node.resolve_topic_name, topics):
        found = node.get_publishers_info_by_topic(topic)
        names = ", ".join(sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in found))
        if len(found) > 1:
            words = f"{topic} has {len(found)} publishers: {names}"
            warnings.append(KeyedWarning(words, "several publishers", f"{topic} {names}"))
    return warnings


def type_name(message: type) -> str:
    return f"{message.__module__.split('.')[0]}/msg/{message.__name__}"


@contextmanager
def ros_context(args: list[str] | None = None) -> Iterator[Callable[[], bool]]:
    """Initialise ROS and shut it down; yield a function that says whether to go on.

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
    """Spin a node until SIGINT or SIGTERM ends it; return the exit status."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with ros_context(args) as go_on:
        executor, node, ended = FrontExecutor(), None, Event()
        Thread(target=_end_hanging_process, args=(ended,), daemon=True).start()
        try:
            node = make_node()
            executor.add_node(node)
            gc.freeze()  # these objects stay alive: collecting them would pause the node for 12 ms
            while go_on():
                executor.spin_once()
        except ExternalShutdownException:
            pass
        except ParallelCalError as error:
            sys.stderr.write(f"error: {error}\n")
            return 1
        except Exception:
            if rclpy.ok():  # otherwise the shutdown itself makes callbacks fail
                raise
        finally:
            if node is not None and hasattr(node, "end_work"):
                node.end_work()
            executor.finish()
            if node is not None:
                node.destroy_node()
            ended.set()
    return 0


def _end_hanging_process(ended: Event) -> None:
    """End the process if a running callback does not return after ROS has shut down."""
    while rclpy.ok():
        if ended.wait(0.1):
            return
    if not ended.wait(SHUTDOWN_TIMEOUT_S):
        sys.stderr.flush()
        os._exit(0)
