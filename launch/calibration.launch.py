"""Start both nodes on one model file: one calibrates, the other uses the result at once.

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
    "measured_pose": "poses from the measuring device, see pose_type",
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
POSE_TYPES = ["PoseWithCovarianceStamped", "PoseStamped"]


def generate_launch_description():
    remappings = [(topic, LaunchConfiguration(topic)) for topic in TOPICS]
    # Types are named: a path that looks like a number must stay a string.
    types = {"model_file": str, "pose_type": str, "use_sim_time": bool}
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type)
        for name, type in types.items()
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("model_file", description="model file (YAML) of the robot"),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of both nodes"
            ),
            DeclareLaunchArgument(
                "pose_type",
                default_value=POSE_TYPES[0],
                choices=POSE_TYPES,
                description="type of measured_pose, from geometry_msgs",
            ),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", description="take the time from /clock"
            ),
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
                    parameters=[parameters],
                    remappings=remappings,
                    output="screen",
                )
                for node in ("kinematics_node", "calibration_node")
            ),
        ]
    )
