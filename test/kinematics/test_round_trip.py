"""An answer of inverse kinematics leads a robot, assembled as at home, to the given pose."""

import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solutions import Status

SHELF = ["five_bar", "hanging_sled", "hexaglide", "pentapod", "planar_stewart", "plate_rrs"]
SHELF += ["quattro", "rssr", "slider_crank", "stewart42", "tripod_prs"]


def test_the_point_below_both_elbows_of_a_five_bar_is_no_answer():
    """Cranks of 0.1 m at 60 and 120 degrees hold elbows at x = +-0.1 m, and rods of 0.15 m meet
    above them, at home, and below. Both points have these angles, with equal elbows."""
    solver = pc.Kinematics(pc.new_model("five_bar"))
    height, reach = 0.1 * np.sin(np.pi / 3), np.sqrt(0.15**2 - 0.1**2)
    angles = np.radians([120, 60])
    above, below = solver.inverse([[0, height + reach, 0], [0, height - reach, 0]])
    np.testing.assert_allclose([above.joints, below.joints], [angles, angles], atol=1e-12)
    assert (above.status, below.status) == (Status.CONVERGED, Status.OTHER_BRANCH)
    assert solver.direct(angles).position[1] == pytest.approx(height + reach)


def test_the_slider_on_the_near_side_of_its_crank_pin_is_no_answer():
    """The rod of 50 mm reaches two points of the axis from the pin of the crank of 80 mm."""
    solver = pc.Kinematics(pc.new_model("slider_crank"))
    foot, away = 0.08 * np.cos(0.3), np.sqrt(0.05**2 - (0.08 * np.sin(0.3)) ** 2)
    far, near = solver.inverse([[foot + away, 0, 0], [foot - away, 0, 0]])
    assert (far.status, near.status) == (Status.CONVERGED, Status.OTHER_BRANCH)
    assert far.joints[0] == pytest.approx(0.3)


@pytest.mark.parametrize("name", SHELF)
def test_the_joints_of_an_answer_lead_back_to_its_pose(name):
    """Also in a box of twice the workspace."""
    model = pc.new_model(name)
    low, high = map(np.array, (model.mechanism.workspace.low, model.mechanism.workspace.high))
    share = np.random.default_rng(5).uniform(-1, 1, (100, len(low)))
    poses = model.mechanism.poses((low + high) / 2 + share * (high - low))
    solver = pc.Kinematics(model)
    found = solver.inverse(*poses)
    back = solver.direct(found.joints[found.ok])
    assert found.ok.sum() > 20
    distance, angle = back.distance_from(found.position[found.ok], found.rotation[found.ok])
    assert max(distance.max(), angle.max()) < 1e-6


@pytest.mark.wide
def test_another_branch_outweighs_joints_outside_their_limits():
    """A wrong assembly is wrong whatever the limits."""
    model = pc.new_model("delta54")
    q = np.random.default_rng(0).uniform(-2.9, 2.9, (400, 3))
    solver = pc.Kinematics(model)
    found, home = solver.direct(q), solver.direct(np.array(model.mechanism.home.joints)[None])
    beyond = distances(model, found).direct_sign != distances(model, home).direct_sign
    assert (found.status == Status.OUTSIDE_LIMITS).sum() > 100
    assert not (beyond & found.solved).any()
    low, high = np.array(model.mechanism.joint_limits).T
    outside = ((q < low) | (high < q)).any(axis=1)
    assert ((found.status == Status.OTHER_BRANCH) & outside).sum() > 2


@pytest.mark.wide
@pytest.mark.parametrize("name", ["argos9", "argos27"])
def test_an_orientation_beyond_a_singularity_is_no_answer(name):
    """The closed form has an orientation at all readings."""
    model = pc.new_model(name)
    low, high = np.array(model.mechanism.joint_limits).T
    found = pc.Kinematics(model).direct(np.random.default_rng(0).uniform(low, high, (80, 3)))
    home = pc.Kinematics(model).direct(np.zeros((1, 3)))
    same = distances(model, found).direct_sign == distances(model, home).direct_sign
    assert same[found.ok].all()
    assert 30 < found.ok.sum() < 80
    assert (found.status[~found.ok] == Status.OTHER_BRANCH).all()
