"""Check whether a sample is plausible: a sample far from the model's prediction indicates a
collision, a slip, or a target that was lost or changed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.campaign.cell import CellError
from parallel_cal.campaign.deviation import compute_way_points, find_deviating_joints
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model
from parallel_cal.planning.expectation import prediction_blocks
from parallel_cal.planning.posepool import Pool
from parallel_cal.recordings.dataset import Dataset

MAX_ERROR_RATIO = 8.0  # times the usual error: noise alone does not exceed it
MAX_TOLERANCE_SIGMAS = 4.0  # sigmas of the error that the tolerances cause
MAX_TARGET_DISTANCE = 2.0  # of the target from the platform's origin, in lengths of the mechanism
ARRIVAL_TOLERANCE = 0.01  # of a joint's range, between the joint and its target
LIMIT_SWITCH_ADVICE = (
    "If it stopped at a limit switch, state that limit (low, high) in the model file and repeat "
    "the command: the campaign goes on within it"
)
LIKELY_CAUSES = "check for a collision, a slip, or a target that was lost or changed"


class ImplausibleSample(CellError):
    """A sample is far from the model's prediction, but not further than the tolerances allow: the
    model may be wrong instead."""


class Checker:
    """Compare samples with a model and its `usual` rms errors by kind (m, rad), empty if not yet
    known."""

    def __init__(self, model: Model, usual: Mapping[str, float]):
        self._model, self._usual = model, usual
        self._usual_applies = True

    @cached_property
    def _robot(self) -> Kinematics:
        return Kinematics(self._model)

    def mark_conditions_changed(self) -> None:
        """Stop comparing with the usual errors: they are not known under the new conditions."""
        self._usual_applies = False

    def check(self, sample: Dataset, sent: np.ndarray, last: Dataset | None) -> None:
        """Check a sample against the commanded joints `sent` (nq,) and the previous sample.

        Raises CellError if a joint is not at its target, or if the platform moved differently than
        the tolerances allow; ImplausibleSample if only the identified model contradicts it."""
        self.check_arrived(sample.q[0], sent)
        if last is not None:
            self._check_moved(sample, last)
        if not (self._usual and self._usual_applies):
            return
        found = errors(self._model, observe(self._model, sample))
        for kind, usual in self._usual.items():
            error = float(found.norms(kind)[0])
            if error > MAX_ERROR_RATIO * usual:
                unit, factor = ERROR_UNITS[kind]
                raise ImplausibleSample(
                    f"the {kind} is {factor * error:.3g} {unit} from the model's prediction, "
                    f"{error / usual:.0f} times the usual error ({factor * usual:.3g} {unit}): "
                    f"{LIKELY_CAUSES}"
                )

    def is_same_pose(self, one: Dataset, other: Dataset) -> bool:
        """Whether two samples (1,) agree within the usual errors."""
        (r, R), (other_r, other_R) = self._get_shown_pose(one), self._get_shown_pose(other)
        distance = {
            "position": float(np.linalg.norm(r - other_r)),
            "orientation": _angle(R, other_R),
        }
        return all(distance[kind] <= MAX_ERROR_RATIO * usual for kind, usual in self._usual.items())

    def _get_shown_pose(self, sample: Dataset) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) and rotation (3, 3) that a device measured, or that images show."""
        if sample.measured.any():
            return sample.r[0], sample.R[0]
        found = errors(self._model, observe(self._model, sample))
        reached = self._robot.direct(sample.q)
        turn = rotation_matrix(np.nan_to_num(found.orientation[0]))
        return reached.position[0] + found.position[0], turn @ reached.rotation[0]

    def check_arrived(
        self, q: np.ndarray, sent: np.ndarray, path: Sequence[np.ndarray] = ()
    ) -> None:
        """Raise CellError unless joints (nq,) are at their targets.

        If the drives stopped all joints because of one, the `path` (stops from the start on) tells
        which one: the others are at a common point of it."""
        m, deviation = self._model.mechanism, self._compute_joint_deviation(q, sent)
        away = np.flatnonzero(deviation > ARRIVAL_TOLERANCE)
        if not len(away):
            return
        blamed = away[np.argsort(-deviation[away], kind="stable")].tolist()
        if len(path) > 1 and len(away) > 1:
            way = compute_way_points(np.array(path))
            found = find_deviating_joints(q, way, np.asarray(m.joint_ranges))
            blamed = [i for i in found if i in blamed] or blamed
        words = "; ".join(
            f"{m.joints[i]} was sent to {sent[i]:.4f} {m.joint_units[i]} but is at {q[i]:.4f}"
            for i in blamed
        )
        others = " and ".join(m.joints[i] for i in away if i not in blamed)
        stopped = f" ({others} stopped with it)" if others else ""
        raise CellError(
            f"{words}{stopped}: the joint does not move, its encoder is stuck, or an obstacle "
            f"blocks it. {LIMIT_SWITCH_ADVICE}"
        )

    def has_arrived(self, q: np.ndarray, sent: np.ndarray) -> bool:
        """Whether joints (nq,) are at their targets."""
        return bool((self._compute_joint_deviation(q, sent) < ARRIVAL_TOLERANCE).all())

    def _compute_joint_deviation(self, q: np.ndarray, sent: np.ndarray) -> np.ndarray:
        """Return the distance of joints (nq,) from their targets, as fractions of their ranges."""
        return np.asarray(np.abs(q - sent) / self._model.mechanism.joint_ranges)

    def _check_moved(self, sample: Dataset, last: Dataset) -> None:
        """Compare how far the platform moved since the previous sample with the model's
        prediction; distances and angles need no registration of the measuring device.

        What does not move in the model is not compared: in reality it moves a little. The target
        may be anywhere on a platform that turns, until a registration determines its place.
        """
        reached, m = self._robot.direct(np.vstack([last.q, sample.q])), self._model.mechanism
        if not reached.solved.all():
            return
        allowed, both = self._tolerance_errors, sample.measured[0] & last.measured[0]
        turned = _angle(sample.R[0], last.R[0]) if both[3:].all() else math.nan
        expected = _angle(reached.rotation[1], reached.rotation[0])
        if max(m.moved) >= 3 and abs(turned - expected) > (
            MAX_TOLERANCE_SIGMAS * allowed["orientation"]
        ):
            raise CellError(
                f"the platform should have turned by {np.degrees(expected):.2f} degrees but "
                f"turned by {np.degrees(turned):.2f}; the tolerances do not allow this "
                f"difference: {LIKELY_CAUSES}"
            )
        if min(m.moved) < 3 and both[:3].all():
            by_target = MAX_TARGET_DISTANCE * m.length * expected
            moved = float(np.linalg.norm(sample.r[0] - last.r[0]))
            expected = float(np.linalg.norm(reached.position[1] - reached.position[0]))
            if abs(moved - expected) > MAX_TOLERANCE_SIGMAS * allowed["position"] + by_target:
                raise CellError(
                    f"the platform should have moved {1e3 * expected:.2f} mm but moved "
                    f"{1e3 * moved:.2f} mm; the tolerances do not allow this difference: "
                    f"{LIKELY_CAUSES}"
                )

    @cached_property
    def _tolerance_errors(self) -> dict[str, float]:
        """Rms pose errors (m, rad) at home of robots with parameter errors of one tolerance."""
        model = self._model
        home = self._robot.direct(np.array([model.mechanism.home.joints]))
        pool = Pool(home, np.zeros((1, 1), int), model.condition_rows(None, 1), None)
        free = ~np.asarray(model.fixed)
        measured = np.ones(len(model.structure.scale), bool)
        G = prediction_blocks(model, free, measured, pool)[0] * model.table.tolerance[free]
        size = np.sqrt(np.sum(G**2, axis=1))
        return {
            "position": float(np.linalg.norm(size[:3])),
            "orientation": float(np.linalg.norm(size[3:])) / model.mechanism.length,
        }


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(rotation_vector(one @ other.T)))
