"""The look-up table: differences to the nominal solution, interpolated (thesis, section 6.1)."""

import numpy as np
import pytest
import virtual_day as vd

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.solvers import lookup_table
from parallel_cal.kinematics.solvers.lookup_table import LookUpTable
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr

MOCK_UP = new_model("delta54", vr.TABLE_5_18)
ASKED = vd.targets(200, seed=3)


def left(size, order):
    """Largest position error (m), judged by the independent robot."""
    found = lookup_table.inverse(MOCK_UP, ASKED, size=size, order=order)
    return np.linalg.norm(vr.MOCK_UP.forward(found.joints)[0] - ASKED, axis=1).max()


def by_hand(order, values, axes):
    return LookUpTable("inverse", axes, np.array(values, dtype=float), order, None)


def test_linear_interpolation_by_hand():
    """On a 2 x 2 grid two answers: 1, 2, 3, 4 and ten times that; both axes tell apart."""
    values = np.array([[[1, 10], [2, 20]], [[3, 30], [4, 40]]])
    table = by_hand("linear", values, (np.array([0.0, 1.0]), np.array([10.0, 30.0])))
    found = table.corrections(np.array([[0.5, 10.0], [0.0, 15.0], [0.25, 20.0], [1.0, 30.0]]))
    assert found == pytest.approx(np.array([[2, 20], [1.25, 12.5], [2, 20], [4, 40]]))


def test_smooth_interpolation_is_exact_for_a_cubic():
    x, y = np.linspace(0, 1, 5), np.linspace(0, 2, 6)
    values = (x[:, None] ** 3 - 2 * x[:, None] * y**2)[..., None]
    given = np.random.default_rng(0).uniform([0, 0], [1, 2], (20, 2))
    found = by_hand("smooth", values, (x, y)).corrections(given)[:, 0]
    assert found == pytest.approx(given[:, 0] ** 3 - 2 * given[:, 0] * given[:, 1] ** 2, abs=1e-12)


def test_outside_the_grid_there_is_no_answer():
    table = by_hand("linear", np.ones((2, 2, 1)), (np.array([0.0, 1]), np.array([0.0, 1])))
    assert np.isnan(table.corrections(np.array([[0.5, 1.01]]))).all()
    found = lookup_table.inverse(MOCK_UP, np.array([[0, 0, 0.2], [0, 0, 0.28]]), size=4)
    assert found.status.tolist() == [Status.CONVERGED, Status.NOT_CONVERGED]
    assert np.isnan(found.joints[1]).all()


def test_at_grid_points_the_table_is_the_exact_solution():
    table = lookup_table.table_for(MOCK_UP, "inverse", None, 5, "linear")
    points = np.stack(np.meshgrid(*table.axes, indexing="ij"), -1).reshape(-1, 3)
    found = lookup_table.inverse(MOCK_UP, points[31:94], size=5, order="linear")
    exact = Kinematics(MOCK_UP).inverse(points[31:94])
    assert np.abs(found.joints - exact.joints).max() < 1e-14
    assert np.abs(rotation_vector(found.rotation @ exact.rotation.transpose(0, 2, 1))).max() < 1e-12
    assert found.residual.max() < 1e-12


@pytest.mark.wide
def test_linear_interpolation_gains_four_times_a_halving_and_smooth_sixteen():
    assert left(9, "linear") / left(17, "linear") == pytest.approx(4, rel=0.25)
    assert left(9, "smooth") / left(17, "smooth") > 10
    assert left(9, "smooth") < left(9, "linear") / 5


def test_a_table_of_nine_kilobytes_leaves_less_than_a_tenth_of_the_devices_noise():
    table = lookup_table.table_for(MOCK_UP, "inverse", None, 9, "smooth")
    assert 4 * 3 * 9**3 == 8748
    assert table.bytes == 4 * 9 * 9**3  # joints, position and rotation of the pose
    assert left(9, "smooth") < 1e-6


def test_the_direct_table_gives_position_and_tilt():
    q, _ = vr.MOCK_UP.inverse(ASKED)
    r, R = vr.MOCK_UP.forward(q)
    found = lookup_table.direct(MOCK_UP, q)
    assert found.ok.all()
    assert np.abs(found.position - r).max() < 0.3e-6
    assert np.abs(rotation_vector(found.rotation @ R.transpose(0, 2, 1))).max() < 1e-5
    assert found.joints == pytest.approx(q)


def test_one_pose_is_answered_with_one_solution():
    found = lookup_table.inverse(MOCK_UP, np.array([0, 0, 0.2]))
    assert found.joints.shape == (3,)
    assert found.status == Status.CONVERGED


def test_orientation_robots_have_tables_too():
    model = new_model("argos9", {"chain2.alpha0": np.radians(46)})
    m = model.mechanism
    home = rotation_vector(quaternion_to_matrix(np.array(m.home.quaternion)))
    m.workspace = type(m.workspace)(tuple(home - 0.1), tuple(home + 0.1))
    q = np.random.default_rng(0).uniform(-0.03, 0.03, (20, 3)) + m.home.joints
    pose = Kinematics(model).direct(q)
    found = lookup_table.inverse(model, pose.position, pose.rotation, size=6)
    assert found.ok.all()
    assert np.abs(found.joints - q).max() < 1e-5


def test_a_table_holds_for_one_set_of_conditions():
    with pytest.raises(SolveError, match="one set of conditions"):
        lookup_table.inverse(MOCK_UP, ASKED, at={"temperature": np.zeros(200)})


@pytest.mark.parametrize(
    ("options", "words"), [({"order": "cubic"}, "linear"), ({"size": 3}, "at least 4")]
)
def test_options_that_cannot_be_are_refused(options, words):
    with pytest.raises(SolveError, match=words):
        lookup_table.inverse(MOCK_UP, ASKED, **options)
