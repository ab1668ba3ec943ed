"""Distance to singularities, and a branch that is followed until it ends."""

import numpy as np
import pytest
import virtual_robot as vr

from parallel_cal.kinematics import Kinematics, Status
from parallel_cal.model import new_model
from parallel_cal.singularity import distances
from parallel_cal.solvers import continuous


@pytest.fixture(scope="module")
def mock_up():
    return Kinematics(new_model("delta54", vr.TABLE_5_18))


def test_rods_in_one_plane_are_a_direct_singularity_and_no_inverse_one():
    """Three rods of one length in the plane of the ball joints carry no load across it."""
    model = new_model("delta_nominal", {"R": 0.05, "La": 0.1, "Lb": 0.05})
    flat = Kinematics(model).direct(np.full(3, np.pi / 2))
    found = distances(model, flat)
    assert found.direct[0] < 1e-6
    assert found.inverse[0] > 0.1


def test_arm_and_rod_in_one_line_are_an_inverse_singularity_and_no_direct_one():
    model = new_model("delta24")
    home = Kinematics(model).inverse([0, 0, 0.2])
    p = model.table.mapping(model.values)
    # Turn chain 1's arm into the line from its axis to the platform point.
    foot = np.array([p["chain1.D_x"], 0, p["chain1.D_y"]])
    line = home.position - foot
    angle = np.arctan2(line[2], line[0]) - np.arctan2(p["chain1.La_y"], p["chain1.La_x"])
    stretched = np.linalg.norm(line) - np.hypot(p["chain1.La_x"], p["chain1.La_y"])
    values = {"chain1.Lb": stretched, "chain1.D_z": 0.0, "chain1.theta": 0.0}
    reached = new_model("delta24", {**p, **values})
    q = np.array([angle, home.joints[1], home.joints[2]])
    found = distances(
        reached, type(home)(q, home.position, home.rotation, home.residual, home.status)
    )
    assert found.inverse[0] < 1e-9
    assert found.direct[0] > 0.1


def test_well_inside_the_workspace_both_distances_are_large(mock_up):
    poses = mock_up.inverse(mock_up.model.mechanism.sample(200, np.random.default_rng(0)))
    found = distances(mock_up.model, poses)
    assert found.direct.min() > 0.1
    assert found.inverse.min() > 0.1
    assert len(set(found.direct_sign)) == len(set(found.inverse_sign)) == 1


def test_the_branch_is_kept_along_a_trajectory_and_equals_the_home_branch(mock_up):
    points = np.linspace([0, 0, 0.2], [0.05, -0.05, 0.24], 30)
    track = continuous.inverse(mock_up, points)
    assert (track.danger, track.lost) == (None, None)
    assert track.message == "the assembly mode is kept"
    assert np.abs(track.solutions.joints - mock_up.inverse(points).joints).max() < 1e-12


def test_the_end_of_reach_is_announced_and_then_named(mock_up):
    points = np.linspace([0, 0, 0.2], [0, 0, 0.36], 400)
    track = continuous.inverse(mock_up, points)
    assert track.lost is not None
    assert track.danger < track.lost == len(track.solutions)
    assert f"lost between points {track.lost - 1} and {track.lost}" in track.message
    assert mock_up.inverse(points[track.lost]).status in (Status.UNREACHABLE, Status.SINGULAR)


def test_an_elbow_the_other_way_stays_the_other_way(mock_up):
    other = mock_up.inverse_all([0.0, 0.0, 0.2])
    elbow = other[len(other) - 1]
    points = np.linspace([0, 0, 0.2], [0.03, 0.02, 0.22], 20)
    moved = elbow
    for point in points:
        moved = mock_up.inverse(point, elbow.rotation, start=moved)
    assert np.abs(moved.joints - elbow.joints).max() < 0.6
    assert np.abs(moved.joints - mock_up.inverse(points[-1]).joints).max() > 0.5
