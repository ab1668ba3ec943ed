"""The launch files start the nodes with the parameters file and the arguments that are given.

launch is not to be had from PyPI: its few classes are stood in for here, and what they were told is
carried out the way launch_ros does.
"""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock
from xml.etree import ElementTree

import pytest
import yaml

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from ros_helpers import NodeProcess

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes import calibration_node, calibration_settings, kinematics_node
from parallel_cal.nodes import launch_arguments as arguments_of
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.virtual_cell_node import SET_UP

REPOSITORY = Path(__file__).parents[2]
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
PARAMETERS_FILE = REPOSITORY / "config" / "nodes" / "parameters.yaml"
CLASSES = {
    "launch": ["LaunchDescription"],
    "launch.actions": [
        "DeclareLaunchArgument",
        "ExecuteProcess",
        "IncludeLaunchDescription",
        "OpaqueFunction",
        "Shutdown",
        "TimerAction",
    ],
    "launch.launch_description_sources": ["PythonLaunchDescriptionSource"],
    "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.substitutions": ["ExecutableInPackage", "FindPackageShare"],
}
PAGE = (REPOSITORY / "docs" / "ros.md").read_text()
OF_ROS = ("/parameter_events", "/rosout", "/diagnostics", "/clock", "/tf")


class Told(SimpleNamespace):
    """What a class of launch was constructed with."""

    def __init__(self, *values, **named):
        super().__init__(values=values, **named)

    def perform(self, context):
        """As LaunchConfiguration does, and FindPackageShare of a package."""
        if kind(self) == "FindPackageShare" and self.values[0] in context.get("missing", ()):
            raise LookupError(f"package '{self.values[0]}' not found")
        return context.get(self.values[0])


def described(file):
    """The actions of a launch file."""
    modules = {
        name: SimpleNamespace(**{c: type(c, (Told,), {}) for c in classes})
        for name, classes in CLASSES.items()
    }
    with mock.patch.dict(sys.modules, modules):
        launched = runpy.run_path(str(REPOSITORY / "launch" / file))
        return launched["generate_launch_description"]().values[0]


def kind(action):
    return type(action).__name__


def arguments(actions):
    return {a.values[0]: a for a in actions if kind(a) == "DeclareLaunchArgument"}


def launched(file, **given):
    """What a launch file does with these arguments: the actions of its function."""
    actions = described(file)
    values = {name: a.default_value for name, a in arguments(actions).items()}
    assert set(given) <= {*values, "missing"}
    [function] = [a.function for a in actions if kind(a) == "OpaqueFunction"]
    return function(values | given)


def parameters_of(node):
    """The parameters file of a node, and the parameters that replace its values."""
    file, given = node.parameters
    if not isinstance(file, str):
        file = installed(file)
    return file, given


def installed(path):
    """The file in this repository that a path into the share folder of the package means."""
    first, *names = path.values[0]
    if kind(first) == "FindPackageShare":
        assert first.values == ("parallel_cal",)
        return str(REPOSITORY.joinpath(*names))
    return str(Path(installed(first), *names))


def started(actions, folder):
    """The nodes of a launch file as processes."""
    for node in actions:
        assert (node.package, node.name) == ("parallel_cal", node.executable)
        file, given = parameters_of(node)
        rules = [
            word
            for topic, to in getattr(node, "remappings", ())
            for word in ("-r", f"{topic}:={to}")
        ]
        ros = ["--params-file", file, *rules, *node.ros_arguments]
        yield NodeProcess(node.executable, folder, node.namespace, ros=ros, **given)


@pytest.mark.parametrize("file", ["calibration.launch.py", "cell.launch.py"])
def test_every_argument_is_described_and_none_must_be_given(file):
    declared = arguments(described(file))
    assert all(a.description and isinstance(a.default_value, str) for a in declared.values())
    types = set(declared["pose_type"].choices) - {""}
    assert types == set(calibration_settings.POSE_TYPES)
    assert all(a.default_value in a.choices for a in declared.values() if a.choices)


def test_each_argument_of_a_node_is_a_parameter_of_it_with_its_type():
    both = arguments_of.OF_BOTH_NODES.items()
    for own, settings in (
        (arguments_of.OF_KINEMATICS, kinematics_node.PARAMETERS),
        (arguments_of.OF_CALIBRATION, calibration_node.PARAMETERS),
    ):
        for name, argument in [*own.items(), *both]:
            if name != "use_sim_time":  # every node of ROS has it
                assert type(settings[name].default) is argument.type, name
    for name, argument in arguments_of.OF_CELL.items():
        assert type(SET_UP[name].default) is argument.type, name


