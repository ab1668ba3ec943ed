"""Helpers of the solvers: inputs of the mechanism, branches, and solutions with status."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, Single, dense
from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.rows import joint_rows, limits_in
from parallel_cal.kinematics.singularity import jacobians, smallest_singular_values
from parallel_cal.kinematics.solutions import (
    MIN_REGULAR_SINGULAR_VALUE,
    Solutions,
    Status,
    make_unsolved,
    stack_solutions,
)
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.model.structure import Structure


def check_step_count(steps: int) -> int:
    if steps < 1:
        raise SolveError(f"{steps} steps requested: expected 1 or more")
    return steps


@lru_cache(maxsize=8)
def get_kinematics(model: Model) -> Kinematics:
    """The model's Newton solver, which refines solutions of other solvers; one per model."""
    return Kinematics(model)


def half_step_function(name: str, s: Structure, q: Any, r: Any, R: Any) -> ca.Function:
    """Build (configuration, a, v) -> configuration from the q, r and R that half steps reach."""
    found = ca.vertcat(q, r, ca.vec(ca.SX(R).T))
    return dense(name, [s.configuration, s.a, s.v], [found])


@lru_cache(maxsize=32)
def _parts(s: Structure, method: str) -> Single:
    """Compile (configuration, a, v) -> results of the mechanism's method, after the effects."""
    parts = getattr(s.mechanism, method)(s.seen.q, s.seen.p)
    outputs = [ca.SX(ca.horzcat(*part)) for part in parts]
    return Single(dense(method, [s.configuration, s.a, s.v], outputs))


def parts(
    model: Model, method: str, q: np.ndarray, at: Mapping[str, Any] | None
) -> list[np.ndarray]:
    """Evaluate the mechanism's method `rods` or `circles` at joints q (nq,), after the effects.

    Returns points (n, 3) and lengths (n,). SolveError if the mechanism has no such method.
    """
    if not hasattr(model.mechanism, method):
        raise SolveError(
            f"mechanism {model.mechanism.name} has no method `{method}`, so its "
            f"direct problem is not known to be one of {method}; use --solver newton"
        )
    given = joint_rows(model, q)[0]
    found = _parts(model.structure, method)(given, model.condition_rows(at, 1)[0], model.values)
    n = min(map(len, found))
    return [part if len(part) == n else part.reshape(n, 3) for part in found]


def match_shape(solutions: Solutions, given: np.ndarray) -> Solutions:
    """Return one solution if one sample was given."""
    return solutions[0] if np.ndim(given) == 1 else solutions


def evaluate_solver(
    model: Model,
    solve: ca.Function,
    given: np.ndarray,
    at: Mapping[str, Any] | None,
    tolerance: float,
    problem: str,
) -> Solutions:
    """Evaluate (configuration, a, v) -> configuration on all samples; the closure gives the status.

    Converged means a residual below `tolerance` (m): the number of steps is fixed.
    """
    (x,) = Batch(solve)(given, model.condition_rows(at, len(given)), model.values)
    solutions = with_status(model, x, at, tolerance, problem)
    solutions.status[~np.isfinite(given).all(axis=1)] = Status.INVALID_INPUT
    return solutions


def residuals(model: Model, x: np.ndarray, at: Mapping[str, Any] | None) -> np.ndarray:
    """Compute the closure's residual (N,) in m at configurations (N, nq + 12)."""
    (rows,) = model.structure.residual_batch(x, model.condition_rows(at, len(x)), model.values)
    return np.asarray(np.linalg.norm(rows, axis=1))


