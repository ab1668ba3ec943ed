"""Where a campaign may send the robot: times by hand, and what it never drives."""

from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelFileError
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.campaign.targets import first_targets
from parallel_cal.campaign.trajectory import plan_trajectory, rates, trapezoid
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model, read_model
from parallel_cal.model.mechanism import Box, Workspace
from parallel_cal.model.model import new_model

DELTA = read_model(Path(__file__).parents[2] / "config" / "delta_mockup_nominal.yaml")
ONE, TWO = np.array([1.0]), np.array([2.0])


def joints_at(*position):
    found = Kinematics(DELTA).inverse(np.array(position))
    assert found.ok
    return found.joints


# ------------------------------------------------------------------ times


def test_on_a_long_path_velocity_rises_stays_and_falls():
    """3 rad at 1 rad/s and 2 rad/s^2: 0.5 s up over 0.25 rad, 2.5 s at 1 rad/s, 0.5 s down."""
    motion = trapezoid(np.zeros(1), np.array([3.0]), ONE, TWO)
    assert motion.seconds == pytest.approx(3.5)
    at = dict(
        zip(
            motion.time.round(6),
            zip(motion.positions[:, 0], motion.velocities[:, 0], strict=True),
            strict=True,
        )
    )
    for time, position, velocity in (
        (0.25, 0.0625, 0.5),
        (0.5, 0.25, 1.0),
        (2.0, 1.75, 1.0),
        (3.0, 2.75, 1.0),
        (3.25, 2.9375, 0.5),
        (3.5, 3.0, 0.0),
    ):
        assert at[time] == pytest.approx((position, velocity), abs=1e-9)


def test_on_a_short_path_velocity_falls_before_its_limit_is_reached():
    """0.5 rad at 2 rad/s^2: half of it in sqrt(0.5) s, at 2 sqrt(0.5) / 2 < 1 rad/s."""
    motion = trapezoid(np.zeros(1), np.array([-0.32]), ONE, TWO)
    assert motion.seconds == pytest.approx(0.8)
    assert np.abs(motion.velocities).max() == pytest.approx(0.8)
    assert motion.positions[-1] == pytest.approx(-0.32)
    assert (motion.velocities <= 1e-12).all()


def test_all_joints_move_for_as_long_as_the_slowest():
    """The second joint needs 3.5 s; the first goes a third of its way with it, straight."""
    motion = trapezoid(np.zeros(2), np.array([1.0, 3.0]), np.ones(2), np.full(2, 2.0))
    assert motion.seconds == pytest.approx(3.5)
    assert motion.positions[:, 0] * 3 == pytest.approx(motion.positions[:, 1])
    assert motion.velocities[-1] == pytest.approx(0.0)


def test_positions_follow_from_the_velocities_and_no_limit_is_passed():
    rng = np.random.default_rng(1)
    for _ in range(20):
        v, a, way = rng.uniform(0.2, 3, 3), rng.uniform(0.2, 9, 3), rng.uniform(-1, 1, 3)
        motion = trapezoid(np.zeros(3), way, v, a)
        time = np.concatenate([[0.0], motion.time])
        q = np.vstack([np.zeros(3), motion.positions])
        u = np.vstack([np.zeros(3), motion.velocities])
        assert (np.abs(u) <= v * (1 + 1e-9)).all()
        gain = np.diff(u, axis=0) / np.diff(time)[:, None]
        assert (np.abs(gain) <= a * (1 + 1e-6)).all()
        # exact where the acceleration is constant between two points, as it is here
        mean = (u[1:] + u[:-1]) / 2
        assert np.diff(q, axis=0) == pytest.approx(mean * np.diff(time)[:, None], abs=1e-9)


def test_the_robot_rests_at_every_stop_and_times_go_on():
    stops = [np.zeros(3), np.full(3, 0.2), np.full(3, 0.1)]
    motion = plan_trajectory(stops, DELTA.mechanism)
    assert (np.diff(motion.time) > 0).all()
    rests = np.flatnonzero(np.abs(motion.velocities).max(axis=1) < 1e-12)
    assert motion.positions[rests] == pytest.approx(np.repeat(stops[1:], 2, axis=0))
    assert np.diff(motion.time[rests])[::2] == pytest.approx(0.15)


