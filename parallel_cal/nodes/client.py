"""Nodes as processes, and a small client that calls their services and actions."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.parameters import LATCHED

KINEMATICS, CALIBRATION = "kinematics_node", "calibration_node"
TIMEOUT_S = 30.0  # s for anything that takes less than one on a quiet machine
RESEND_INTERVAL_S = 5.0  # s without word of a goal


class NodeError(ParallelCalError):
    """A node did not start, died, or did not answer in time."""


# Run in a node's process: it ends as by Ctrl-C when whoever started it is gone, however that ended.
NO_ORPHAN = """
import os, signal, sys, threading
def follow():
    os.read(0, 1)  # our end of its input is closed with us
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=follow, daemon=True).start()
"""


class Process:
    """A node of this package in a process of its own; its output goes to a file. Ctrl-C in the
    terminal is for whoever started it, who ends it when its work is done."""

    def __init__(self, node: str, folder: Path, namespace: str, **parameters: Any):
        self.node, self.log = node, folder / f"{node}.log"
        code = f"{NO_ORPHAN}from parallel_cal.nodes.{node} import main\nsys.exit(main())"
        arguments = ["-r", f"__ns:={namespace}"]
        for name, value in parameters.items():
            # JSON is YAML: a path that looks like a number stays a string
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        with self.log.open("w") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, "--ros-args", *arguments],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def check(self) -> None:
        """NodeError with its last line when it failed."""
        if self.status and self.status < 0:
            raise NodeError(f"{self.node} was ended by {signal.Signals(-self.status).name}")
        if self.status:
            lines = self.log.read_text(errors="replace").split("\n")
            said = next((line for line in reversed(lines) if line.strip()), "no output")
            raise NodeError(f"{self.node} ended with status {self.status}: {said.strip()}")

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.poll()

    def end(self) -> int:
        """Ask it to end as Ctrl-C does, insist after a while; its exit status."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            return self._process.wait(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


class Client:
    """Calls and listens; every wait is for a condition and ends when a process died or the user
    has `interrupted`."""

    def __init__(
        self,
        name: str,
        namespace: str,
        processes: list[Process],
        interrupted: Callable[[], bool] = lambda: False,
    ):
        self._interrupted = interrupted
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(name, namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._processes, self._clients = processes, dict[str, Any]()

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def wait(self, ready: Callable[[], bool], what: str, patience: float = TIMEOUT_S) -> None:
        """Serve callbacks until `ready`; NodeError names `what` was waited for."""
        end = time.monotonic() + patience
        while not ready():
            if self._interrupted():
                raise KeyboardInterrupt
            for process in self._processes:
                process.check()
            if time.monotonic() > end:
                raise NodeError(f"waited {patience:.0f} s without success for {what}")
            self._executor.spin_once(timeout_sec=0.02)

    def await_result(self, future: Future, what: str, patience: float = TIMEOUT_S) -> Any:
        """What a future comes to."""
        self.wait(future.done, what, patience)
        return future.result()

    def ask(self, type: Any, name: str, **fields: Any) -> Future:
        """A service's response to come."""
        if name not in self._clients:
            self._clients[name] = self._node.create_client(type, name)
        client = self._clients[name]
        self.wait(client.service_is_ready, f"service {name}")
        return client.call_async(type.Request(**fields))

    def call(self, type: Any, name: str, **fields: Any) -> Any:
        """A service's response."""
        return self.await_result(self.ask(type, name, **fields), f"the answer of {name}")

    def count_subscribers(self, topics: Iterable[str]) -> int:
        """How many subscriptions there are, so that a replay can wait for all of them."""
        names = (self._node.resolve_topic_name(topic.lstrip("/")) for topic in topics)
        return sum(self._node.count_subscribers(name) for name in names)

    def count_publishers(self, topic: str) -> int:
        """How many publishers there are; one that was killed counts for some twenty seconds."""
        return self._node.count_publishers(self._node.resolve_topic_name(topic))

    def subscribe_latest(self, type: Any, topic: str) -> list[Any]:
        """A list that holds the newest message of a latched topic as soon as there is one."""
        newest: list[Any] = []

        def keep(message: Any) -> None:
            newest[:] = [message]

        self._node.create_subscription(type, topic, keep, LATCHED)
        return newest

    def send_goal(self, type: Any, name: str, hear: Callable[[Any], None], **fields: Any) -> Any:
        """A goal's handle; `hear` gets the feedback.

        A server whose answer finds no listener within 0.1 s, as it happens to one that was just
        made on a busy machine, drops both the answer and the goal: it is then asked again.
        """
        if name not in self._clients:
            self._clients[name] = ActionClient(self._node, type, name)
        client = self._clients[name]
        self.wait(client.server_is_ready, f"action {name}")
        goal, sent, again = type.Goal(**fields), list[Future](), 0.0

        def handles() -> list[Any]:
            return sorted((f.result() for f in sent if f.done()), key=lambda h: not h.accepted)

        def settled() -> bool:
            nonlocal again
            if time.monotonic() > again:
                sent.append(client.send_goal_async(goal, lambda m: hear(m.feedback)))
                again = time.monotonic() + RESEND_INTERVAL_S
            known = handles()
            return len(known) == len(sent) or (bool(known) and known[0].accepted)

        self.wait(settled, f"the acceptance of {name}")
        return handles()[0]


def use_private_domain() -> str:
    """A domain and a namespace for this process alone, seen by this machine only; the namespace.

    Set before the first context: children inherit both.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(_reserve_domain()[0])
    return f"/of_{os.getpid()}"


@cache
def _reserve_domain() -> tuple[int, socket.socket]:
    """A free domain, and what holds it until this process ends: the TCP port that has the number
    of the domain's UDP port, so that no two that run at once meet, and nothing is left behind."""
    for domain in range(1, 101):  # below the ports that the system gives away by itself
        held = socket.socket()
        try:
            held.bind(("127.0.0.1", 7400 + 250 * domain))
        except OSError:
            held.close()
        else:
            return domain, held
    raise NodeError("no free ROS domain from 1 to 100: other programs use all of them")
