"""The parameters file holds every parameter of every node at its default, and nodes accept it."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

from importlib import import_module
from pathlib import Path

import pytest
import yaml
from marks import keep

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

import rclpy
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from ros_helpers import NodeProcess

from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.parameters_file import NODES, parameters_file

FILE = Path(__file__).parents[2] / "config" / "nodes" / "parameters.yaml"


def settings(node):
    return import_module(f"parallel_cal.nodes.{node}").PARAMETERS


def test_the_file_is_what_the_nodes_declare():
    assert FILE.read_text() == parameters_file(), "python -m parallel_cal.nodes.parameters_file"
    sections = yaml.safe_load(FILE.read_text())
    assert set(sections) == {f"/**/{node}" for node in NODES}
    for node in NODES:
        values = sections[f"/**/{node}"]["ros__parameters"]
        assert values == {name: one.default for name, one in settings(node).items()}
        for name, one in settings(node).items():
            assert type(values[name]) is type(one.default), name


@pytest.mark.parametrize("namespace", ["", "cell/arm"])
def test_values_of_the_file_arrive_in_every_namespace(namespace, tmp_path):
    text = FILE.read_text().replace("time_from_start: 0.1\n", "time_from_start: 7\n")
    assert text != FILE.read_text()
    (tmp_path / "mine.yaml").write_text(text)
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(tmp_path / "mine.yaml")])
    node = rclpy.create_node("kinematics_node", namespace=namespace, context=context)
    try:
        assert node._parameter_overrides["time_from_start"].value == 7
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.mark.wide
@pytest.mark.parametrize(
    "node",
    keep(["kinematics_node", "calibration_node", "virtual_cell_node"], "calibration_node"),
)
def test_what_a_node_dumps_starts_it_again_with_the_same_parameters(node, tmp_path):
    """As `ros2 param dump` writes it: every parameter that the node lists, with its value."""
    namespace = use_private_domain()

    def dumped(*ros, **given):
        process = NodeProcess(node, tmp_path, namespace, ros=ros, **given)
        client = Client("tester", namespace, [process])
        names = client.call(ListParameters, f"{node}/list_parameters").result.names
        values = client.call(GetParameters, f"{node}/get_parameters", names=names).values
        client.close()
        assert process.end() == 0
        return dict(zip(names, map(parameter_value_to_python, values), strict=True))

    first = dumped("--params-file", str(FILE), model_file=str(tmp_path / "robot.yaml"))
    assert {**first, "model_file": ""} | settings_defaults(node) == {**first, "model_file": ""}
    file = tmp_path / "dumped.yaml"
    file.write_text(yaml.safe_dump({f"{namespace}/{node}": {"ros__parameters": first}}))
    assert dumped("--params-file", str(file)) == first


def settings_defaults(node):
    return {name: one.default for name, one in settings(node).items()}
