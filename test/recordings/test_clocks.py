"""Joint states on one clock, poses on another: the motion that both show tells how far apart."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.clocks import MAX_DRIVER_DELAY_S, clock_offset, describe_offset
from parallel_cal.recordings.loading import dataset_from_recording
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.recording import JointStream, PoseStream

BAGS = Path(__file__).parents[2] / "bags"
ALL = sorted(p.name for p in BAGS.iterdir() if (p / "metadata.yaml").exists())


@cache
def recording(name):
    return read_bag(BAGS / name)


def late(name, delay):
    """The recording with the device's stamps `delay` seconds later, or drawn anew by a function."""
    pose = recording(name).pose
    return dataclasses.replace(
        recording(name), pose=dataclasses.replace(pose, time=pose.time + delay)
    )


@pytest.mark.parametrize("delay", [0.12, -0.4, 3.0, -1000.0])
def test_dwells_come_out_as_if_there_were_one_clock(delay):
    plain = dataset_from_recording(recording("delta_crosstalk"))
    found = dataset_from_recording(late("delta_crosstalk", delay))
    assert len(found) == len(plain)
    assert np.abs(found.r - plain.r).max() < 5e-6
    assert np.abs(found.q - plain.q).max() == 0
    assert not any("two clocks" in w for w in plain.warnings)
    [said] = [w for w in found.warnings if "two clocks" in w]
    assert f"s {'later' if delay > 0 else 'earlier'} than" in said
    assert float(said.split(" was stamped ")[1].split()[0]) == pytest.approx(abs(delay), abs=1e-3)


def test_motion_is_paired_as_if_there_were_one_clock():
    options = SampleOptions(mode="continuous")
    plain = dataset_from_recording(recording("delta_latency"), options)
    found = dataset_from_recording(late("delta_latency", 0.25), options)
    shown = {r.tobytes(): q for r, q in zip(plain.r, plain.q, strict=True)}
    apart = [q - shown[r.tobytes()] for r, q in zip(found.r, found.q, strict=True)]
    assert len(found) > 0.98 * len(plain)
    fastest = max(np.abs(plain.conditions[f"velocity.{j}"]).max() for j in plain.joint_names)
    assert np.abs(apart).max() < 3e-3 * fastest  # 3 ms of motion
    assert sum("two clocks" in w for w in found.warnings) == 1


@pytest.mark.parametrize("spread", [0.0, 0.02, 0.07])
def test_stamps_of_arrival_are_recognised_by_their_delay_and_their_irregular_intervals(spread):
    """60 to 200 ms late: the time that a network needs, which varies from message to message."""
    there = late("delta_crosstalk", 0.13)
    wait = spread * np.random.default_rng(1).uniform(-1, 1, len(there.pose.time))
    time = np.maximum.accumulate(there.pose.time + wait)  # messages arrive in their order
    there = dataclasses.replace(there, pose=dataclasses.replace(there.pose, time=time))
    found = clock_offset(there.joints, there.pose)
    assert found.delay == pytest.approx(0.13, abs=6e-3)
    assert found.jitter == pytest.approx(spread / 3**0.5, rel=0.3, abs=1e-6)
    words = describe_offset(found, "pose", "joints")
    assert ("probably times of arrival" in str(words)) == (spread > 0)


@pytest.mark.parametrize("name", ["delta_crosstalk", "argos_gear_ripple"])
def test_the_uncertainty_is_that_of_the_delay(name):
    """Positions tell it, and orientations alone do."""
    own = [clock_offset(late(name, d).joints, late(name, d).pose) for d in (0.2, -0.7, 5.03)]
    errors = [o.delay - d for o, d in zip(own, (0.2, -0.7, 5.03), strict=True)]
    assert all(o.sigma < 1e-3 for o in own)
    assert np.abs(errors).max() < 5 * own[0].sigma
    assert np.ptp(errors) < own[0].sigma


