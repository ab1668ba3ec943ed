"""Live images: searched at rest, seldom in a long rest, and every unused one has a reason."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from bag_writing import Session, joint_states, ns

from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.live_images import LiveImages, RestMemory
from parallel_cal.recordings.channels import CORNERS

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

import board_images  # noqa: E402
from test_bag_images import (  # noqa: E402
    SMALL,
    STOPS,
    check_samples,
    compressed_message,
    image_message,
    recorded_images,
)

JOINTS = ("joint1", "joint2")


@pytest.fixture(scope="module")
def shots():
    return list(board_images.shots(len(STOPS), SMALL, near=0.38, far=0.5, tilt=0.4))


class Desk:
    """A camera, the joint states beside it, and a collector of its corners."""

    def __init__(self, board="8x6"):
        self.rests = RestMemory(lambda: JOINTS, lambda: 1e-3)
        self.collector, self.unusable, self.looks = Collector(JOINTS), [], []
        self.camera = LiveImages(
            "camera",
            "/cam/image_raw",
            board,
            self.rests,
            lambda: 0.1,
            lambda seen: self.collector.receive(CORNERS, seen, seen.received),
            lambda received, why: self.unusable.append(why),
            self.looks.append,
        )

    def play(self, messages):
        """Take messages in the order of their stamps, joint states before the images."""
        for topic, _, log, message in sorted(
            messages, key=lambda m: (m[2], m[0] != "joint_states")
        ):
            if topic == "joint_states":
                self.rests.add(message)
                self.collector.receive("joint_states", message, log)
            else:
                self.camera.take([(message, {"received_timestamp": log})])
        self.collector.refresh()


@pytest.mark.wide
def test_live_images_become_the_samples_that_a_bag_gives(shots):
    desk = Desk()
    desk.play(joint_states(Session(STOPS)) + recorded_images(shots))
    counts = desk.camera.counts
    check_samples(desk.collector.collection().dataset, shots)
    assert counts["received"] == sum(
        counts[what] for what in ("in motion", "not needed: the rest has others", "searched")
    )
    # Five images of each second of rest; two of them come before the robot has settled or repeat.
    assert len(STOPS) <= counts["used"] < counts["received"] - counts["in motion"]
    assert counts["in motion"] > 0
    assert not desk.unusable
    assert desk.camera.warning == ""


@pytest.mark.wide
def test_a_long_rest_costs_few_searches(shots):
    still = Session([STOPS[0]], dwell=30.0)
    images = [
        ("/cam/image_raw", "", ns(t + 0.02), compressed_message(shots[0].image, t))
        for t in np.arange(0.15, 29.0, 0.1)
    ]
    desk = Desk()
    desk.play(joint_states(still) + images)
    assert desk.camera.counts["received"] == len(images)
    assert 4 <= desk.camera.counts["searched"] <= 12


def test_an_image_without_the_board_is_named_and_the_robot_need_not_wait():
    grey = np.full((512, 640), 120, np.uint8)
    desk = Desk()
    still = Session([STOPS[0]], dwell=2.0)
    images = [("/cam/image_raw", "", ns(t + 0.02), image_message(grey, t)) for t in (0.3, 0.6, 1.2)]
    desk.play(joint_states(still) + images)
    assert desk.camera.counts["not used"] == len(desk.unusable) == 3
    assert "image not used: no marker of the dictionary 5X5_100" in desk.unusable[0]
    assert all(look.corners.problem for look in desk.looks)
    desk.camera.take([(image_message(grey, 1.95), {}), (image_message(grey, 1.96), {})])
    assert "none of 5 images can be used" in desk.camera.warning


def test_a_camera_with_another_clock_is_named(shots):
    desk = Desk()
    desk.play(joint_states(Session([STOPS[0]], dwell=1.0)))
    begun = time.monotonic()
    desk.camera.take([(image_message(shots[0].image, 500.0), {})])
    assert time.monotonic() - begun < 0.9  # it does not wait for joint states of that time
    assert "its stamp is +499 s from the joint states" in desk.camera.last


def test_a_message_that_is_no_image_is_counted_with_its_reason(shots):
    desk = Desk()
    message = image_message(shots[0].image, 0.5, encoding="32FC1")
    desk.play(joint_states(Session([STOPS[0]])) + [("/cam/image_raw", "", ns(0.52), message)])
    assert desk.camera.reasons == {"encoding 32FC1": 1}


@pytest.mark.wide
def test_a_shaken_image_is_set_aside_once_sharp_ones_are_known(shots):
    desk = Desk()
    stops = [STOPS[k % 3] for k in range(6)]
    session = Session(stops)
    slot = session.dwell + session.move
    images = [
        (
            "/cam/image_raw",
            "",
            ns(k * slot + 0.52),
            image_message(
                shots[1].image if k < 5 else cv2.GaussianBlur(shots[1].image, (0, 0), 1.3),
                k * slot + 0.5,
            ),
        )
        for k in range(6)
    ]
    desk.play(joint_states(session) + images)
    assert desk.camera.counts["used"] == 5
    assert "blurred: its edges are" in desk.unusable[0]


def test_rests_are_found_from_joint_states_and_other_joints_do_not_matter():
    memory = RestMemory(lambda: JOINTS, lambda: 1e-3)

    def state(t, q, names=JOINTS):
        stamp = SimpleNamespace(sec=int(t), nanosec=int(1e9 * (t % 1)))
        header = SimpleNamespace(stamp=stamp)
        memory.add(SimpleNamespace(header=header, name=names, position=q))

    for k in range(11):
        state(100 + 0.1 * k, [0.5, 0.1 * max(k - 5, 0)])
        state(100 + 0.1 * k, [1.0 * k], ["gripper"])
    begin, end = memory.find_rest(100.3)
    assert begin == pytest.approx(100.0)
    assert end == pytest.approx(100.5)
    assert memory.find_rest(100.75) is None
    assert memory.latest == pytest.approx(101.0)


def test_a_board_of_the_default_is_drawn_with_its_corners(shots):
    from parallel_cal.imaging.board import Board
    from parallel_cal.imaging.detection import Detector
    from parallel_cal.imaging.drawing import draw_corners

    found = Detector(Board()).detect(shots[0].image)
    jpeg = np.frombuffer(draw_corners(shots[0].image, found), np.uint8)
    drawn = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert drawn.shape == (*shots[0].image.shape, 3)
    coloured = np.ptp(drawn.astype(int), axis=2) > 60
    for u, v in np.round(found.pixels).astype(int):
        assert coloured[max(v - 9, 0) : v + 10, max(u - 9, 0) : u + 10].any()
