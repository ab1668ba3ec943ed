"""kinematics_node follows a robot through its joint states: a hexapod with a seventh leg."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.wide]
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_helpers import LONG, NodeProcess
from sensor_msgs.msg import JointState
from test_extra_legs import SIGMA
from test_live_watch import states
from test_watch import calibrated

from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import Noise
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.parameters import LATCHED


def values_of(status):
    return {item.key: item.value for item in status.values}


def test_a_jump_is_published_and_is_in_the_diagnostics(tmp_path):
    write_model(replace(calibrated(), noise=Noise(joint=SIGMA)), tmp_path / "hexa.yaml")
    namespace, given = use_private_domain(), {"watch": True, "watch_interval": 29.0}
    # The test sends faster than a robot: what waits must not be dropped.
    qos = f"qos_overrides.{namespace}/joint_states.subscription"
    given |= {f"{qos}.reliability": "reliable", f"{qos}.depth": 1000}
    node = NodeProcess(
        "kinematics_node", tmp_path, namespace, model_file=str(tmp_path / "hexa.yaml"), **given
    )
    client = Client("tester", namespace, [node])
    heard, diagnosed = [], []
    own = client._node
    own.create_subscription(DiagnosticStatus, "kinematics_node/watch", heard.append, LATCHED)
    own.create_subscription(DiagnosticArray, "/diagnostics", diagnosed.append, 10)
    publisher = own.create_publisher(JointState, "joint_states", 1000)
    client.wait(lambda: publisher.get_subscription_count() >= 2, "both subscriptions", LONG)
    client.wait(lambda: diagnosed, "diagnostics", LONG)

    def recordings():
        return {values_of(status)["Recordings"]: status for status in heard}

    for day in range(6):
        for stamp, readings in states(day, 300e-6 * (day >= 5)):
            message = JointState(name=[*readings], position=[*readings.values()])
            message.header.stamp.sec = int(stamp)
            message.header.stamp.nanosec = round(1e9 * (stamp % 1))
            publisher.publish(message)
        client.wait(lambda count=str(day + 1): count in recordings(), f"recording {day}", LONG)
    last = recordings()["6"]
    assert last.level == DiagnosticStatus.WARN
    assert "what changed: leg3" in last.message
    assert values_of(last)["Probability of leg3"].endswith("%")
    assert recordings()["5"].message.startswith("no change")

    def is_in_diagnostics():
        entries = [s for s in diagnosed[-1].status if s.name.endswith("kinematics_node: watch")]
        return bool(entries) and entries[0].level == DiagnosticStatus.WARN

    client.wait(is_in_diagnostics, "the alarm in the diagnostics", LONG)
    client.close()
    assert node.end() == 0
    assert (tmp_path / "hexa.live_watch.json").exists()
