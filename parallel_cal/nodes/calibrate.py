"""Asks a running calibration_node, or one started for a simulated robot, to calibrate."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus, Question
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from parallel_cal.nodes.client import (
    CALIBRATION,
    KINEMATICS,
    Client,
    NodeError,
    Process,
    use_private_domain,
)

CELL = "virtual_cell_node"
CELL_IMAGES = "camera/image_raw/compressed"  # of its camera
# s
STOP_TIMEOUT_S = 30.0
RESULT_TIMEOUT_S = 600.0

Hear = Callable[[Any], None]  # Calibrate.Feedback


class Calibration:
    """A client of `~/calibrate`; a context manager that ends every process it started.

    With `simulated`, the parameters of a virtual_cell_node, it starts that node, calibration_node
    and kinematics_node in a separate ROS domain. The virtual_cell_node writes the model file unless
    it exists.
    """

    def __init__(
        self,
        model_file: Path,
        namespace: str = "",
        simulated: Mapping[str, Any] | None = None,
        folder: Path | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ):
        self._model_file, self._namespace = model_file.resolve(), namespace
        self._simulated, self._folder = simulated, (folder or model_file.parent).resolve()
        self._interrupted, self._processes = interrupted, list[Process]()
        self.cancelled = False  # whether the last run was cancelled

    def __enter__(self) -> Calibration:
        with ExitStack() as self._open:
            if self._simulated is not None:
                self._namespace = use_private_domain()
                self._start(CELL, model_file=str(self._model_file), **self._simulated)
            self.client = Client("calibrate", self._namespace, self._processes)
            self._open.callback(self.client.close)
            if self._simulated is not None:
                self.client.wait(
                    self._model_file.exists, f"{self._model_file}, which {CELL} writes"
                )
                folders = {str(self._model_file.parent), str(self._folder)}
                given = {
                    "model_file": str(self._model_file),
                    "allowed_folders": os.pathsep.join(folders),
                }
                self._start(KINEMATICS, **given)
                if self._simulated.get("device") == "camera":
                    given["images"] = CELL_IMAGES
                self._start(CALIBRATION, **given, journal_folder=str(self._folder))
            self._open = self._open.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _start(self, node: str, **parameters: Any) -> None:
        process = Process(node, self._folder, self._namespace, **parameters)
        self._processes.append(process)
        self._open.callback(process.end)

    def run(self, hear: Hear, minutes: float, **goal: Any) -> Calibrate.Result:
        """Run a campaign and return its result; an interruption cancels it. Raise NodeError if the
        node does not answer or rejects the goal."""
        news = deque[Any]()
        topic = f"{CALIBRATION}/session_status"
        heard = self.client.subscribe_latest(CalibrationStatus, topic)
        try:
            self.client.wait(lambda: bool(heard), topic)
        except NodeError:
            raise NodeError(
                f"{CALIBRATION} in {self._namespace or '/'} does not answer: is it running in "
                "this ROS domain?"
            ) from None
        handle = self.client.send_goal(
            Calibrate,
            f"{CALIBRATION}/calibrate",
            news.append,
            model_file=str(self._model_file),
            minutes=minutes,
            **goal,
        )
        if not handle.accepted:
            raise NodeError(f"{CALIBRATION} rejected the goal; see its log for the reason")
        future, end = handle.get_result_async(), time.monotonic() + 60 * minutes + RESULT_TIMEOUT_S

        def gone() -> bool:
            return not self.client.count_publishers(topic)

        while not future.done():
            self.client.wait(
                lambda: bool(future.done() or news or self._interrupted() or gone()),
                f"a message from {CALIBRATION}",
                end - time.monotonic(),
            )
            if not (future.done() or news) and gone():
                raise NodeError(
                    f"{CALIBRATION} has ended; the samples are saved. Start the node again, then "
                    "repeat this command to continue"
                )
            while news:
                hear(news.popleft())
            if self._interrupted():
                handle.cancel_goal_async()
                self.client.wait(future.done, "the robot to stop", STOP_TIMEOUT_S)
        answer = future.result()
        self.cancelled = answer.status == GoalStatus.STATUS_CANCELED
        return answer.result

    @property
    def hidden(self) -> list[str]:
        """The effects that a simulated robot has, to compare with those found."""
        from parallel_cal.virtual.kinds import KINDS, hide, words_of  # no real robot needs them

        cell = self._simulated or {}
        words = words_of(cell.get("effects", ""))
        names, _ = hide(cell["robot"], words, cell.get("seed", 0)) if words else ([], [])
        return [KINDS[name].effect for name in names]

    def confirm_done(self) -> None:
        """Confirm that the requested change was made."""
        self.client.call(Trigger, f"{CALIBRATION}/continue")

    def set_requested_conditions(self, questions: Iterable[Question]) -> None:
        """Set the conditions of the simulated cell that a person is asked to change; confirm."""
        changes = [
            Parameter(question.condition, value=question.value).to_parameter_msg()
            for question in questions
        ]
        self.client.call(SetParameters, f"{CELL}/set_parameters", parameters=changes)
        self.confirm_done()
