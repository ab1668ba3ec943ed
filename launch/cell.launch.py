"""A virtual cell and both nodes on it: a robot that can be calibrated without one.

ros2 launch parallel_cal cell.launch.py model_file:=robot.yaml robot:=stewart effects:=hidden
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

OF_THE_CELL = {
    "robot": (str, "delta", "delta, stewart, argos or linear_delta"),
    "seed": (int, "0", "draws how it was built, what is hidden in it, and all noise"),
    "effects": (str, "", "physics that it has, by commas; hidden: one that is not told"),
    "rate": (float, "1.0", "how many times faster than life"),
}


def generate_launch_description():
    model = {"model_file": ParameterValue(LaunchConfiguration("model_file"), value_type=str)}
    cell = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type)
        for name, (type, _, _) in OF_THE_CELL.items()
    }
    nodes = {"virtual_cell_node": model | cell, "kinematics_node": model, "calibration_node": model}
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "model_file", description="its model file: the nominal one, unless there is one"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="of all nodes"),
            *(
                DeclareLaunchArgument(name, default_value=default, description=what)
                for name, (_, default, what) in OF_THE_CELL.items()
            ),
            *(
                Node(
                    package="parallel_cal",
                    executable=node,
                    name=node,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=[parameters],
                    output="screen",
                )
                for node, parameters in nodes.items()
            ),
        ]
    )
