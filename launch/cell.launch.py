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

"""Start a simulated robot with both nodes: calibrate without a real robot.

ros2 launch parallel_cal cell.launch.py robot:=stewart effects:=hidden calibrate:=true
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
    TimerAction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

from parallel_cal.nodes.launch_arguments import (
    ARGUMENTS,
    CELL_ARGUMENTS,
    OF_CELL,
    cell_values,
    given_parameters,
    parameters_file_of,
)

POLL_INTERVAL_S = 0.2  # s between two looks whether the cell has written the model file


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(
            name, default_value=one.default, choices=one.choices or None, description=one.what
        )
        for name, one in CELL_ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def start(context):
    values = cell_values(
        {name: LaunchConfiguration(name).perform(context) for name in CELL_ARGUMENTS}
    )
    # The nodes start after the cell, so what is wrong with them is found before it starts.
    given_parameters(CELL_ARGUMENTS, values)
    if values["rviz"] == "true":
        FindPackageShare("rviz2").perform(context)
    share = FindPackageShare("parallel_cal")
    usual = PathJoinSubstitution([share, "config", "nodes", "parameters.yaml"])
    model = {"model_file": values["model_file"]}
    cell = Node(
        package="parallel_cal",
        executable="virtual_cell_node",
        name="virtual_cell_node",
        namespace=values["namespace"],
        parameters=[
            parameters_file_of(values, usual),
            given_parameters(OF_CELL, values) | model,
        ],
        output=values["output"],
        ros_arguments=["--log-level", values["log_level"]],
        on_exit=Shutdown(reason="the cell has ended"),
    )
    return [cell, *start_nodes(values)]


def start_nodes(values):
    """Start both nodes as soon as there is a model file: the cell writes the nominal model."""
    if not Path(values["model_file"]).exists():
        again = OpaqueFunction(function=lambda context: start_nodes(values))
        return [TimerAction(period=POLL_INTERVAL_S, actions=[again])]
    both = PythonLaunchDescriptionSource(str(Path(__file__).with_name("calibration.launch.py")))
    nodes = IncludeLaunchDescription(
        both, launch_arguments=[(name, values[name]) for name in ARGUMENTS]
    )
    if values["calibrate"] == "false":
        return [nodes]
    command = [
        ExecutableInPackage(package="parallel_cal", executable="parallel-cal"),
        *("calibrate", values["model_file"], "--namespace", values["namespace"]),
    ]
    return [nodes, ExecuteProcess(cmd=command, output=values["output"])]
