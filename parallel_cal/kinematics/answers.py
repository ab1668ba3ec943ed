"""Parse the inputs and format the outputs of forward and inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError, SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solutions import MAX_CLOSED_RESIDUAL_M
from parallel_cal.model.effect import CONDITIONS, parse_lag, parse_part
from parallel_cal.model.model import Model


def parse_conditions(model: Model, items: Iterable[str]) -> dict[str, float]:
    """Parse `temperature=25`, `direction.joint1=-1` as conditions (ModelError)."""
    given = []
    for item in items:
        name, _, text = item.partition("=")
        try:
            given.append((name, float(text)))
        except ValueError:
            raise ModelError(f"condition '{item}': expected NAME=NUMBER") from None
    return named_conditions(model, given)


def named_conditions(model: Model, given: Iterable[tuple[str, float]]) -> dict[str, float]:
    """Collect conditions by column name (ModelError for an unknown name).

    A condition of joints without a joint's name, like `direction`, applies to all joints.
    """
    conditions: dict[str, float] = {}
    parts = {c for c in model.conditions if parse_part(c)}
    parts |= {f"temperature.{body}" for body in model.mechanism.expanding_bodies}
    for name, value in given:
        kind, _, joint = name.partition(".")
        if parse_lag(name) or name in parts:
            conditions[name] = value
            continue
        if kind not in CONDITIONS or (joint and joint not in model.joints):
            known = [f"{c}.JOINT" if spec[2] else c for c, spec in CONDITIONS.items()]
            known += sorted(parts)
            raise ModelError(
                f"no condition '{name}'; there are {', '.join(known)}, where JOINT is "
                f"one of {', '.join(model.joints)}"
            )
        of_all_joints = CONDITIONS[kind][2] and not joint
        columns = [f"{kind}.{j}" for j in model.joints] if of_all_joints else [name]
        conditions.update(dict.fromkeys(columns, value))
    return conditions


def parse_rotation(quaternion: Sequence[float]) -> np.ndarray:
    """Convert a quaternion x y z w of any length to a matrix; SolveError if it is not one."""
    q = np.array(quaternion, dtype=float)
    if not np.isfinite(q).all() or np.linalg.norm(q) < 1e-9:
        raise SolveError(f"orientation {q.tolist()}: expected a quaternion x y z w, not all zero")
    return quaternion_to_matrix(q)


def direct_covariances(model: Model, found: Solutions, at: Mapping[str, Any]) -> np.ndarray:
    """Compute the covariance (N, 6, 6) of each pose, NaN for one that is not solved; ModelError if
    the model has none."""
    return _of_solved(_with_covariance(model).direct_covariance, found, at, 6)


def inverse_covariances(model: Model, found: Solutions, at: Mapping[str, Any]) -> np.ndarray:
    """Compute the covariance (N, nq, nq) of each joint set; NaN and ModelError as above."""
    return _of_solved(_with_covariance(model).inverse_covariance, found, at, len(model.joints))


# A residual of so many expected residuals has another cause.
MAX_RESIDUAL_RATIO = 3.0


def explained_residuals(model: Model, found: Solutions, at: Mapping[str, Any]) -> np.ndarray | None:
    """Compute the residual (N,) in m that noise and the errors of the model explain.

    It is that of the uncertainty of the parameters or that of the last fit, the larger one. None if
    the robot has no more joints than freedoms; NaN for a sample that is not solved.
    """
    if model.structure.equations <= len(model.mechanism.moved):
        return None
    explained = np.full(len(found), np.nan)
    if (solved := found.solved).any():
        noise = np.nan_to_num(model.joint_noise)
        compute = Kinematics(model).direct_residual_sigma
        sigma = compute(found[solved], select_rows(at, solved), noise)
        explained[solved] = np.maximum(sigma, _fitted_residual(model))
    return explained


def _fitted_residual(model: Model) -> float:
    """Return the norm (rms, m) of the closure at the held-out poses of the last fit, 0 without."""
    for step in reversed(model.history):
        judged = (step.get("held_out") or {}).get("after") or step.get("after") or {}
        if (rms := judged.get("closure_rms")) is not None:
            return float(rms) * model.structure.phi.shape[0] ** 0.5
    return 0.0


def describe_disagreement(found: Solutions, explained: np.ndarray | None) -> str:
    """Describe readings that disagree by more than is explained; empty if there are none."""
    if explained is None:
        return ""
    # Nothing may be explained, as with exact readings; then a closed sample is left with rounding.
    allowed = np.maximum(MAX_RESIDUAL_RATIO * explained, MAX_CLOSED_RESIDUAL_M)
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero(found.residual > allowed)
    if not len(beyond):
        return ""
    worst = beyond[np.argmax(found.residual[beyond] / allowed[beyond])]
    which, row = "the joint readings", ""
    if len(found) > 1:
        which = f"the readings of {len(beyond)} row{'s' * (len(beyond) > 1)}"
        row = f" in row {worst + 1}"
    return (
        f"{which} agree on no pose: the residual{row} is {1e3 * found.residual[worst]:.4g} mm, and "
        "the noise and the errors of the model explain "
        f"{1e3 * explained[worst]:.3g} mm (rms). The pose is that of least squares. Check the "
        "readings, and the geometry in the model file"
    )


def _of_solved(
    compute: Callable[[Solutions, Mapping[str, Any]], np.ndarray],
    found: Solutions,
    at: Mapping[str, Any],
    size: int,
) -> np.ndarray:
    covariances = np.full((len(found), size, size), np.nan)
    if (solved := found.solved).any():
        covariances[solved] = compute(found[solved], select_rows(at, solved))
    return covariances


def select_rows(conditions: Mapping[str, Any], rows: np.ndarray) -> dict[str, Any]:
    """Select rows of the conditions that have a value for each row."""
    return {name: value[rows] if np.ndim(value) else value for name, value in conditions.items()}


def _with_covariance(model: Model) -> Kinematics:
    if model.covariance is None:
        raise ModelError("the model file has no covariance: only an identified model has one")
    return Kinematics(model)


def to_rows(
    solutions: Solutions,
    covariances: np.ndarray | None = None,
    explained: np.ndarray | None = None,
) -> list[dict[str, Any]]:
    """Convert solutions, and their covariances and explained residuals if these are known, to
    dictionaries with the keys of the command line's JSON documents."""
    rows: list[dict[str, Any]] = [
        {
            "position": s.position,
            "quaternion": s.quaternion,
            "joints": s.joints,
            "residual": s.residual,
            "status": status_text(s.status),
        }
        for s in solutions
    ]
    for row, s in zip(rows, solutions, strict=True):
        row |= {"passive": s.passive} if s.passive.size else {}
    if covariances is not None:
        for row, covariance in zip(rows, covariances, strict=True):
            row["covariance"] = covariance
    if explained is not None:
        for row, size in zip(rows, explained, strict=True):
            row["explained_residual"] = size
    return rows


def status_text(status: Any) -> str:
    """Name of a status: `converged`, `unreachable`, ..."""
    return Status(int(status)).text