def test_without_arguments_the_parameters_file_counts():
    for node in launched("calibration.launch.py"):
        assert parameters_of(node) == (str(PARAMETERS_FILE), {})
        assert (node.output, node.ros_arguments) == ("screen", ["--log-level", "info"])


def test_arguments_replace_values_of_the_parameters_file_with_their_types(tmp_path):
    mine = str(tmp_path / "mine.yaml")
    Path(mine).write_text("")
    given = {
        "params_file": mine,
        "model_file": "12",
        "output_file": "better.yaml",
        "trajectory_action": "/arm/follow",
        "driver_type": "tf2_msgs/msg/TFMessage",
        "body": "7",
        "images": "camera/image_raw",
        "journal": "false",
        "autostart": "true",
        "tf_rate": "5",
        "output": "both",
        "log_level": "debug",
    }
    kinematics, calibration = launched("calibration.launch.py", **given)
    both = {"model_file": "12", "trajectory_action": "/arm/follow", "autostart": True}
    assert parameters_of(kinematics) == (mine, both | {"tf_rate": 5.0})
    assert parameters_of(calibration) == (
        mine,
        both
        | {
            "output_file": "better.yaml",
            "driver_type": "tf2_msgs/msg/TFMessage",
            "body": "7",
            "images": "camera/image_raw",
            "journal": False,
        },
    )
    assert calibration.output == "both"
    assert calibration.ros_arguments == ["--log-level", "debug"]


@pytest.mark.parametrize("file", ["calibration.launch.py", "cell.launch.py"])
def test_a_parameters_file_that_is_missing_is_refused(file, tmp_path):
    with pytest.raises(ParallelCalError, match=r"params_file '.*mine.yaml': no such file"):
        launched(file, params_file=str(tmp_path / "mine.yaml"), model_file=str(tmp_path / "m.yaml"))


def test_an_argument_that_is_no_number_is_refused_with_its_name():
    with pytest.raises(ParallelCalError, match="launch argument tf_rate 'fast': expected a number"):
        launched("calibration.launch.py", tf_rate="fast")
    with pytest.raises(ParallelCalError, match=r"seed '1.5': expected a whole number"):
        launched("cell.launch.py", seed="1.5")
    with pytest.raises(ParallelCalError, match="tf_rate 'fast'"):  # before the cell has started
        launched("cell.launch.py", tf_rate="fast")


@pytest.mark.parametrize("file", ["calibration.launch.py", "cell.launch.py"])
def test_nothing_starts_where_rviz_is_asked_for_and_missing(file, tmp_path):
    given = {"rviz": "true", "model_file": str(tmp_path / "robot.yaml")}
    with pytest.raises(LookupError, match="rviz2"):
        launched(file, **given, missing=("rviz2",))


def test_a_recording_of_the_topics_under_their_names_is_started_on_request():
    *_, record = launched(
        "calibration.launch.py",
        bag="day1",
        namespace="arm",
        measured_pose="/tf",
        images="left, right",
    )
    assert record.cmd[:7] == ["ros2", "bag", "record", "-s", "mcap", "-o", "day1"]
    assert {"/arm/joint_states", "/tf", "/tf_static", "/arm/left", "/arm/right"} <= {
        *record.cmd[7:]
    }


def test_rviz_shows_the_topics_of_the_nodes_in_their_namespace():
    *_, rviz = launched(
        "calibration.launch.py", rviz="true", namespace="/arm", fixed_frame="base_link"
    )
    assert rviz.package == "rviz2"
    assert rviz.arguments[0] == "-d"
    assert rviz.arguments[2:] == ["-f", "base_link"]
    text = Path(installed(rviz.arguments[1])).read_text()
    shown = {
        display["Topic" if "Topic" in display else "Description Topic"]["Value"]
        for display in yaml.safe_load(text)["Visualization Manager"]["Displays"]
        if {"Topic", "Description Topic"} & set(display)
    }
    assert dict(rviz.remappings) == {topic: f"/arm{topic}" for topic in shown}
    policy = ElementTree.parse(REPOSITORY / "config" / "sros2_policy.xml")
    published = {
        topic.text.replace("~", f"/{profile.get('node')}")
        for profile in policy.iter("profile")
        for part in profile.iter("topics")
        if part.get("publish")
        for topic in part
    }
    assert shown <= published


