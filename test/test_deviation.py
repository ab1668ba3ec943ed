"""Which joint is blamed for a motion that leaves its path."""

import numpy as np
import pytest
from campaign_cells import model_of

from parallel_cal.campaign.deviation import (
    MAX_PATH_DEVIATION,
    compute_path_deviation,
    find_deviating_joints,
)
from parallel_cal.campaign.trajectory import plan_trajectory
from parallel_cal.planning.posepool import make_pool
from parallel_cal.recordings.simulate import with_noise


def blamed_joints(mechanism, stops, stuck, since, lag):
    """The joints that are named for a motion through some stops, of which one joint does not move
    after `since` (s); None if the motion ends before anything is noticed."""
    ranges, held = np.asarray(mechanism.joint_ranges), None
    trajectory = plan_trajectory(stops, mechanism)
    path, times = np.vstack([stops[0], trajectory.positions]), np.r_[0.0, trajectory.time]
    for elapsed in np.arange(0.0, trajectory.seconds + lag, 0.01):
        q = np.array([np.interp(elapsed - lag, times, column) for column in path.T])
        if elapsed >= since:
            held = q[stuck] if held is None else held
            q[stuck] = held
        if compute_path_deviation(q, path, ranges) > MAX_PATH_DEVIATION:
            return find_deviating_joints(q, stops[0], trajectory, elapsed, ranges)
    return None


@pytest.mark.wide
@pytest.mark.parametrize("robot", ["stewart", "delta"])
@pytest.mark.parametrize("share", [0.0, 0.4], ids=["from the start", "on the way"])
def test_the_stuck_axis_is_blamed_in_all_of_200_motions(robot, share):
    """The joint furthest from the nearest point of the path was another one in 40 % of them."""
    model, rng = model_of(robot), np.random.default_rng(0)
    mechanism = model.mechanism
    poses = make_pool(with_noise(model), 100, rng, symmetric=False).poses.joints
    noticed = 0
    for k in range(200):
        stops = poses[rng.integers(len(poses), size=2 + (k % 3 == 0))]
        stuck, lag = int(rng.integers(len(mechanism.joints))), rng.uniform(0.0, 0.15)
        since = share * rng.uniform() * plan_trajectory(stops, mechanism).seconds
        named = blamed_joints(mechanism, stops, stuck, since, lag)
        noticed += named is not None
        assert named in (None, [stuck])
    assert noticed > 80


def test_two_joints_that_take_each_others_commands_are_both_named():
    mechanism = model_of("delta").mechanism
    ranges, start = np.asarray(mechanism.joint_ranges), np.array([0.5, 0.5, 0.5])
    trajectory = plan_trajectory([start, start + [0.6, -0.6, 0.3]], mechanism)
    half = trajectory.seconds / 2
    q = np.array([np.interp(half, trajectory.time, c) for c in trajectory.positions.T])
    named = find_deviating_joints(q[[1, 0, 2]], start, trajectory, half, ranges)
    assert sorted(named) == [0, 1]
