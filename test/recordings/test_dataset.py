"""From channels to samples: dwells, directions, replicates, conditions, units, folds, the file."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_writing import (
    POINT,
    POSE,
    Session,
    joint_state,
    joint_states,
    payload,
    pose,
    poses,
    temperature,
    write_bag,
)

from parallel_cal.base.errors import DatasetError
from parallel_cal.model.model import new_model
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.dwells import approach, still_intervals, still_tolerance
from parallel_cal.recordings.info import info
from parallel_cal.recordings.loading import dataset_from_recording, load_dataset, load_sessions
from parallel_cal.recordings.options import ReadOptions, SampleOptions
from parallel_cal.recordings.recording import COORDINATES
from parallel_cal.recordings.sampling import samples_of
from parallel_cal.recordings.simulate import simulate
from parallel_cal.reporting.blocks import as_text
from parallel_cal.reporting.recorded import describe_info

BAGS = Path(__file__).parents[2] / "bags"
STOPS = [[0.1, 0.2, 0.3], [0.4, 0.0, 0.5], [0.2, 0.3, 0.1], [0.4, 0.0, 0.5], [0.0, 0.1, 0.2]]
ROBOT = Session(STOPS)


def dataset_of(tmp_path, messages, **options):
    return load_dataset(write_bag(tmp_path / "bag", messages), **options)


def reasons(dataset):
    return {d.reason for d in dataset.dropped}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The samples of a robot that stands at five poses, two of them the same."""
    return dataset_of(tmp_path_factory.mktemp("robot"), joint_states(ROBOT) + poses(ROBOT))


# ---- dwells


def test_every_standstill_is_one_sample_with_the_mean_of_its_readings(robot):
    assert len(robot) == 5
    assert robot.mode == "dwell"
    np.testing.assert_allclose(robot.q, STOPS, atol=2e-5)
    np.testing.assert_allclose(robot.r, STOPS, atol=3e-6)
    np.testing.assert_allclose(robot.duration, 0.85, atol=0.08)
    np.testing.assert_allclose(robot.time, [0.5, 2.1, 3.7, 5.3, 6.9], atol=0.06)
    assert robot.dropped == ()
    assert robot.warnings == ()


def test_the_mean_rotation_is_the_rotation_that_was_published(robot):
    # x y z w = 0 0 0.6 0.8 turns about z: cos = 0.8^2 - 0.6^2, sin = 2 0.6 0.8
    expected = [[0.28, -0.96, 0.0], [0.96, 0.28, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(robot.R, np.broadcast_to(expected, (5, 3, 3)), atol=1e-12)


def test_the_scatter_within_a_dwell_is_that_of_single_readings(robot):
    np.testing.assert_allclose(robot.scatter_q, 2e-5, rtol=0.35)
    np.testing.assert_allclose(robot.scatter_pose[:, :3], 2e-6, rtol=0.7)
    np.testing.assert_allclose(robot.scatter_pose[:, 3:], 0.0, atol=1e-9)
    assert robot.count_q.min() > 70
    assert robot.count_pose.min() > 13


def test_no_reading_taken_while_moving_enters_a_sample(tmp_path):
    # with 30 times less noise a moving reading would show as a shift of the mean
    quiet = Session(STOPS, jitter=6e-7)
    dataset = dataset_of(tmp_path, joint_states(quiet) + poses(quiet, jitter=0.0))
    np.testing.assert_allclose(dataset.q, STOPS, atol=6e-7)
    np.testing.assert_allclose(dataset.r, STOPS, atol=1e-6)


@pytest.mark.parametrize("jitter", [0.0, 1e-6, 1e-4])
@pytest.mark.parametrize("rate", [10.0, 50.0, 500.0])
def test_dwells_are_found_at_any_rate_and_noise(jitter, rate):
    session = Session(STOPS, jitter=jitter, rate=rate)
    tolerance = still_tolerance(session.time, session.q, 0.3)
    assert len(still_intervals(session.time, session.q, tolerance, 0.3, 0.5)) == 5


def test_a_coarse_encoder_stands_still_although_it_toggles():
    session = Session(STOPS, jitter=2e-4)
    q = np.round(session.q / 1e-3) * 1e-3
    tolerance = still_tolerance(session.time, q, 0.3)
    assert (tolerance >= 1e-3).all()


def test_dwells_are_found_when_one_joint_never_moves():
    session = Session([[0.1, 0.2], [0.4, 0.2], [0.0, 0.2]])
    tolerance = still_tolerance(session.time, session.q, 0.3)
    assert len(still_intervals(session.time, session.q, tolerance, 0.3, 0.5)) == 3


@pytest.mark.parametrize("travel", [4e-4, 1e-3, 3e-3])
def test_a_joint_that_hardly_moves_does_not_break_the_dwells_of_the_others(tmp_path, travel):
    stops = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3)) * [travel, 1, 1]
    session = Session(stops)  # 2e-5 of noise on every joint
    dataset = dataset_of(tmp_path, joint_states(session) + poses(session))
    np.testing.assert_allclose(dataset.q, stops, atol=1e-5)


