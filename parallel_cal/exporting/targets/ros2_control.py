"""ros2_control: a package with a plug-in of kinematics_interface for the calibrated model."""

from __future__ import annotations

from parallel_cal.exporting.targets._ros_package import Plugin, package
from parallel_cal.model.model import Model

PLUGIN = Plugin(
    kind="ros2_control",
    base_package="kinematics_interface",
    base_class="kinematics_interface::KinematicsInterface",
    description="Calibrated kinematics of {} for ros2_control",
    depends=("ament_index_cpp", "kinematics_interface", "pluginlib", "rclcpp"),
    libraries=(
        "ament_index_cpp::ament_index_cpp",
        "kinematics_interface::kinematics_interface",
        "pluginlib::pluginlib",
        "rclcpp::rclcpp",
    ),
)


def files(
    model: Model, name: str = "", poses: int = 200, base: str = "", tip: str = ""
) -> dict[str, str]:
    """Return the package `name`_ros2_control; the default is the mechanism's name.

    `base` and `tip` are the links of {B} and {P}, by default the frames of the model file. Its
    self-test compares with `poses` solutions.
    """
    return package(model, PLUGIN, name, poses, (base, tip))
