"""Poses over several hops of /tf and /tf_static, each hop from parent to child or the reverse."""

import bag_writing as bw
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

ROBOT = bw.Session([[0.1, 0.2], [0.4, 0.0], [0.2, 0.5]])
TIMES = np.arange(0.0, ROBOT.time[-1], 0.05)
WORLD_TRACKER = (np.array([0.5, -0.2, 1.0]), Rotation.from_rotvec([0.3, -0.4, 1.2]))
TOOL_TARGET = (np.array([0.01, 0.02, 0.03]), Rotation.from_rotvec([-0.2, 0.7, 0.1]))


def tf(t, parent, child, r, turn, topic="tf"):
    """A message with one transform."""
    k = bw.kind
    place = k("geometry_msgs/msg/Vector3")(*map(float, r))
    quaternion = k("geometry_msgs/msg/Quaternion")(*turn.as_quat().tolist())
    inner = k("geometry_msgs/msg/Transform")(place, quaternion)
    one = k("geometry_msgs/msg/TransformStamped")(bw.header(bw.ns(t), parent), child, inner)
    return topic, "tf2_msgs/msg/TFMessage", bw.ns(t), k("tf2_msgs/msg/TFMessage")([one])


def tool(t):
    """The true pose of the tool in the world."""
    r = np.stack([0.1 * t, 0.2 - 0.01 * t, 0.3 + 0.02 * t], axis=1)
    ends = Rotation.from_rotvec([[0.1, 0.0, 0.2], [0.3, -0.5, 0.4]])
    return r, Slerp([0.0, 10.0], ends)(t)


def messages(times=TIMES):
    """A tracker, fixed in the world, sees a target that is fixed to the tool."""
    r, R = tool(times)
    R_target = R * TOOL_TARGET[1]
    r_target = r + R.apply(TOOL_TARGET[0])
    seen_r = WORLD_TRACKER[1].inv().apply(r_target - WORLD_TRACKER[0])
    seen_R = WORLD_TRACKER[1].inv() * R_target
    moving = [
        tf(t, "tracker", "target", *one) for t, *one in zip(times, seen_r, seen_R, strict=True)
    ]
    fixed = [
        tf(0.0, "world", "tracker", *WORLD_TRACKER, "tf_static"),
        tf(0.0, "tool", "target", *TOOL_TARGET, "tf_static"),
    ]
    return [*fixed, *bw.joint_states(ROBOT), *moving]


def read(tmp_path, content, body):
    path = bw.write_bag(tmp_path / "bag", content)
    return read_bag(path, ReadOptions(topics={"measured_pose": f"/tf:{body}"}))


def test_the_pose_over_three_hops_is_the_true_one(tmp_path):
    found = read(tmp_path, messages(), "world->tool")
    times = found.pose.time + (found.start_ns - bw.START) * 1e-9
    r, R = tool(times)
    np.testing.assert_allclose(found.pose.position, r, atol=1e-12)
    np.testing.assert_allclose(found.pose.rotation, R.as_matrix(), atol=1e-12)
    assert found.pose.frame == "world"
    assert len(times) == len(TIMES)
    assert any("world -> tracker -> target -> tool" in note for note in found.notes)


def test_two_moving_hops_are_taken_at_one_time(tmp_path):
    # The world moves on a turntable that is published 20 ms off the tracker's times.
    late = TIMES[::2] + 0.02
    table = [
        tf(t, "room", "world", [0, 0, 0.1 * t], Rotation.from_rotvec([0, 0, 0.05 * t]))
        for t in late
    ]
    found = read(tmp_path, [*messages(), *table], "room->tool")
    times = found.pose.time + (found.start_ns - bw.START) * 1e-9
    r, R = tool(times)
    turn = Rotation.from_rotvec(np.stack([0 * times, 0 * times, 0.05 * times], axis=1))
    moved = np.stack([0 * times, 0 * times, 0.1 * times], axis=1) + turn.apply(r)
    np.testing.assert_allclose(found.pose.position, moved, atol=2e-6)
    np.testing.assert_allclose(found.pose.rotation, (turn * R).as_matrix(), atol=1e-9)


def test_frames_that_nothing_connects_are_named(tmp_path):
    with pytest.raises(BagError, match=r"no chain.*'world' to 'gripper'.*tool->target, tracker"):
        read(tmp_path, messages(), "world->gripper")


def test_a_chain_of_static_transforms_is_no_measurement(tmp_path):
    alone = tf(0.0, "world", "wall", *WORLD_TRACKER, "tf_static")
    with pytest.raises(BagError, match="nothing on it was measured"):
        read(tmp_path, [alone, *messages()], "tracker->wall")
