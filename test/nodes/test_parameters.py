"""Parameters of the nodes: their types and their limits, as any client sees them."""

import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")

from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from parallel_cal.base.errors import ParallelCalError  # noqa: E402
from parallel_cal.nodes.calibration_settings import PARAMETERS  # noqa: E402
from parallel_cal.nodes.parameters import Setting, declare  # noqa: E402

SETTINGS = {
    "share": Setting(0.25, "a share", (0, 0.5)),
    "period": Setting(0.5, "a period, s", (0.01, 3600), fixed=True),
    "count": Setting(3, "a count", (1, 10)),
}


@pytest.fixture
def make_node():
    context, nodes = Context(), []
    rclpy.init(context=context)

    def make(*given, settings=SETTINGS):
        words = ["--ros-args", *(word for one in given for word in ("-p", one))]
        nodes.append(Node("tester", context=context, cli_args=words, use_global_arguments=False))
        declare(nodes[-1], settings)
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def kind(node, name):
    return node.get_parameter(name).type_


def test_an_integer_for_a_float_parameter_is_stored_as_a_float(make_node):
    node = make_node("share:=0", "period:=2")
    assert kind(node, "share") == kind(node, "period") == Parameter.Type.DOUBLE
    assert node.get_parameter("period").value == 2.0
    (result,) = node.set_parameters([Parameter("share", Parameter.Type.DOUBLE, 0.5)])
    assert result.successful
    (result,) = node.set_parameters([Parameter("share", Parameter.Type.INTEGER, 0)])
    assert result.successful, result.reason
    assert kind(node, "share") == Parameter.Type.DOUBLE
    assert node.get_parameter("share").value == 0.0


def test_an_integer_beyond_the_limits_of_a_float_parameter_is_refused(make_node):
    node = make_node()
    (result,) = node.set_parameters([Parameter("share", Parameter.Type.INTEGER, 1)])
    assert not result.successful
    assert node.get_parameter("share").value == 0.25
    (result,) = node.set_parameters([Parameter("period", Parameter.Type.INTEGER, 1)])
    assert not result.successful  # read at the start only


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("mode:=walk", "auto or dwell or continuous"),
        ("look_period:=-1.0", "a number from 0.01 to 3600"),
        ("pose_type:=Pose", "PoseWithCovarianceStamped or PoseStamped"),
        ("joint_sigma:=.nan", "a number from 0 to 1"),
    ],
)
def test_what_a_calibration_does_not_allow_is_refused_at_the_start(make_node, given, expected):
    with pytest.raises(ParallelCalError) as refused:
        make_node(given, settings=PARAMETERS)
    name = given.partition(":")[0]
    assert str(refused.value).startswith(f"parameter {name}: expected {expected}: ")


@pytest.mark.parametrize("given", ["share:=2", "share:=true", "share:=some", "count:=2.5"])
def test_a_value_of_another_kind_or_beyond_the_limits_is_refused_at_the_start(make_node, given):
    with pytest.raises(ParallelCalError, match=f"parameter {given.split(':')[0]}: expected"):
        make_node(given)