def test_what_a_driver_may_be_late_by_stays_an_effect():
    for delay in (-0.8 * MAX_DRIVER_DELAY_S, 0.8 * MAX_DRIVER_DELAY_S):
        there = late("delta_crosstalk", delay)
        assert clock_offset(there.joints, there.pose) is None


def test_a_device_that_shows_only_noise_gives_no_offset():
    there = recording("delta_crosstalk")
    noise = 1e-5 * np.random.default_rng(0).standard_normal(there.pose.position.shape)
    assert clock_offset(there.joints, dataclasses.replace(there.pose, position=noise)) is None


def drawn(seed, motion=None, joints=6, rate=20.0, length=5.0, drift=0.0, step=0.0, fine=False):
    """Streams of a robot that rests, or whose joints follow `motion(t)`: 1 um (0.1 um if `fine`) of
    reading noise, ten times as much of the device's, `drift` (m) of both, encoder `step` (m)."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, length, 1 / rate)
    sigma, n = 1e-7 if fine else 1e-6, len(time)
    bend = 1 - np.exp(-time / length)[:, None]
    way = np.zeros((n, joints)) if motion is None else motion(time)
    q = rng.uniform(-0.1, 0.1, joints) + way + sigma * rng.standard_normal((n, joints))
    q = q + drift * rng.standard_normal(joints) * bend
    q = np.round(q / step) * step if step else q
    r = way @ (rng.standard_normal((joints, 3)) / np.sqrt(joints))
    r = r + 10 * sigma * rng.standard_normal((n, 3)) + drift * rng.standard_normal(3) * bend
    unturned = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    names = tuple(f"leg{i + 1}" for i in range(joints))
    seen = np.ones((n, 6), dtype=bool)
    pose = PoseStream("pose", "base", time, r, unturned, seen, np.full((n, 6, 6), np.nan))
    return JointStream("joints", names, time, q, np.full((n, joints), np.nan)), pose


def offset_of(delay, *args, **how):
    """What is found where the device's stamps are `delay` seconds later."""
    joints, pose = drawn(*args, **how)
    return clock_offset(joints, dataclasses.replace(pose, time=pose.time + delay))


def moves(joints, which, begin=2.0, length=0.8):
    """One smooth move of 30 to 50 mm of some joints among rest."""
    ways = np.where(np.isin(range(joints), which), 0.03 + 0.02 * np.arange(joints) / joints, 0.0)

    def at(time):
        u = np.clip((time - begin) / length, 0, 1)
        return (u**3 * (10 + u * (-15 + 6 * u)))[:, None] * ways

    return at


AT_REST = {
    "white": {},
    "one joint": {"joints": 1},
    "two joints": {"joints": 2},
    "three joints": {"joints": 3},
    "four joints": {"joints": 4},
    "five joints": {"joints": 5},
    "thermal growth": {"drift": 5e-6},
    "thermal growth above the noise": {"drift": 5e-6, "fine": True},
    "encoder steps": {"step": 2e-6},
    "encoder steps and thermal growth": {"step": 1e-6, "drift": 3e-6, "fine": True},
    "fast readings": {"rate": 100.0},
    "a long rest": {"length": 60.0, "drift": 5e-6},
}


def test_a_robot_at_rest_gives_no_offset():
    found = [offset_of(0.0, seed) for seed in range(200)]
    assert not any(found)


@pytest.mark.wide
@pytest.mark.parametrize("kind", AT_REST)
@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_none_of_many_looks_at_a_robot_at_rest_finds_an_offset(kind, delay):
    """6,000 looks in all: an offset by chance in one of 1,000 would be seen."""
    assert not any(offset_of(delay, seed, **AT_REST[kind]) for seed in range(250))


@pytest.mark.parametrize("rate", [20.0, 100.0])
@pytest.mark.parametrize("which", [[3], [0, 4], range(6)], ids=["one", "two", "all"])
def test_a_short_move_between_rests_gives_the_offset(which, rate):
    """Joints that rest are noise, and take no part."""
    for delay in (0.2, 1.8, -1.8):
        found = offset_of(delay, 1, moves(6, which), rate=rate)
        assert found.delay == pytest.approx(delay, abs=5 * found.sigma + 1e-4)
        assert found.sigma < 3e-3
    assert offset_of(0.03, 1, moves(6, which), rate=rate) is None  # a driver's


