"""The virtual cell, held to numbers worked by hand: limits, settling, instruments, faults."""

import numpy as np
import pytest
from marks import keep

from parallel_cal.virtual.cell import Cell
from parallel_cal.virtual.drive import Drive, Limits
from parallel_cal.virtual.kinds import KINDS, hide, kinds_of
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import turn
from parallel_cal.virtual.tracker import OTHER_SHIFT, Tracker

LIMITS = Limits(
    velocity=1.0, acceleration=10.0, brake=20.0, low=-0.5, high=2.0, bandwidth=100.0, trip=0.1
)
STILL = Tracker(missing=0.0)


def driven(drive, seconds):
    """(times, set points, their speeds, joints) of every period."""
    states = [drive.step() for _ in range(round(seconds / drive.period))]
    return [
        np.array([getattr(s, f) for s in states]) for f in ("time", "target", "target_speed", "q")
    ]


# --- the drives -------------------------------------------------------------------------------


def test_a_step_of_half_a_radian_is_driven_as_a_trapezoid_within_the_limits():
    drive = Drive(np.zeros(1), LIMITS, 0.01)
    drive.follow(np.array([0.01]), np.array([[0.5]]))
    time, target, speed, q = driven(drive, 1.0)
    assert np.abs(speed).max() == pytest.approx(1.0)
    assert np.abs(np.diff(speed, axis=0)).max() <= 10.0 * 0.01 + 1e-12
    # 0.1 s up to 1 rad/s, 0.4 s on, 0.1 s down: 0.05 + 0.4 + 0.05 rad in 0.6 s
    assert time[np.argmax(target[:, 0] > 0.5 - 1e-9)] == pytest.approx(0.6, abs=0.025)
    assert target.max() <= 0.5 + 1e-12
    assert q.max() <= 0.5 + 1e-12
    assert q[-1, 0] == 0.5
    assert drive.idle


def test_a_ramp_is_followed_two_time_constants_late():
    drive = Drive(np.zeros(1), LIMITS, 0.01)
    drive.follow(np.array([1.0]), np.array([[0.5]]))
    _, target, _, q = driven(drive, 1.0)
    # y'' + 2 w y' + w^2 y = 0: behind a ramp of 0.5 rad/s by 2 v / w = 10 mrad, less the half
    # period by which the drive knows the set point early
    assert (target - q)[50, 0] == pytest.approx(0.01 - 0.5 * 0.01 / 2, abs=2e-5)


def test_a_joint_settles_without_overshoot_where_its_course_ends_at_rest():
    drive = Drive(np.zeros(1), LIMITS, 0.01)
    drive.follow(np.array([1.0]), np.array([[0.5]]), np.array([[0.0]]))
    _, target, _, q = driven(drive, 1.4)
    assert target[49, 0] == pytest.approx(0.25, abs=1e-9)
    assert (np.diff(q[:, 0]) >= 0).all()
    assert q[-1, 0] == 0.5


def test_a_rounding_error_of_its_place_does_not_turn_a_joint_back():
    """Play of a milliradian would move the platform by a tenth of a millimetre."""
    cell = Cell("delta", 0, ["backlash"])
    cell.follow([1.0], [cell.drive.state.q + 0.1])
    cell.advance(2.0)
    before, _ = cell.true_pose()
    cell.follow([0.1], [np.nextafter(cell.drive.state.q, 0.0)])
    cell.advance(3.0)
    np.testing.assert_allclose(cell.true_pose()[0], before, atol=1e-9)


def test_points_with_velocities_are_joined_by_cubics():
    drive = Drive(np.zeros(1), LIMITS, 0.01)
    drive.follow(np.array([1.0, 2.0]), np.array([[0.25], [0.5]]), np.array([[0.4], [0.0]]))
    time, target, _, _ = driven(drive, 2.0)
    # from rest to 0.25 at 0.4 rad/s: 0.25 (3 s^2 - 2 s^3) + 0.4 (s^3 - s^2), at s = 1/2 0.075
    assert target[49, 0] == pytest.approx(0.075, abs=1e-9)
    assert time[49] == pytest.approx(0.5)
    assert target[99, 0] == pytest.approx(0.25, abs=1e-9)


def test_stopping_brakes_with_the_brake_and_holds_there():
    drive = Drive(np.zeros(1), LIMITS, 0.01)
    drive.follow(np.array([2.0]), np.array([[2.0]]))
    driven(drive, 1.0)
    at = drive.state.target[0]
    drive.stop()
    _, target, speed, q = driven(drive, 0.1)
    # v^2 / (2 b) = 1 / 40 m further, in v / b = 50 ms; then the loop fades within another 50 ms
    assert target[-1, 0] - at == pytest.approx(0.025, abs=1e-9)
    assert (speed[6:] == 0).all()
    assert np.abs(np.diff(q[-2:, 0]))[0] < 0.01 * 0.05
    _, target, _, q = driven(drive, 1.0)
    assert target[-1, 0] - at == pytest.approx(0.025, abs=1e-9)
    assert drive.idle