@pytest.mark.parametrize("jitter", [5e-3, 2e-2, 5e-2])
def test_a_robot_that_trembles_stands_still_all_the_same(tmp_path, jitter):
    stops = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3))
    session = Session(stops, jitter=jitter)
    dataset = dataset_of(tmp_path, joint_states(session) + poses(session))
    np.testing.assert_allclose(dataset.q, stops, atol=3 * jitter / np.sqrt(85))


def test_a_silence_ends_a_dwell():
    session = Session([[0.1, 0.2], [0.4, 0.0]], dwell=3.0)
    time = np.where(session.time > 1.5, session.time + 5.0, session.time)
    tolerance = still_tolerance(time, session.q, 0.3)
    assert len(still_intervals(time, session.q, tolerance, 0.3, 0.5)) == 3


def test_a_short_stop_is_dropped_with_its_reason(tmp_path):
    hasty = Session(STOPS, dwell=0.2)
    slow = Session(STOPS, start=20.0)
    messages = joint_states(hasty) + poses(hasty) + joint_states(slow) + poses(slow)
    dataset = dataset_of(tmp_path, messages)
    assert len(dataset) == 5
    assert "too short" in reasons(dataset)
    assert dataset.time.min() > 20.0


def test_a_dwell_that_nobody_measured_is_dropped_with_its_reason(tmp_path):
    seen = [m for m in poses(ROBOT) if not 1.5e9 < m[2] - ROBOT_START < 2.7e9]
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + seen)
    assert len(dataset) == 4
    assert [d.reason for d in dataset.dropped] == ["no pose messages"]
    assert dataset.dropped[0].time == pytest.approx(2.1, abs=0.1)


ROBOT_START = joint_states(ROBOT)[0][2]


def test_a_platform_that_moves_while_the_joints_stand_is_dropped(tmp_path):
    messages = [m for m in poses(ROBOT) if not 1.5e9 < m[2] - ROBOT_START < 2.7e9]
    swinging = [pose(t, [0.4 + 0.01 * t, 0, 0.5]) for t in np.arange(1.5, 2.7, 0.05)]
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + messages + swinging)
    assert len(dataset) == 4
    assert [d.reason for d in dataset.dropped] == ["moving while measured"]
    assert "while the joints stand still" in dataset.dropped[0].detail


@pytest.mark.parametrize(("every", "samples"), [(10, 5), (5, 4)])
def test_orientations_of_a_dwell_that_are_far_apart_are_not_averaged(tmp_path, every, samples):
    """A device that takes a symmetric target for a turned one: few such readings are removed, more
    make the dwell unusable."""
    rng, seen = np.random.default_rng(0), []
    for k, t in enumerate(np.arange(0.004, ROBOT.time[-1], 1 / ROBOT.pose_rate)):
        half = (np.pi * (k % every == 0 and 1.5 < t < 2.7) + 1e-5 * rng.normal()) / 2
        turn = [*1e-5 * rng.normal(size=2), np.sin(half), np.cos(half)]
        r = ROBOT.position(np.array([t]))[0] + 2e-6 * rng.normal(size=3)
        seen.append(pose(t, r, turn))
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + seen)
    assert len(dataset) == samples
    assert len(dataset.dropped) == 1
    np.testing.assert_allclose(dataset.R, np.broadcast_to(np.eye(3), (samples, 3, 3)), atol=1e-4)


def late_by(late, tmp_path):
    """A recording whose device's clock goes `late` s after that of the joints."""
    there = joint_states(ROBOT) + poses(dataclasses.replace(ROBOT, start=late))
    return write_bag(tmp_path / "late", there)


@pytest.mark.parametrize("late", [0.2, -0.2, 0.5, 0.7, -0.5])
def test_where_clocks_differ_motion_brings_them_together(tmp_path, late):
    dataset = load_dataset(late_by(late, tmp_path))
    assert len(dataset) == 5
    np.testing.assert_allclose(dataset.r, STOPS, atol=2e-5)
    assert dataset.dropped == ()
    assert sum("moved to the joints' clock" in w for w in dataset.warnings) == 1


@pytest.mark.parametrize("late", [0.2, -0.2])
def test_poses_taken_in_motion_are_removed_where_clocks_differ_a_little(tmp_path, late):
    samples = samples_of(read_bag(late_by(late, tmp_path)), SampleOptions())
    assert len(samples.kept) == 5
    np.testing.assert_allclose([s.r for s in samples.kept], STOPS, atol=2e-5)
    assert {d.reason for d in samples.dropped} == {"pose reading is an outlier"}


