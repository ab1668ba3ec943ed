"""Nominal solution corrected to first order in the parameter errors (Savoure et al., eqs 27-33).

A controller that knows the nominal closed form can do this: it needs neither iterations nor a
start. The solution has an error of second order; `residual` is that of the full model's closure.
Effects are included: they are parameter errors with nominal value zero. A fixed parameter (a tool's
length) is known and not an error: the nominal robot has its value.

Prefer it where a controller has the nominal closed form alone: no iteration, first order.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.evaluating import match_shape, with_status
from parallel_cal.kinematics.kinematics import MAX_CLOSED_RESIDUAL_M, Kinematics, Solutions, Status
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model


def direct(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find the nominal pose and add the predicted error dX (eq. 30)."""
    _require_pose_alone(model)
    nominal = _nominal(model).direct(np.atleast_2d(q), at)
    dX = pose_error(model, nominal, at)
    still = np.zeros_like(nominal.joints)
    x = nominal.configuration.apply_change(np.hstack([still, dX]))
    return match_shape(_answer(model, x, nominal, at, "direct"), q)


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
) -> Solutions:
    """Find the nominal joints and subtract the correction of the predicted error (eqs 29-33).

    SolveError for a robot with more closure rows than degrees of freedom: its joints need not agree
    on one error.
    """
    if model.structure.equations > len(model.mechanism.moved):
        raise SolveError(
            "ipr_compensation corrects joints through the pose, but "
            f"{model.mechanism.name} has more closure rows than degrees of freedom: "
            "use --solver newton"
        )
    _require_pose_alone(model)
    nominal = _nominal(model).inverse(np.atleast_2d(position), rotation, at)  # (i)
    dX = pose_error(model, nominal, at)  # (ii)
    m = model.mechanism
    dx = dX[:, m.controlled]  # (iii)
    dq, follows = joint_correction(model, nominal, dx, at)  # (iv)
    passive = np.zeros_like(dX)
    passive[:, m.parasitic] = dX[:, m.parasitic] - follows
    x = nominal.configuration.apply_change(np.hstack([-dq, passive]))
    return match_shape(_answer(model, x, nominal, at, "inverse"), position)  # (v)


def _require_pose_alone(model: Model) -> None:
    """SolveError for a mechanism whose closure has passive coordinates besides the pose."""
    if model.mechanism.passive:
        raise SolveError(
            f"ipr_compensation corrects the pose alone, but {model.mechanism.name} has passive "
            "coordinates: use --solver newton"
        )


def pose_error(model: Model, nominal: Solutions, at: Mapping[str, Any] | None = None) -> np.ndarray:
    """Compute dX = S_C dk (eqs 22, 30) at nominal solutions: (N, 6), m and rad about base axes."""
    _, J_x, J_v = _blocks(model, nominal, at)
    dk = model.values - nominal_values(model)
    dX, moved = np.zeros((len(nominal), 6)), model.mechanism.moved
    dX[:, moved] = -_solve_least_squares(J_x[:, :, moved], J_v @ dk)
    return dX


def joint_correction(
    model: Model, nominal: Solutions, dx: np.ndarray, at: Mapping[str, Any] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute dq = J_S dx (eq. 32), and how passive coordinates follow a displacement dx."""
    J_q, J_x, _ = _blocks(model, nominal, at)
    m, n = model.mechanism, len(model.joints)
    unknown = np.concatenate([J_q, J_x[:, :, m.parasitic]], axis=2)
    given = (J_x[:, :, m.controlled] @ dx[..., None])[..., 0]
    change = -_solve_least_squares(unknown, given)
    return change[:, :n], change[:, n:]


@lru_cache(maxsize=16)
def _nominal(model: Model) -> Kinematics:
    return Kinematics(model.with_values(nominal_values(model)))


def nominal_values(model: Model) -> np.ndarray:
    """Return the parameters k of the robot before calibration."""
    return np.where(model.fixed, model.values, model.table.nominal)


def _blocks(
    model: Model, s: Solutions, at: Mapping[str, Any] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d phi/dq, d phi/d(r, w), d phi/dk at the nominal parameters, (N, rows, columns)."""
    x, n = s.configuration.rows, len(model.joints)
    a = model.condition_rows(at, len(x))
    J_x, J_v = model.structure.jacobians(x, a, nominal_values(model))
    return J_x[:, :, :n], J_x[:, :, n:], J_v


def _solve_least_squares(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least squares A u = b for each sample; NaN if the nominal solution failed."""
    u = np.full(A.shape[::2], np.nan)
    good = np.isfinite(A).all(axis=(1, 2)) & np.isfinite(b).all(axis=1)
    A, b = A[good], b[good][..., None]
    try:
        solved = np.linalg.solve(A, b) if A.shape[1] == A.shape[2] else np.linalg.pinv(A) @ b
    except np.linalg.LinAlgError:  # one singular pose in the batch
        solved = np.linalg.pinv(A) @ b
    u[good] = solved[..., 0]
    return u


def _answer(
    model: Model,
    x: Configuration,
    nominal: Solutions,
    at: Mapping[str, Any] | None,
    problem: str,
) -> Solutions:
    """Solutions with the full model's residual; a failed nominal solution keeps its status.

    Not converged if more than a tenth of the error remains: it is then not of first order.
    """
    before, solutions = (
        with_status(model, each.rows, at, np.inf, problem) for each in (nominal.configuration, x)
    )
    bad = solutions.residual > np.maximum(0.1 * before.residual, MAX_CLOSED_RESIDUAL_M)
    solutions.status[bad] = Status.NOT_CONVERGED
    failed = (nominal.status != Status.CONVERGED) & (nominal.status != Status.OUTSIDE_LIMITS)
    solutions.status[failed] = nominal.status[failed]
    return solutions
