# Copyright 2026 parallel_cal maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Start both nodes on one model file: one calibrates, the other uses the result at once.

ros2 launch parallel_cal calibration.launch.py model_file:=robot.yaml \
    joint_states:=/robot/joint_states measured_pose:=/tracker/pose
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from parallel_cal.nodes.launch_arguments import (
    ARGUMENTS,
    OF_BOTH_NODES,
    OF_CALIBRATION,
    OF_KINEMATICS,
    RVIZ_TOPICS,
    TOPICS,
    given_parameters,
    in_namespace,
    parameters_file_of,
    record_command,
)

OF_NODE = {"kinematics_node": OF_KINEMATICS, "calibration_node": OF_CALIBRATION}


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(
            name, default_value=one.default, choices=one.choices or None, description=one.what
        )
        for name, one in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def start(context):
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if values["rviz"] == "true":
        FindPackageShare("rviz2").perform(context)  # if it is missing, no node is started
    config = PathJoinSubstitution([FindPackageShare("parallel_cal"), "config"])
    usual = PathJoinSubstitution([config, "nodes", "parameters.yaml"])
    file = parameters_file_of(values, usual)
    actions = [
        Node(
            package="parallel_cal",
            executable=node,
            name=node,
            namespace=values["namespace"],
            # Later parameters count: the arguments replace what the file says.
            parameters=[file, given_parameters(OF_BOTH_NODES | own, values)],
            remappings=[(topic, values[topic]) for topic in TOPICS],
            output=values["output"],
            ros_arguments=["--log-level", values["log_level"]],
        )
        for node, own in OF_NODE.items()
    ]
    if values["bag"]:
        actions.append(ExecuteProcess(cmd=record_command(values), output=values["output"]))
    if values["rviz"] == "true":
        layout = PathJoinSubstitution([config, "calibration.rviz"])
        actions.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", layout, "-f", values["fixed_frame"]],
                remappings=in_namespace(values["namespace"], RVIZ_TOPICS),
                output=values["output"],
            )
        )
    return actions