@pytest.mark.parametrize("late", [0.5, 0.7, -0.5])
def test_no_sample_is_made_of_poses_in_motion_where_clocks_differ(tmp_path, late):
    samples = samples_of(read_bag(late_by(late, tmp_path)), SampleOptions())
    assert len(samples.kept) == 1  # before the first move, or after the last
    moving = [d for d in samples.dropped if d.reason == "moving while measured"]
    assert len(moving) == 4
    assert "do their clocks agree" in moving[0].detail


def test_a_noisy_or_vibrating_device_is_no_motion(tmp_path):
    for k, shake in enumerate(
        (lambda t: 1e-3 * np.sin(44 * t), lambda t: 1e-3 * np.sign(t % 0.2 - 0.1))
    ):
        shaken = [
            pose(t, ROBOT.position(np.array([t]))[0] + shake(t))
            for t in np.arange(0.004, ROBOT.time[-1], 0.02).tolist()
        ]
        dataset = load_dataset(write_bag(tmp_path / f"bag{k}", joint_states(ROBOT) + shaken))
        assert len(dataset) == 5
        assert dataset.dropped == ()


@pytest.mark.parametrize("rate", [5.0, 20.0])
def test_a_device_that_shows_whole_steps_is_no_motion(tmp_path, rate):
    session = Session(STOPS, pose_rate=rate)
    time = np.arange(0.004, session.time[-1], 1 / rate)
    noise = np.random.default_rng(2).normal(0.0, 2e-4, (len(time), 3))
    seen = np.round((session.position(time) + noise) / 1e-3) * 1e-3
    shown = [pose(t, r) for t, r in zip(time.tolist(), seen, strict=True)]
    dataset = dataset_of(tmp_path, joint_states(session) + shown)
    assert len(dataset) == 5
    assert dataset.dropped == ()


def test_joints_that_come_too_rarely_are_reported_and_make_no_sample(tmp_path):
    stops = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 3))
    slow, seen = Session(stops, rate=1.0), poses(Session(stops))
    with pytest.raises(DatasetError, match="one message per 1 s; only standstills of 10 s"):
        dataset_of(tmp_path, joint_states(slow) + seen)


def test_messages_that_measure_less_than_their_dwell_are_reported(tmp_path):
    some = [1e-10] * 3 + [1e9] * 3
    messages = poses(ROBOT)
    messages[5] = pose(0.254, ROBOT.stops[0], variances=some)
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + messages)
    assert dataset.measured.all()
    told = [(d.reason, d.count, round(d.time, 3)) for d in dataset.dropped]
    assert told == [("measures fewer coordinates than the rest of its dwell", 1, 0.254)]


def test_a_joint_that_creeps_is_not_standing_still(tmp_path):
    session = Session([*STOPS, *STOPS])
    creep = (session.time > 1.6) & (session.time < 2.6)
    session.q[:, 1] += np.where(creep, 2e-3 * (session.time - 1.6), 0.0)
    dataset = dataset_of(tmp_path, joint_states(session) + poses(session))
    assert len(dataset) == 9
    assert "moving while measured" in reasons(dataset)


def test_one_wild_pose_reading_is_removed_and_the_dwell_kept(tmp_path):
    wild = pose(2.1234, [0.4, 0.03, 0.5])
    dataset = dataset_of(tmp_path, [*joint_states(ROBOT), *poses(ROBOT), wild])
    np.testing.assert_allclose(dataset.r, STOPS, atol=3e-6)
    assert [(d.reason, d.count) for d in dataset.dropped] == [("pose reading is an outlier", 1)]


def test_a_device_triggered_once_per_pose_is_enough_and_reported(tmp_path):
    single = [pose(0.5 + 1.6 * k, stop) for k, stop in enumerate(STOPS)]
    dataset = dataset_of(tmp_path, [*joint_states(ROBOT), *single, pose(1.3, [0, 0, 0])])
    assert len(dataset) == 5
    assert np.isnan(dataset.scatter_pose).all()
    assert "fewer than 3" in dataset.warnings[0]
    assert reasons(dataset) == {"moving while measured"}


@pytest.mark.parametrize("length", [2, 5, 15])
def test_a_recording_of_a_few_messages_says_what_to_do(tmp_path, length):
    with pytest.raises(DatasetError, match=r"no usable dwell.*Let the robot stand"):
        dataset_of(tmp_path, joint_states(ROBOT)[:length] + poses(ROBOT)[:2])


def test_a_recording_without_dwells_says_what_to_do(tmp_path):
    moving = Session(STOPS, dwell=0.0)
    with pytest.raises(DatasetError, match="mode='continuous'"):
        dataset_of(tmp_path, joint_states(moving) + poses(moving))


