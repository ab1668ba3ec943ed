"""The virtual robot before its camera, through the real nodes."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import json

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")
cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

import numpy as np
from builtin_interfaces.msg import Time
from parallel_cal_msgs.msg import CollectionStatus
from parallel_cal_msgs.srv import ListSamples
from ros_helpers import NodeProcess
from sensor_msgs.msg import CompressedImage

from parallel_cal.base.worker import Worker
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes.calibrate import Calibration
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.photographer import Photographer
from parallel_cal.virtual.cell import Circumstances


@pytest.mark.wide
def test_the_node_shows_the_corners_that_it_saw_and_makes_a_sample_of_them(tmp_path):
    namespace, file = use_private_domain(), tmp_path / "robot.yaml"
    cell = NodeProcess(
        "virtual_cell_node", tmp_path, namespace, device="camera", model_file=str(file)
    )
    client = Client("tester", namespace, [cell])
    client.wait(file.exists, "the nominal model")
    [camera] = read_model(file).sensors
    assert (camera.columns, camera.rows, camera.image_size) == (8, 6, (1280, 1024))
    node = NodeProcess(
        "calibration_node",
        tmp_path,
        namespace,
        model_file=str(file),
        journal_folder=str(tmp_path),
        images="camera/image_raw/compressed",
    )
    shown = client.subscribe_latest(CompressedImage, "calibration_node/camera/board")
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(shown), "an image with corners", 120)
    drawn = cv2.imdecode(np.frombuffer(shown[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert drawn.shape == (1024, 1280, 3)
    client.wait(lambda: bool(status) and status[0].samples == 1, "its sample", 120)
    assert status[0].poses_received >= 1
    [sample] = client.call(ListSamples, "calibration_node/list_samples").samples
    pixels = [c.name for c in sample.conditions if c.name.startswith("reading.camera.")]
    assert len(pixels) > 40
    client.close()
    assert node.end() == 0
    assert cell.end() == 0


@pytest.mark.slow
def test_a_camera_names_a_hidden_backlash_through_the_nodes(tmp_path):
    file = tmp_path / "robot.yaml"
    cell = {"robot": "delta", "seed": 2, "effects": "backlash", "rate": 2.0, "device": "camera"}
    with Calibration(file, simulated=cell) as calibration:
        result = calibration.run(lambda status: None, 60.0, poses=48)
    assert "backlash" in [effect.name for effect in read_model(file).effects], result.message
    curve = json.loads(result.json)["curve"]
    assert curve[0]["error_unseen"] > 4 * curve[-1]["error_unseen"]


class RestingCell:
    """A cell in which nothing moves."""

    idle, time, now = True, 0.0, Circumstances()

    def true_pose(self):
        return np.zeros(3), np.eye(3)


class Listener:
    """A node that keeps what is published."""

    def __init__(self):
        self.published = []

    def create_publisher(self, *_):
        return self

    def publish(self, message):
        self.published.append(message.header.stamp.sec)


def test_a_robot_that_rests_for_long_is_photographed_seldom(monkeypatch):
    monkeypatch.setattr(Worker, "work", lambda *_: b"")
    cell, node = RestingCell(), Listener()
    camera = Photographer(node, cell, 0, lambda time: Time(sec=round(100 * time)))

    def rest(begin, end):
        for cell.time in np.arange(begin, end, 0.05):
            camera.watch()
            if camera._rendering is not None:
                camera._rendering.result()  # as if it took no time

    rest(0.0, 40.0)
    taken = [stamp / 100 for stamp in node.published]
    assert taken[0] == pytest.approx(0.25, abs=0.06)
    assert taken[1] == pytest.approx(2.25, abs=0.11)
    assert len(taken) <= 7  # every 2 s: 20
    assert max(np.diff(taken)) < 20  # a campaign waits as long for a sample
    cell.idle = False
    camera.watch()
    cell.idle = True
    rest(40.0, 43.0)
    assert len(node.published) == len(taken) + 2
    camera.close()
