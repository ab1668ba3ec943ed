"""MoveIt: a package with a plug-in of kinematics::KinematicsBase for the calibrated model."""

from __future__ import annotations

from parallel_cal.exporting.targets._ros_package import (
    COORDINATES,
    Plugin,
    is_out_of_reach,
    neutral_solutions,
    package,
)
from parallel_cal.model.model import Model

# The pose of a solution may differ by this from the target, in coordinates that the robot does not
# control. Both are parameters of the plug-in.
POSITION_TOLERANCE = 1e-4  # m
ORIENTATION_TOLERANCE = 1e-2  # rad

PLUGIN = Plugin(
    kind="moveit",
    base_package="moveit_core",
    base_class="kinematics::KinematicsBase",
    description="Calibrated kinematics of {} for MoveIt",
    depends=(
        "ament_index_cpp",
        "moveit_core",
        "moveit_msgs",
        "pluginlib",
        "rclcpp",
        "srdfdom",
        "urdfdom",
    ),
    libraries=(
        "ament_index_cpp::ament_index_cpp",
        "moveit_core::moveit_kinematics_base",
        "moveit_core::moveit_robot_model",
        "pluginlib::pluginlib",
        "rclcpp::rclcpp",
        "urdfdom::urdfdom_model",
    ),
    headers=("solver.hpp",),
)


def files(
    model: Model, name: str = "", poses: int = 200, base: str = "", tip: str = ""
) -> dict[str, str]:
    """Return the package `name`_moveit; the default is the mechanism's name.

    `base` and `tip` are the links of {B} and {P}, by default the frames of the model file. Its
    self-test compares with `poses` solutions.
    """
    m = model.mechanism
    words = {
        "position_tolerance": repr(POSITION_TOLERANCE),
        "orientation_tolerance": repr(ORIENTATION_TOLERANCE),
        "slides": ", ".join(str(unit == "m").lower() for unit in m.joint_units),
        "controlled": ", ".join(str(axis in m.controls).lower() for axis in COORDINATES),
        "unique": str(model.structure.phi.shape[0] >= len(model.joints) + len(m.parasitic)).lower(),
        "out_of_reach": str(is_out_of_reach(model, neutral_solutions(model, 1))).lower(),
    }
    return package(model, PLUGIN, name, poses, (base, tip), **words)