def test_a_moving_robot_is_sampled_at_every_pose_message(tmp_path):
    moving = Session(STOPS, dwell=0.0, jitter=0.0)
    dataset = dataset_of(
        tmp_path, joint_states(moving) + poses(moving, jitter=0.0), mode="continuous"
    )
    assert len(dataset) == len(poses(moving))
    np.testing.assert_allclose(dataset.q, moving.path(STOPS, dataset.time), atol=1e-4)
    speed = np.gradient(dataset.q[:, 0], dataset.time)
    velocity = dataset.conditions["velocity.joint1"]
    np.testing.assert_allclose(velocity[1:-1], speed[1:-1], atol=0.05)
    rise = np.gradient(velocity, dataset.time)
    acceleration = dataset.conditions["acceleration.joint1"]
    assert np.ptp(rise) > 5
    assert np.abs(acceleration - rise)[5:-5].max() < 0.1 * np.ptp(rise)
    fast = np.abs(speed) > 0.1
    np.testing.assert_array_equal(
        dataset.conditions["direction.joint1"][fast], np.sign(speed[fast])
    )


def test_poses_in_a_silence_of_the_joints_are_not_interpolated(tmp_path):
    moving = Session(STOPS, dwell=0.0)
    gap = [m for m in joint_states(moving) if not 0.5e9 < m[2] - ROBOT_START < 1.5e9]
    dataset = dataset_of(tmp_path, gap + poses(moving), mode="continuous")
    assert reasons(dataset) == {"no joint readings before and after the pose"}
    assert not ((dataset.time > 0.51) & (dataset.time < 1.49)).any()


def test_an_unknown_option_or_mode_names_those_that_exist(tmp_path):
    bag = write_bag(tmp_path / "bag", joint_states(ROBOT) + poses(ROBOT))
    with pytest.raises(DatasetError, match=r"min_dwel; did you mean .*known: mode, min_dwell"):
        load_dataset(bag, min_dwel=1.0)
    with pytest.raises(DatasetError, match=r"mode='fast'; expected one of auto, dwell, continuous"):
        load_dataset(bag, mode="fast")


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_dwell": "abc"},
        {"min_dwell": -1},
        {"min_dwell": np.nan},
        {"trim_start": -0.1},
        {"min_joint_messages": 0},
        {"assume_units": "maybe"},
        {"still_tolerance": "abc"},
        {"still_tolerance": [1e-3, 2e-3]},
        {"joint_sigma": 0},
        {"max_samples": 0},
    ],
)
def test_an_option_of_a_wrong_value_is_named_with_what_is_expected(tmp_path, wrong):
    bag = write_bag(tmp_path / "bag", joint_states(ROBOT) + poses(ROBOT))
    with pytest.raises(DatasetError, match=rf"{next(iter(wrong))}(=| is ).*expected"):
        load_dataset(bag, **wrong)


# ---- what is measured


def test_positions_alone_make_samples_without_orientation(tmp_path):
    points = poses(ROBOT, type=POINT, topic="measured_position")
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + points)
    assert dataset.measured.tolist() == [[True] * 3 + [False] * 3] * 5
    np.testing.assert_array_equal(dataset.R, np.broadcast_to(np.eye(3), (5, 3, 3)))
    assert np.isnan(dataset.scatter_pose[:, 3:]).all()


def test_the_stated_accuracy_is_kept_and_not_divided_by_the_number_of_readings(tmp_path):
    variances = [1e-10, 2e-10, 3e-10, 1e-8, 2e-8, 1e6]
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + poses(ROBOT, variances=variances))
    np.testing.assert_allclose(np.diagonal(dataset.pose_cov[0])[:5], variances[:5])
    assert np.isnan(dataset.pose_cov[0, 5]).all()
    assert dataset.measured[0].tolist() == [True] * 5 + [False]


def test_poses_without_accuracy_say_so_with_nan(tmp_path):
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + poses(ROBOT, type=POSE))
    assert np.isnan(dataset.pose_cov).all()
    assert dataset.joint_sigma is None


def test_a_dwell_whose_orientation_was_lost_keeps_its_position(tmp_path):
    lost = [1e-10] * 3 + [1e9] * 3
    messages = [
        pose(
            (m[2] - ROBOT_START) * 1e-9,
            STOPS[1] if 1.5e9 < m[2] - ROBOT_START < 2.7e9 else ROBOT.position(at)[0],
            variances=lost if 1.5e9 < m[2] - ROBOT_START < 2.7e9 else None,
        )
        for m in poses(ROBOT)
        for at in [np.array([(m[2] - ROBOT_START) * 1e-9])]
    ]
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + messages)
    assert dataset.measured.sum(axis=1).tolist() == [6, 3, 6, 6, 6]


def test_the_users_joint_accuracy_is_kept_and_checked(tmp_path):
    bag = write_bag(tmp_path / "bag", joint_states(ROBOT) + poses(ROBOT))
    assert load_dataset(bag, joint_sigma=1e-4).joint_sigma.tolist() == [1e-4] * 3
    with pytest.raises(DatasetError, match=r"joint_sigma=.*expected one positive number"):
        load_dataset(bag, joint_sigma=[1e-4, 1e-4])