def test_a_stuck_axis_stays_and_the_drives_give_up_where_the_lag_passes_the_limit():
    drive = Drive(np.zeros(2), LIMITS, 0.01)
    drive.stuck[:] = [True, False]
    drive.follow(np.array([1.0]), np.array([[0.5, 0.25]]))
    _, target, _, q = driven(drive, 1.0)
    assert (q[:, 0] == 0).all()
    assert drive.tripped == 1
    # 0.5 rad/s lag by 0.1 rad after 0.2 s; the other joint was on its way at half the speed
    assert q[-1, 1] == pytest.approx(0.25 * 0.2 - 0.005, abs=0.004)
    assert (target[-1] == q[-1]).all()


def test_a_mechanical_stop_holds_a_joint_that_is_sent_beyond():
    drive = Drive(np.array([1.9]), LIMITS, 0.01)
    drive.follow(np.array([1.0]), np.array([[2.05]]))
    _, _, _, q = driven(drive, 2.0)
    assert q.max() == 2.0


# --- the tracker ------------------------------------------------------------------------------


def test_a_trackers_clock_is_ahead_and_gains():
    tracker = Tracker(period=0.05, begin=0.004, offset=2.0, drift=1e-3)
    taken = tracker.sampling_times(0.0, 0.16)
    np.testing.assert_allclose(taken, [0.004, 0.054, 0.104, 0.154], atol=1e-12)
    np.testing.assert_allclose(tracker.stamps(np.array([0.0, 10.0])), [2.0, 12.01])


def test_a_tracker_that_stands_aside_and_is_turned_sees_the_target_from_there():
    quarter = np.array([0.0, 0.0, np.pi / 2])
    tracker = Tracker(shift=np.array([1.0, 0, 0]), spin=quarter, target=np.array([0.0, 0, 0.1]))
    r, R = tracker.observe(np.array([[1.0, 2.0, 0.5]]), np.eye(3)[None])
    # 2 m along the base's y, which is the tracker's x; the target 0.1 m above the platform
    np.testing.assert_allclose(r, [[2.0, 0.0, 0.6]], atol=1e-15)
    np.testing.assert_allclose(R[0], turn(-quarter), atol=1e-15)


# --- the cell ---------------------------------------------------------------------------------


def quiet(robot="delta", **options):
    return Cell(robot, noise=0.0, tracker=STILL, **options)


@pytest.mark.parametrize("robot", MACHINES)
def test_without_noise_tracker_and_encoders_show_what_the_robot_is(robot):
    cell = quiet(robot, seed=3)
    home = np.asarray(cell.machine.make_nominal().home_joints, float)
    there = home + 0.1 * cell.machine.lever * np.resize([1.0, -1.0, 0.5], len(home))
    cell.follow([1.0], [there])
    shown = cell.advance(2.0)
    np.testing.assert_allclose(shown.time, 0.01 * np.arange(1, 201), atol=1e-9)
    np.testing.assert_array_equal(shown.q[-1], there)
    r, R = cell.built.forward(there)
    np.testing.assert_allclose(shown.r[-1], r, atol=1e-9)
    np.testing.assert_allclose(shown.R[-1], R, atol=1e-9)
    assert len(shown.stamp) == 40


def test_equal_seeds_show_the_same_however_time_is_cut():
    cells = [Cell("delta", seed=5, effects=["hidden", "hidden"]) for _ in range(3)]
    for cell in cells:
        cell.follow([0.5], [[0.6, 0.5, 0.4]])
        cell.change_at(1.0, swapped_target=True)
    whole = cells[0].advance(2.0)
    parts = [cells[1].advance(t) for t in np.arange(1, 201) * 0.01]
    few = [cells[2].advance(t) for t in (0.33, 0.777, 1.02, 2.0)]
    for name in ("time", "q", "stamp", "r", "R"):
        for cut in (parts, few):
            together = np.concatenate([getattr(part, name) for part in cut])
            np.testing.assert_allclose(together, getattr(whole, name), atol=1e-9)


def test_encoders_show_whole_steps_and_err_as_stated_from_dwell_to_dwell():
    cell = Cell("delta", seed=1)
    step, home, errors = cell.machine.noise.joint / 2, cell.drive.state.q, []
    for k in range(30):
        there = home + (0.05 if k % 2 else -0.05)
        cell.follow([0.1], [there])
        cell.advance(cell.time + 0.8)
        assert cell.idle
        shown = cell.advance(cell.time + 0.2).q
        np.testing.assert_allclose(shown / step, np.round(shown / step), atol=1e-6)
        errors.append(shown.mean(axis=0) - there)
    # 90 errors of one sigma: their rms is known to 8 %
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(cell.machine.noise.joint, rel=0.2)


