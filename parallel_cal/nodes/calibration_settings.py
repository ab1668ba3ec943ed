"""The parameters of the calibration node and what follows from them."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes.folders import Folders
from parallel_cal.nodes.frames import DEVICE_FRAME_SENSOR
from parallel_cal.nodes.jobs import describe_error
from parallel_cal.nodes.live_images import DEFAULT_REST_TOLERANCE, REST_SHARE
from parallel_cal.nodes.managed_node import AUTOSTART
from parallel_cal.nodes.motion import TRAJECTORY_ACTION
from parallel_cal.nodes.parameters import ACCEPTED, SECURITY, Changes, Setting, absolute, declare
from parallel_cal.recordings.options import MODES, ReadOptions, SampleOptions

POSE_TYPES = ("PoseWithCovarianceStamped", "PoseStamped")
EXTRA_DWELL_S = 0.3  # s that a campaign rests beyond the shortest dwell, to receive enough poses

PARAMETERS = {
    "model_file": Setting("", "model file to identify (YAML)"),
    "output_file": Setting("", "file for the calibrated model; empty = model_file"),
    "auto_collect": Setting(True, "sample every standstill; false = only on take_sample"),
    "mode": Setting("auto", "one sample per standstill (dwell) or per pose (continuous)", MODES),
    "min_dwell": Setting(0.3, "shortest dwell, s", (0, 3600)),
    "trim_start": Setting(
        0.1, "time ignored at the start of a dwell, s: the robot settles", (0, 3600)
    ),
    "trim_end": Setting(0.05, "time ignored at the end of a dwell, s", (0, 3600)),
    "still_tolerance": Setting(
        0.0, "motion of a joint at rest, rad or m; 0 = estimated from the data", (0, 1)
    ),
    "joint_sigma": Setting(
        0.0, "1-sigma encoder noise, rad or m; 0 = as in the model file", (0, 1)
    ),
    "hold_out": Setting(0.25, "share of held-out poses if a goal gives none", (0, 0.5)),
    "pose_type": Setting(POSE_TYPES[0], "type of measured_pose", POSE_TYPES, fixed=True),
    "driver_type": Setting(
        "",
        "full name of the type of measured_pose, such as tf2_msgs/msg/TFMessage, if it is not one "
        "of pose_type; empty = pose_type",
        fixed=True,
    ),
    "body": Setting(
        "",
        "name of the body, tag or frame in the messages of driver_type; empty = the only one",
        fixed=True,
    ),
    "images": Setting(
        "",
        "topics of the images of a printed board, one for each camera, separated by commas; "
        "compressed if the name ends in /compressed; empty = none",
        fixed=True,
    ),
    "board": Setting(
        "",
        "the board in the images, such as 8x6 or 8x6:5X5_100; empty = that of the model's camera, "
        "or 8x6",
        fixed=True,
    ),
    "channels": Setting("", "Python paths of your own channels, separated by commas", fixed=True),
    "journal": Setting(True, "write every sample to disk at once", fixed=True),
    "journal_folder": Setting(
        "", "folder of the journal; empty = parallel_cal in ROS_HOME (~/.ros)", fixed=True
    ),
    "record": Setting(False, "while true, record every message to an MCAP file in journal_folder"),
    "arrow_scale": Setting(100.0, "length of a residual arrow divided by the residual", (0, 1e9)),
    "look_period": Setting(
        0.5, "interval at which received messages are processed, s", (0.01, 3600), fixed=True
    ),
    **TRAJECTORY_ACTION,
    **SECURITY,
    **AUTOSTART,
}


class CalibrationSettings:
    """Declares the parameters of the calibration node and reads their current values.

    `folder` holds the journal, the recordings and the campaigns. `folders` says which files a
    request may name.
    """

    def __init__(self, node: Node):
        self._node = node
        declare(node, PARAMETERS, self._check_changes)
        home = absolute(os.environ.get("ROS_HOME") or "~/.ros")
        self.folder = Path(absolute(self.get("journal_folder")) or f"{home}/parallel_cal")
        # Whoever starts the node is trusted: the files named at the start allow their folders.
        files = (absolute(self.get(name)) for name in ("model_file", "output_file"))
        usual = [self.folder, *(Path(path).parent for path in files if path)]
        self.folders = Folders(self.get("allowed_folders"), usual)
        self.base = ""  # base frame of the model; empty if the device's frame is a parameter of it
        # The version of the model file that was read last, or the error, and the model's joints.
        self._version: Any = None
        self._joints: tuple[str, ...] | None = None
        self.rest_tolerance: Any = DEFAULT_REST_TOLERANCE  # (nq,) rad or m, of a joint at rest
        self.passive: tuple[str, ...] = ()  # passive joints of the model
        self.camera_board = ""  # columns x rows of the board of the model's camera, or empty
        self.model_trouble = ""  # why the model file cannot be read; empty if it can

    def get(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self._node.get_parameter(name).value

    @property
    def joint_sigma(self) -> float | None:
        """1-sigma encoder noise, rad or m; None if the model file determines it."""
        return self.get("joint_sigma") or None

    def dwell(self) -> float:
        """Return the time in s for which the robot of a campaign rests at each pose."""
        times = (self.get(name) for name in ("min_dwell", "trim_start", "trim_end"))
        return float(sum(times)) + EXTRA_DWELL_S

    def sample_options(self) -> SampleOptions:
        """Return the options of making samples from messages."""
        names = ("mode", "min_dwell", "trim_start", "trim_end")
        tolerance = self.get("still_tolerance") or None
        return SampleOptions(**{n: self.get(n) for n in names}, still_tolerance=tolerance)

    @property
    def known_joints(self) -> tuple[str, ...] | None:
        """The model's joints as they were read last; None if unknown. For threads that must not
        wait for a file."""
        return self._joints

    def find_rest_tolerance(self) -> Any:
        """Return how far the joints may deviate in a coarse search for rests, rad or m."""
        return self.get("still_tolerance") or self.rest_tolerance

    def board(self) -> str:
        """Return the board that images show; the parameter counts more than the model."""
        self.joints()  # reads the model
        return self.get("board") or self.camera_board or ReadOptions.board

    def fit_options(self) -> dict[str, Any]:
        """Return the options of a fit that a goal does not give."""
        return {"hold_out": self.get("hold_out"), "joint_sigma": self.joint_sigma}

    def check_model_file(self) -> None:
        """Raise ParallelCalError if the model file exists and cannot be read.

        A file that does not exist yet may be written later, for example by another node.
        """
        path = absolute(self.get("model_file"))
        if path and os.path.lexists(path):
            read_model(path)

    def joints(self) -> tuple[str, ...] | None:
        """Return the model's joints, read again when the file changes; None if unreadable."""
        path = absolute(self.get("model_file"))
        if not path:
            return None
        try:
            modified = None
            with suppress(OSError):  # `read_model` reports a file that is missing
                modified = Path(path).stat().st_mtime_ns
            if (path, modified) != self._version:
                model = read_model(path)
                moves = any(sensor.name == DEVICE_FRAME_SENSOR for sensor in model.sensors)
                self.base = "" if moves else model.frames["base"]
                self.rest_tolerance = REST_SHARE * np.asarray(model.mechanism.joint_ranges)
                self.passive = model.mechanism.passive
                seen = [sensor.options for sensor in model.sensors if sensor.shows_pose]
                boards = (
                    f"{o['columns']}x{o['rows']}" for o in seen if {"columns", "rows"} <= set(o)
                )
                self.camera_board = next(boards, "")
                self._version, self._joints = (path, modified), model.joints
                self.model_trouble = ""
        except ParallelCalError as error:
            if self._version != str(error):
                if self._version is None and not os.path.lexists(path):
                    # Another node that is launched with this one may write it.
                    self._node.get_logger().warning(f"model file: {path} does not exist yet")
                else:
                    self._node.get_logger().error(f"model file: {error}")
            self._version, self._joints = str(error), None
            self.model_trouble = str(error)
        return self._joints

    def _check_changes(self, changes: Changes) -> SetParametersResult:
        """Refuse files that requests may not name, and a model file that cannot be read."""
        named = {c.name: c.value for c in changes if c.name in ("model_file", "output_file")}
        try:
            for name, file in named.items():
                if file:
                    self.folders.to_read(file)
                if file and name == "model_file":
                    read_model(absolute(file))
        except Exception as error:  # a user's own mechanism may raise anything
            return SetParametersResult(successful=False, reason=describe_error(error))
        return ACCEPTED
