"""Publishers that each state some of the joints: their messages are merged at one time."""

from itertools import count

import bag_writing as bw
import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.base.errors import BagError
from parallel_cal.nodes.inbox import Inbox, Snapshot
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions, SampleOptions

STOPS = [[0.1, 0.2, 0.3, 0.4], [0.4, 0.0, 0.1, 0.2], [0.2, 0.5, 0.2, 0.1], [0.3, 0.1, 0.4, 0.3]]
ROBOT = bw.Session(STOPS, jitter=0.0)
NAMES = ROBOT.names


def halves(late=0.004, every=2):
    """The first two joints at 100 Hz; the others 4 ms later, at every second time."""
    first = [bw.joint_state(t, NAMES[:2], q[:2]) for t, q in zip(ROBOT.time, ROBOT.q, strict=True)]
    times = ROBOT.time[::every] + late
    q = ROBOT.path(STOPS, times)
    second = [bw.joint_state(t, NAMES[2:], row[2:]) for t, row in zip(times, q, strict=True)]
    return sorted([*first, *second], key=lambda m: m[2])


def read(tmp_path, messages, joints=NAMES):
    return read_bag(bw.write_bag(tmp_path / "bag", messages), ReadOptions(joints=joints))


def test_halves_of_a_moving_robot_are_interpolated_to_one_time(tmp_path):
    found = read(tmp_path, [*halves(), *bw.poses(ROBOT)])
    truth = ROBOT.path(STOPS, found.joints.time + (found.start_ns - bw.START) * 1e-9)
    assert len(found.joints.time) == pytest.approx(len(ROBOT.time) / 2, abs=2)
    # Between two readings 10 ms apart, the motion differs from a straight one by up to 1.2e-4 rad.
    # A delay of 4 ms between the halves would be an error of 4e-3 rad.
    np.testing.assert_allclose(found.joints.position, truth, atol=1.2e-4)
    assert any("merged (joint1, joint2; joint3, joint4)" in note for note in found.notes)


def test_the_samples_are_those_of_one_publisher(tmp_path):
    merged = pc.load_dataset(
        bw.write_bag(tmp_path / "a", [*halves(), *bw.poses(ROBOT)]), joints=NAMES
    )
    whole = pc.load_dataset(
        bw.write_bag(tmp_path / "b", [*bw.joint_states(ROBOT), *bw.poses(ROBOT)]), joints=NAMES
    )
    np.testing.assert_allclose(merged.q, whole.q, atol=1e-9)


def test_joints_in_another_order_are_those_of_the_model(tmp_path):
    found = read(tmp_path, [*halves(), *bw.poses(ROBOT)], NAMES[::-1])
    np.testing.assert_allclose(found.joints.position[0], STOPS[0][::-1], atol=1e-9)


def test_a_time_at_which_one_publisher_was_silent_has_no_reading(tmp_path):
    quiet = [m for m in halves() if m[3].name[0] == "joint1" or not 2.2e9 < m[2] - bw.START < 3.0e9]
    q = read(tmp_path, [*quiet, *bw.poses(ROBOT)]).joints
    assert not ((q.time > 2.25) & (q.time < 2.95)).any()


def test_a_reading_that_is_not_finite_is_counted(tmp_path):
    content = halves()
    content[200][3].position[0] = np.nan
    found = read(tmp_path, [*content, *bw.poses(ROBOT)])
    assert any("not finite" in one.reason for one in found.dropped)
    assert np.isfinite(found.joints.position).all()


def test_a_joint_that_nobody_publishes_is_named(tmp_path):
    with pytest.raises(BagError, match="not found: joint9"):
        read(tmp_path, [*halves(), *bw.poses(ROBOT)], (*NAMES, "joint9"))


def test_a_node_makes_the_same_samples_of_halves_that_it_receives():
    inbox = Inbox({}, count())
    for topic, _, log, message in sorted([*halves(), *bw.poses(ROBOT)], key=lambda m: m[2]):
        if topic == "joint_states":
            row = (tuple(message.name), message.position, message.effort)
        else:
            p, q = message.pose.pose.position, message.pose.pose.orientation
            row = ("base", (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), message.pose.covariance)
        inbox.raws[topic].append(log, log, row)
    found = Snapshot(inbox, 0, inbox.raws, NAMES, SampleOptions()).make_samples()
    assert found.trouble == ""
    np.testing.assert_allclose(found.dataset.q, STOPS, atol=1e-9)