def test_velocities_are_the_model_files_or_a_quarter_of_the_range_a_second():
    """-30 to 135 degrees are 2.88 rad: 0.72 rad/s, to which it takes half a second."""
    velocity, acceleration = rates(DELTA.mechanism)
    assert velocity == pytest.approx(np.full(3, np.radians(165) / 4))
    assert acceleration == pytest.approx(2 * velocity)
    mechanism = new_model("delta24").mechanism
    mechanism.joint_rates = ((1.0, 5.0), (2.0, np.inf), (np.inf, 7.0))
    velocity, acceleration = rates(mechanism)
    assert velocity[:2].tolist() == [1.0, 2.0]
    assert acceleration.tolist() == [5.0, 4.0, 7.0]


# ------------------------------------------------------------------ what is never driven


def test_a_path_between_two_poses_of_the_workspace_is_one_line():
    a, b = joints_at(0.05, 0, 0.2), joints_at(-0.05, 0.05, 0.16)
    assert [stop.tolist() for stop in Guard.of(DELTA).plan_path(a, [b])] == [a.tolist(), b.tolist()]


def test_a_joint_motion_shorter_than_the_backlash_limit_is_lengthened():
    guard, here = Guard.of(DELTA), joints_at(0.0, 0.0, 0.2)
    least = 3e-3
    there = here + [0.1, -least / 5, 0.0]
    away, last = guard.lengthen_approach(here, [there])
    assert (last == there).all()
    assert away == pytest.approx([here[0], there[1] + least, here[2]])
    assert guard.lengthen_approach(here, [here + 0.1]) == [pytest.approx(here + 0.1)]


def test_the_shortest_motion_is_1_25_times_the_backlash_of_the_model():
    known = DELTA.with_effect("backlash")
    values = known.table.vector(known.table.mapping(known.values) | {"backlash.joint2.width": 1e-3})
    guard, here = Guard.of(known.with_values(values)), joints_at(0.0, 0.0, 0.2)
    away, _ = guard.lengthen_approach(here, [here + [0.1, -1e-4, 1e-4]])
    assert away == pytest.approx(here + [0.0, 1.25e-3 - 1e-4, 1e-4 - 3e-3], abs=1e-9)


def test_a_reach_of_2_allows_poses_twice_as_far_from_the_middle_of_the_workspace():
    beyond = np.array([joints_at(0.0, 0.075, 0.2), joints_at(0.0, 0.125, 0.2)])
    assert Guard.of(DELTA).is_allowed(beyond).tolist() == [False, False]
    assert Guard.of(DELTA, reach=2.0).is_allowed(beyond).tolist() == [True, False]


def test_no_path_leads_to_joints_outside_their_limits():
    low, high = DELTA.mechanism.joint_limits[0]
    beyond = joints_at(0, 0, 0.2) + np.array([high, 0, 0])
    with pytest.raises(PathError, match=r"reach|limits|workspace|singularity"):
        Guard.of(DELTA).plan_path(joints_at(0, 0, 0.2), [beyond])
    narrow = parse_model(dump_model(DELTA))
    narrow.mechanism.joint_limits = ((low, 0.6),) * 3
    words = r"outside the joint limits \(joint1 at 0\.6\d+ rad, allowed from -0\.5236 to 0\.6000; "
    with pytest.raises(PathError, match=words):
        Guard.of(narrow).plan_path(joints_at(0, 0, 0.2), [joints_at(0, 0, 0.255)])


def test_no_path_leads_out_of_the_workspace_or_out_of_reach():
    here = joints_at(0, 0, 0.2)
    with pytest.raises(PathError, match="outside the workspace"):
        Guard.of(DELTA).plan_path(here, [joints_at(0.075, 0, 0.2)])
    # Arms that hang 90 degrees apart cannot carry one platform.
    with pytest.raises(PathError, match=r"reach|singularity|workspace"):
        Guard.of(DELTA).plan_path(here, [np.array([-0.5, 2.0, 2.0])])


def test_no_path_leads_near_a_singularity_or_beyond_it():
    """0.7 rad on, slider and crank are nearly in one line; 3.2 rad on, they are past it."""
    model = new_model("slider_crank")
    model.mechanism.workspace = Workspace((-10.0,), (10.0,))
    model.mechanism.joint_limits = ((-10.0, 10.0),)
    guard, home = Guard.of(model), np.array(model.mechanism.home.joints)
    guard.plan_path(home, [home - 0.4])
    with pytest.raises(PathError, match="too near a singularity"):
        guard.plan_path(home, [home - 0.7])
    assert guard.find_violation(home[None] - 3.2) is None
    with pytest.raises(PathError, match="too near a singularity"):
        guard.plan_path(home, [home - 3.2])


