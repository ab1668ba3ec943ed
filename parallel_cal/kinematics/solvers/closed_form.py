"""The mechanism's own closed form, if the closure confirms that it is exact.

Prefer it where an error in the formula must not go unseen: it refuses where it is not exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.evaluating import (
    get_kinematics,
    joint_candidates,
    order_from_home,
    pose_candidates,
    select_conditions,
    solve_on_home_branch,
    with_status,
)
from parallel_cal.kinematics.solutions import (
    MAX_CLOSED_RESIDUAL_M,
    Solutions,
    make_unsolved,
    stack_solutions,
)
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

At = Mapping[str, Any]


def direct(model: Model, q: np.ndarray, at: At | None = None) -> Solutions:
    """Find the pose on the home branch for joints (nq,) or (N, nq)."""
    return solve_on_home_branch(model, q, at, direct_all)


def direct_all(model: Model, q: np.ndarray, at: At | None = None) -> Solutions:
    """Find the candidate poses of joints (nq,) that are exact, the home branch first."""
    found = _select_exact(model, pose_candidates(model, q), at, "direct")
    return replace(order_from_home(model, found, at), complete=found.complete)


def inverse(
    model: Model, position: np.ndarray, rotation: np.ndarray | None = None, at: At | None = None
) -> Solutions:
    """Find the joints on the home branch for positions (3,) or (N, 3) and rotations."""
    r = np.asarray(position, dtype=float)
    if r.ndim == 1:
        found = inverse_all(model, r, rotation, at)
        return found[0] if len(found) else make_unsolved(model, r=r)
    turns = [None] * len(r) if rotation is None else np.reshape(rotation, (-1, 3, 3))
    rows = enumerate(zip(r, turns, strict=True))
    return stack_solutions([inverse(model, *row, select_conditions(at, i)) for i, row in rows])


def inverse_all(
    model: Model, position: np.ndarray, rotation: np.ndarray | None = None, at: At | None = None
) -> Solutions:
    """Find the candidate joints for a pose that are exact, the home branch first."""
    home = model.mechanism.home
    R = quaternion_to_matrix(home.quaternion) if rotation is None else np.reshape(rotation, (3, 3))
    found = _select_exact(model, joint_candidates(model, position, R), at, "inverse")
    first = get_kinematics(model).inverse(position, R, at).joints
    order = np.argsort(np.sum(1 - np.cos(found.joints - first), axis=1))
    return replace(found[order], complete=found.complete)


def _select_exact(
    model: Model, candidates: Configuration, at: At | None, problem: str
) -> Solutions:
    """The exact candidates with status; SolveError if none is exact in the workspace either."""
    solutions = with_status(model, candidates.rows, at, MAX_CLOSED_RESIDUAL_M, problem)
    exact = np.flatnonzero(solutions.residual < MAX_CLOSED_RESIDUAL_M)
    if len(solutions) and not len(exact):
        off = _compute_max_residual(model, at, problem)
        # Otherwise the formula holds for this model, and the sample is out of reach.
        if off >= MAX_CLOSED_RESIDUAL_M:
            raise SolveError(
                f"closed_form is not exact for this {model.mechanism.name} and its "
                f"effects (error {off:.2g} m); use newton"
            )
    every = problem in model.mechanism.closed_forms and len(exact) == len(solutions)
    return replace(solutions[exact], complete=every)


def _compute_max_residual(model: Model, at: At | None, problem: str) -> float:
    """Largest residual (m) of the formula's best candidates at five poses of the workspace."""
    r, R = poses_in_workspace(model.mechanism, 5, np.random.default_rng(0))
    solved = get_kinematics(model).inverse(r, R, at)
    judged = partial(with_status, model, at=at, tolerance=MAX_CLOSED_RESIDUAL_M, problem=problem)
    best = []
    for i in np.flatnonzero(solved.ok):
        found = (
            pose_candidates(model, solved.joints[i])
            if problem == "direct"
            else joint_candidates(model, r[i], R[i])
        )
        best += [judged(found.rows).residual.min()] if len(found.rows) else []
    return float(max(best, default=np.inf))
