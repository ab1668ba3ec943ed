"""Start kinematics_node and calibration_node, replay a recording to them, and query them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from parallel_cal_msgs.action import Diagnose, Identify
from parallel_cal_msgs.msg import CollectionStatus, JointConfiguration, ModelStatus, Sample
from parallel_cal_msgs.srv import AddEffect, ComputeFK, ListSamples, LoadSamples, RemoveSample

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.nodes.client import Client, NodeError, Process, use_private_domain
from parallel_cal.nodes.computing import SOLVED
from parallel_cal.nodes.conversions import pose_numbers
from parallel_cal.recordings.bag import list_topics

Feedback = Callable[[str, float], None]
HOLD_OUT_INTERVAL = 8  # one pose in eight is held out of the fit
RESULT_TIMEOUT_S = 120.0  # s for an action, which takes seconds even on a quiet machine


@dataclass(frozen=True)
class Answers:
    """Samples and the poses that kinematics_node predicts for them: r (n, 3) and R (n, 3, 3)."""

    samples: list[Sample]
    r: np.ndarray
    R: np.ndarray
    model_hash: str

    def norms(self) -> dict[str, np.ndarray]:
        """Return the position error [m] and the orientation error [rad] of each sample, (n,)."""
        r, R = _stack_poses([pose_numbers(sample.pose.pose) for sample in self.samples])
        turn = rotation_vector(R @ self.R.transpose(0, 2, 1))
        return {
            "position": np.linalg.norm(r - self.r, axis=1),
            "orientation": np.linalg.norm(turn, axis=1),
        }

    def summarise_errors(self) -> dict[str, Any]:
        """Return the mean errors and the hash of the model."""
        means = {f"{kind}_mean": float(n.mean()) for kind, n in self.norms().items()}
        return {**means, "model_hash": self.model_hash}


class BothNodes:
    """Run kinematics_node and calibration_node on one model file, within a `with` block."""

    def __init__(
        self,
        model_file: Path,
        recordings: Path,
        interrupted: Callable[[], bool] = lambda: False,
    ):
        """Let calibration_node load files from the folder `recordings`."""
        self.model_file, self._interrupted = model_file, interrupted
        folders = (model_file.parent, recordings)
        self._allowed = os.pathsep.join(str(folder.resolve()) for folder in folders)
        self._processes: list[Process] = []

    def __enter__(self) -> BothNodes:
        self._namespace = use_private_domain()
        with ExitStack() as self._open:  # a failure or an interrupt here ends all processes
            self._start("kinematics_node", model_file=str(self.model_file))
            given = {"model_file": str(self.model_file), "allowed_folders": self._allowed}
            self._start("calibration_node", journal=False, **given)
            self._client = Client("test", self._namespace, self._processes, self._interrupted)
            self._open.callback(self._client.close)
            status = "calibration_node/collection_status"
            self._status = self._client.subscribe_latest(CollectionStatus, status)
            self._model = self._client.subscribe_latest(ModelStatus, "kinematics_node/model_status")
            self._open = self._open.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _start(self, node: str, **parameters: Any) -> Process:
        process = Process(node, self.model_file.parent, self._namespace, **parameters)
        self._processes.append(process)
        self._open.callback(process.end)
        return process

    def hash_served(self) -> str:
        """Return the hash of the model that kinematics_node uses."""
        self._client.wait(lambda: bool(self._model), "kinematics_node/model_status")
        return str(self._model[0].hash)

    def collect(self, bag: Path, messages: int, rate: float, hear: Feedback) -> CollectionStatus:
        """Replay a recording; return the status once all its messages were received."""
        self._client.wait(lambda: bool(self._status), "calibration_node/collection_status")
        topics = [topic.name for topic in list_topics(bag)[0]]
        listeners = self._client.count_subscribers(topics)
        self._start("replay_node", bag=str(bag), rate=rate, wait_for_subscribers=listeners)

        def all_in() -> bool:
            status = self._status[0]
            received = status.joint_states_received + status.poses_received
            hear(f"{status.samples} samples", received / messages)
            return bool(received >= messages)

        self._client.wait(all_in, f"{messages} messages", patience=60 + 600 / rate)
        return self._status[0]

    def samples(self) -> tuple[list[Sample], list[str]]:
        """Return the collected samples and the order of their joints."""
        response = self._client.call(ListSamples, "calibration_node/list_samples")
        return list(response.samples), list(response.joint_names)

    def remove(self, samples: list[Sample]) -> None:
        for sample in samples:
            done = self._client.call(RemoveSample, "calibration_node/remove_sample", id=sample.id)
            if not done.success:
                raise NodeError(done.message)

    def load(self, path: Path) -> None:
        """Replace the samples by those of a recording or a file of samples."""
        done = self._client.call(LoadSamples, "calibration_node/load_samples", path=str(path))
        if not done.success:
            raise NodeError(done.message)

    def answers(self, samples: list[Sample], joints: list[str]) -> Answers:
        """Query the pose that kinematics_node predicts for each sample under its conditions."""
        told = [self._answer(sample, joints) for sample in samples]
        poses = [pose_numbers(answer.results[0].solutions[0].pose) for answer in told]
        return Answers(samples, *_stack_poses(poses), told[-1].model_hash)

    def _answer(self, sample: Sample, joints: list[str]) -> ComputeFK.Response:
        answer = self._client.call(
            ComputeFK,
            "kinematics_node/compute_fk",
            joint_names=joints,
            configurations=[JointConfiguration(positions=sample.joints)],
            conditions=[c for c in sample.conditions if c.name.split(".")[0] in CONDITIONS],
        )
        solutions = [one for result in answer.results for one in result.solutions]
        failed = answer.message or next(
            (s.message for s in solutions if s.status not in SOLVED), ""
        )
        if failed:
            raise NodeError(f"compute_fk: {failed}")
        return answer

    def identify(self, hold_out: float, hear: Feedback) -> Identify.Result:
        """Identify the parameters; raise NodeError if the action fails."""
        return self._run_goal(Identify, "identify", hear, hold_out=hold_out)

    def diagnose(self, hold_out: float, hear: Feedback) -> Diagnose.Result:
        """Diagnose the residuals; raise NodeError if the action fails."""
        return self._run_goal(Diagnose, "diagnose", hear, hold_out=hold_out)

    def _run_goal(self, type: Any, name: str, hear: Feedback, **goal: Any) -> Any:
        handle = self._client.send_goal(
            type, f"calibration_node/{name}", lambda f: hear(f.stage, f.fraction), **goal
        )
        if not handle.accepted:
            raise NodeError("calibration_node rejected the goal; see its log for the reason")
        future = handle.get_result_async()
        result = self._client.await_result(future, f"the result of {name}", RESULT_TIMEOUT_S).result
        if not result.success:
            raise NodeError(result.message)
        return result

    def add_effect(self, effect: str) -> AddEffect.Response:
        """Add an effect to the model file; raise NodeError if that is refused."""
        done = self._client.call(AddEffect, "calibration_node/add_effect", effect=effect)
        if not done.success:
            raise NodeError(done.message)
        return done

    def wait_until_served(self, hash: str) -> float:
        """Wait until kinematics_node uses the model with this hash; return the time taken [s]."""
        begin = time.monotonic()
        self._client.wait(
            lambda: bool(self._model) and self._model[0].hash == hash,
            f"kinematics_node to use {hash[:12]}",
        )
        return time.monotonic() - begin


def select_held_out(samples: Sequence[Any]) -> list[Any]:
    """Select all replicates of every eighth pose."""
    pose = {s.id: s.id if s.replicate_of < 0 else s.replicate_of for s in samples}
    chosen = set(list(dict.fromkeys(pose.values()))[HOLD_OUT_INTERVAL // 2 :: HOLD_OUT_INTERVAL])
    return [s for s in samples if pose[s.id] in chosen]


def _stack_poses(poses: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Stack positions to (n, 3) and rotations to (n, 3, 3)."""
    return np.array([r for r, _ in poses]), np.array([R for _, R in poses])
