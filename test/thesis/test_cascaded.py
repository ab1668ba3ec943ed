"""Model 54 in half steps and with a fixed Jacobian: as accurate as table 6.6 says."""

import numpy as np
import pytest
import virtual_day as vd

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.model import new_model
from parallel_cal.thesis.solvers import cascaded, fixed_newton
from parallel_cal.virtual import robot as vr

ARCSECOND = np.pi / 180 / 3600
PARALLELOGRAM = {
    p.name for p in new_model("delta54").mechanism.parameters if p.group == cascaded.PERFECT
}


@pytest.fixture(scope="module")
def mock_up():
    return new_model("delta54", vr.TABLE_5_18)


@pytest.fixture(scope="module")
def poses(mock_up):
    """The pose and joints of 74 points in the workspace, to machine precision."""
    return Kinematics(mock_up).inverse(vd.targets(74, 1))


def errors(found, truth):
    """Mean position error (m), orientation error (rad) and largest joint error (rad)."""
    turned = rotation_vector(found.rotation @ np.swapaxes(truth.rotation, 1, 2))
    apart = np.linalg.norm(found.position - truth.position, axis=1)
    joints = np.abs(found.joints - truth.joints).max()
    return apart.mean(), np.linalg.norm(turned, axis=1).mean(), joints


def test_one_and_a_half_steps_leave_tenths_of_a_micrometre_and_arcseconds(mock_up, poses):
    """Table 6.6: 0.1 um and 1.3 arcseconds, for a set of parameters that it does not print."""
    found = cascaded.direct(mock_up, poses.joints)
    position, orientation, _ = errors(found, poses)
    assert 0.05e-6 < position < 0.5e-6
    assert ARCSECOND < orientation < 5 * ARCSECOND
    assert found.ok.all()


def test_the_rough_cascade_leaves_tenths_of_a_millimetre_and_arcseconds(mock_up, poses):
    """Table 6.6: 483 um and 2.9 arcseconds."""
    position, orientation, _ = errors(cascaded.direct(mock_up, poses.joints, rough=True), poses)
    assert 100e-6 < position < 600e-6
    assert ARCSECOND < orientation < 5 * ARCSECOND


def test_five_fixed_steps_from_the_centre_leave_hundredths_of_a_micrometre_near_it(mock_up):
    """Table 6.6: 0.02 um and 0.3 arcseconds; 20 mm from the centre's Jacobian it is so."""
    poses = Kinematics(mock_up).inverse(vd.targets(74, 1, 0.04))
    found = fixed_newton.direct(mock_up, poses.joints, start="home")
    position, orientation, _ = errors(found, poses)
    assert 0.005e-6 < position < 0.5e-6
    assert orientation < 0.3 * ARCSECOND


def test_the_cascades_error_falls_with_the_square_of_the_parallelogram_errors(mock_up):
    """Table 6.6 again: at its tilt (1070 arcseconds against 1500 here) 0.2 um are left."""
    small = np.array([row.name in PARALLELOGRAM for row in mock_up.table])
    left = []
    for share in (1.0, 0.71):
        model = mock_up.with_values(mock_up.values * np.where(small, share, 1.0))
        truth = Kinematics(model).inverse(vd.targets(74, 1, 0.04))
        left.append(errors(cascaded.direct(model, truth.joints), truth)[:2])
    assert np.divide(*left) == pytest.approx([0.71**-2] * 2, rel=0.1)
    assert left[1][0] == pytest.approx(0.2e-6, rel=0.1)
    assert left[1][1] == pytest.approx(2 * ARCSECOND, rel=0.1)


def test_each_whole_cascade_step_gains_three_digits(mock_up, poses):
    sizes = [
        errors(cascaded.direct(mock_up, poses.joints, half_steps=n), poses)[0] for n in (1, 3, 5)
    ]
    assert sizes[1] < sizes[0] / 100
    assert sizes[2] < sizes[1] / 1000


def test_the_cascaded_inverse_finds_the_joints(mock_up, poses):
    found = cascaded.inverse(mock_up, poses.position)
    assert errors(found, poses)[2] < 3 * ARCSECOND
    assert errors(cascaded.inverse(mock_up, poses.position, half_steps=7), poses)[2] < 1e-11
    assert found.position == pytest.approx(poses.position, abs=0)


def test_updating_the_jacobian_converges_quadratically_and_keeping_it_linearly(mock_up, poses):
    def position(steps, update):
        found = fixed_newton.direct(mock_up, poses.joints, steps=steps, update=update)
        return errors(found, poses)[0]

    assert position(1, True) == position(1, False)
    assert position(2, True) < 1e-10 < 1e-9 < position(2, False) < 1e-7
    assert position(3, True) < 1e-14
    assert position(6, False) < 1e-14


def test_both_solvers_agree_with_the_careful_one_where_effects_are_strong():
    model = new_model("delta54", vr.TABLE_5_18, ["encoder_eccentricity"])
    values = {**vr.TABLE_5_18, "encoder_eccentricity.joint2.sin": 1e-2}
    model = model.with_values(model.table.vector(values))
    truth = Kinematics(model).inverse(vd.targets(20, 2))
    for solver, options in ((cascaded, {"half_steps": 7}), (fixed_newton, {"steps": 7})):
        found = solver.inverse(model, truth.position, **options)
        assert errors(found, truth)[2] < 1e-11
        found = solver.direct(model, truth.joints, **options)
        assert errors(found, truth)[0] < 1e-12


def test_one_sample_has_the_shape_of_one_answer(mock_up, poses):
    one = cascaded.direct(mock_up, poses.joints[0])
    assert one.position.shape == (3,)
    assert fixed_newton.inverse(mock_up, one.position).joints.shape == (3,)


def test_what_cannot_be_reached_or_read_is_a_status(mock_up):
    for solver in (cascaded, fixed_newton):
        assert solver.inverse(mock_up, [0, 0, 0.6]).status == Status.UNREACHABLE
        assert solver.inverse(mock_up, [0, 0, np.nan]).status == Status.INVALID_INPUT
    rough = cascaded.direct(mock_up, np.radians([30, 30, 30]), rough=True)
    assert rough.status == Status.NOT_CONVERGED  # half a millimetre off is no solution
    assert cascaded.direct(mock_up, np.radians([-31, 0, 0])).status == Status.OUTSIDE_LIMITS


def test_mechanisms_that_do_not_fall_into_halves_are_refused():
    with pytest.raises(SolveError, match="use --solver newton"):
        cascaded.direct(new_model("delta24"), np.zeros(3))
    with pytest.raises(SolveError, match="use --solver newton"):
        cascaded.direct(new_model("stewart42"), np.zeros(6))
    with pytest.raises(SolveError, match="use --solver newton"):
        cascaded.direct(new_model("delta51"), np.zeros(3))
    with pytest.raises(SolveError, match="are prismatic: use --solver newton"):
        cascaded.inverse(new_model("linear_delta"), np.zeros(3))
    with pytest.raises(SolveError, match="has 3"):
        cascaded.direct(new_model("delta54"), np.zeros(4))