# ---- conditions


def test_each_joints_approach_direction_is_that_of_its_last_motion(robot):
    expected = [[0, 0, 0], [1, -1, 1], [-1, 1, -1], [1, -1, 1], [-1, 1, -1]]
    found = np.stack([robot.conditions[f"direction.joint{j}"] for j in (1, 2, 3)], axis=1)
    np.testing.assert_array_equal(found, expected)


def test_a_joint_that_rests_keeps_the_direction_of_its_motion_before():
    session = Session([[0.0, 0.0], [0.3, 0.1], [0.3, 0.5], [0.3, 0.2]])
    level, ends = np.array(session.stops), [10, 160, 320, 480]
    found = approach(session.q, ends, level, np.array([3e-4, 3e-4]))
    assert found.tolist() == [[0, 0], [1, 1], [1, 1], [1, -1]]


def test_overshoot_counts_as_the_last_motion():
    q = np.concatenate([np.linspace(0, 0.52, 50), np.linspace(0.52, 0.5, 20), np.full(50, 0.5)])
    found = approach(q[:, None], [len(q)], np.array([[0.5]]), np.array([1e-3]))
    assert found.tolist() == [[-1]]


def test_velocity_is_zero_at_standstill(robot):
    for j in (1, 2, 3):
        np.testing.assert_allclose(robot.conditions[f"velocity.joint{j}"], 0.0, atol=5e-5)


def test_temperature_is_interpolated_and_payload_is_the_latest(tmp_path):
    extra = [temperature(0.0, 20.0), temperature(8.0, 28.0), payload(1.3, 0.5), payload(4.5, 1.5)]
    dataset = dataset_of(tmp_path, joint_states(ROBOT) + poses(ROBOT) + extra)
    np.testing.assert_allclose(dataset.conditions["temperature"], 20 + dataset.time, atol=1e-9)
    assert dataset.conditions["payload"].tolist() == [0.5, 0.5, 0.5, 1.5, 1.5]
    assert any("payload: 1 samples are earlier" in w for w in dataset.warnings)


def test_conditions_that_were_not_recorded_are_absent(robot):
    assert "temperature" not in robot.conditions
    assert "payload" not in robot.conditions
    np.testing.assert_array_equal(robot.conditions["time"], robot.time)


# ---- units


def test_positions_in_millimetres_are_refused_unless_insisted_on(tmp_path):
    far = Session(STOPS, r=1e3 * np.array(STOPS))
    bag = write_bag(tmp_path / "bag", joint_states(far) + poses(far, jitter=2e-3))
    with pytest.raises(DatasetError, match=r"looks like millimetres: median \|r\| = .*metres"):
        load_dataset(bag)
    assert len(load_dataset(bag, assume_units=True)) == 5
    assert any("millimetres" in warning for warning in info(bag)["warnings"])


def test_one_pose_in_millimetres_among_good_ones_is_dropped(tmp_path):
    r = np.array(STOPS)
    r[2] *= 1e3
    odd = Session(STOPS, r=r)
    dataset = dataset_of(tmp_path, joint_states(odd) + poses(odd))
    assert len(dataset) == 4
    assert [d.reason for d in dataset.dropped] == ["position looks like millimetres"]


def test_joints_in_degrees_are_suspicious(tmp_path):
    turned = Session(60.0 * np.array(STOPS), r=STOPS, jitter=1e-3)
    dataset = dataset_of(tmp_path, joint_states(turned) + poses(turned))
    assert "joint1 looks like degrees" in dataset.warnings[0]


@pytest.mark.parametrize(
    ("measured", "told"),
    [
        (temperature(0.0, 294.15), "temperature does not look like degC: it ranges from 294.1"),
        (temperature(0.0, -400.0), "temperature does not look like degC: it ranges from -400"),
        (payload(0.0, -1.0), "payload does not look like kg: it ranges from -1"),
    ],
)
def test_a_condition_in_another_unit_is_suspicious(tmp_path, measured, told):
    dataset = dataset_of(tmp_path, [*joint_states(ROBOT), *poses(ROBOT), measured])
    assert [w for w in dataset.warnings if w.startswith(told)]


def test_a_cold_hall_is_not_suspicious(tmp_path):
    cold = temperature(0.0, -25.0)
    assert dataset_of(tmp_path, [*joint_states(ROBOT), *poses(ROBOT), cold]).warnings == ()


# ---- replicates and folds


def test_a_pose_visited_twice_is_found_and_gives_the_noise(robot):
    assert robot.pose_id.tolist() == [0, 1, 2, 1, 3]
    noise = robot.replicate_noise()
    assert noise.dof == 1
    pair = robot.q[1] - robot.q[3]
    np.testing.assert_allclose(noise.joint, np.abs(pair) / np.sqrt(2.0))
    np.testing.assert_allclose(noise.pose[:3], np.abs(robot.r[1] - robot.r[3]) / np.sqrt(2.0))