def with_status(
    model: Model, x: np.ndarray, at: Mapping[str, Any] | None, tolerance: float, problem: str
) -> Solutions:
    """Convert configurations (N, nq + 12) to solutions of the direct or inverse problem, with the
    closure's residual and a status."""
    n, residual = len(model.joints), residuals(model, x, at)
    limits = limits_in(problem, model.mechanism)
    inside = ((x[:, :n] >= limits[:, 0]) & (x[:, :n] <= limits[:, 1])).all(axis=1)
    status = np.where(inside, Status.CONVERGED, Status.OUTSIDE_LIMITS).astype(np.int8)
    status[residual >= tolerance] = Status.NOT_CONVERGED
    status[~np.isfinite(residual)] = Status.UNREACHABLE
    solutions = Solutions.of(x, residual, status, len(model.mechanism.passive))
    near = (
        smallest_singular_values(jacobians(model, solutions, at)[problem == "inverse"])
        < MIN_REGULAR_SINGULAR_VALUE
    )
    status[near & (residual < tolerance)] = Status.SINGULAR
    return solutions


def solve_on_home_branch(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None,
    every: Callable[[Model, np.ndarray, Mapping[str, Any] | None], Solutions],
) -> Solutions:
    """Return the first solution of `every` for joints (nq,) or (N, nq); unreachable if none."""
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        found = every(model, q, at) if np.isfinite(q).all() else None
        return found[0] if found else make_unsolved(model, q=q)
    rows = [
        solve_on_home_branch(model, row, select_conditions(at, i), every) for i, row in enumerate(q)
    ]
    return stack_solutions(rows)


def order_from_home(model: Model, poses: Solutions, at: Mapping[str, Any] | None) -> Solutions:
    """Order all poses of one set of joints by their distance from what Newton's method answers,
    whose status the first one has if that is on another branch than home.

    The distance from home would not do: far from home another assembly mode may be nearer to it.
    """
    if len(poses) == 0:
        return poses
    branch, home = get_kinematics(model).direct(poses.joints[0], at), model.mechanism.home
    r, R = branch.position, branch.rotation
    if branch.status == Status.UNREACHABLE:
        r, R = np.array(home.position), quaternion_to_matrix(home.quaternion)
    turned = rotation_vector(poses.rotation @ R.T)
    apart = np.concatenate([poses.position - r, model.mechanism.length * turned], 1)
    poses = poses[np.argsort(np.linalg.norm(apart, axis=1))]
    if branch.status == Status.OTHER_BRANCH:
        poses.status[0] = Status.OTHER_BRANCH
    return poses


def select_conditions(at: Mapping[str, Any] | None, i: int) -> dict[str, Any] | None:
    """Select the conditions of sample i; some conditions may be columns."""
    if at is None:
        return None
    return {name: np.ravel(v)[i] if np.size(v) > 1 else v for name, v in at.items()}


def pose_candidates(model: Model, q: np.ndarray) -> Configuration:
    """Evaluate the mechanism's candidates for the poses of joints (nq,); real ones only."""
    columns = np.array(model.structure.candidates(q, model.values)).T
    poses = columns[np.isfinite(columns).all(axis=1)]
    R, u = poses[:, 3:].reshape(-1, 3, 3), np.array(model.mechanism.home.passive)
    return Configuration(np.asarray(q), poses[:, :3], R, u)


def joint_candidates(model: Model, r: np.ndarray, R: np.ndarray) -> Configuration:
    """Combine the joints' candidates for a pose in all ways; real ones only."""
    choices = model.structure.joint_candidates.call([r, R.ravel(), model.values])
    sets = np.array(list(product(*(np.array(c).ravel() for c in choices))))
    q, u = sets[np.isfinite(sets).all(axis=1)], np.array(model.mechanism.home.passive)
    return Configuration(q, np.asarray(r, dtype=float), R, u)


@lru_cache(maxsize=16)
def is_pose_unaffected(s: Structure) -> bool:
    """Whether no effect changes the pose, and none uses it to change joints or geometry."""
    ideal, pose = s.seen, ca.vertcat(s.r, s.R9)
    edited = ca.vertcat(ca.vec(ideal.r - s.r), ca.vec(ca.SX(ideal.R - s.R)))
    return edited.is_zero() and not ca.depends_on(ca.vertcat(ideal.q, ideal.p._vector), pose)
