"""Argos 27: all sixteen poses, and the cascade of section 6.7."""

import numpy as np
import pytest

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.solvers import three_circles
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.thesis.solvers import cascaded_circles


def strayed(seed):
    model = new_model("argos27")
    draw = np.random.default_rng(seed).standard_normal(len(model.values))
    return model.with_values(model.values + model.table.tolerance * draw)


def some_start(q, rng):
    R = rotation_matrix(rng.standard_normal(3) * 2)
    return Solutions(q, rng.standard_normal(3) * 0.03, R, np.array(np.nan), np.array(0))


def apart(one, other):
    return np.abs(one.rotation - other.rotation).max()


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(4))
def test_sixteen_poses_are_found_and_they_are_those_of_many_newton_starts(seed):
    model, rng = strayed(seed), np.random.default_rng(seed)
    q = np.array(model.mechanism.home.joints) + rng.uniform(-0.2, 0.2, 3)
    found = three_circles.direct_all(model, q)
    assert found.count_complex == 16
    assert found.residual.max() < 1e-12
    kinematics = Kinematics(model)
    for _ in range(150):
        other = kinematics.direct(q, None, some_start(q, rng))
        if other.residual < 1e-12:
            assert min(apart(other, pose) for pose in found) < 1e-6


def test_a_triangle_on_circles_that_was_put_there_is_found_again():
    """Worked from the answer: balls at known places of circles in any position."""
    rng = np.random.default_rng(3)
    R = rotation_matrix(rng.standard_normal(3))
    B, r = rng.standard_normal((3, 3)), rng.standard_normal(3)
    P = r + B @ R.T
    u = rng.standard_normal((3, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    towards = np.cross(u, rng.standard_normal((3, 3)))
    C = P - towards
    z, triangles = three_circles.balls(C, u, np.linalg.norm(towards, axis=1), B)
    assert len(z) == 16
    best = min(triangles, key=lambda points: np.abs(points - P).max())
    position, turn = three_circles.fit_pose(B, best)
    assert np.abs(best - P).max() < 1e-6
    assert np.abs(position - r).max() < 1e-6
    assert np.abs(turn - R).max() < 1e-6


def test_home_comes_first_and_all_are_in_the_public_answer():
    model = strayed(5)
    kinematics = Kinematics(model)
    q = np.array(model.mechanism.home.joints)
    every = direct_all(kinematics.model, q)
    assert every.count_complex == 16
    assert apart(every[0], kinematics.direct(q)) < 1e-9


def test_the_cascade_comes_to_the_poses_of_newton_s_method():
    model = strayed(6)
    kinematics = Kinematics(model)
    q = np.array(model.mechanism.home.joints) + np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    exact = kinematics.direct(q)
    errors = []
    for half_steps in (4, 8, 16):
        found = cascaded_circles.direct(model, q, half_steps=half_steps)
        errors.append(np.abs(found.position - exact.position).max())
    assert errors[0] > 5 * errors[1] > 25 * errors[2]
    turned = rotation_vector(found.rotation @ exact.rotation.transpose(0, 2, 1))
    assert np.abs(turned).max() < 1e-6
    back = cascaded_circles.inverse(model, exact.position, exact.rotation, half_steps=24)
    assert np.abs(back.joints - q).max() < 1e-6


def test_the_default_cascade_converges_over_the_workspace():
    model = strayed(7)
    exact = Kinematics(model).inverse(
        *poses_in_workspace(model.mechanism, 100, np.random.default_rng(0))
    )
    exact = exact[exact.ok]
    found = cascaded_circles.direct(model, exact.joints)
    assert found.ok.all()
    assert np.abs(found.position - exact.position).max() < 0.1e-6


def test_other_mechanisms_and_problems_are_refused_with_a_way_out():
    delta = new_model("delta54")
    with pytest.raises(SolveError, match="for argos27, not for delta54; use --solver newton"):
        cascaded_circles.direct(delta, np.zeros(3))
    with pytest.raises(SolveError, match="no method `circles`"):
        three_circles.direct_all(delta, np.zeros(3))
    with pytest.raises(SolveError, match="three_circles does not solve the inverse problem"):
        solving.inverse(strayed(0), np.zeros(3), None, {}, solver="three_circles")
    with pytest.raises(SolveError, match="supports no effects"):
        cascaded_circles.direct(strayed(0).with_effect("backlash"), np.zeros(3))
