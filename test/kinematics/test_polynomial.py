"""The general orientation problem: a spherical triangle fitted to three small circles."""

import numpy as np
import pytest

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix, rotation_vector
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.solvers import polynomial
from parallel_cal.kinematics.solvers._orientation import (
    FORMS,
    HALF_TANGENT,
    angles,
    coefficients,
    orientations,
    sh,
    sw,
)
from parallel_cal.model.model import new_model


def problem(rng):
    """Random directions u, v (3, 3), a rotation R and the cosines it makes."""
    u, v = rng.normal(size=(2, 3, 3))
    R = rotation_matrix(2 * rng.normal(size=3))
    return u, v, np.einsum("ni,ij,nj->n", u, R, v), R


def nearest(R, others):
    return np.abs(others - R).max(axis=(1, 2)).min()


@pytest.mark.parametrize("form", FORMS)
def test_a_known_orientation_is_among_the_solutions(form):
    rng = np.random.default_rng(1)
    for _ in range(100):
        u, v, c, R = problem(rng)
        found = orientations(u, v, c, form)
        assert len(found) in (2, 4, 6, 8)
        assert nearest(R, found) < 1e-9
        assert np.einsum("ni,kij,nj->kn", u, found, v) == pytest.approx(np.tile(c, (len(found), 1)))
        assert np.linalg.det(found) == pytest.approx(np.ones(len(found)))


def test_both_forms_have_the_same_eight_roots():
    rng = np.random.default_rng(2)
    for _ in range(50):
        m, k = rng.normal(size=(2, 3, 3))
        by_form = [roots(m, k)[0] for roots in FORMS.values()]
        apart = np.abs(by_form[0][:, None] - by_form[1]) / (1 + np.abs(by_form[1]))
        assert apart.shape == (8, 8)
        assert apart.min(axis=0).max() < 1e-9
        assert apart.min(axis=1).max() < 1e-9


def test_both_forms_find_the_same_orientations():
    rng = np.random.default_rng(3)
    for _ in range(50):
        u, v, c, _ = problem(rng)
        a, b = (orientations(u, v, c, form) for form in FORMS)
        assert len(a) == len(b)
        assert max(nearest(R, b) for R in a) < 1e-9


@pytest.mark.parametrize("form", FORMS)
def test_three_right_angles_are_made_by_the_turns_about_the_diagonals(form):
    """Hand-worked: R_xx = R_yy = R_zz = 0 asks for quaternions with x^2 = y^2 = z^2 = w^2: a
    third of a turn about each of the four diagonals of a cube, either way. All first angles
    are multiples of 90 degrees, two solutions each: double roots, and half tangents at
    infinity."""
    found = orientations(np.eye(3), np.eye(3), np.zeros(3), form)
    turns = 2 * np.pi / 3 / np.sqrt(3) * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    assert len(found) == 8
    for turn in turns:
        assert np.linalg.norm(rotation_vector(found) - turn, axis=1).min() < 1e-9


@pytest.mark.parametrize("form", FORMS)
def test_a_half_tangent_at_infinity_is_found(form):
    """Hand-worked: sin a = 0 and sin b = 0, cos a = cos b, is solved by (0, 0) and (pi, pi)."""
    m = np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 0]])  # sin a = 0
    k = np.array([[0, 0, 1.0], [0, 0, 0], [-1.0, 0, 0]])  # cos a - cos b = 0
    found = np.abs(angles(m, k, form))
    assert found == pytest.approx(np.array([[0, 0], [np.pi, np.pi]]), abs=1e-6)


def test_the_polynomial_is_the_resultant():
    """P(u) equals the determinant of eq. 6.10 at any u."""
    rng = np.random.default_rng(4)
    m, k = rng.normal(size=(2, 3, 3))
    u = 0.7
    a, b = (np.array([u * u, u, 1]) @ HALF_TANGENT.T @ x @ HALF_TANGENT for x in (m, k))
    rows = [[*a, 0], [0, *a], [*b, 0], [0, *b]]
    assert np.polyval(coefficients(m, k), u) == pytest.approx(np.linalg.det(rows))


def test_shrink_and_swap_do_what_annex_b_says():
    rng = np.random.default_rng(5)
    G, x = rng.normal(size=(5, 5)), 1.3
    powers = x ** np.arange(4, -1, -1)
    assert np.polyval(sh(G), x) == pytest.approx(powers @ G @ powers)
    assert sh(np.array([[1, 2], [3, 4]])) == pytest.approx([1, 5, 4])
    k, v, t = np.array([1.0, 2, 2]) / 3, rng.normal(size=3), 0.4
    turned = sw(k, v) @ [np.cos(t), np.sin(t), 1]
    assert turned == pytest.approx(rotation_matrix(k * t) @ v)


def test_a_cone_that_no_direction_reaches_has_no_solution():
    assert orientations(np.eye(3), np.eye(3), np.full(3, 1.1)).shape == (0, 3, 3)


def test_conditions_that_depend_on_each_other_are_refused():
    u = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0]])
    with pytest.raises(SolveError, match="depend on each other"):
        orientations(u, u, np.array([0.1, 0.2, 0.2]))


@pytest.fixture(scope="module")
def argos():
    """Model 9 off its nominal geometry, where eight orientations are distinct."""
    model = new_model("argos9")
    rng = np.random.default_rng(6)
    return model.with_values(model.values + 0.02 * rng.standard_normal(len(model.values)))


@pytest.mark.parametrize("form", FORMS)
def test_all_orientations_of_argos_9_close_and_the_first_is_the_home_branch(argos, form):
    R = rotation_matrix([0.1, -0.2, 0.15]) @ quaternion_to_matrix(argos.mechanism.home.quaternion)
    q = Kinematics(argos).inverse(np.zeros(3), R).joints
    found = polynomial.direct_all(argos, q, form=form)
    assert len(found) == 8
    assert found.rotation[0] == pytest.approx(R, abs=1e-9)
    assert (found.status == Status.CONVERGED).all()
    assert found.residual.max() < 1e-12


def test_argos_9_is_solved_for_many_joints_at_once(argos):
    turns = rotation_matrix(0.2 * np.random.default_rng(7).normal(size=(5, 3)))
    R = turns @ quaternion_to_matrix(argos.mechanism.home.quaternion)
    q = Kinematics(argos).inverse(np.zeros((5, 3)), R).joints
    assert polynomial.direct(argos, q).rotation == pytest.approx(R, abs=1e-9)
    assert polynomial.direct(argos, q[0]).rotation == pytest.approx(R[0], abs=1e-9)


def test_other_mechanisms_are_refused():
    for name in ("delta24", "stewart42"):
        model = new_model(name)
        with pytest.raises(SolveError, match="use --solver newton"):
            polynomial.direct(model, np.array(model.mechanism.home.joints))
    with pytest.raises(SolveError, match="polynomial does not solve the inverse problem"):
        solving.inverse(new_model("argos9"), np.zeros(3), None, {}, solver="polynomial")
