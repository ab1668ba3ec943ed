"""Parse the inputs and format the outputs of forward and inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError, SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solutions import MAX_CLOSED_RESIDUAL_M
from parallel_cal.model.effect import CONDITIONS, parse_lag, parse_part
from parallel_cal.model.mechanism import POSE, Mechanism
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


# m or rad; more than the rounding of a pose that the command line printed.
MAX_ROUNDED = 1e-6
KINDS = {"position": POSE[:3], "orientation": POSE[3:]}


@dataclass(frozen=True)
class Differences:
    """How far the solutions of an inverse problem are from the given poses, in coordinates that the
    robot does not control: the distances of the positions (N,) m, and the angles between the
    orientations (N,) rad; NaN for a sample without a solution. None of what was not given."""

    position: np.ndarray | None
    orientation: np.ndarray | None

    @classmethod
    def of(cls, found: Solutions, r: np.ndarray | None, R: np.ndarray | None) -> Differences:
        """Compare solutions with positions (3,) or (N, 3), and rotations (3, 3) or (N, 3, 3)."""
        r_, R_ = np.zeros(3) if r is None else r, np.eye(3) if R is None else R
        position, orientation = (
            np.atleast_1d(np.where(found.solved, size, np.nan))
            for size in found.distance_from(r_, R_)
        )
        return cls(None if r is None else position, None if R is None else orientation)

    @property
    def first(self) -> Differences:
        """Those of the first solution alone."""
        r, R = self.position, self.orientation
        return Differences(None if r is None else r[:1], None if R is None else R[:1])

    def uncontrolled(self, mechanism: Mechanism) -> dict[str, np.ndarray]:
        """Return the differences of a kind, `position` or `orientation`, of which the robot does
        not control every coordinate."""
        kinds = {"position": self.position, "orientation": self.orientation}
        return {
            kind: size
            for kind, size in kinds.items()
            if size is not None and not {*KINDS[kind]} <= {*mechanism.controls}
        }

    def describe(self, mechanism: Mechanism) -> Iterator[str]:
        """Describe what the solutions do not meet, a sentence for position and orientation each."""
        units = {"position": (1e3, "mm"), "orientation": (1 / DEGREE, "deg")}
        for kind, size in self.uncontrolled(mechanism).items():
            (factor, unit), names = units[kind], KINDS[kind]
            free = [name for name in names if name not in mechanism.controls]
            with np.errstate(invalid="ignore"):
                off = np.flatnonzero(size > MAX_ROUNDED)
            if not len(off):
                continue
            which = " ".join(free) if len(free) < len(names) else f"its {kind}"
            worst = int(off[np.argmax(size[off])])
            row = f" in {len(off)} of {len(size)} rows, most in row {worst + 1}:"
            yield (
                f"{mechanism.name} does not control {which}:{row if len(size) > 1 else ''} the "
                f"solution is {factor * size[worst]:.4g} {unit} from the given {kind}"
            )


def describe_missed(mechanism: Mechanism, found: Solutions, r: np.ndarray, R: np.ndarray) -> str:
    """Describe how far a solution is from a target that needs numbers for all of a pose.

    A position or an orientation of which the robot controls nothing is not compared: any one stands
    for none there.
    """
    turned = {i >= 3 for i in mechanism.controlled}
    apart = Differences.of(found, r if False in turned else None, R if True in turned else None)
    return "; ".join(apart.describe(mechanism))


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
    differences: Differences | None = None,
) -> list[dict[str, Any]]:
    """Convert solutions, and their covariances, explained residuals and differences if these are
    known, to dictionaries with the keys of the command line's JSON documents."""
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
    for kind, sizes in () if differences is None else vars(differences).items():
        for row, size in zip(rows, () if sizes is None else sizes, strict=sizes is not None):
            row[f"{kind}_difference"] = size
    return rows


def status_text(status: Any) -> str:
    """Name of a status: `converged`, `unreachable`, ..."""
    return Status(int(status)).text