def test_a_forbidden_box_is_avoided_through_home_or_the_path_is_refused():
    """A box between two corners at one height, with home beside it; then one around the corner."""
    a, b = joints_at(0.055, 0.055, 0.15), joints_at(0.055, -0.055, 0.15)
    middle = Kinematics(DELTA).direct((a + b) / 2).position
    box = Box(tuple(middle - 0.004), tuple(middle + 0.004))
    stops = Guard.of(DELTA, [box]).plan_path(a, [b])
    assert len(stops) == 3
    assert stops[1] == pytest.approx(DELTA.mechanism.home.joints)
    there = Kinematics(DELTA).direct(b).position
    around = Box(tuple(there - 0.01), tuple(there + 0.01))
    with pytest.raises(PathError, match="inside the keep-out box x"):
        Guard.of(DELTA, [around]).plan_path(a, [b])


def test_the_arms_keep_out_of_a_box_too():
    """A box half way along a rod, 9 cm from the platform's middle."""
    guard = Guard.of(DELTA)
    q = joints_at(0, 0, 0.2)
    points = guard._sample_drawing(Kinematics(DELTA).direct(q[None]))[0]
    far = points[np.argmax(np.linalg.norm(points - [0, 0, 0.2], axis=1))]
    assert np.linalg.norm(far - [0, 0, 0.2]) > 0.09
    box = Box(tuple(far - 0.005), tuple(far + 0.005))
    with pytest.raises(PathError, match="keep-out box"):
        Guard.of(DELTA, [box]).plan_path(q, [joints_at(0.01, 0, 0.2)])


def test_a_robot_that_stands_where_it_must_not_be_is_not_moved():
    with pytest.raises(PathError, match="present pose is outside the workspace"):
        Guard.of(DELTA).plan_path(joints_at(0, 0, 0.28), [joints_at(0, 0, 0.2)])


def test_a_robot_that_rests_a_hair_beyond_a_joint_limit_is_taken_back():
    q = joints_at(0, 0, 0.2)
    high = DELTA.mechanism.joint_limits[0][1]
    model = parse_model(dump_model(DELTA).replace(f"high: {high}", f"high: {float(q[0])!r}", 1))
    there, guard = joints_at(0.01, 0, 0.19), Guard.of(model)
    assert there[0] < q[0]
    hair = [1e-4, 0.0, 0.0]
    assert guard.plan_path(q + hair, [there])[0] == pytest.approx(q)


def test_a_robot_that_stands_beyond_a_joint_limit_first_moves_straight_back_to_it():
    """The limit was stated with a margin, and the robot stands at its switch."""
    model = parse_model(dump_model(DELTA))
    q, there = joints_at(0, 0, 0.2), joints_at(0.01, 0, 0.19)
    (low, _), *others = model.mechanism.joint_limits
    model.mechanism.joint_limits = ((low, float(q[0])), *others)
    guard, switch = Guard.of(model), q + np.array([0.1, 0, 0])
    np.testing.assert_allclose(guard.plan_path(switch, [there]), [switch, q, there], atol=1e-12)
    at = Kinematics(DELTA).direct(q + np.array([0.05, 0, 0])).position
    box = Box(tuple(at - 1e-3), tuple(at + 1e-3))
    with pytest.raises(PathError, match="present pose is inside the keep-out box"):
        Guard.of(model, [box]).plan_path(switch, [there])


def test_with_too_few_reachable_poses_the_message_says_what_forbids_them():
    table = Box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.3))
    with pytest.raises(PathError, match=r"only 0 of 400 .*: 400 are inside the keep-out box"):
        first_targets(Guard.of(DELTA, [table]), 80)


def test_boxes_to_keep_out_of_are_in_the_model_file():
    text = dump_model(DELTA)
    line = next(one for one in text.splitlines() if one.startswith("workspace:"))
    boxes = "keep_out:\n  - {low: [0.0, 0.0, 0.1], high: [0.1, 0.2, 0.15]}"
    model = parse_model(text.replace(line, f"{line}\n{boxes}"))
    assert model.mechanism.keep_out == (Box((0.0, 0.0, 0.1), (0.1, 0.2, 0.15)),)
    assert boxes in dump_model(model)
    assert Guard.of(model).keep_out == model.mechanism.keep_out
    assert "keep_out" not in dump_model(DELTA)
    inside_out = boxes.replace("high: [0.1", "high: [-0.1")
    with pytest.raises(ModelFileError, match=r"keep_out.0.low.0.*above high"):
        parse_model(text.replace(line, f"{line}\n{inside_out}"))