@mock.patch.dict(os.environ)
def test_the_cell_starts_without_arguments_with_a_model_file_of_its_own(tmp_path):
    os.environ["ROS_HOME"] = str(tmp_path)
    cell, wait = launched("cell.launch.py")
    file = tmp_path / "parallel_cal" / "cell_delta_0.yaml"
    assert parameters_of(cell) == (str(PARAMETERS_FILE), {"model_file": str(file)})
    assert kind(cell.on_exit) == "Shutdown"
    # The other nodes wait until the cell has written the file.
    [again] = wait.actions
    [wait] = again.function(None)
    assert kind(wait) == "TimerAction"
    file.write_text("")
    [nodes] = wait.actions[0].function(None)
    assert kind(nodes) == "IncludeLaunchDescription"
    assert nodes.values[0].values == (str(REPOSITORY / "launch" / "calibration.launch.py"),)
    assert dict(nodes.launch_arguments)["model_file"] == str(file)
    assert set(dict(nodes.launch_arguments)) == set(arguments(described("calibration.launch.py")))


def test_the_cell_with_a_camera_gives_the_node_its_images_and_starts_a_campaign(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("")
    cell, nodes, campaign = launched(
        "cell.launch.py",
        model_file=str(file),
        robot="stewart",
        seed="3",
        rate="4",
        device="camera",
        namespace="a",
        calibrate="true",
    )
    own = {"robot": "stewart", "seed": 3, "rate": 4.0, "device": "camera"}
    assert parameters_of(cell)[1] == {**own, "model_file": str(file)}
    assert dict(nodes.launch_arguments)["images"] == "camera/image_raw/compressed"
    program, *words = campaign.cmd
    assert (program.package, program.executable) == ("parallel_cal", "parallel-cal")
    assert words == ["calibrate", str(file), "--namespace", "a"]


@pytest.mark.parametrize("node", [kinematics_node, calibration_node])
def test_the_page_about_the_nodes_names_every_parameter(node):
    assert [name for name in node.PARAMETERS if f"`{name}`" not in PAGE] == []


def test_the_page_about_the_nodes_names_every_launch_argument():
    named = set(arguments(described("cell.launch.py"))) - set(arguments_of.TOPICS)
    assert [name for name in named if f"`{name}`" not in PAGE] == []


@mock.patch.dict(os.environ)
def test_both_nodes_run_with_every_topic_under_the_name_given(tmp_path):
    namespace = use_private_domain()
    topics = set(arguments_of.TOPICS)
    given = {"model_file": str(PRESET), "namespace": namespace, "pose_type": "PoseStamped"}
    actions = launched("calibration.launch.py", **given, **{t: f"arm/{t}" for t in topics})
    processes = list(started(actions, tmp_path))
    client = Client("tester", namespace, processes)
    names = [process.node for process in processes]
    used = dict.fromkeys(names, frozenset())

    def complete():
        for name in names:
            if (name, namespace) in client._node.get_node_names_and_namespaces():
                used[name] = topics_of(client._node, name, namespace)
        return {f"{namespace}/arm/{t}" for t in topics} <= frozenset().union(*used.values())

    try:
        client.wait(complete, "all topics")
        services = [
            (service, type)
            for name in names
            for service, (type,) in client._node.get_service_names_and_types_by_node(
                name, namespace
            )
        ]
    finally:
        client.close()
        ends = [process.end() for process in processes]
    assert (names, ends) == (["kinematics_node", "calibration_node"], [0, 0])
    for service, type in services:
        ours = type.startswith(("parallel_cal_msgs/srv", "std_srvs/"))
        assert f"`~/{service.split('/')[-1]}`" in PAGE or not ours, service
    own = tuple(f"{namespace}/{name}/" for name in names)
    for topic in frozenset().union(*used.values()):
        assert topic.startswith((f"{namespace}/arm/", *own, *OF_ROS)), topic
        assert f"{topic.split('/')[-1]}`" in PAGE or topic in OF_ROS, topic


def topics_of(node, name, namespace):
    heard = node.get_subscriber_names_and_types_by_node(name, namespace)
    told = node.get_publisher_names_and_types_by_node(name, namespace)
    return frozenset(topic for topic, _ in heard + told if "/_action/" not in topic)