def test_replicate_noise_is_pooled_over_groups_with_their_degrees_of_freedom():
    # two groups of 2 and 3 about their means: squares 2*0.01 + (0.04 + 0 + 0.04), 1 + 2 dof
    q = np.array([[1.1], [0.9], [5.2], [5.0], [4.8]])
    ids = [0, 0, 1, 1, 1]
    noise = Dataset.from_arrays(["a"], q, np.zeros((5, 3)), pose_id=ids).replicate_noise()
    assert noise.joint[0] == pytest.approx(np.sqrt(0.10 / 3))
    assert noise.dof == 3
    assert np.isnan(noise.pose[3:]).all()


def test_without_replicates_the_noise_is_unknown():
    data = Dataset.from_arrays(["a", "b"], np.eye(2), np.eye(3)[:2])
    noise = data.replicate_noise()
    assert noise.dof == 0
    assert np.isnan(noise.joint).all()
    assert noise.pose.shape == (6,)


@pytest.mark.parametrize("play", [0.0, 3e-4, 1.5e-3])
def test_visits_that_differ_by_encoder_error_and_play_are_still_replicates(play):
    rng = np.random.default_rng(1)
    q = rng.uniform(-0.4, 1.2, (40, 3))
    again = q + rng.normal(0.0, 1.2e-4, q.shape) + play
    r = np.concatenate([q, again + 0.1 * play])
    data = Dataset.from_arrays(["a", "b", "c"], np.concatenate([q, again]), r)
    np.testing.assert_array_equal(data.pose_id, np.tile(np.arange(40), 2))


def test_five_visits_in_succession_are_visits_of_one_pose():
    """Four of five steps from row to row are the noise of the encoders."""
    rng = np.random.default_rng(2)
    q = np.repeat(rng.uniform(-0.05, 0.05, (15, 6)), 5, axis=0) + rng.normal(0, 1e-6, (75, 6))
    data = Dataset.from_arrays([f"leg{k}" for k in range(6)], q, 1.5 * q[:, :3])
    np.testing.assert_array_equal(data.pose_id, np.repeat(np.arange(15), 5))


def test_a_fine_sweep_is_not_taken_for_replicates():
    q = np.linspace(0.0, 6.28, 1500)[:, None]
    data = Dataset.from_arrays(["crank"], q, np.hstack([np.cos(q), 0 * q, 0 * q]))
    assert len(set(data.pose_id)) == 1500


def test_two_assembly_modes_of_the_same_joints_are_two_poses():
    q = np.array([[0.1, 0.2], [0.5, 0.9], [0.1, 0.2]])
    data = Dataset.from_arrays(["a", "b"], q, [[0, 0, 1.0], [0, 0.4, 0.5], [0, 0, -1.0]])
    assert data.pose_id.tolist() == [0, 1, 2]


def test_equal_poses_are_one_pose_visited_often(tmp_path):
    still = Session([[0.3, 0.3, 0.3]] * 4)
    nods = [[0.3, 0.3, 0.3], [0.301, 0.3, 0.3]] * 4
    dataset = dataset_of(tmp_path, joint_states(still) + poses(still))
    assert len(set(dataset.pose_id)) == 1
    data = Dataset.from_arrays(["a", "b", "c"], nods[::2], np.zeros((4, 3)))
    assert set(data.pose_id) == {0}
    with pytest.raises(DatasetError, match="one pose"):
        data.folds()


def many(n=30, poses=12):
    rng = np.random.default_rng(0)
    ids = rng.integers(0, poses, n)
    q = rng.uniform(0, 1, (poses, 3))[ids]
    return Dataset.from_arrays(["a", "b", "c"], q, q, pose_id=ids)


def test_folds_test_every_sample_once_and_never_split_a_pose():
    data = many()
    folds = data.folds(0.25, seed=3)
    assert len(folds) == 4
    assert sorted(np.concatenate([test for _, test in folds]).tolist()) == list(range(30))
    for train, test in folds:
        assert sorted([*train, *test]) == list(range(30))
        assert not set(data.pose_id[train]) & set(data.pose_id[test])
    assert max(len(test) for _, test in folds) - min(len(test) for _, test in folds) <= 4


def test_folds_depend_on_the_seed_alone():
    first, again, other = (many().folds(0.25, seed=s) for s in (1, 1, 2))
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a[1], b[1]) for a, b in zip(first, other, strict=True))


@pytest.mark.parametrize("fraction", [0.0, -1.0, 0.7, 1.0])
def test_an_impossible_fraction_is_refused(fraction):
    with pytest.raises(DatasetError, match="hold-out fraction"):
        many().folds(fraction)


def test_folds_of_a_continuous_motion_hold_out_stretches_of_time():
    data = dataclasses.replace(
        Dataset.from_arrays(["a"], np.arange(200.0)[:, None], np.zeros((200, 3))), mode="continuous"
    )
    for _, test in data.folds(0.25):
        assert (np.diff(test) == 1).mean() > 0.8


