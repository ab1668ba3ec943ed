"""An arm with more joints than a pose has coordinates: answered nearest to where it starts."""

import numpy as np
import pytest

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset

QUARTER = np.pi / 2
# A whole-arm manipulator of seven turning joints: twist, offset along, offset across (rad, m).
ARM = [
    (-QUARTER, 0, 0),
    (QUARTER, 0, 0),
    (-QUARTER, 0.55, 0.045),
    (QUARTER, 0, -0.045),
    (-QUARTER, 0.3, 0),
    (QUARTER, 0, 0),
    (0, 0.06, 0),
]
HOME = (0.1, 0.5, 0.1, 1.2, 0.1, 0.5, 0.1)


def arm():
    links = [
        {"joint": "R", "axes": "perpendicular", "alpha": t, "d": d, "a": a} for t, d, a in ARM[:-1]
    ]
    links.append({"joint": "R", "alpha": ARM[-1][0], "d": ARM[-1][1], "a": ARM[-1][2]})
    return new_model(load_mechanism("serial", links=links, home=HOME))


def by_matrices(q, shifts):
    """The same arm in plain 4 x 4 matrices, each joint's angle and offset off by `shifts`."""
    T = np.eye(4)
    for k, (twist, along, across) in enumerate(ARM):
        c, s = np.cos(q[k] + shifts[0][k]), np.sin(q[k] + shifts[0][k])
        ct, st = np.cos(twist), np.sin(twist)
        A = np.array(
            [
                [c, -s * ct, s * st, across * c],
                [s, c * ct, -c * st, across * s],
                [0, st, ct, along + shifts[1][k]],
                [0, 0, 0, 1],
            ]
        )
        T = T @ A
    return T


def session(shifts, n=80, seed=0, noise=(5e-6, 20e-6, 30e-6)):
    rng = np.random.default_rng(seed)
    q = np.array(HOME) + rng.uniform(-0.7, 0.7, (n, 7))
    T = np.array([by_matrices(row, shifts) for row in q])
    sigma = np.diag([noise[1] ** 2] * 3 + [noise[2] ** 2] * 3)
    return Dataset.from_arrays(
        [f"joint{i + 1}" for i in range(7)],
        q + noise[0] * rng.standard_normal(q.shape),
        T[:, :3, 3] + noise[1] * rng.standard_normal((n, 3)),
        rotation_matrix(noise[2] * rng.standard_normal((n, 3))) @ T[:, :3, :3],
        pose_cov=sigma,
        joint_sigma=[noise[0]] * 7,
    )


def test_the_answer_is_on_the_pose_and_near_home():
    model = arm()
    kinematics = Kinematics(model)
    q = np.array(HOME) + np.random.default_rng(0).uniform(-0.5, 0.5, (100, 7))
    pose = kinematics.direct(q)
    assert np.abs(
        pose.position - [by_matrices(row, np.zeros((2, 7)))[:3, 3] for row in q]
    ).max() < (1e-12)
    found = kinematics.inverse(pose.position, pose.rotation)
    assert found.ok.all()
    assert np.abs(kinematics.direct(found.joints).position - pose.position).max() < 1e-12
    away, first = (np.linalg.norm(a - HOME, axis=1).mean() for a in (found.joints, q))
    assert away < 1.01 * first


def test_from_a_start_the_answer_is_the_nearest_to_it():
    kinematics = Kinematics(arm())
    q = np.array(HOME) + np.random.default_rng(1).uniform(-0.5, 0.5, (20, 7))
    pose = kinematics.direct(q)
    near = kinematics.inverse(pose.position + [1e-4, 0, 0], pose.rotation, None, pose)
    step = near.joints - q
    assert near.ok.all()
    # The shortest step is at right angles to what the arm can do without moving its hand.
    for row, where, change in zip(q, pose, step, strict=True):
        columns = [
            (kinematics.direct(row + 1e-6 * e).position - where.position) / 1e-6 for e in np.eye(7)
        ]
        turns = [
            (kinematics.direct(row + 1e-6 * e).rotation @ where.rotation.T)[[2, 0, 1], [1, 2, 0]]
            / 1e-6
            for e in np.eye(7)
        ]
        null = np.linalg.svd(np.vstack([np.array(columns).T, np.array(turns).T]))[2][-1]
        assert abs(null @ change) < 1e-3 * np.linalg.norm(change)


def test_all_of_infinitely_many_answers_are_refused_with_the_reason():
    kinematics = Kinematics(arm())
    pose = kinematics.direct(np.array(HOME))
    with pytest.raises(SolveError, match="infinitely many"):
        inverse_all(kinematics.model, pose.position, pose.rotation)


def test_it_is_compared_and_identified_like_any_robot():
    rng = np.random.default_rng(5)
    shifts = np.array([2e-3 * rng.standard_normal(7), 0.3e-3 * rng.standard_normal(7)])
    data = session(shifts)
    before = compare(arm(), data).given.errors_as_given.summary
    result = fit(arm(), data)
    assert before.position_rms > 1e-3
    assert result.estimate.chi2_per_dof == pytest.approx(1, abs=0.2)
    fresh = session(shifts, seed=7, noise=(1e-12, 1e-12, 1e-12))
    unseen = compare(result.model, fresh, joint_sigma=5e-6).errors.summary
    assert unseen.position_rms < 25e-6
    assert unseen.joint_rms < 0.05 * before.joint_rms
