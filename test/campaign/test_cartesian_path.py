"""A path of poses as a joint trajectory: where it leads, its limits, and what it refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.campaign.cartesian import plan_cartesian_path
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.campaign.trajectory import trapezoid
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.mechanism import Box, poses_in_workspace
from parallel_cal.model.model import new_model

PERIOD = 1e-3
SPEED, RATE = 2.0, 15.0


def delta():
    model = read_model(Path(__file__).parents[2] / "config" / "delta_mockup_nominal.yaml")
    model.mechanism.joint_rates = ((SPEED, RATE),) * 3
    return model


DELTA = delta()
GUARD, KINEMATICS = Guard.of(DELTA), Kinematics(DELTA)


def joints_at(*position):
    return KINEMATICS.inverse(np.array(position)).joints


def driven(trajectory, before=None):
    """Positions (n, nq) of joint_trajectory_controller: cubics between points, every PERIOD."""
    time, q, v = trajectory.time, trajectory.positions, trajectory.velocities
    t = np.arange(0.0, time[-1] + PERIOD, PERIOD)
    k = np.clip(np.searchsorted(time, t, side="right") - 1, 0, len(time) - 2)
    T = (time[k + 1] - time[k])[:, None]
    s = np.clip((t[:, None] - time[k][:, None]) / T, 0.0, 1.0)
    rise = s * s * (3 - 2 * s)
    lead = s * (1 - s) * T * ((1 - s) * v[k] - s * v[k + 1])
    return q[k] + rise * (q[k + 1] - q[k]) + lead


def peaks(trajectory):
    speed = np.diff(driven(trajectory), axis=0) / PERIOD
    return np.abs(speed).max(axis=0), np.abs(np.diff(speed, axis=0)).max(axis=0) / PERIOD


def test_between_two_poses_the_platform_moves_along_a_straight_line_within_the_limits():
    start, end = np.array([-0.04, 0.01, 0.19]), np.array([0.04, 0.03, 0.22])
    found = plan_cartesian_path(GUARD, joints_at(*start), end[None])
    seen = KINEMATICS.direct(driven(found)).position
    way = (end - start) / np.linalg.norm(end - start)
    off = (seen - start) - ((seen - start) @ way)[:, None] * way
    assert np.linalg.norm(off, axis=1).max() < 2e-6
    np.testing.assert_allclose(seen[-1], end, atol=1e-9)
    speed, rate = peaks(found)
    assert (speed < SPEED * (1 + 1e-6)).all()
    assert (rate < RATE * (1 + 1e-6)).all()
    assert max(speed.max() / SPEED, rate.max() / RATE) > 0.95


def test_it_is_nearly_as_fast_as_a_motion_with_a_trapezoidal_speed():
    """The carriages of a linear Delta move on straight lines when the platform rises."""
    model = new_model("linear_delta")
    model.mechanism.joint_rates = ((0.2, 1.0),) * 3
    kinematics = Kinematics(model)
    low = np.array([0.0, 0.0, model.mechanism.workspace.low[2] + 0.01])
    start, end = (kinematics.inverse(low + [0, 0, z]).joints for z in (0.0, 0.1))
    found = plan_cartesian_path(Guard.of(model), start, low[None] + [0, 0, 0.1])
    best = trapezoid(start, end, np.full(3, 0.2), np.full(3, 1.0)).seconds
    assert best <= found.seconds * (1 + 1e-9) < 1.05 * best


def test_the_robot_stops_at_a_corner_and_not_on_a_curve():
    corner = plan_cartesian_path(
        GUARD, joints_at(0.0, 0.0, 0.2), np.array([[0.04, 0.0, 0.2], [0.04, 0.04, 0.2]])
    )
    i = int(np.argmin(np.abs(corner.positions - joints_at(0.04, 0.0, 0.2)).max(axis=1)))
    assert 0 < i < len(corner.time) - 1
    assert not corner.velocities[i].any()
    turn = np.linspace(0.0, 2 * np.pi, 37)
    circle = 0.03 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]) + [0, 0, 0.2]
    curve = plan_cartesian_path(GUARD, joints_at(*circle[0]), circle)
    assert np.abs(curve.velocities[1:-1]).max(axis=1).min() > 0.05
    seen = KINEMATICS.direct(driven(curve)).position
    radius = np.hypot(*seen[:, :2].T)
    # Poses 10 degrees apart on a circle: a spline keeps within a few um of it.
    assert np.abs(radius - 0.03).max() < 20e-6
    assert np.abs(seen[:, 2] - 0.2).max() < 2e-6


def test_a_hexapod_turns_about_a_fixed_axis_while_it_moves():
    model = new_model("stewart42")
    kinematics, home = Kinematics(model), model.mechanism.home
    q = np.array(home.joints)
    here = kinematics.direct(q)
    turn = np.array([0.05, -0.08, 0.06])
    end = here.position + np.array([0.01, -0.015, 0.01])
    R = rotation_matrix(turn) @ here.rotation
    found = plan_cartesian_path(Guard.of(model), q, end[None], R[None])
    seen = kinematics.direct(driven(found))
    angles = rotation_vector(seen.rotation @ here.rotation.T)
    along = angles @ turn / (turn @ turn)
    assert np.abs(angles - along[:, None] * turn).max() < 1e-6
    share = (seen.position - here.position) @ (end - here.position)
    share /= np.sum((end - here.position) ** 2)
    assert np.abs(share - along).max() < 1e-4
    np.testing.assert_allclose(seen.rotation[-1], R, atol=1e-8)


def test_a_curve_that_turns_the_platform_half_round_is_refused():
    """Beyond half a turn, the spline would lead back on the shorter side."""
    model = new_model("stewart42")
    home = model.mechanism.home
    R = rotation_matrix(np.radians([[0.0, 0.0, z] for z in (60.0, 120.0, 180.0)]))
    position = Kinematics(model).direct(np.array(home.joints)).position
    with pytest.raises(PathError, match="turns by 180 degrees on one curve"):
        plan_cartesian_path(Guard.of(model), np.array(home.joints), position + np.zeros((3, 3)), R)


# On path 149, a joint is fastest between two points and not at one.
@pytest.mark.parametrize(
    "paths", [[*range(12), 149], pytest.param(range(250), marks=pytest.mark.slow)], ids=len
)
def test_no_drawn_path_exceeds_a_limit(paths, monkeypatch):
    rng, planned = np.random.default_rng(7), 0
    for k in range(max(paths) + 1):
        speed, rate = rng.uniform(0.5, 5.0, 3), rng.uniform(2.0, 60.0, 3)
        rates = tuple(zip(speed, rate, strict=True))
        monkeypatch.setattr(GUARD.model.mechanism, "joint_rates", rates)
        r, _ = poses_in_workspace(DELTA.mechanism, 5, rng)
        r = np.vstack([0.6 * r[:, :2].T, r[:, 2]]).T
        if k not in paths:
            continue
        try:
            found = plan_cartesian_path(GUARD, joints_at(*r[0]), r[1:])
        except PathError:
            continue
        planned += 1
        fastest, sharpest = peaks(found)
        assert (fastest < speed * (1 + 1e-6)).all()
        assert (sharpest < rate * (1 + 1e-6)).all()
        # A path that is slower than need be would keep the limits, too.
        assert max((fastest / speed).max(), (sharpest / rate).max()) > 0.9
    assert planned > 0.6 * len(paths)


def test_a_forbidden_path_is_refused_with_the_reason_and_the_place():
    start = joints_at(-0.04, 0.0, 0.2)
    cases = {
        "outside the workspace before pose 2 of 2": [[0.0, 0.0, 0.2], [0.0, 0.0, 0.3]],
        "not converged before pose 1 of 1": [[0.0, 0.0, 0.9]],
    }
    for words, poses in cases.items():
        with pytest.raises(PathError, match=words):
            plan_cartesian_path(GUARD, start, np.array(poses))
    box = Box((-0.005, -0.005, 0.19), (0.005, 0.005, 0.21))
    with pytest.raises(PathError, match=r"inside the keep-out box .* before pose 1 of 1"):
        plan_cartesian_path(replace(GUARD, keep_out=(box,)), start, np.array([[0.04, 0, 0.2]]))
    with pytest.raises(PathError, match="no poses"):
        plan_cartesian_path(GUARD, start, np.empty((0, 3)))
    with pytest.raises(PathError, match="already at the pose"):
        plan_cartesian_path(GUARD, start, KINEMATICS.direct(start).position[None])


def test_a_path_through_a_singularity_is_refused():
    """The arms of this Delta may turn so far that they are in line with their rods."""
    model = delta()
    model.mechanism.workspace = replace(
        model.mechanism.workspace, low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.0)
    )
    with pytest.raises(PathError, match=r"not converged|singular") as refused:
        plan_cartesian_path(Guard.of(model), joints_at(0.0, 0.0, 0.2), np.array([[0, 0, 0.36]]))
    assert "before pose 1 of 1" in str(refused.value)
