"""kinematics_node publishes the calibrated robot for RViz: its URDF, and where its links are."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from geometry_msgs.msg import PoseStamped
from parallel_cal_msgs.srv import LoadModel
from ros_helpers import NodeProcess
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from test_export_urdf import Urdf

from parallel_cal.nodes.client import Client, use_private_domain

CONFIG = Path(__file__).parents[2] / "config"
NODE, NAMES = "kinematics_node", ["joint1", "joint2", "joint3"]


class Robot:
    """A node on a file of its own, with parameters, and a client of it."""

    def __init__(self, folder, **parameters):
        self.file, namespace = folder / "robot.yaml", use_private_domain()
        shutil.copy(CONFIG / "delta24_mockup_identified.yaml", self.file)
        self.process = NodeProcess(NODE, folder, namespace, model_file=str(self.file), **parameters)
        self.client = Client("tester", namespace, [self.process])
        self.latest = {}
        self.described = self.client.subscribe_latest(String, f"{NODE}/robot_description")
        self.client.wait(lambda: bool(self.described), "a description")

    def follow(self, type, topic):
        self.client._node.create_subscription(
            type, topic, lambda message: self.latest.setdefault(topic, []).append(message), 10
        )

    def move(self, position, *topics):
        """Publish joint readings until each topic has an answer to them; return the answers."""
        publisher = self.client._node.create_publisher(JointState, "joint_states", 10)
        state = JointState(name=NAMES, position=position)
        state.header.stamp.sec = 77

        def stamp(message):
            return getattr(message, "header", None) or message.transforms[0].header

        def answers():
            return [
                next((m for m in self.latest.get(t, []) if stamp(m).stamp.sec == 77), None)
                for t in topics
            ]

        def there():
            publisher.publish(state)
            return all(answers())

        self.client.wait(there, "answers to a joint state")
        return answers()

    def close(self):
        self.client.close()
        assert self.process.end() == 0


@pytest.fixture
def start(tmp_path):
    robots = []

    def begin(**parameters):
        robots.append(Robot(tmp_path, **parameters))
        return robots[-1]

    yield begin
    for robot in robots:
        robot.close()


def test_the_urdf_is_latched_and_follows_the_model_file_and_there_is_no_tf_by_itself(
    start, tmp_path
):
    robot = start()
    (tmp_path / "robot.urdf").write_text(robot.described[0].data)
    reader = Urdf(tmp_path / "robot.urdf")
    assert (reader.root, set(NAMES) < set(reader.names)) == ("base", True)
    # The rods have their identified lengths (table 5.13).
    drawn = [
        float(e.get("length")) for link in reader.links.values() for e in link.iter("cylinder")
    ]
    for expected in (0.24013, 0.240067, 0.239949):
        assert min(abs(length - expected) for length in drawn) < 1e-9
    assert robot.client.count_publishers("/tf") == 0
    shutil.copy(CONFIG / "stewart_general.yaml", robot.file)
    loaded = robot.client.call(LoadModel, f"{NODE}/load_model", path=str(robot.file))
    assert loaded.success
    robot.client.wait(lambda: 'robot name="stewart42"' in robot.described[0].data, "another one")


def test_the_transforms_place_all_links_as_the_description_and_the_pose_say(start, tmp_path):
    """A prefix keeps the frames apart from those of another source."""
    tf2_msgs = pytest.importorskip("tf2_msgs.msg")
    robot = start(tf_rate=100, frame_prefix="calibrated/")
    robot.follow(tf2_msgs.TFMessage, "/tf")
    robot.follow(PoseStamped, f"{NODE}/pose")
    robot.follow(JointState, f"{NODE}/passive_joint_states")
    q = [0.5, 0.6, 0.7]
    told, pose, passive = robot.move(q, "/tf", f"{NODE}/pose", f"{NODE}/passive_joint_states")
    path = tmp_path / "robot.urdf"
    path.write_text(robot.described[0].data)
    reader, links = Urdf(path), frames(told, "base")
    assert set(links) == {"base", *(f"calibrated/{link}" for link in reader.links)}
    at = dict(zip(NAMES, q, strict=True)) | dict(zip(passive.name, passive.position, strict=True))
    for link in reader.links:
        (r, R), (R_link, r_link) = links[f"calibrated/{link}"], reader.frame(link, at)
        np.testing.assert_allclose(r, r_link, atol=1e-9)
        np.testing.assert_allclose(R, R_link, atol=1e-9)
    p = pose.pose.position
    np.testing.assert_allclose(links["calibrated/platform"][0], [p.x, p.y, p.z], atol=1e-12)


def test_without_tf2_msgs_the_rate_is_refused():
    code = (
        "import sys; sys.modules['tf2_msgs'] = None\n"
        f"from parallel_cal.nodes.{NODE} import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "--ros-args", "-p", "tf_rate:=20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    line = done.stderr.strip().split("\n")[-1]
    assert line.startswith("error: parameter tf_rate 20: the package tf2_msgs is not installed")
    assert "ros-jazzy-tf2-msgs" in line


def frames(message, root):
    """The pose of each frame in the root, whatever the order of the transforms."""
    found, waiting = {root: (np.zeros(3), np.eye(3))}, list(message.transforms)
    while waiting:
        known = [t for t in waiting if t.header.frame_id in found]
        assert known, waiting
        for one in known:
            t, o = one.transform.translation, one.transform.rotation
            r, R = found[one.header.frame_id]
            turn = Rotation.from_quat([o.x, o.y, o.z, o.w]).as_matrix()
            assert one.child_frame_id not in found
            found[one.child_frame_id] = (r + R @ [t.x, t.y, t.z], R @ turn)
            waiting.remove(one)
    return found
