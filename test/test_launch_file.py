"""The launch file starts both nodes, and all their topics can be given other names.

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

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from ros_helpers import NodeProcess

from parallel_cal.nodes import calibration_node, calibration_settings, kinematics_node
from parallel_cal.nodes.client import Client, use_private_domain

REPOSITORY = Path(__file__).parents[1]
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
CLASSES = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument"],
    "launch.substitutions": ["LaunchConfiguration"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.parameter_descriptions": ["ParameterValue"],
}
PAGE = (REPOSITORY / "docs" / "ros.md").read_text()
OF_ROS = ("/parameter_events", "/rosout", "/diagnostics", "/clock")


class Told(SimpleNamespace):
    """What a class of launch was constructed with."""

    def __init__(self, *values, **named):
        super().__init__(values=values, **named)


def described(file):
    """The actions of a launch file."""
    modules = {
        name: SimpleNamespace(**{c: type(c, (Told,), {}) for c in classes})
        for name, classes in CLASSES.items()
    }
    with mock.patch.dict(sys.modules, modules):
        launched = runpy.run_path(str(REPOSITORY / "launch" / file))
        return launched["generate_launch_description"]().values[0]


@pytest.fixture
def actions():
    return described("calibration.launch.py")


def arguments(actions):
    return {a.values[0]: a for a in actions if type(a).__name__ == "DeclareLaunchArgument"}


def started(actions, folder, given):
    """Both nodes as processes, with every argument's value where it is asked for."""
    defaults = {n: getattr(a, "default_value", None) for n, a in arguments(actions).items()}
    values = defaults | given
    for node in (a for a in actions if type(a).__name__ == "Node"):
        assert (node.package, node.name) == ("parallel_cal", node.executable)
        remapped = [f"{topic}:={values[to.values[0]]}" for topic, to in node.remappings]
        ros = [word for rule in remapped for word in ("-r", rule)]
        parameters = {n: values[p.values[0].values[0]] for n, p in node.parameters[0].items()}
        parameters["use_sim_time"] = parameters["use_sim_time"] == "true"
        namespace = values[node.namespace.values[0]]
        yield NodeProcess(node.executable, folder, namespace, ros=ros, **parameters)


def test_every_argument_is_described_and_only_the_model_file_has_no_default(actions):
    declared = arguments(actions)
    assert all(a.description for a in declared.values())
    assert [n for n, a in declared.items() if not hasattr(a, "default_value")] == ["model_file"]
    assert declared["pose_type"].choices == list(calibration_settings.POSE_TYPES)


@pytest.mark.parametrize("node", [kinematics_node, calibration_node])
def test_the_page_about_the_nodes_names_every_parameter(node):
    assert [name for name in node.PARAMETERS if f"`{name}`" not in PAGE] == []


@mock.patch.dict(os.environ)
def test_both_nodes_run_with_every_topic_under_the_name_given(actions, tmp_path):
    namespace = use_private_domain()
    topics = {n for n, a in arguments(actions).items() if vars(a).get("default_value") == n}
    given = {"model_file": str(PRESET), "namespace": namespace, "pose_type": "PoseStamped"}
    processes = list(started(actions, tmp_path, given | {t: f"arm/{t}" for t in topics}))
    client = Client("tester", namespace, processes)
    names = [process.node for process in processes]
    used = dict.fromkeys(names, frozenset())

    def complete():
        for name in names:
            if (name, namespace) in client._node.get_node_names_and_namespaces():
                used[name] = topics_of(client._node, name, namespace)
        return {f"{namespace}/arm/{t}" for t in topics} <= frozenset().union(*used.values())

    client.wait(complete, "all topics")
    for name in names:
        for service, (type,) in client._node.get_service_names_and_types_by_node(name, namespace):
            ours = type.startswith(("parallel_cal_msgs/srv", "std_srvs/"))
            assert f"`~/{service.split('/')[-1]}`" in PAGE or not ours, service
    client.close()
    assert names == ["kinematics_node", "calibration_node"]
    own = tuple(f"{namespace}/{name}/" for name in names)
    for topic in frozenset().union(*used.values()):
        assert topic.startswith((f"{namespace}/arm/", *own, *OF_ROS)), topic
        assert f"{topic.split('/')[-1]}`" in PAGE or topic in OF_ROS, topic
    assert [process.end() for process in processes] == [0, 0]


def topics_of(node, name, namespace):
    heard = node.get_subscriber_names_and_types_by_node(name, namespace)
    told = node.get_publisher_names_and_types_by_node(name, namespace)
    return frozenset(topic for topic, _ in heard + told if "/_action/" not in topic)
