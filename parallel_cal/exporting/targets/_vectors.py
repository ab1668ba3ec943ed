"""Test vectors: Python's solutions over the workspace, out of reach, and for NaN."""

from __future__ import annotations

import itertools

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.singularity import jacobians, smallest_singular_values
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.kinematics.solving import controlled_pose
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

# Conditions are drawn from these values, or about neutral with this sigma.
CONDITION_CHOICES = {"direction": (-1.0, 0.0, 1.0), "session": (0.0, 1.0, 2.0)}
CONDITION_SIGMAS = {
    "temperature": 5.0,
    "payload": 0.0,
    "time": 100.0,
    "velocity": 0.5,
    "acceleration": 5.0,
    "travel": 0.1,
}
N_UNREACHABLE_POSES = 20
UNREACHABLE_DISTANCE_FACTOR = 10.0  # sigma of their distance, per length of the mechanism
# rad or m (1 sigma) by which joints disagree with each other if there are more than coordinates
JOINT_DISAGREEMENT_SIGMA = 1e-5
# If a pose moves by this (m), its joints may move by that (rad or m).
POSE_PERTURBATION_M = 1e-9
MAX_JOINT_CHANGE = 1e-3
# Two programs round the closure differently: by this many units in the last place of its longest
# length.
ROUNDING_UNITS = 100
MIN_LIMIT = 1e-12  # m, rad: what Newton's method may leave after its last step


def vectors(model: Model, poses: int) -> str:
    """Return a table of problems, one per line.

    A line contains: inverse (1) or direct (0), status, conditions, joints, position, rotation row
    by row, and the limit of a difference from this solution (m, rad). The part that is not given is
    the solution, NaN if invalid. Poses whose solution changes if the pose moves by a nanometre are
    not used.
    """
    rng = np.random.default_rng(0)
    r, R = poses_in_workspace(model.mechanism, poses, rng)
    r[:N_UNREACHABLE_POSES] += (
        UNREACHABLE_DISTANCE_FACTOR
        * model.mechanism.length
        * rng.standard_normal(r[:N_UNREACHABLE_POSES].shape)
    )
    r[-1], R[-1] = np.nan, np.nan
    r, turned = controlled_pose(model, r, R)
    a = np.column_stack(
        [_draw_condition(name, poses, rng) for name in model.conditions] or [np.empty((poses, 0))]
    )
    a[-2] = np.nan
    at = {name: a[:, k] for k, name in enumerate(model.conditions)}
    kinematics = Kinematics(model)
    inverse = kinematics.inverse(r, turned, at)
    # The last digit may decide on which branch an arm's search from home ends. Two programs differ
    # there, so such poses are no test.
    near = kinematics.inverse(r + POSE_PERTURBATION_M, turned, at)
    steady = np.isclose(near.joints, inverse.joints, rtol=0, atol=MAX_JOINT_CHANGE).all(axis=1)
    steady = (steady | ~inverse.solved) & (near.status == inverse.status)
    home = np.array(model.mechanism.home.joints)
    q = np.where(inverse.ok[:, None], inverse.joints, home)
    q += JOINT_DISAGREEMENT_SIGMA * rng.standard_normal(q.shape)
    q[-1] = np.nan
    direct = kinematics.direct(q, at)
    names = [*model.conditions, *model.joints, *"xyz", *(f"R{i}{j}" for i in "123" for j in "123")]
    to_joints, to_pose = (
        _limits(problem, solutions, smallest_singular_values(jacobians(model, solutions, at)[k]))
        for problem, solutions, k in (
            (kinematics.inverse_problem, inverse, 1),
            (kinematics.direct_problem, direct, 0),
        )
    )
    rows = [
        *itertools.compress(_rows(1, a, inverse, to_joints, position=r, rotation=R), steady),
        *_rows(0, a, direct, to_pose, joints=q),
    ]
    return "\n".join([",".join(["inverse", "status", *names, "limit"]), *rows]) + "\n"


def _limits(problem: Problem, found: Solutions, sigma: np.ndarray) -> np.ndarray:
    """Compute how far another program's solution may differ.

    The smallest singular value `sigma` (N,) of the problem amplifies the rounding of the closure.
    At a minimum of least squares the residual is flat: it differs by its rounding over a distance
    that is the root of their product.
    """
    model = problem.model
    lengths = [abs(model.values[i]) for i, p in enumerate(model.table) if p.unit == "m"]
    rounding = ROUNDING_UNITS * np.finfo(float).eps * max([1.0, *lengths])
    flat = np.sqrt(2 * rounding * found.residual) if problem.redundant else 0.0
    # Where nothing was found, sigma may be 0, and numpy would print a warning.
    amplified = (rounding + flat) / np.where(found.ok, sigma, 1.0)
    return np.where(found.ok, np.maximum(MIN_LIMIT, amplified), MIN_LIMIT)


def _draw_condition(condition: str, n: int, rng: np.random.Generator) -> np.ndarray:
    kind = condition.split(".")[0]
    if kind in CONDITION_CHOICES:
        return rng.choice(CONDITION_CHOICES[kind], n)
    if kind == "payload":
        return rng.uniform(0.0, 1.0, n)
    return (20.0 if kind == "temperature" else 0.0) + CONDITION_SIGMAS[kind] * rng.standard_normal(
        n
    )


def _rows(
    problem: int, a: np.ndarray, answers: Solutions, limits: np.ndarray, **given: np.ndarray
) -> list[str]:
    """Format lines; without a solution, only the given part is stated and the rest is zero."""
    parts = {name: getattr(answers, name).copy() for name in ("joints", "position", "rotation")}
    for name, part in parts.items():
        if name in given:
            part[~answers.solved] = given[name][~answers.solved]
        else:
            part[~answers.solved] = 0.0
    numbers = np.hstack(
        [a, *(part.reshape(len(a), -1) for part in parts.values()), limits[:, None]]
    )
    status = answers.status.astype(int)
    return [
        f"{problem},{status[i]}," + ",".join(map(repr, row))
        for i, row in enumerate(numbers.tolist())
    ]