def test_selecting_by_mask_and_by_index_agree(robot):
    mask = np.array([False, True, True, False, True])
    by_mask, by_index = robot.select(mask), robot.select([1, 2, 4])
    np.testing.assert_array_equal(by_mask.q, by_index.q)
    np.testing.assert_array_equal(by_mask.conditions["time"], robot.time[mask])
    assert by_mask.pose_id.tolist() == [1, 2, 3]
    assert len(robot.select([])) == 0
    with pytest.raises(DatasetError, match="mask of shape"):
        robot.select([True, False])


# ---- the sample file


def test_samples_survive_the_file_bit_for_bit(robot, tmp_path):
    robot.to_json(tmp_path / "samples.json")
    back = load_dataset(tmp_path / "samples.json")
    for item in dataclasses.fields(Dataset):
        old, new = getattr(robot, item.name), getattr(back, item.name)
        if item.name == "conditions":
            assert old.keys() == new.keys()
            assert len(old) > 1
            assert all(np.array_equal(old[k], new[k]) for k in old)
        elif isinstance(old, np.ndarray):
            assert old.dtype == new.dtype
            np.testing.assert_array_equal(old, new)
        else:
            assert old == new
    assert list(tmp_path.iterdir()) == [tmp_path / "samples.json"]


def test_a_sample_file_is_read_in_the_wanted_joint_order(robot, tmp_path):
    robot.to_json(tmp_path / "s.json")
    back = load_dataset(tmp_path / "s.json", joints=("joint3", "joint1", "joint2"))
    np.testing.assert_array_equal(back.q, robot.q[:, [2, 0, 1]])
    with pytest.raises(DatasetError, match="not found: elbow"):
        load_dataset(tmp_path / "s.json", joints=("elbow",))


def test_a_damaged_sample_file_is_refused_naming_file_and_key(robot, tmp_path):
    path = tmp_path / "s.json"
    robot.to_json(path)
    document = json.loads(path.read_text())
    del document["R"]
    path.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match=r"s\.json.*'R'"):
        Dataset.from_json(path)
    path.write_text("{}")
    with pytest.raises(DatasetError, match=r"parallel_cal_samples is None; expected 1"):
        Dataset.from_json(path)
    path.write_text("{")
    with pytest.raises(DatasetError, match=r"cannot read samples.*truncated"):
        Dataset.from_json(path)


