"""From "cancel" to a robot that stops: through the action, while it is on its way."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from parallel_cal_msgs.action import Calibrate
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from bench.speed.timing import Row, show
from parallel_cal.nodes.calibrate import Calibration
from parallel_cal.nodes.client import CALIBRATION

TIMES, MOVING = 10, 0.05  # rad/s


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        cell = {"robot": "delta", "seed": 2, "rate": 1.0}
        with Calibration(Path(folder, "robot.yaml"), simulated=cell) as one:
            client, sent, states = one.client, list[Any](), list[Any]()
            listen = client._node.create_subscription
            listen(JointTrajectory, "joint_trajectory", sent.append, 10)
            listen(JointState, "joint_states", states.append, 100)
            trips, stops, slower = list[float](), list[float](), list[float]()
            for _ in range(TIMES):
                handle = client.send_goal(
                    Calibrate,
                    f"{CALIBRATION}/calibrate",
                    lambda news: None,
                    model_file=str(Path(folder, "robot.yaml")),
                    minutes=5.0,
                )
                result = handle.get_result_async()
                client.wait(lambda: bool(states) and _speed(states[-1]) > MOVING, "motion", 60)
                begin = time.perf_counter()
                client.call(Trigger, f"{CALIBRATION}/resume")
                trips.append(time.perf_counter() - begin)
                client.wait(lambda: _speed(states[-1]) > MOVING, "motion", 60)
                begin, before, speed = time.perf_counter(), len(sent), _speed(states[-1])
                handle.cancel_goal_async()
                client.wait(lambda n=before: len(sent) > n, "the stop")
                stops.append(time.perf_counter() - begin)
                client.wait(lambda v=speed: _speed(states[-1]) < v / 2, "the robot slower")
                slower.append(time.perf_counter() - begin)
                client.await_result(result, "the end")
    show(
        f"A campaign is cancelled, median of {TIMES}",
        [
            Row("a service's round trip", median(trips)),
            Row("until a stop is sent", median(stops)),
            Row("... the slowest", max(stops)),
            Row("until the robot has half its speed", median(slower)),
        ],
    )


def _speed(state: Any) -> float:
    return max(map(abs, state.velocity))


if __name__ == "__main__":
    main()