def test_motion_that_repeats_is_no_proof_of_an_offset_of_half_a_period():
    def swing(time):
        return 0.003 * np.sin(2 * np.pi * time)[:, None]

    assert not any(offset_of(0.9 * MAX_DRIVER_DELAY_S, seed, swing, joints=1) for seed in range(6))


def test_a_device_that_does_not_see_the_motion_gives_no_offset():
    joints, _ = drawn(0, moves(6, range(6)))
    for seed in range(50):
        assert clock_offset(joints, drawn(seed)[1]) is None


@pytest.mark.wide
@pytest.mark.parametrize("name", ALL)
def test_recordings_on_one_clock_are_left_alone(name):
    there = recording(name)
    assert clock_offset(there.joints, there.pose) is None


def robot_that_moves(seed, stops=5, moves_s=0.4, rest=1.0, rate=20.0):
    """Streams of two joints that turn a link of two bars, 0.4 s from each stop to the next."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.6, 0.6, (stops + 1, 2)) + [0.3, 1.2]

    def at(t):
        k, part = np.divmod(np.clip(t - rest, 0, stops * (rest + moves_s) - 1e-9), rest + moves_s)
        k, u = k.astype(int), np.clip(part / moves_s, 0, 1)[:, None]
        return places[k] + u**3 * (10 - 15 * u + 6 * u**2) * (places[k + 1] - places[k])

    end = stops * (rest + moves_s) + rest
    t, seen = np.arange(0, end, 0.01), np.arange(rng.uniform(0, 1 / rate), end, 1 / rate)
    q, angle = at(t) + 2e-5 * rng.standard_normal((len(t), 2)), at(seen)
    far = angle.sum(axis=1)
    r = 0.3 * np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0])], 1)
    r = np.column_stack([r + 0.2 * np.stack([np.cos(far), np.sin(far)], 1), 0 * far])
    r[:, :2] += 2e-5 * rng.standard_normal((len(seen), 2))
    unturned, n = np.tile([0.0, 0.0, 0.0, 1.0], (len(seen), 1)), len(seen)
    measured = np.tile([True, True, False, False, False, False], (n, 1))
    pose = PoseStream("pose", "base", seen, r, unturned, measured, np.full((n, 6, 6), np.nan))
    return JointStream("joints", ("a", "b"), t, q, np.full(q.shape, np.nan)), pose


def cut(stream, until):
    """The part of a stream before a time."""
    kept = stream.time < until
    fields = ("time", "position", "velocity", "quaternion", "measured", "covariance")
    return dataclasses.replace(
        stream, **{f: getattr(stream, f)[kept] for f in fields if hasattr(stream, f)}
    )


def look_at_offset(seed, true, until):
    joints, pose = (cut(stream, until) for stream in robot_that_moves(seed))
    return clock_offset(joints, dataclasses.replace(pose, time=pose.time + true))


@pytest.mark.wide
def test_the_stated_interval_contains_the_offset_in_95_of_100_looks():
    """Bent paths leave residuals that are no noise: a sigma that takes them for noise is too
    small."""
    inside = [
        abs(found.delay - true) <= found.margin
        for seed in range(40)
        for true, until in ((0.31, 4.0), (-12.2, 5.5), (7e4, 7.9))
        if (found := look_at_offset(seed, true, until)) is not None
    ]
    assert len(inside) > 80
    assert np.mean(inside) >= 0.93


def test_the_beginning_of_a_first_move_states_no_wrong_offset():
    """A ramp that is cut off fits many delays."""
    found = [look_at_offset(s, 3.7, 1.0 + part) for s in range(30) for part in (0.1, 0.2, 0.3)]
    assert all(abs(one.delay - 3.7) < 0.05 for one in found if one is not None)