def mirrored(document):
    document["R"][2] = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda d: d["q"].__setitem__(1, [None] * 3), "q of sample 1 is null"),
        (lambda d: d["time"].__setitem__(0, None), "time of sample 0 is null"),
        (lambda d: d["r"].pop(), "r is not"),
        (lambda d: d["duration"].pop(), "duration is not"),
        (lambda d: d["measured"].pop(), "measured has"),
        (lambda d: d["pose_id"].pop(), "pose_id has"),
        (lambda d: next(iter(d["conditions"].values())).pop(), "conditions.*has"),
        (mirrored, "R of sample 2 is not a rotation: it is a reflection"),
        (lambda d: d["R"].__setitem__(0, [[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "not orthogonal"),
        (lambda d: d.update(joint_names=["a", "a", "b"]), "joint_names"),
        (lambda d: d.update(joint_sigma=[1e-5]), "joint_sigma"),
        (lambda d: d.update(dropped=[{"odd": 1}]), "dropped"),
    ],
)
def test_a_sample_file_with_an_invalid_column_is_refused_with_its_key(robot, tmp_path, spoil, said):
    path = tmp_path / "s.json"
    robot.to_json(path)
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    with pytest.raises(DatasetError, match=said):
        load_dataset(path)


def test_what_is_no_regular_sample_file_of_sane_depth_is_refused(tmp_path):
    deep, pipe, digits = (tmp_path / f"{name}.json" for name in ("deep", "pipe", "digits"))
    deep.write_text("[" * 60_000)
    digits.write_text('{"parallel_cal_samples": ' + "1" * 5000 + "}")
    os.mkfifo(pipe)
    for path in (deep, pipe, digits):
        with pytest.raises(DatasetError, match="cannot read samples"):
            load_dataset(path)


# ---- look


def test_look_returns_everything_as_json(tmp_path):
    wild = joint_state(0.5051, ROBOT.names, [np.nan, 0.0, 0.0])
    bag = write_bag(tmp_path / "bag", [*joint_states(ROBOT), *poses(ROBOT), wild])
    document = json.loads(json.dumps(info(bag), allow_nan=False))
    assert document["samples"] == 5
    assert document["poses"] == 4
    assert document["replicates"] == {"poses": 1, "samples": 2}
    assert document["dropped"] == {"joint reading is not finite": 1}
    assert document["channels"]["joints"] == "joint_states"
    assert document["measured"] == list(COORDINATES)
    assert document["topics"][0]["rate"] == pytest.approx(100.0, rel=0.02)
    assert document["joints"]["joint1"]["max"] == pytest.approx(0.4, abs=1e-3)


def test_look_shows_a_recording_that_gives_no_sample(tmp_path):
    moving = Session(STOPS, dwell=0.0)
    document = info(write_bag(tmp_path / "bag", joint_states(moving) + poses(moving)))
    assert document["samples"] == 0
    assert "mode='continuous'" in document["warnings"][-1]


def test_look_prints_units(tmp_path):
    document = info(write_bag(tmp_path / "b", joint_states(ROBOT) + poses(ROBOT)))
    shown = as_text(describe_info(document), width=80)
    _, *lines = shown.splitlines()  # the first line is the path of the recording
    assert all(len(line) <= 80 for line in lines)
    assert "geometry_msgs/msg/PoseWithCovarianceStamped  " in shown
    for word in ("100.", "Hz", "5 samples (dwell) of 4 poses", " um", "arcmin", "deg"):
        assert word in shown


def test_look_prints_when_and_what_was_dropped(tmp_path):
    wild = joint_state(0.5051, ROBOT.names, [np.nan, 0.0, 0.0])
    bag = write_bag(tmp_path / "bag", [*joint_states(ROBOT), *poses(ROBOT), wild])
    told = (
        "dropped 1: joint reading is not finite; first at 0.51 s: joint_states: 1 of 741 messages"
    )
    assert told in as_text(describe_info(info(bag)))


def test_info_omits_excluded_samples(tmp_path):
    bag = write_bag(tmp_path / "bag", joint_states(ROBOT) + poses(ROBOT))
    document = info(bag, ReadOptions(exclude=[1]))
    assert document["samples"] == 4
    assert document["replicates"]["poses"] == 0


def test_a_part_of_the_samples_has_all_visits_of_poses_over_the_whole_recording():
    whole = load_dataset(BAGS / "delta_backlash")
    some = load_dataset(BAGS / "delta_backlash", max_samples=40, exclude=[0])
    assert 30 < len(some) <= 40
    assert some.warnings[-1] == (
        f"{len(some)} of 93 samples are used, evenly spread over the recording"
    )
    assert set(some.pose_id) < set(whole.pose_id)
    every_visit = np.isin(whole.pose_id, some.pose_id) & (whole.numbers > 0)
    assert some.numbers.tolist() == np.flatnonzero(every_visit).tolist()
    thirds = np.digitize(some.time, np.quantile(whole.time, [1 / 3, 2 / 3]))
    assert np.bincount(thirds).min() >= 8
    assert load_dataset(BAGS / "delta_backlash", max_samples=94).warnings == whole.warnings


def test_a_part_of_two_recordings_has_samples_of_both():
    both = [BAGS / "delta_backlash", BAGS / "delta_clean"]
    some = load_sessions(both, max_samples=50)
    assert 40 < len(some) < 60
    counts = np.bincount(some.conditions["session"].astype(int))
    assert counts.min() > 15
    document = info(both[0], ReadOptions(max_samples=50))
    assert 40 < document["samples"] < 60
    assert "samples are used, evenly spread" in document["warnings"][-1]


# ---- the recordings that ship with the package


@pytest.mark.wide
@pytest.mark.parametrize("name", ["delta_clean", "delta_eccentricity", "delta_backlash"])
def test_shipped_recordings_give_their_94_dwells_directions_and_replicates(name):
    truth = yaml.safe_load((BAGS / "truth" / f"{name}.yaml").read_text())
    dwells = truth["dwells_arrive_leave_pose_direction"]
    dataset = dataset_from_recording(read_bag(BAGS / name))
    assert len(dataset) == len(dwells) == 94
    assert dataset.dropped == dataset.warnings == ()
    found = np.stack([dataset.conditions[f"direction.joint{j}"] for j in (1, 2, 3)], axis=1)
    np.testing.assert_array_equal(found, [d[3] for d in dwells])
    visited = np.array([d[2] for d in dwells])
    together = dataset.pose_id[:, None] == dataset.pose_id
    np.testing.assert_array_equal(together, visited[:, None] == visited)
    assert dataset.replicate_noise().dof == (np.bincount(dataset.pose_id) > 1).sum() == 20


def test_the_numbers_of_samples_are_made_once_and_cannot_be_changed():
    model = new_model("delta24")
    data = simulate(model, 6, 1).dataset()
    part = data.excluding([2])
    for one in (data, part):
        assert one.numbers is one.numbers  # a list of 10^5 samples asks 10^5 times
        with pytest.raises(ValueError, match="read-only"):
            one.numbers[0] = 7
    assert part.numbers.tolist() == [n for n in range(len(data)) if n != 2]
    assert dataclasses.replace(part, q=part.q + 1).numbers.tolist() == part.numbers.tolist()
