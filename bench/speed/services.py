"""Round trips of the kinematic services beside a service that answers a constant.

All services live in one server process and are called in turn by one client process, one
configuration or one target in each request. Targets are the poses of random configurations.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import rclpy
from parallel_cal_msgs.msg import JointConfiguration, Solution, SolutionSet
from parallel_cal_msgs.srv import ComputeFK, ComputeIK
from rich.console import Console
from rich.table import Table

from bench.speed.timing import readable
from parallel_cal.nodes import position_ik
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.kinematics_node import KinematicsNode
from parallel_cal.nodes.run import run

PRESET = Path(__file__).parents[2] / "config" / "delta_mockup_identified.yaml"
CALLS = 5000
TARGETS = 200
JOINT_RANGE = (0.3, 0.9)  # rad; the Delta reaches every combination


class All(KinematicsNode):
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


def call(node: Any, client: Any, request: Any) -> tuple[float, Any]:
    """Return the duration of a call (s) and its response."""
    begin = time.perf_counter()
    future = client.call_async(request)
    while not future.done():
        rclpy.spin_once(node)
    answer = future.result()
    if hasattr(answer, "results"):
        assert answer.results[0].solutions
    else:
        assert answer.error_code.val == answer.error_code.SUCCESS, answer.error_code
    return time.perf_counter() - begin, future.result()


def measure() -> None:
    rclpy.init()
    node = rclpy.create_node("bench")
    types = {"constant": ComputeFK, "compute_fk": ComputeFK, "compute_ik": ComputeIK}
    if position_ik_type := position_ik.find_service_type():
        types[position_ik.NAME] = position_ik_type
    clients = {
        name: node.create_client(type, f"kinematics_node/{name}") for name, type in types.items()
    }
    assert all(client.wait_for_service(30) for client in clients.values()), "no server"
    rng = random.Random(0)
    joints = [[rng.uniform(*JOINT_RANGE) for _ in range(3)] for _ in range(TARGETS)]
    configurations = [JointConfiguration(positions=positions) for positions in joints]
    _, found = call(node, clients["compute_fk"], ComputeFK.Request(configurations=configurations))
    solutions = [answer.solutions[0] for answer in found.results]
    assert all(solution.status == Solution.CONVERGED for solution in solutions)
    forward = [ComputeFK.Request(configurations=[one]) for one in configurations]
    inverse = [ComputeIK.Request(targets=[solution.pose]) for solution in solutions]
    requests = {"constant": forward, "compute_fk": forward, "compute_ik": inverse}
    if position_ik_type:
        asked = requests[position_ik.NAME] = [position_ik_type.Request() for _ in solutions]
        for request, positions, solution in zip(asked, joints, solutions, strict=True):
            request.ik_request.pose_stamped.pose = solution.pose
            state = request.ik_request.robot_state.joint_state
            state.name, state.position = ["joint1", "joint2", "joint3"], positions
    times: dict[str, list[float]] = {name: [] for name in types}
    for k in range(-300, CALLS):  # warm up: discovery, and the C compiler in the background
        for name, client in clients.items():
            lapse, _ = call(node, client, requests[name][k % TARGETS])
            if k >= 0:
                times[name].append(lapse)
    table = Table("service", "median", "99.9 %", "longest", title=f"Round trips of {CALLS} calls")
    for name, kept in times.items():
        late = quantiles(kept, n=1000)[-1]
        table.add_row(name, *map(readable, (median(kept), late, max(kept))))
    Console().print(table)
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
    sys.exit(run(All)) if "--serve" in sys.argv else main()
