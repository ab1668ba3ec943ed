"""`inverse` says how far its solution is from a pose in what the robot does not control."""

import chains
import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics.answers import Differences, describe_missed, to_rows

FOOT = [0.14, 0.0, -0.035]  # m, from the universal joint


def ankle(controls):
    return chains.make_chain(chains.ankle() | {"target": FOOT, "controls": controls})


def pitched(pitch=-0.4):
    """Return the pose of the foot ahead at a pitch (rad) beyond the maximum of x at -0.245 rad."""
    R = rotation_matrix(np.array([0.0, pitch, 0.0]))
    return R @ np.array(FOOT), R


@pytest.mark.wide
def test_solutions_tell_how_far_they_are_from_a_pose_in_what_is_not_controlled():
    model = ankle(["x", "y"])
    r, R = pitched()
    found = pc.Kinematics(model).inverse(r, R)
    assert found.ok
    # The same x at the mirrored pitch: both are at equal angles from the maximum.
    mirror = 2 * np.arctan2(-0.035, 0.14) + 0.4
    other = rotation_matrix(np.array([0.0, mirror, 0.0])) @ np.array(FOOT)
    distance, angle = found.distance_from(r, R)
    assert distance == pytest.approx(abs(other[2] - r[2]), abs=1e-9)
    assert angle == pytest.approx(0.4 + mirror, abs=1e-9)
    said = describe_missed(model.mechanism, found, r, R)
    assert said == (
        f"chain does not control z: the solution is {1e3 * distance:.4g} mm from the given position"
    )
    by_angles = ankle(["rx", "ry"])
    back = pc.Kinematics(by_angles).inverse(r, R)
    assert describe_missed(by_angles.mechanism, back, r, R) == ""


def test_differences_are_numbers_of_each_row_and_only_of_what_was_given():
    model = ankle(["x", "y"])
    r, R = pitched()
    far = np.array([9.0, 0, 0])
    found = pc.Kinematics(model).inverse([r, far], np.array([R, R]))
    rows = to_rows(found, differences=Differences.of(found, np.array([r, far]), None))
    assert rows[0]["position_difference"] == np.linalg.norm(found.position[0] - r) > 0.01
    assert np.isnan(rows[1]["position_difference"])  # nothing was found there
    assert "orientation_difference" not in rows[0]


def test_nothing_is_said_of_the_conventional_orientation_of_a_delta_that_tilts_a_little():
    rng = np.random.default_rng(0)
    nominal = pc.new_model("delta54")
    shift = nominal.table.tolerance * ~np.array(nominal.fixed) * rng.normal(size=len(nominal.table))
    model = nominal.with_values(nominal.values + shift)
    r, R = np.array([0.0, 0.0, 0.2]), np.eye(3)
    found = pc.Kinematics(model).inverse(r, R)
    assert describe_missed(model.mechanism, found, r, R) == ""
    (tilt,) = Differences.of(found, None, R).orientation
    assert 1e-5 < tilt < 0.1
    (said,) = Differences.of(found, None, R).describe(model.mechanism)
    assert said.startswith("delta54 does not control its orientation: the solution is ")
