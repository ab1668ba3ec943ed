"""Start a simulated robot with both nodes: calibrate without a real robot.

ros2 launch parallel_cal cell.launch.py model_file:=robot.yaml robot:=stewart effects:=hidden
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

OF_THE_CELL = {
    "robot": (str, "delta", "delta, stewart, argos or linear_delta"),
    "seed": (int, "0", "seed of the geometric errors, hidden effects and noise"),
    "effects": (str, "", "effects of the robot, separated by commas; hidden = one drawn at random"),
    "rate": (float, "1.0", "factor on real time"),
    "device": (str, "tracker", "tracker, or camera: a camera before a board on the platform"),
}


def generate_launch_description():
    model = {"model_file": ParameterValue(LaunchConfiguration("model_file"), value_type=str)}
    cell = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type)
        for name, (type, _, _) in OF_THE_CELL.items()
    }
    images = ParameterValue(LaunchConfiguration("images"), value_type=str)
    nodes = {
        "virtual_cell_node": model | cell,
        "kinematics_node": model,
        "calibration_node": model | {"images": images},
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "model_file",
                description="model file of the robot; if missing, the nominal model is written",
            ),
            DeclareLaunchArgument(
                "images",
                default_value="",
                description="topic of the camera's images: with device:=camera, "
                "camera/image_raw/compressed",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of all nodes"
            ),
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
