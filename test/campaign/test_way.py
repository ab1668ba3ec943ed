"""The way to a target: its time by hand-worked numbers, its workspace and its singularities."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelFileError, SolveError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.nodes.path_check import Bounds, check_path

NOMINAL = Path(__file__).parents[2] / "config" / "delta_mockup_nominal.yaml"
BOUNDS = Bounds(crossing=1.0, singularity=0.02)


def with_rates(*rates):
    """The Delta whose three joints have these velocities and accelerations."""
    text = NOMINAL.read_text()
    for k, (velocity, acceleration) in enumerate(rates, 1):
        old = next(line for line in text.splitlines() if line.startswith(f"  joint{k}:"))
        new = old.replace("}", f", velocity: {velocity}, acceleration: {acceleration}}}")
        text = text.replace(old, new)
    return parse_model(text)


def way(model, start, goal, bounds=BOUNDS):
    kinematics = Kinematics(model)
    target = kinematics.direct(np.array(goal))
    return check_path(kinematics, np.array(start), target, None, bounds)


def test_the_slowest_joint_sets_the_time_by_velocity_or_by_acceleration():
    """0.2 rad at 1.5 rad/s: 1.5 * 0.2 / 1.5 = 0.2 s; 0.15 rad at 10 rad/s^2: sqrt(0.09) = 0.3 s."""
    model = with_rates((1.5, 1e9), (1e9, 10.0), (1e9, 1e9))
    found = way(model, [0.5, 0.5, 0.5], [0.7, 0.5, 0.5])
    assert found.seconds == pytest.approx(0.2, rel=1e-9)
    assert "joint1" in found.why
    assert "velocity 1.5" in found.why
    found = way(model, [0.5, 0.5, 0.5], [0.5, 0.65, 0.5])
    assert found.seconds == pytest.approx(0.3, rel=1e-9)
    assert "joint2" in found.why


def test_a_joint_without_a_velocity_crosses_its_range_in_the_time_given():
    model = parse_model(NOMINAL.read_text())
    low, high = model.mechanism.joint_limits[0]
    found = way(model, [0.5] * 3, [0.6, 0.5, 0.5], Bounds(2.0, 0.02))
    assert found.seconds == pytest.approx(1.5 * 0.1 * 2.0 / (high - low), rel=1e-9)


class TrajectoryController:
    """The published rules of joint_trajectory_controller for a message with one point: a cubic from
    the measured position and velocity if the point has velocities, else a straight line."""

    def __init__(self, q):
        self.q, self.speed, self._time = np.array(q, dtype=float), np.zeros(len(q)), 0.0
        self._follow(self.q, self.speed, 1.0)

    def _follow(self, goal, goal_speed, seconds):
        move, t = goal - self.q, seconds
        self._goal, self._seconds, self._time = goal, seconds, 0.0
        if goal_speed is None:
            self._coefficients = np.array([self.q, move / t, 0 * move, 0 * move])
            return
        square = (3 * move - (2 * self.speed + goal_speed) * t) / t**2
        cube = (-2 * move + (self.speed + goal_speed) * t) / t**3
        self._coefficients = np.array([self.q, self.speed, square, cube])

    def take(self, goal, goal_speed, seconds):
        self._follow(np.array(goal), goal_speed, seconds)

    def run(self, seconds, period):
        """Positions (n, nq) of the next seconds, a period apart."""
        t = self._time + np.arange(1, round(seconds / period) + 1) * period
        self._time, inside = float(t[-1]), t[:, None] < self._seconds
        a, b, c, d = self._coefficients
        t = t[:, None]
        q = np.where(inside, a + t * (b + t * (c + t * d)), self._goal)
        self.q = q[-1]
        self.speed = np.where(inside, b + t * (2 * c + 3 * t * d), 0.0)[-1]
        return q


PERIOD = 1e-3
LIMITS = (1.2, 15.0)  # rad/s, rad/s^2


def drive(targets, seed, goal_speed=0.0):
    """Peak velocity and acceleration of a robot that gets a new target while it moves to the last,
    and the number of accepted targets."""
    model = with_rates(*[LIMITS] * 3)
    rng, kinematics = np.random.default_rng(seed), Kinematics(model)
    robot, driven, accepted = TrajectoryController([0.5] * 3), [np.full(3, 0.5)], 0
    for _ in range(targets):
        target = kinematics.direct(rng.uniform(0.25, 0.75, 3))
        try:
            found = check_path(kinematics, robot.q, target, None, BOUNDS, robot.speed, 0.05)
        except SolveError:
            pass  # the robot goes on to the last target
        else:
            accepted += 1
            end = None if goal_speed is None else np.full(3, goal_speed)
            robot.take(target.joints, end, found.seconds)
        driven.extend(robot.run(rng.uniform(0.02, 0.5), PERIOD))
    speed = np.diff(driven, axis=0) / PERIOD
    return np.abs(speed).max(), np.abs(np.diff(speed, axis=0)).max() / PERIOD, accepted


@pytest.mark.parametrize("targets", [60, pytest.param(1000, marks=pytest.mark.wide)])
def test_a_trajectory_controller_keeps_the_limits_also_when_a_target_replaces_another(targets):
    velocity, acceleration, accepted = drive(targets, seed=1)
    assert accepted > 0.7 * targets
    assert 0.9 * LIMITS[0] < velocity < LIMITS[0] * (1 + 1e-6)
    assert 0.9 * LIMITS[1] < acceleration < LIMITS[1] * (1 + 1e-6)


def test_a_point_without_velocities_would_break_the_acceleration_limit():
    """The controller then jumps to a constant velocity: the reason why a command carries them."""
    assert drive(20, seed=1, goal_speed=None)[1] > 10 * LIMITS[1]


def test_a_path_that_overshoots_a_joint_limit_is_refused_with_the_joint():
    model = with_rates(*[LIMITS] * 3)
    model.mechanism.joint_limits = ((0.45, 1.0),) * 3
    start, target = np.full(3, 0.48), Kinematics(model).direct(np.full(3, 0.47))
    fast = np.array([0.0, -1.2, 0.0])
    check_path(Kinematics(model), start, target, None, BOUNDS)
    with pytest.raises(SolveError, match="leaves the limits of joint2"):
        check_path(Kinematics(model), start, target, None, BOUNDS, fast)


def test_a_way_that_leaves_the_workspace_is_refused_and_one_back_in_is_not():
    model = parse_model(NOMINAL.read_text())
    inside, outside = [0.5] * 3, [1.2] * 3
    low, high = model.mechanism.workspace.low, model.mechanism.workspace.high
    z = Kinematics(model).direct(np.array(outside)).position[2]
    assert not low[2] <= z <= high[2]
    words = r"leaves the model file's workspace at \d+ % of its length: [xyz] -?[\d.]+ mm is"
    with pytest.raises(SolveError, match=words):
        way(model, inside, outside)
    assert way(model, outside, inside).seconds > 0


def test_no_way_leads_near_a_singularity():
    """The usual way keeps 0.1 and more; where more is asked for it is refused."""
    model = parse_model(NOMINAL.read_text())
    usual = way(model, [0.5] * 3, [0.6] * 3).singularity
    assert usual > 0.1
    with pytest.raises(SolveError, match="too near a singularity"):
        way(model, [0.5] * 3, [0.6] * 3, Bounds(1.0, 10.0))


def test_limits_survive_the_file_and_must_be_positive():
    model = with_rates((1.5, 20.0), (2.0, 10.0), (3.0, 5.0))
    again = parse_model(dump_model(model))
    assert again.mechanism.joint_rates == ((1.5, 20.0), (2.0, 10.0), (3.0, 5.0))
    assert new_model("delta24").mechanism.joint_rates == ()
    assert not any(map(math.isfinite, sum(with_some().mechanism.joint_rates, ())[1:]))
    with pytest.raises(ModelFileError, match="velocity"):
        with_rates((-1.0, 1.0))
    assert replace(model).mechanism.joint_rates == model.mechanism.joint_rates


def with_some():
    text = NOMINAL.read_text()
    old = next(line for line in text.splitlines() if line.startswith("  joint1:"))
    return parse_model(text.replace(old, old.replace("}", ", velocity: 2.0}")))
