"""Which joint is blamed for a motion that leaves its path."""

import numpy as np
import pytest
from campaign_cells import model_of

from parallel_cal.campaign.cell import CellError
from parallel_cal.campaign.checking import Checker
from parallel_cal.campaign.deviation import (
    MAX_PATH_DEVIATION,
    compute_path_deviation,
    compute_way_points,
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
            moments = np.linspace(0.0, min(elapsed, trajectory.seconds), 400)
            way = np.stack([np.interp(moments, times, column) for column in path.T], axis=1)
            return find_deviating_joints(q, way, ranges)
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
    ranges = np.asarray(model_of("delta").mechanism.joint_ranges)
    start = np.array([0.5, 0.5, 0.5])
    way = compute_way_points(np.array([start, start + [0.6, -0.6, 0.3]]))
    half = len(way) // 2
    assert sorted(find_deviating_joints(way[half][[1, 0, 2]], way, ranges)) == [0, 1]


def test_of_joints_that_the_drives_stopped_together_the_one_that_lagged_is_blamed():
    """The stuck joint stopped all; another one is further from its target."""
    checker = Checker(model_of("delta"), {})
    path = [np.array([0.6097, 0.6097, 0.75]), np.array([0.68, 0.9211, 1.15])]
    q = path[0] + 0.17 * (path[1] - path[0])
    q[1] = path[0][1]
    words = r"^joint2 was sent to 0.9211 rad but is at 0.6097 \(joint1 and joint3 stopped with it\)"
    with pytest.raises(CellError, match=words):
        checker.check_arrived(q, path[-1], path)


def test_joints_that_stopped_at_one_point_of_the_path_are_all_named():
    checker = Checker(model_of("delta"), {})
    path = [np.array([0.6, 0.6, 0.7]), np.array([0.7, 0.9, 1.1])]
    with pytest.raises(CellError, match=r"^joint3 was sent to .*; joint2 was .*; joint1 was sent"):
        checker.check_arrived((path[0] + path[1]) / 2, path[-1], path)


def test_a_single_joint_that_did_not_arrive_is_named_alone():
    checker = Checker(model_of("delta"), {})
    path = [np.array([0.6, 0.6, 0.7]), np.array([0.7, 0.9, 1.1])]
    with pytest.raises(CellError, match=r"^joint2 was sent to 0\.9000 rad but is at 0\.7500: the"):
        checker.check_arrived(path[1] - [0, 0.15, 0], path[-1], path)
