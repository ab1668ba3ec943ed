"""Distance to singularities, and a branch that is followed until it ends."""

import numpy as np
import pytest

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solvers import continuous
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr


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
    track = continuous.follow_poses(mock_up, points)
    assert (track.danger, track.lost) == (None, None)
    assert track.message == "the assembly mode is kept"
    assert np.abs(track.solutions.joints - mock_up.inverse(points).joints).max() < 1e-12


def test_the_end_of_reach_is_announced_and_then_named(mock_up):
    points = np.linspace([0, 0, 0.2], [0, 0, 0.36], 400)
    track = continuous.follow_poses(mock_up, points)
    assert track.lost is not None
    assert track.danger < track.lost == len(track.solutions)
    assert f"lost between points {track.lost - 1} and {track.lost}" in track.message
    assert mock_up.inverse(points[track.lost]).status == Status.UNREACHABLE


def test_an_elbow_the_other_way_stays_the_other_way(mock_up):
    other = inverse_all(mock_up.model, [0.0, 0.0, 0.2], starts=0)  # no platform upside down
    elbow = other[len(other) - 1]
    points = np.linspace([0, 0, 0.2], [0.03, 0.02, 0.22], 20)
    moved = elbow
    for point in points:
        moved = mock_up.inverse(point, elbow.rotation, start=moved, keep_branch=True)
    assert np.abs(moved.joints - elbow.joints).max() < 0.6
    assert np.abs(moved.joints - mock_up.inverse(points[-1]).joints).max() > 0.5


def towards_the_direct_singularity(points):
    """The line of bench/documents/singularity.py: the platform tilts freely before reach ends."""
    return np.linspace([0, 0, 0.2], [0.3, 0, 0.1], points)


def test_a_commanded_platform_loses_its_mode_in_a_direct_singularity(mock_up):
    points = towards_the_direct_singularity(40)
    track = continuous.follow_poses(mock_up, points)
    beyond = mock_up.inverse(points[track.lost])
    # Also outside the limits of its joints, but their limits do not matter there.
    assert beyond.status == Status.OTHER_BRANCH
    found = distances(mock_up.model, mock_up.inverse(points[track.lost - 1 : track.lost + 1]))
    assert found.direct_sign.prod() == -1
    assert found.inverse.min() > 0.1
    assert track.danger < track.lost


def test_huge_steps_and_points_twice_end_on_the_same_branch(mock_up):
    points = np.array([[-0.1, 0, 0.2], [0.1, 0, 0.15], [0.1, 0, 0.15], [-0.1, 0.05, 0.25]])
    track = continuous.follow_poses(mock_up, points)
    assert track.lost is None
    assert np.abs(track.solutions.joints - mock_up.inverse(points).joints).max() < 1e-12
    back = continuous.follow_joints(mock_up, track.solutions.joints[::-1])
    assert np.abs(back.solutions.position[::-1] - points).max() < 1e-12


def test_orientations_are_followed_too():
    kinematics = Kinematics(new_model("stewart42"))
    home = np.array(kinematics.model.mechanism.home.position)
    R = rotation_matrix(np.linspace([0, 0, 0], [0.2, -0.1, 0.3], 5))
    track = continuous.follow_poses(kinematics, np.tile(home, (5, 1)), R)
    assert track.lost is None
    assert track.solutions.rotation == pytest.approx(R)


def test_the_solver_says_where_the_trajectory_ends(mock_up):
    points = towards_the_direct_singularity(40)
    found = solving.inverse(mock_up.model, points, None, {}, solver="continuous")
    lost = continuous.follow_poses(mock_up, points).lost
    assert found.message == f"the assembly mode is lost between points {lost - 1} and {lost}"
    assert (found.status[lost:] == Status.NOT_CONVERGED).all()
    assert np.isnan(found.joints[lost:]).all()
    assert np.isfinite(found.joints[:lost]).all()


def test_a_trajectory_begins_with_a_point_within_reach(mock_up):
    far = continuous.follow_poses(mock_up, np.array([[0, 0, 0.6], [0, 0, 0.2]]))
    assert (far.lost, far.message) == (0, "point 0 of the trajectory has no solution")
    with pytest.raises(SolveError, match="at least one point"):
        continuous.follow_joints(mock_up, np.empty((0, 3)))


@pytest.mark.parametrize("solver", ["newton", "closed_form", "fixed_newton"])
def test_a_stretched_arm_is_singular_for_every_solver(solver):
    """Hand-worked: arm and rod of 0.17 and 0.21 m in line from (0.056, 0) to (0, z)."""
    geometry = {"R": 0.056, "La": 0.17, "Lb": 0.21}
    model = new_model("delta_nominal", geometry)
    reach = np.sqrt(0.38**2 - 0.056**2)
    for short, status in ((1e-12, Status.SINGULAR), (1e-3, Status.CONVERGED)):
        found = solving.inverse(model, np.array([[0, 0, reach - short]]), None, {}, solver=solver)
        assert found.status[0] == status
