"""The arguments of the launch files, and the parameters that they set.

An argument that is not given sets nothing, so that the parameters file counts. This module needs
neither rclpy nor launch.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from parallel_cal.base.errors import ParallelCalError

Values = Mapping[str, str]


class Argument(NamedTuple):
    """An argument of a launch file: its meaning, its default, the allowed values, and the type of
    the parameter of the same name, if it sets one."""

    what: str
    default: str = ""
    choices: tuple[str, ...] = ()
    type: type = str


SWITCH = ("", "true", "false")
LEVELS = ("debug", "info", "warn", "error", "fatal")
# The arguments that are parameters of the same name; empty = as in the parameters file.
OF_BOTH_NODES = {
    "model_file": Argument("model file (YAML) of the robot"),
    "trajectory_action": Argument(
        "name of the controller's action FollowJointTrajectory; empty: topics"
    ),
    "allowed_folders": Argument("folders that requests may name, separated by colons"),
    "autostart": Argument("activate the nodes at the start", choices=SWITCH, type=bool),
    "use_sim_time": Argument("take the time from /clock", choices=SWITCH, type=bool),
}
OF_KINEMATICS = {
    "tf_rate": Argument("largest rate of the transforms of all links on /tf, Hz", type=float),
    "frame_prefix": Argument("text before each frame on /tf, such as calibrated/"),
}
OF_CALIBRATION = {
    "output_file": Argument("file for the improved model; empty: the model file"),
    "pose_type": Argument(
        "type of measured_pose, from geometry_msgs",
        choices=("", "PoseWithCovarianceStamped", "PoseStamped"),
    ),
    "driver_type": Argument("full name of another type of measured_pose, from a driver"),
    "body": Argument("with driver_type: the body, tag or frame that is measured"),
    "images": Argument("topics of the images of a printed board, separated by commas"),
    "board": Argument("the board in the images, such as 8x6:5X5_100"),
    "journal": Argument("write each sample to disk at once", choices=SWITCH, type=bool),
    "journal_folder": Argument("folder of the journal; empty: ~/.ros/parallel_cal"),
    "record": Argument("record every message to an MCAP file", choices=SWITCH, type=bool),
}
OF_LAUNCH = {
    "params_file": Argument(
        "parameters of all nodes (YAML); empty: config/nodes/parameters.yaml of this package"
    ),
    "namespace": Argument("namespace of the nodes"),
    "log_level": Argument("least severe messages that the nodes log", "info", LEVELS),
    "output": Argument("where the nodes log", "screen", ("screen", "log", "both")),
    "bag": Argument("folder into which ros2 bag records all topics of a calibration; empty: none"),
    "rviz": Argument("show the calibrated robot in RViz", "false", SWITCH[1:]),
    "fixed_frame": Argument("with rviz: the base frame of the model", "base"),
}
TOPICS = {
    "joint_states": "sensor_msgs/JointState, the encoder readings",
    "measured_pose": "poses from the measuring device, see pose_type and driver_type",
    "measured_position": "geometry_msgs/PointStamped, for position-only devices",
    "constraint": "std_msgs/String, the constraint on the tip, if no device measures poses",
    "distance": "sensor_msgs/Range, a distance reading, if no device measures poses",
    "temperature": "sensor_msgs/Temperature",
    "payload": "geometry_msgs/InertiaStamped, the mass m in kg",
    "target_pose": "geometry_msgs/PoseStamped, a target pose for the robot",
    "target_path": "nav_msgs/Path, target poses for the robot to pass one after another",
    "joint_command": "trajectory_msgs/JointTrajectory, the joint command for a target",
    "joint_trajectory": "trajectory_msgs/JointTrajectory, the motions of a campaign",
}
ARGUMENTS = {
    **OF_BOTH_NODES,
    **OF_KINEMATICS,
    **OF_CALIBRATION,
    **OF_LAUNCH,
    **{topic: Argument(what, topic) for topic, what in TOPICS.items()},
}
# Of the simulated cell: the parameters of virtual_cell_node that a launch argument sets, too.
OF_CELL = {
    "robot": Argument("delta, stewart, argos or linear_delta"),
    "seed": Argument("seed of the geometric errors, hidden effects and noise", type=int),
    "effects": Argument("effects of the robot, separated by commas; hidden = one drawn at random"),
    "rate": Argument("factor on real time", type=float),
    "device": Argument("tracker, or camera: a camera before a board on the platform"),
}
CELL_ARGUMENTS = {
    **ARGUMENTS,
    **OF_CELL,
    "model_file": Argument(
        "model file of the robot; empty: one for each robot and seed in ~/.ros/parallel_cal. If "
        "missing, the nominal model is written"
    ),
    "calibrate": Argument("start a campaign", "false", SWITCH[1:]),
}
CELL_TF_RATE = "20.0"  # Hz
CAMERA_IMAGES = "camera/image_raw/compressed"  # of the cell's camera
RVIZ_TOPICS = [
    "/kinematics_node/robot_description",
    "/kinematics_node/pose",
    "/calibration_node/residuals",
    "/calibration_node/residuals/measured",
    "/calibration_node/residuals/predicted",
]


def given_parameters(arguments: Mapping[str, Argument], values: Values) -> dict[str, Any]:
    """Return the parameters that the arguments set; ParallelCalError if one has a wrong type."""
    return {
        name: _parse(name, one.type, values[name])
        for name, one in arguments.items()
        if values[name]
    }


def _parse(name: str, type: type, text: str) -> Any:
    """Convert the text of an argument; a path that looks like a number stays a string."""
    try:
        return text.lower() == "true" if type is bool else type(text)
    except ValueError:
        kind = {int: "a whole number", float: "a number"}[type]
        raise ParallelCalError(f"launch argument {name} '{text}': expected {kind}") from None


def parameters_file_of(values: Values, usual: Any) -> Any:
    """Return the parameters file, by default `usual`; ParallelCalError if it is missing.

    launch starts the nodes without a file that is missing, and only logs that.
    """
    if not values["params_file"]:
        return usual
    file = Path(values["params_file"]).expanduser()
    if not file.is_file():
        raise ParallelCalError(
            f"launch argument params_file '{file}': no such file; expected the parameters of the "
            "nodes (YAML)"
        )
    return str(file)


def cell_values(values: Values) -> dict[str, str]:
    """Complete the values of the cell: a model file for each robot, the images of its camera, and
    TF, of which it has no other source.

    The folder of the model file is made.
    """
    home = Path(os.environ.get("ROS_HOME") or "~/.ros").expanduser()
    name = f"cell_{values['robot'] or 'delta'}_{values['seed'] or 0}.yaml"
    path = Path(values["model_file"] or home / "parallel_cal" / name).expanduser().absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    images = CAMERA_IMAGES if values["device"] == "camera" else ""
    rate = CELL_TF_RATE if not values["params_file"] and find_spec("tf2_msgs") else ""
    return {
        **values,
        "model_file": str(path),
        "images": values["images"] or images,
        "tf_rate": values["tf_rate"] or rate,
    }


def in_namespace(namespace: str, topics: Iterable[str]) -> list[tuple[str, str]]:
    """Return remappings of absolute topics into a namespace, for RViz; none if it is empty."""
    space = namespace.strip("/")
    return [(topic, f"/{space}{topic}") for topic in topics] if space else []


def record_command(values: Values) -> list[str]:
    """Return the words of the command that records the topics of a calibration."""
    from parallel_cal.recordings.channels import list_channels
    from parallel_cal.recordings.options import ReadOptions
    from parallel_cal.recordings.record_topics import list_record_topics, make_record_command

    channels = set(list_channels("joints", "poses", "condition", "words", "readings"))
    options = ReadOptions(
        topics={name: values[name] for name in TOPICS if name in channels},
        images=[name.strip() for name in values["images"].split(",") if name.strip()],
    )
    return make_record_command(list_record_topics(options, values["namespace"]), values["bag"])
