"""What the solver modules share: what the mechanism sees, branches, and solutions with status."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch
from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.singularity import jacobians, smallest
from parallel_cal.kinematics.solutions import SINGULAR, Solutions, Status, stacked
from parallel_cal.model.model import Model


def nearest(candidates: Sequence[Any], distance: Callable[[Any], Any]) -> Any:
    """The candidate column of least distance; one that is NaN is never nearer."""
    best = candidates[0]
    for other in candidates[1:]:
        best = ca.if_else(distance(other) < distance(best), other, best)
    return best


def at_least_one(steps: int) -> int:
    if steps < 1:
        raise SolveError(f"{steps} steps asked for: expected 1 or more")
    return steps


@lru_cache(maxsize=8)
def kinematics_of(model: Model) -> Kinematics:
    """The model's own direct problem, for refining what a solver found; made once a model."""
    return Kinematics(model)


def answers(
    model: Model,
    solve: ca.Function,
    given: np.ndarray,
    at: Mapping[str, Any] | None,
    tolerance: float,
    problem: str,
) -> Solutions:
    """(configuration, a, v) -> configuration on all samples, judged by the closure.

    Converged means a residual below `tolerance` (m): a fixed number of steps is as good as it is.
    """
    (x,) = Batch(solve)(given, model.condition_rows(at, len(given)), model.values)
    solutions = with_status(model, x, at, tolerance, problem)
    solutions.status[~np.isfinite(given).all(axis=1)] = Status.INVALID_INPUT
    return solutions


def with_status(
    model: Model, x: np.ndarray, at: Mapping[str, Any] | None, tolerance: float, problem: str
) -> Solutions:
    """Configurations (N, nq + 12) as solutions of the direct or the inverse problem, with the
    closure's residual and a status."""
    conditions, n = model.condition_rows(at, len(x)), len(model.joints)
    phi = model.structure.closure_batch(x, conditions, model.values)[0]
    residual = np.linalg.norm(phi, axis=1)
    limits = np.array(model.mechanism.joint_limits, dtype=float).reshape(-1, 2)
    inside = ((x[:, :n] >= limits[:, 0]) & (x[:, :n] <= limits[:, 1])).all(axis=1)
    status = np.where(inside, Status.CONVERGED, Status.OUTSIDE_LIMITS).astype(np.int8)
    status[residual >= tolerance] = Status.NOT_CONVERGED
    status[~np.isfinite(residual)] = Status.UNREACHABLE
    solutions = Solutions.of(x, residual, status)
    near = smallest(jacobians(model, solutions, at)[problem == "inverse"]) < SINGULAR
    status[near & (residual < tolerance)] = Status.SINGULAR
    return solutions


def on_home_branch(
    q: np.ndarray,
    at: Mapping[str, Any] | None,
    every: Callable[[np.ndarray, Mapping[str, Any] | None], Solutions],
) -> Solutions:
    """The first of `every` solution for joints (nq,) or (N, nq); unreachable where none is."""
    q = np.asarray(q, dtype=float)
    if q.ndim == 1:
        found = every(q, at) if np.isfinite(q).all() else None
        return found[0] if found else _unreachable(q)
    rows = [on_home_branch(row, sample(at, i), every) for i, row in enumerate(q)]
    return stacked(rows)


def home_first(model: Model, poses: Solutions, at: Mapping[str, Any] | None) -> np.ndarray:
    """The order of all poses of one set of joints from the home branch outwards.

    Nearest to home is not enough: far from home a pose of another assembly mode may be nearer.
    """
    if len(poses) == 0:
        return np.arange(0)
    branch, home = kinematics_of(model).direct(poses.joints[0], at), model.mechanism.home
    r, R = branch.position, branch.rotation
    if branch.status == Status.UNREACHABLE:
        r, R = np.array(home.position), quaternion_to_matrix(home.quaternion)
    turned = rotation_vector(poses.rotation @ R.T)
    apart = np.concatenate([poses.position - r, model.mechanism.length * turned], 1)
    return np.argsort(np.linalg.norm(apart, axis=1))


def sample(at: Mapping[str, Any] | None, i: int) -> dict[str, Any] | None:
    """The conditions of sample i, where some are columns."""
    if at is None:
        return None
    return {name: np.ravel(v)[i] if np.size(v) > 1 else v for name, v in at.items()}


def _unreachable(q: np.ndarray) -> Solutions:
    nowhere, finite = np.full((3, 3), np.nan), np.isfinite(q).all()
    status = np.array(Status.UNREACHABLE if finite else Status.INVALID_INPUT, dtype=np.int8)
    return Solutions(q, nowhere[0], nowhere, np.array(np.nan), status)