def test_a_stuck_encoder_shows_what_it_showed_while_the_platform_moves():
    cell = quiet()
    before = cell.advance(0.1)
    cell.change(stuck_encoder=2)
    cell.follow([0.5], [[0.6, 0.6, 0.6]])
    shown = cell.advance(1.5)
    assert (shown.q[:, 1] == before.q[-1, 1]).all()
    assert shown.q[-1, 0] == 0.6
    np.testing.assert_allclose(shown.r[-1], cell.built.forward(np.full(3, 0.6))[0], atol=1e-9)


def test_a_lost_target_gives_no_poses_and_a_swapped_one_stands_beside():
    cell = quiet()
    cell.change_at(1.0, lost_target=True)
    cell.change_at(2.0, lost_target=False, swapped_target=True)
    shown = cell.advance(3.0)
    assert not ((shown.stamp > 1.01) & (shown.stamp < 2.0)).any()
    r, R = cell.true_pose()
    np.testing.assert_allclose(shown.r[-1], r + R @ OTHER_SHIFT, atol=1e-12)
    np.testing.assert_allclose(shown.r[0], r, atol=1e-12)


def test_a_coupling_that_slips_moves_the_arm_and_not_the_reading():
    cell = quiet()
    cell.change(slipped=0.02)
    cell.follow([0.1], [[0.52, 0.5, 0.5]])
    shown = cell.advance(1.0)
    assert shown.q[-1, 0] == 0.52
    np.testing.assert_allclose(shown.r[-1], cell.built.forward([0.5, 0.5, 0.5])[0], atol=1e-9)


def test_crossed_axes_go_the_other_joints_way_and_drives_without_power_none():
    cell = quiet()
    cell.change(crossed_axes=True)
    cell.follow([0.5], [[0.6, 0.5, 0.4]])
    np.testing.assert_array_equal(cell.advance(1.5).q[-1], [0.5, 0.6, 0.4])
    cell.change(crossed_axes=False, drives_off=True)
    cell.follow([0.5], [[0.7, 0.7, 0.7]])
    np.testing.assert_array_equal(cell.advance(3.0).q[-1], [0.5, 0.6, 0.4])


def test_an_obstacle_stops_the_platform_before_it_and_lets_it_go_back():
    cell = quiet()
    below = ((-0.1, -0.1, 0.21), (0.1, 0.1, 0.30))  # a table: z points down for this robot
    cell.change(obstacles=((np.array(below[0]), np.array(below[1])),))
    home = cell.drive.state.q
    far = quiet()
    far.follow([1.0], [home + 0.3])
    assert far.advance(2.0).r[-1, 2] > 0.22  # where it would have gone
    cell.follow([1.0], [home + 0.3])
    shown = cell.advance(2.0)
    assert shown.r[:, 2].max() < 0.21
    assert shown.r[-1, 2] > 0.205
    assert cell.drive.tripped == 1
    cell.follow([1.0], [home])
    np.testing.assert_array_equal(cell.advance(4.0).q[-1], home)


# --- what is hidden ---------------------------------------------------------------------------


@pytest.mark.wide
@pytest.mark.parametrize("robot", keep(MACHINES, "argos", "linear_delta"))
def test_what_is_hidden_shows_in_the_poses_beyond_the_noise(robot):
    for kind in kinds_of(robot):
        plain, cell = (quiet(robot, seed=2, effects=e, air=0.0) for e in ((), (kind,)))
        for c in (plain, cell):
            c.change(payload=1.0, temperature=32.0)
            home = c.drive.state.q
            c.follow([1.0], [home + c.machine.lever * np.resize([0.3, -0.15, 0.2], len(home))])
            c.advance(3.0)
        end = 600.0 if KINDS[kind].asks == "time" else 4.0
        one, other = (c.advance(end) for c in (plain, cell))
        moved = np.abs(one.R[-1] - other.R[-1]).max() / cell.machine.noise.orientation
        if cell.machine.sees_position:
            moved = max(moved, np.abs(one.r[-1] - other.r[-1]).max() / cell.machine.noise.position)
        assert moved > 1, kind


def test_thirteen_kinds_may_be_hidden_seven_and_more_in_every_robot():
    assert len(KINDS) == 13
    assert {robot: len(kinds_of(robot)) for robot in MACHINES} == {
        "delta": 10,
        "stewart": 8,
        "argos": 7,
        "linear_delta": 10,
    }


def test_hidden_kinds_are_drawn_by_the_seed_each_once_and_a_wrong_name_is_reported():
    drawn = [hide("delta", ["hidden", "backlash", "hidden"], seed)[0] for seed in range(40)]
    assert {len(set(names)) for names in drawn} == {3}
    assert all(names[1] == "backlash" for names in drawn)
    assert {name for names in drawn for name in names} == set(kinds_of("delta"))
    with pytest.raises(ValueError, match="effect soft_rods: a argos supports eccentricity"):
        hide("argos", ["soft_rods"], 0)
