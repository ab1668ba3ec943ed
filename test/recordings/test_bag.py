"""Reading recordings: what is accepted, what is dropped and counted, what is refused and why."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from bag_writing import (
    POINT,
    POSE,
    START,
    Session,
    data_file,
    joint_state,
    joint_states,
    ns,
    payload,
    pose,
    poses,
    split,
    temperature,
    text,
    write_bag,
)

from parallel_cal.base.errors import BagError, ParallelCalError
from parallel_cal.cli.recordings import data_options
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

MOVES = Session([[0.1, 0.2, 0.3], [0.4, 0.0, 0.5]])


def reasons(recording):
    return {d.reason: d.count for d in recording.dropped}


def test_importing_the_reader_does_not_import_rosbags():
    modules = "sys, parallel_cal.recordings.bag, parallel_cal.recordings.loading"
    code = f"import {modules}; sys.exit('rosbags' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_channels_come_as_arrays_on_one_clock(tmp_path):
    extra = [temperature(0.5, 21.0), temperature(1.5, 23.0), payload(0.0, 0.2)]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES) + extra))
    assert recording.joints.names == ("joint1", "joint2", "joint3")
    np.testing.assert_allclose(recording.joints.position, MOVES.q, atol=0)
    np.testing.assert_allclose(recording.joints.time, MOVES.time, atol=1e-9)
    np.testing.assert_allclose(recording.pose.time[:2], [0.004, 0.054], atol=1e-9)
    np.testing.assert_allclose(recording.pose.quaternion[0], [0, 0, 0.6, 0.8])
    assert recording.conditions["temperature"].value.tolist() == [21.0, 23.0]
    assert recording.conditions["payload"].value.tolist() == [0.2]
    assert recording.start_ns == START
    assert recording.pose.frame == "base"
    assert recording.dropped == recording.notes == ()


def test_sqlite_and_mcap_give_the_same_numbers(tmp_path):
    messages = joint_states(MOVES) + poses(MOVES)
    mcap = read_bag(write_bag(tmp_path / "m", messages))
    sqlite = read_bag(write_bag(tmp_path / "s", messages, sqlite=True))
    np.testing.assert_array_equal(mcap.joints.position, sqlite.joints.position)
    np.testing.assert_array_equal(mcap.pose.position, sqlite.pose.position)
    np.testing.assert_array_equal(mcap.pose.time, sqlite.pose.time)


@pytest.mark.parametrize("sqlite", [False, True])
def test_a_bare_data_file_is_the_same_recording_with_the_same_hash(tmp_path, sqlite):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES), sqlite=sqlite)
    whole, bare = read_bag(bag), read_bag(data_file(bag))
    np.testing.assert_array_equal(whole.joints.position, bare.joints.position)
    assert whole.sha256 == bare.sha256
    assert len(whole.sha256) == 64


def test_a_directory_without_metadata_is_read_by_its_data_file(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    (bag / "metadata.yaml").unlink()
    assert "no metadata.yaml" in read_bag(bag).notes[0]


def test_a_recording_split_over_files_is_read_as_one(tmp_path):
    whole = joint_states(MOVES) + poses(MOVES)
    (tmp_path / "s").mkdir()
    early, late = ([m for m in whole if (m[2] < ns(1.2)) == first] for first in (True, False))
    bag = split(tmp_path / "s", early, late)
    recording = read_bag(bag)
    np.testing.assert_array_equal(recording.joints.position, MOVES.q)
    assert len(recording.pose.time) == len(poses(MOVES))
    (bag / "metadata.yaml").unlink()
    with pytest.raises(BagError, match=r"data files: part0\.mcap, part1\.mcap.*reindex"):
        read_bag(bag)


def test_a_folder_without_a_recording_is_refused(tmp_path):
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(
        BagError, match=r"not a rosbag2 recording: it contains neither metadata\.yaml"
    ):
        read_bag(tmp_path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(BagError, match=r"nowhere.*no such file"):
        read_bag(tmp_path / "nowhere")


def test_a_file_that_is_not_a_recording_is_refused(tmp_path):
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(BagError, match="not a recording; expected a bag directory"):
        read_bag(tmp_path / "a.txt")


@pytest.mark.parametrize("sqlite", [False, True])
def test_an_empty_bag_is_refused(tmp_path, sqlite):
    with pytest.raises(BagError, match="contains no message"):
        read_bag(write_bag(tmp_path / "b", [], sqlite=sqlite))


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.9])
def test_a_truncated_bag_is_refused_with_advice(tmp_path, sqlite, part):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES), sqlite=sqlite)
    file = data_file(bag)
    content = file.read_bytes()
    file.write_bytes(content[: int(part * len(content))])
    for path in (bag, file):
        with pytest.raises(BagError, match=r"damaged or truncated.*reindex"):
            read_bag(path)


def test_a_bag_with_flipped_bytes_is_read_or_refused_and_fails_in_no_other_way(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    file = data_file(bag)
    content = bytearray(file.read_bytes())
    outcomes = []
    for place in range(40, len(content), len(content) // 40):
        damaged = content.copy()
        damaged[place : place + 8] = b"\xff" * 8
        file.write_bytes(damaged)
        try:  # any other error fails the test
            outcomes.append(len(read_bag(file).joints.time) > 0)
        except BagError as error:
            outcomes.append(str(file) in str(error))
    assert len(outcomes) > 39
    assert all(outcomes)  # samples, or an error that names the file


def test_a_missing_topic_lists_what_is_there(tmp_path):
    bag = write_bag(tmp_path / "b", [*joint_states(MOVES), text(0.0, "hi", "chatter")])
    with pytest.raises(BagError) as error:
        read_bag(bag)
    for word in ("measured_pose", "PoseWithCovarianceStamped", "chatter [std_msgs/msg/String] 1"):
        assert word in str(error.value)


def test_the_only_topic_of_the_right_type_serves_a_default_and_is_reported(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES, topic="/tracker/pose"))
    recording = read_bag(bag)
    assert recording.pose.topic == "/tracker/pose"
    assert "/tracker/pose is used" in recording.notes[0]


def test_a_commanded_pose_is_never_taken_for_a_measurement(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES, topic="target_pose"))
    with pytest.raises(BagError, match="measured_pose"):
        read_bag(bag)


def test_a_topic_requested_by_name_is_not_replaced(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    with pytest.raises(BagError, match="'/tracker'"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/tracker"}))


def test_a_leading_slash_does_not_matter(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES, topic="/measured_pose"))
    assert read_bag(bag).notes == ()


def test_an_empty_name_switches_a_condition_off(tmp_path):
    messages = [*joint_states(MOVES), *poses(MOVES), temperature(0.5, 20.0)]
    bag = write_bag(tmp_path / "b", messages)
    assert not read_bag(bag, ReadOptions(topics={"temperature": ""})).conditions


def test_a_topic_of_the_wrong_type_is_refused_naming_both(tmp_path):
    bag = write_bag(tmp_path / "b", [*joint_states(MOVES), text(0.0, "x", "measured_pose")])
    with pytest.raises(BagError, match=r"std_msgs/msg/String; expected geometry_msgs"):
        read_bag(bag)


def test_unknown_joints_are_refused_naming_both_lists(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    with pytest.raises(BagError) as error:
        read_bag(bag, ReadOptions(joints=("joint1", "elbow")))
    assert "expected: joint1, elbow" in str(error.value)
    assert "recorded: joint1, joint2, joint3" in str(error.value)
    assert "not found: elbow" in str(error.value)


def test_joints_are_matched_by_name_not_by_place(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES, order=[2, 0, 1]) + poses(MOVES))
    recording = read_bag(bag, ReadOptions(joints=("joint1", "joint2", "joint3")))
    np.testing.assert_array_equal(recording.joints.position, MOVES.q)


def test_the_order_of_joints_may_change_between_messages(tmp_path):
    mixed = joint_states(MOVES)[::2] + joint_states(MOVES, order=[2, 0, 1])[1::2]
    recording = read_bag(write_bag(tmp_path / "b", mixed + poses(MOVES)))
    np.testing.assert_array_equal(recording.joints.position, MOVES.q)


def test_extra_joints_are_ignored_and_reported(tmp_path):
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    recording = read_bag(bag, ReadOptions(joints=("joint3", "joint1")))
    np.testing.assert_array_equal(recording.joints.position, MOVES.q[:, [2, 0]])
    assert recording.notes == ("joint_states: ignored joints: joint2",)


def test_messages_of_another_publisher_are_dropped_and_counted(tmp_path):
    gripper = [joint_state(0.5051, ["finger"], [0.0]), joint_state(0.6051, ["finger"], [0.0])]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES) + gripper))
    assert reasons(recording) == {"lacks some of the joints joint1, joint2, joint3": 2}
    assert len(recording.joints.time) == len(MOVES.time)


def test_empty_velocity_and_given_velocity_are_both_accepted(tmp_path):
    moving = [
        joint_state(t, MOVES.names, q, velocity=[1.0, 2.0, 3.0])
        for t, q in zip(MOVES.time, MOVES.q, strict=True)
    ]
    with_velocity = read_bag(write_bag(tmp_path / "a", moving + poses(MOVES)))
    without = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES)))
    np.testing.assert_array_equal(with_velocity.joints.position, without.joints.position)


def test_a_position_list_of_the_wrong_length_is_dropped(tmp_path):
    bad = joint_state(0.5051, MOVES.names, [0.1])
    recording = read_bag(write_bag(tmp_path / "b", [*joint_states(MOVES), *poses(MOVES), bad]))
    assert reasons(recording) == {"position and name differ in length": 1}


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_single_readings_that_are_not_finite_are_dropped_and_counted(tmp_path, value):
    bad = [joint_state(0.5051, MOVES.names, [0.1, value, 0.3]), pose(0.5051, [0, value, 0])]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES) + bad))
    assert reasons(recording) == {"joint reading is not finite": 1, "pose is not finite": 1}
    assert "message 51" in recording.dropped[0].detail
    assert recording.dropped[0].time == pytest.approx(0.5051)


def test_a_reading_that_is_not_finite_is_reported_with_its_value(tmp_path):
    bad = joint_state(0.5051, MOVES.names, [0.1, np.nan, 0.3])
    recording = read_bag(write_bag(tmp_path / "a", [*joint_states(MOVES), *poses(MOVES), bad]))
    assert "the first is message 51: 0.1 nan 0.3" in recording.dropped[0].detail
    never = [joint_state(t, MOVES.names, [0.1, np.nan, 0.3]) for t in MOVES.time]
    with pytest.raises(BagError, match=r"message 0: 0\.1 nan 0\.3.*joint1, joint2, joint3: check"):
        read_bag(write_bag(tmp_path / "b", never + poses(MOVES)))


def test_numbers_that_no_robot_reads_are_dropped(tmp_path):
    bad = [joint_state(0.5051, MOVES.names, [1e300, 0, 0]), pose(0.5051, [0, 1e200, 0])]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES) + bad))
    assert reasons(recording) == {"joint reading is beyond 1e9": 1, "position is beyond 1e9": 1}


def test_every_message_is_kept_or_counted_as_dropped(tmp_path):
    bad = [
        joint_state(0.5051, MOVES.names, [0.1, np.nan, 0.3]),
        joint_state(0.6051, ["finger"], [0.0]),
        joint_state(0.7051, MOVES.names, [0.1], stamp=ns(0.2)),
        pose(0.5051, [0, 0, np.inf]),
        pose(0.6051, [0, 0, 0], (0, 0, 0, 0)),
        pose(0.7051, [0, 0, 0], frame="world"),
    ]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES) + bad))
    kept = len(recording.joints.time) + len(recording.pose.time)
    recorded = sum(topic.count for topic in recording.topics)
    assert kept + sum(reasons(recording).values()) == recorded
    assert len(reasons(recording)) == 6


def test_a_stream_without_a_finite_pose_is_refused(tmp_path):
    bad = [pose(t, [np.nan, 0, 0]) for t in (0.1, 0.2)]
    with pytest.raises(BagError, match=r"measured_pose: none of its 2 messages .*not finite"):
        read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + bad))


def test_a_zero_quaternion_is_dropped_and_a_stream_of_them_refused(tmp_path):
    one = pose(0.5051, [0, 0, 0], (0, 0, 0, 0))
    recording = read_bag(write_bag(tmp_path / "a", [*joint_states(MOVES), *poses(MOVES), one]))
    assert reasons(recording) == {"quaternion is zero": 1}
    zeros = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES, quaternion=(0, 0, 0, 0)))
    with pytest.raises(BagError, match=r"quaternion is zero.*measures=x,y,z"):
        read_bag(zeros)
    assert not read_bag(zeros, ReadOptions(measures=("x", "y", "z"))).pose.measured[:, 3:].any()


def test_a_quaternion_of_wrong_length_is_dropped(tmp_path):
    bad = pose(0.5051, [0, 0, 0], (0, 0, 0, 2))
    recording = read_bag(write_bag(tmp_path / "b", [*joint_states(MOVES), *poses(MOVES), bad]))
    assert reasons(recording) == {"quaternion is not of unit length": 1}


def test_a_late_message_is_dropped_and_a_clock_reset_is_refused(tmp_path):
    late = joint_state(0.5051, MOVES.names, [9.0, 9.0, 9.0], stamp=ns(0.2))
    recording = read_bag(write_bag(tmp_path / "a", [*joint_states(MOVES), *poses(MOVES), late]))
    assert reasons(recording) == {"stamp earlier than the message before": 1}
    assert recording.joints.position.max() < 1.0
    reset = [joint_state(2.7 + t, MOVES.names, [0.0, 0.0, 0.0], stamp=ns(t)) for t in (0, 0.1, 0.2)]
    with pytest.raises(BagError, match=r"joint_states: time runs backwards at message 260: "):
        read_bag(write_bag(tmp_path / "b", [*joint_states(MOVES), *poses(MOVES), *reset]))


@pytest.mark.parametrize("off", [-1.8, 100.0, 1e6])
def test_one_wild_stamp_costs_one_message_as_in_the_live_node(off, tmp_path):
    wild = joint_state(2.0001, MOVES.names, [9.0, 9.0, 9.0], stamp=ns(2.0 + off))
    recording = read_bag(write_bag(tmp_path / "a", [*joint_states(MOVES), *poses(MOVES), wild]))
    assert reasons(recording) == {"stamp fits neither the previous nor the next message": 1}
    assert recording.joints.position.max() < 1.0
    assert recording.start_ns == ns(0)


def test_a_repeated_stamp_is_dropped(tmp_path):
    again = joint_state(0.5051, MOVES.names, [9.0, 9.0, 9.0], stamp=ns(0.5))
    recording = read_bag(write_bag(tmp_path / "a", [*joint_states(MOVES), *poses(MOVES), again]))
    assert reasons(recording) == {"stamp repeats the message before": 1}


def test_zero_stamps_fall_back_to_the_time_of_recording_with_a_note(tmp_path):
    bare = [pose(t, [0.1, 0, 0], stamp=0) for t in (0.1, 0.2, 0.3)]
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + bare))
    np.testing.assert_allclose(recording.pose.time, [0.1, 0.2, 0.3], atol=1e-9)
    assert "header stamps are zero or negative" in recording.notes[0]


def test_streams_that_never_overlap_are_refused_with_both_spans(tmp_path):
    late = Session(MOVES.stops, start=100.0)
    with pytest.raises(BagError, match=r"never overlap: joint_states from .* measured_pose from"):
        read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(late)))


def test_clocks_that_differ_can_be_read_by_log_time(tmp_path):
    old = [pose(t, [0.1, 0, 0], stamp=int(1e9 * (5 + t))) for t in (0.1, 0.2)]
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + old)
    with pytest.raises(BagError, match="never overlap"):
        read_bag(bag)
    np.testing.assert_allclose(
        read_bag(bag, ReadOptions(stamps="log")).pose.time, [0.1, 0.2], atol=1e-9
    )


def test_a_variance_above_1000_means_not_measured(tmp_path):
    messages = poses(MOVES, variances=[1e-10, 1e-10, 1e-10, 1e-8, 1e-8, 1e4])
    stream = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + messages)).pose
    assert stream.measured[0].tolist() == [True] * 5 + [False]
    assert stream.covariance[0, 0, 0] == 1e-10
    assert np.isnan(stream.covariance[0, 5]).all()


def test_a_variance_of_zero_or_less_means_not_given(tmp_path):
    messages = poses(MOVES, variances=[0.0, -1.0, 1e-10, 1e-8, 1e-8, 1e-8])
    stream = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + messages)).pose
    assert stream.measured.all()
    assert np.isnan(stream.covariance[0, :2]).all()
    assert stream.covariance[0, 2, 2] == 1e-10


def test_a_variance_that_no_device_has_means_not_given(tmp_path):
    messages = poses(MOVES, variances=[5e-324, 1e-30, 1e-18, 1e-8, 1e-8, 1e-8])
    stream = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + messages)).pose
    assert stream.measured.all()
    assert np.isnan(np.diagonal(stream.covariance[0])[:2]).all()
    assert stream.covariance[0, 2, 2] == 1e-18


def correlated(value, *, both=True):
    messages = poses(MOVES, variances=[1e-10] * 6)
    for *_, message in messages:
        covariance = message.pose.covariance.reshape(6, 6)
        covariance[0, 1] = value
        covariance[1, 0] = value if both else 0.0
    return joint_states(MOVES) + messages


@pytest.mark.parametrize("value", [5e-10, -5e-10, np.inf, 1e300])
def test_an_invalid_covariance_is_reported_and_its_variances_are_kept(tmp_path, value):
    recording = read_bag(write_bag(tmp_path / "b", correlated(value)))
    np.testing.assert_array_equal(recording.pose.covariance[0], np.diag([1e-10] * 6))
    assert "the covariance has a negative eigenvalue" in recording.notes[0]


def test_a_correlation_is_kept_even_when_written_on_one_side(tmp_path):
    whole = read_bag(write_bag(tmp_path / "a", correlated(5e-11)))
    half = read_bag(write_bag(tmp_path / "b", correlated(5e-11, both=False)))
    assert whole.pose.covariance[0, 0, 1] == whole.pose.covariance[0, 1, 0] == 5e-11
    assert half.pose.covariance[0, 0, 1] == half.pose.covariance[0, 1, 0] == 2.5e-11
    assert whole.notes == half.notes == ()


def test_poses_without_covariance_are_measured_but_give_no_accuracy(tmp_path):
    stream = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES, type=POSE))).pose
    assert stream.measured.all()
    assert np.isnan(stream.covariance).all()


def test_points_measure_position_only(tmp_path):
    points = poses(MOVES, type=POINT, topic="measured_position")
    recording = read_bag(write_bag(tmp_path / "b", joint_states(MOVES) + points))
    assert recording.pose.measured[0].tolist() == [True] * 3 + [False] * 3
    assert recording.notes == ()


def test_orientations_that_are_all_identity_are_suspicious(tmp_path):
    messages = joint_states(MOVES) + poses(MOVES, quaternion=(0, 0, 0, 1))
    assert "exactly the identity" in read_bag(write_bag(tmp_path / "b", messages)).notes[0]


def test_poses_in_another_frame_are_dropped(tmp_path):
    odd = pose(0.5051, [0, 0, 0], frame="world")
    recording = read_bag(write_bag(tmp_path / "b", [*joint_states(MOVES), *poses(MOVES), odd]))
    assert reasons(recording) == {"frame_id is not 'base' like the others'": 1}


def test_temperatures_of_parts_are_read_from_their_own_topics(tmp_path):
    """`temperature` is guessed from what is left: here the only topic that no part has."""
    warm = [
        temperature(t, degrees, topic)
        for topic, degrees in (("t1", 31.0), ("t2", 26.0), ("hall", 21.0))
        for t in (0.5, 1.5)
    ]
    bag = write_bag(tmp_path / "bag", [*joint_states(MOVES), *poses(MOVES), *warm])
    topics = {"temperature.arms": "t1", "temperature.rods": "t2"}
    found = read_bag(bag, ReadOptions(topics=topics)).conditions
    means = {name: stream.value.mean() for name, stream in found.items()}
    assert means == {"temperature.arms": 31.0, "temperature.rods": 26.0, "temperature": 21.0}
    assert set(data_options(["temperature.arms=t1"]).topics) == {"temperature.arms"}
    with pytest.raises(ParallelCalError, match=r"payload\.arms=t1: expected KEY=VALUE"):
        data_options(["payload.arms=t1"])
    with pytest.raises(BagError, match=r"no messages on topic 't3' \(temperature\.arms\)"):
        read_bag(bag, ReadOptions(topics={"temperature.arms": "t3"}))


def test_a_temperature_from_another_day_is_ignored_with_a_note(tmp_path):
    messages = [
        *joint_states(MOVES),
        *poses(MOVES),
        temperature(9e4, 20.0),
        temperature(9.1e4, 20.0),
    ]
    recording = read_bag(write_bag(tmp_path / "b", messages))
    assert "temperature" not in recording.conditions
    assert "do not overlap" in recording.notes[0]


def test_progress_is_reported_from_start_to_end(tmp_path):
    told = []
    bag = write_bag(tmp_path / "b", joint_states(MOVES) + poses(MOVES))
    read_bag(bag, progress=lambda stage, fraction: told.append(fraction))
    assert told[0] == 0.0
    assert told[-1] == 1.0
