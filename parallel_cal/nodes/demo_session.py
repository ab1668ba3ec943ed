"""The demo's ROS side: both nodes, a replayed recording, and the questions put to them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from parallel_cal_msgs.action import Identify
from parallel_cal_msgs.msg import CollectionStatus, JointConfiguration, ModelStatus, Sample
from parallel_cal_msgs.srv import ComputeFK, ListSamples, RemoveSample

from parallel_cal.bag import list_topics
from parallel_cal.nodes.client import Client, NodeError, Process, own_domain
from parallel_cal.nodes.conversions import pose_numbers
from parallel_cal.rotation import rotation_vector

Feedback = Callable[[str, float], None]


class DemoSession:
    """kinematics_node and calibration_node on one model file; a context that ends them all."""

    def __init__(self, model_file: Path):
        self._model_file = model_file
        self._processes: list[Process] = []

    def __enter__(self) -> DemoSession:
        self._namespace = own_domain()
        with ExitStack() as self._open:  # whatever fails or is interrupted here, all is ended
            self._start("kinematics_node", model_file=str(self._model_file))
            self._start("calibration_node", model_file=str(self._model_file))
            self._client = Client("demo", self._namespace, self._processes)
            self._open.callback(self._client.close)
            status = "calibration_node/collection_status"
            self._status = self._client.latest(CollectionStatus, status)
            self._model = self._client.latest(ModelStatus, "kinematics_node/model_status")
            self._open = self._open.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _start(self, node: str, **parameters: Any) -> Process:
        process = Process(node, self._model_file.parent, self._namespace, **parameters)
        self._processes.append(process)
        self._open.callback(process.end)
        return process

    def hash_served(self) -> str:
        """The hash of the model that kinematics_node answers with."""
        self._client.wait(lambda: bool(self._model), "kinematics_node/model_status")
        return str(self._model[0].hash)

    def collect(self, bag: Path, messages: int, rate: float, hear: Feedback) -> CollectionStatus:
        """Replay a recording; the status once all its readings and poses have been looked at."""
        self._client.wait(lambda: bool(self._status), "calibration_node/collection_status")
        topics = [topic.name for topic in list_topics(bag)[0]]
        listeners = self._client.listeners(topics)
        self._start("replay_node", bag=str(bag), rate=rate, wait_for_subscribers=listeners)

        def all_in() -> bool:
            status = self._status[0]
            received = status.joint_states_received + status.poses_received
            hear(f"{status.samples} samples", received / messages)
            return bool(received >= messages)

        self._client.wait(all_in, f"{messages} messages", patience=60 + 600 / rate)
        return self._status[0]

    def samples(self) -> tuple[list[Sample], list[str]]:
        """What was collected, and the order of the joints."""
        response = self._client.call(ListSamples, "calibration_node/list_samples")
        return list(response.samples), list(response.joint_names)

    def remove(self, samples: list[Sample]) -> None:
        for sample in samples:
            done = self._client.call(RemoveSample, "calibration_node/remove_sample", id=sample.id)
            if not done.success:
                raise NodeError(done.message)

    def miss(self, samples: list[Sample], joints: list[str]) -> dict[str, Any]:
        """How far the poses that kinematics_node predicts lie off the measured ones (m, rad)."""
        answer = self._client.call(
            ComputeFK,
            "kinematics_node/compute_fk",
            joint_names=joints,
            configurations=[JointConfiguration(positions=s.joints) for s in samples],
        )
        first = [one.solutions[0] for one in answer.results]
        failed = answer.message or next((s.message for s in first if s.status), "")
        if failed:
            raise NodeError(f"compute_fk: {failed}")
        predicted = [pose_numbers(solution.pose) for solution in first]
        measured = [pose_numbers(sample.pose.pose) for sample in samples]
        (r, R), (r_measured, R_measured) = _stacked(predicted), _stacked(measured)
        turn = rotation_vector(R_measured @ R.transpose(0, 2, 1))
        return {
            "position_mean": float(np.linalg.norm(r_measured - r, axis=1).mean()),
            "orientation_mean": float(np.linalg.norm(turn, axis=1).mean()),
            "model_hash": answer.model_hash,
        }

    def identify(self, hold_out: float, hear: Feedback) -> Identify.Result:
        """The action's result; NodeError when it was refused."""
        goal = self._client.send_goal(
            Identify,
            "calibration_node/identify",
            lambda f: hear(f.stage, f.fraction),
            hold_out=hold_out,
        )
        if not goal.accepted:
            raise NodeError("calibration_node rejected the goal")
        result = self._client.answer(goal.get_result_async(), "the result of identify").result
        if not result.success:
            raise NodeError(result.message)
        return result

    def wait_until_served(self, hash: str) -> float:
        """Seconds until kinematics_node uses the model of that hash."""
        begin = time.monotonic()
        self._client.wait(
            lambda: bool(self._model) and self._model[0].hash == hash,
            f"kinematics_node to use {hash[:12]}",
        )
        return time.monotonic() - begin


def _stacked(poses: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) and (n, 3, 3)."""
    return np.array([r for r, _ in poses]), np.array([R for _, R in poses])
