"""The replay node: every message, in order, at its time over the rate, with its own stamp."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

import rclpy
from geometry_msgs.msg import InertiaStamped, PoseWithCovarianceStamped
from rclpy.qos import QoSProfile
from ros_helpers import LONG, NodeProcess
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from parallel_cal.nodes import replay_node
from parallel_cal.nodes.client import LATCHED, Client, use_private_domain
from parallel_cal.recordings.bag import list_topics, raw_messages

BAG = Path(__file__).parents[2] / "bags" / "delta_clean"
COUNTS = {topic.name: topic.count for topic in list_topics(BAG)[0]}
NODE = "replay_node"


@pytest.fixture
def client():
    with mock.patch.dict(os.environ):
        namespace = use_private_domain()
        client = Client("listener", namespace, [])
        client.namespace = namespace
        yield client
        client.close()


def listen(client, type, topic, qos=None):
    heard = []
    qos = QoSProfile(depth=50_000) if qos is None else qos
    client._node.create_subscription(type, topic, heard.append, qos)
    return heard


class Clock:
    """Time that goes on only when somebody sleeps, or is busy."""

    def __init__(self):
        self.now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def sent(client, monkeypatch):
    """sent(rate, busy): the recording's messages as (s when due, s when sent), on a clock of its
    own; `busy` are s that publishing a message of that number takes."""

    def play(rate, busy):
        clock, when = Clock(), []

        def publish(data):
            when.append(clock.now)
            clock.now += busy.get(len(when) - 1, 0.0)

        monkeypatch.setattr(replay_node, "time", clock)
        rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        try:
            node = replay_node.ReplayNode(
                lambda: True, bag=str(BAG), rate=rate, wait_for_subscribers=0
            )
            sender = SimpleNamespace(publish=publish, wait_for_all_acked=lambda limit: True)
            node._senders = dict.fromkeys(node._senders, sender)
            assert node.play() == 0
            node.destroy_node()
        finally:
            rclpy.shutdown()
        logged = [message.time for message in raw_messages(BAG)]
        return [(log - logged[0]) * 1e-9 / rate for log in logged], when

    return play


@pytest.mark.parametrize("rate", [0.5, 30.0])
def test_every_message_is_sent_when_it_was_recorded_over_the_rate(sent, rate):
    due, when = sent(rate, {})
    assert when == pytest.approx(due, abs=1e-9)
    assert due[-1] == pytest.approx(replay_node.list_topics(BAG)[1] / rate, rel=1e-3)


def test_what_is_late_is_sent_at_once_and_the_rest_in_time(sent):
    due, when = sent(30.0, {500: 1.0})
    held = when[500] + 1.0
    assert due[501] < held < due[-1]
    late = [max(d, held) for d in due[501:]]
    assert when == pytest.approx(due[:501] + late, abs=1e-9)


@pytest.mark.wide
def test_every_message_arrives_in_order_with_its_own_stamp(client, tmp_path):
    """Of a recording with half as many messages as the others have, played twice as fast."""
    bag = BAG.with_name("argos_gear_ripple")
    counts = {topic.name: topic.count for topic in list_topics(bag)[0]}
    joints = listen(client, JointState, "joint_states")
    poses = listen(client, PoseWithCovarianceStamped, "measured_pose")
    payload = listen(client, InertiaStamped, "payload", LATCHED)
    process = NodeProcess(NODE, tmp_path, client.namespace, str(bag), "--rate", "60")
    client.wait(lambda: len(joints) == counts["joint_states"], "all joint states", LONG)
    client.wait(lambda: len(poses) == counts["measured_pose"], "all poses")
    assert process.ended() == 0
    assert len(payload) == 1
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for m in joints]
    assert stamps == sorted(stamps)
    recorded = [m.time for m in raw_messages(bag) if m.topic == "joint_states"]
    assert [sec * 10**9 + ns for sec, ns in stamps] == recorded
    assert f"{sum(counts.values())} messages" in process.said


def test_it_waits_paused_and_plays_only_the_topics_named(client, tmp_path):
    poses = listen(client, PoseWithCovarianceStamped, "measured_pose")
    joints = listen(client, JointState, "joint_states")
    options = ("--topics", "measured_pose", "--rate", "200", "--start-paused")
    process = NodeProcess(NODE, tmp_path, client.namespace, str(BAG), *options)
    assert client.call(SetBool, f"{NODE}/pause", data=True).success
    assert poses == []
    assert client.call(SetBool, f"{NODE}/pause", data=False).message == "running"
    client.wait(lambda: len(poses) == COUNTS["measured_pose"], "all poses", LONG)
    assert process.ended() == 0
    assert joints == []


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_cleanly_when_asked_to(client, tmp_path, by):
    poses = listen(client, PoseWithCovarianceStamped, "measured_pose")
    process = NodeProcess(NODE, tmp_path, client.namespace, str(BAG), "--loop")
    client.wait(lambda: len(poses) > 2, "the first poses")
    assert process.end(by) == 0
    assert "ended after" in process.said


@pytest.mark.parametrize(
    ("arguments", "status", "word"),
    [
        (["/nowhere"], 1, "/nowhere"),
        ([], 1, "no bag"),
        ([str(BAG), "--rate", "0"], 1, "rate"),
        ([str(BAG), "--topics", "mood"], 1, "mood"),
        ([str(BAG), "--wait-for-subscribers", "1", "--patience", "0.2"], 1, "expected 1"),
        ([str(BAG), "--speed", "3"], 2, "--speed"),
    ],
)
def test_what_cannot_be_replayed_is_one_line_and_a_status(
    client, tmp_path, arguments, status, word
):
    process = NodeProcess(NODE, tmp_path, client.namespace, *arguments)
    assert process.ended() == status
    assert word in process.said.splitlines()[-1]
    assert "Traceback" not in process.said
