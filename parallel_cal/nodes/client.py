"""Start nodes as processes, and call their services and actions."""

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
from rcl_interfaces.srv import GetParameterTypes
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.parameters import LATCHED

KINEMATICS, CALIBRATION = "kinematics_node", "calibration_node"
TIMEOUT_S = 30.0  # s for an answer that takes less than 1 s on a machine without other load
ASK_AGAIN_S = 1.0  # s without an answer, after which a node is asked again whether it knows us


class NodeError(ParallelCalError):
    """A node did not start, died, or did not answer in time."""


# Run in the process of a node: it interrupts the node when the process that started it has ended,
# even if that process was killed.
NO_ORPHAN = """
import os, signal, sys, threading
def follow():
    os.read(0, 1)  # returns when the starter's end of the pipe is closed
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=follow, daemon=True).start()
"""


class Process:
    """A node of this package in its own process, with its output in a file.

    Ctrl-C in the terminal does not reach the node: the process that started it must call `end`.
    """

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
        """Raise NodeError with the last line of its output if the node failed."""
        if self.status and self.status < 0:
            raise NodeError(f"{self.node} was ended by {signal.Signals(-self.status).name}")
        if self.status:
            lines = self.log.read_text(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "no output")
            raise NodeError(f"{self.node} ended with status {self.status}: {last.strip()}")

    @property
    def status(self) -> int | None:
        """The exit status; None while the node runs."""
        return self._process.poll()

    def end(self) -> int:
        """Interrupt the node, kill it after TIMEOUT_S, and return its exit status."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            return self._process.wait(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


class Client:
    """A ROS node that calls the other nodes.

    Every wait ends early if one of the processes failed or if `interrupted` returns true.
    """

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
        """End the node, with the action clients, which it leaves to the garbage collection: one
        that outlives its context crashes the process."""
        self._executor.shutdown()
        for client in self._clients.values():
            if isinstance(client, ActionClient):
                client.destroy()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def wait(self, ready: Callable[[], bool], what: str, patience: float = TIMEOUT_S) -> None:
        """Execute callbacks until `ready`; on a timeout raise NodeError, which names `what`."""
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
        """Wait for a future and return its result."""
        self.wait(future.done, what, patience)
        return future.result()

    def ask(self, type: Any, name: str, **fields: Any) -> Future:
        """Send a request to a service and return the future of its response."""
        client = self._known_client(name, lambda: self._node.create_client(type, name))
        self.wait(client.service_is_ready, f"service {name}")
        return client.call_async(type.Request(**fields))

    def call(self, type: Any, name: str, **fields: Any) -> Any:
        """Send a request to a service and return its response."""
        return self.await_result(self.ask(type, name, **fields), f"the answer of {name}")

    def count_subscribers(self, topics: Iterable[str]) -> int:
        """Count the subscriptions, so that a replay can wait for all of them."""
        names = (self._node.resolve_topic_name(topic.lstrip("/")) for topic in topics)
        return sum(self._node.count_subscribers(name) for name in names)

    def count_publishers(self, topic: str) -> int:
        """Count the publishers; one that was killed still counts for about 20 s."""
        return self._node.count_publishers(self._node.resolve_topic_name(topic))

    def subscribe_latest(self, type: Any, topic: str) -> list[Any]:
        """Subscribe to a latched topic; return a list that will hold only its newest message."""
        newest: list[Any] = []

        def keep(message: Any) -> None:
            newest[:] = [message]

        self._node.create_subscription(type, topic, keep, LATCHED)
        return newest

    def send_goal(self, type: Any, name: str, hear: Callable[[Any], None], **fields: Any) -> Any:
        """Send a goal and return its handle; `hear` receives the feedback."""
        client = self._known_client(name, lambda: ActionClient(self._node, type, name))
        self.wait(client.server_is_ready, f"action {name}")
        sent = client.send_goal_async(type.Goal(**fields), lambda m: hear(m.feedback))
        return self.await_result(sent, f"the acceptance of {name}")

    def _known_client(self, name: str, create: Callable[[], Any]) -> Any:
        """Return the client of a service or an action, known to the node that offers it.

        A server drops its answer if it does not find the client within 0.1 s, which happens on a
        busy machine. A node finds the clients of another in the order of their creation, so that
        its answer to a younger one shows that it knows the older ones. The younger one asks for
        nothing (the types of no parameters) and may therefore ask again.
        """
        if name in self._clients:
            return self._clients[name]
        client, node = create(), name.rpartition("/")[0]
        younger = self._node.create_client(GetParameterTypes, f"{node}/get_parameter_types")
        asked, again = list[Future](), 0.0

        def answered() -> bool:
            nonlocal again
            if younger.service_is_ready() and time.monotonic() > again:
                asked.append(younger.call_async(GetParameterTypes.Request()))
                again = time.monotonic() + ASK_AGAIN_S
            return any(future.done() for future in asked)

        self.wait(answered, f"an answer of {node}")
        self._node.destroy_client(younger)
        self._clients[name] = client
        return client


def use_private_domain() -> str:
    """Choose a ROS domain that only this process and its children use; return a namespace.

    The domain is visible on this machine only. Call this before the first context is created.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(_reserve_domain()[0])
    return f"/of_{os.getpid()}"


@cache
def _reserve_domain() -> tuple[int, socket.socket]:
    """Reserve a free domain until this process ends; return it with the socket that reserves it.

    The socket binds the TCP port with the number of the domain's UDP port. Two processes cannot
    bind the same port, and the system frees it with the process.
    """
    for domain in range(1, 101):  # their ports lie below those that the system assigns itself
        reservation = socket.socket()
        try:
            reservation.bind(("127.0.0.1", 7400 + 250 * domain))
        except OSError:
            reservation.close()
        else:
            return domain, reservation
    raise NodeError("no free ROS domain from 1 to 100: other programs use all of them")
