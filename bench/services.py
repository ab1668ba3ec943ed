"""Round trip of ~/compute_fk beside a service of the same type that answers a constant.

Both services live in one server process and are called in turn by one client process.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import rclpy
from parallel_cal_msgs.msg import JointConfiguration, Solution, SolutionSet
from parallel_cal_msgs.srv import ComputeFK
from timing import Row, show

from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.kinematics_node import KinematicsNode
from parallel_cal.nodes.run import run

PRESET = Path(__file__).parents[1] / "config" / "delta_mockup_identified.yaml"
CALLS = 1000


class Both(KinematicsNode):
    """The kinematics node with one more service, whose answer is always the same."""

    def __init__(self) -> None:
        super().__init__()
        self._constant = ComputeFK.Response(
            results=[SolutionSet(solutions=[Solution(joints=[0.5] * 3)], count_complex=-1)],
            model_hash="0" * 64,
        )
        self.create_service(
            ComputeFK,
            "~/constant",
            lambda request, response: self._constant,
            callback_group=self._front,
        )


def round_trip(node: Any, client: Any, request: Any) -> float:
    begin = time.perf_counter()
    future = client.call_async(request)
    while not future.done():
        rclpy.spin_once(node)
    assert future.result().results[0].solutions
    return time.perf_counter() - begin


def measure() -> None:
    rclpy.init()
    node = rclpy.create_node("bench")
    names = ("compute_fk", "constant")
    clients = [node.create_client(ComputeFK, f"kinematics_node/{name}") for name in names]
    assert all(client.wait_for_service(30) for client in clients), "the server is not there"
    request = ComputeFK.Request(configurations=[JointConfiguration(positions=[0.5] * 3)])
    for client in clients:  # warm up: discovery, and the C compiler in the background
        for _ in range(300):
            round_trip(node, client, request)
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(CALLS):
        for client, kept in zip(clients, times, strict=True):
            kept.append(round_trip(node, client, request))
    rows = ["constant answer of the same type", "compute_fk, one configuration"]
    show(
        "Service round trip, median",
        [Row(rows[0], median(times[1])), Row(rows[1], median(times[0]))],
    )
    rclpy.shutdown()


def main() -> None:
    use_private_domain()
    parameter = f"model_file:={PRESET}"
    command = [sys.executable, __file__, "--serve", "--ros-args", "-p", parameter]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL) as server:
        try:
            measure()
        finally:
            server.terminate()


if __name__ == "__main__":
    sys.exit(run(Both)) if "--serve" in sys.argv else main()
