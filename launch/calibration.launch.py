"""Both nodes on one model file: calibrate with one, use the result at once with the other.

ros2 launch parallel_cal calibration.launch.py model_file:=robot.yaml \
    joint_states:=/robot/joint_states measured_pose:=/tracker/pose
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

TOPICS = {
    "joint_states": "sensor_msgs/JointState, the encoder readings",
    "measured_pose": "geometry_msgs/PoseStamped or PoseWithCovarianceStamped from the device",
    "measured_position": "geometry_msgs/PointStamped, for position-only devices",
    "temperature": "sensor_msgs/Temperature",
    "payload": "geometry_msgs/InertiaStamped, m in kg",
    "target_pose": "geometry_msgs/PoseStamped to be turned into joint commands",
}


def generate_launch_description():
    remappings = [(topic, LaunchConfiguration(topic)) for topic in TOPICS]
    # A path that looks like a number must stay a string.
    model = {"model_file": ParameterValue(LaunchConfiguration("model_file"), value_type=str)}
    return LaunchDescription(
        [
            DeclareLaunchArgument("model_file", description="model file (YAML) of the robot"),
            DeclareLaunchArgument("namespace", default_value="", description="of both nodes"),
            *(
                DeclareLaunchArgument(topic, default_value=topic, description=what)
                for topic, what in TOPICS.items()
            ),
            *(
                Node(
                    package="parallel_cal",
                    executable=node,
                    name=node,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=[model],
                    remappings=remappings,
                    output="screen",
                )
                for node in ("kinematics_node", "calibration_node")
            ),
        ]
    )
