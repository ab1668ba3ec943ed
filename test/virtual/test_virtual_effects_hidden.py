"""The physics hidden in the recordings, held to hand-worked numbers."""

import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_hidden as he
import virtual_sessions as days
from test_virtual_robot import PAPER

from parallel_cal.virtual import robot as vr

FLAT = np.zeros((1, 3))
SILENT = vr.Noise(0, 0, 0)


def at(time=0.0, temperature=20.0, payload=0.0):
    n = np.ones(1)
    return vr.SampleConditions(time * n, temperature * n, payload * n, np.ones((1, 3)))


def stand(*effects, **circumstances):
    """The flat paper robot's pose: its arms' balls 0.15 m outside, 0.2 m below the platform's."""
    _, r, R = vr.truth(vr.Delta(PAPER), effects, FLAT, at(**circumstances))
    return r[0], R[0]


def test_a_gear_ripples_by_its_amplitude_where_the_wave_peaks():
    ripple = he.GearRipple(amplitude=(1e-3, 2e-3, 3e-3), phase=(np.pi / 2, 0, 0), ratio=20.0)
    reading = np.array([[0.0, np.pi / 40, np.pi / 20]])
    np.testing.assert_allclose(
        ripple.arm(reading, None, at()) - reading, [[1e-3, 2e-3, 0]], atol=1e-15
    )


def test_a_third_of_the_weight_hangs_on_each_flat_arm():
    # all arms lift the platform as fast as their own ends, 0.1 m/rad: 3 kg are 0.981 Nm a joint
    compliance = he.JointCompliance(compliance=(1e-3, 2e-3, 0.0))
    angle = compliance.arm(FLAT, vr.Delta(PAPER), at(payload=3.0))
    np.testing.assert_allclose(angle, [[-0.981e-3, -1.962e-3, 0]], rtol=2e-3, atol=1e-12)


def test_twisted_shafts_store_half_the_energy_that_the_payload_loses():
    compliance = he.JointCompliance(compliance=(1e-3, 1e-3, 1e-3))
    twist = compliance.arm(FLAT, vr.Delta(PAPER), at(payload=3.0))[0]
    sunk = 0.2 - stand(compliance, payload=3.0)[0][2]
    stored = np.sum(twist**2) / 2 / 1e-3
    assert 3.0 * he.GRAVITY * sunk / 2 == pytest.approx(stored, rel=2e-3)


@pytest.mark.parametrize(
    ("part", "rise"),
    [("arms", -0.75 * 0.10), ("rods", 1.25 * 0.25), ("base", -0.75 * 0.05)],
)
def test_a_warm_part_moves_the_platform_as_the_3_4_5_triangle_says(part, rise):
    growth = he.ThermalGrowth(**{"arms": 0.0, "rods": 0.0, "base": 0.0} | {part: 1e-5})
    assert stand(growth, temperature=30.0)[0][2] - 0.2 == pytest.approx(1e-4 * rise, rel=1e-3)
    assert stand(growth, temperature=20.0)[0][2] == pytest.approx(0.2, abs=1e-14)


def test_a_creeping_base_shifts_and_turns_the_pose_in_proportion_to_time():
    r, R = stand(he.BaseDrift(v=(1e-7, 0, 0), w=(0, 1e-6, 0)), time=100.0)
    np.testing.assert_allclose(r, [1e-5 + 1e-4 * 0.2, 0, 0.2], atol=2e-9)
    np.testing.assert_allclose(R, vr.axis_rotation("y", 1e-4), atol=1e-14)


def test_a_leaning_axis_shows_the_others_coordinates_too_small():
    shown, _ = he.LeaningAxes(1e-4, 2e-4, 3e-4).device(np.array([[0.1, 0.2, 0.3]]), None, at())
    np.testing.assert_allclose(shown, [[0.1 - 8e-5, 0.2 - 9e-5, 0.3]], atol=1e-8)


def test_a_late_stamp_shows_where_the_robot_was_before():
    sweep, clocks = days.Sweep(seed=1, end=1.0), vd.Clocks(joint=0.1, pose=0.1, offset=0.0)
    late = vd.stream(vr.NOMINAL, sweep, [he.LateStamp(5e-3)], SILENT, clocks=clocks)
    np.testing.assert_allclose(late["r"], sweep.path(late["pose_time"] - 5e-3), atol=1e-12)
    np.testing.assert_allclose(late["q"], sweep.joints(late["pose_time"]), atol=1e-12)


def test_cross_talk_follows_the_next_joint_and_not_its_own():
    talk = he.CrossTalk(amplitude=(1e-3, 2e-3, 3e-3), waves=2.0)
    reading = np.array([[0.5, np.pi / 4, 0.0]])
    expected = [[1e-3, 0.0, 3e-3 * np.sin(1.0)]]
    np.testing.assert_allclose(talk.arm(reading, None, at()) - reading, expected, atol=1e-15)


# --- days -------------------------------------------------------------------------------------


def test_the_air_wanders_by_8_K_or_rises_all_the_time_or_holds():
    time = np.arange(0.0, 1000.0, 5.0)
    wandering, warming = days.wandering(time), days.warming(time)
    assert np.ptp(wandering) > 14
    assert abs(np.corrcoef(time, wandering)[0, 1]) < 0.6
    assert (np.diff(warming) > 0).all()
    assert np.corrcoef(time, warming)[0, 1] > 0.998
    assert np.ptp(days.steady(time)) < 0.11


def test_a_sweep_never_stops_and_changes_its_speed_five_times_over():
    sweep = days.Sweep(seed=10)
    time = np.linspace(0, sweep.end, 4000)
    speed = np.linalg.norm(np.gradient(sweep.path(time), time, axis=0), axis=1)
    assert speed.min() > 0.005
    assert np.quantile(speed, 0.95) > 4 * np.quantile(speed, 0.05)
    assert speed.max() < 0.3


def test_a_load_changes_when_the_robot_sets_out():
    session = days.loaded(5)
    for visit in (25, 26):  # the first quarter of 104 visits ends with number 25
        there = session.load(session.arrive[[visit]])
        assert there == (0.2 if visit == 25 else 1.2)
    assert session.load(session.leave[[25]] + 1e-6) == 1.2


@pytest.mark.parametrize(
    ("robot", "day"), [(days.ARGOS, days.turning), (days.HEXAPOD, days.climbing)]
)
def test_other_robots_reach_the_poses_of_their_day(robot, day):
    session = day(1)
    r, R = robot.forward(session.reading)
    assert robot.max_gap(session.reading, r, R).max() < 1e-12
    assert len(session.reading) > len(np.unique(session.pose_index))
