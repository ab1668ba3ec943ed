"""Until when a calibration can be trusted, by the drift of the robot or of its fleet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.drift_rate import DriftRate
from parallel_cal.identification.linearisation import follow_closure
from parallel_cal.identification.update import list_drift_parts
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

PROBABILITY = 0.95
# Without a stated limit: at this factor the drift is as large as the error of the calibration.
USUAL_FACTOR = 2**0.5
KINDS = ("position", "orientation")
PLACES, DRAWS = 60, 4000  # poses in the workspace, and draws of the drift
RESOLUTION = 1 / 1024  # of the time that the sessions span
UNKNOWN = "unknown: no second calibration"
OUTDATED = "unknown: the model was fitted again since its drift was estimated"


@dataclass(frozen=True)
class Trust:
    """Until when (s since 1970) one kind of error stays within a `limit` with `PROBABILITY`, SI.

    `error` is the rms validation error. `is_seen` is False if the end is that of the time over
    which a drift was seen: later is not known. `until` is the time of the calibration if the next
    session is already likely to be beyond the limit."""

    kind: str
    error: float
    limit: float
    until: float
    is_seen: bool


@dataclass(frozen=True)
class Age:
    """What a model says about its age: when it was `calibrated` (s since 1970), and until when each
    kind of error can be trusted; or why this is `unknown`."""

    calibrated: float | None = None
    trusts: tuple[Trust, ...] = ()
    rate: DriftRate | None = field(default=None, repr=False)
    unknown: str = ""

    @property
    def until(self) -> float | None:
        """The earliest end (s since 1970); None if it is not known."""
        return min((one.until for one in self.trusts), default=None)

    def entry(self) -> dict[str, Any]:
        """The entry of the history of a model. It needs a known age."""
        assert self.rate is not None
        return {
            "step": "drift",
            "calibrated": self.calibrated,
            "trusted": [vars(one) for one in self.trusts],
            "probability": PROBABILITY,
            **self.rate.document(),
        }

    @classmethod
    def of_model(cls, model: Model) -> Age:
        """Read what the history of a model states; FitError if it cannot be read."""
        for entry in reversed(model.history):
            if entry.get("step") == "drift":
                try:
                    trusts = tuple(Trust(**one) for one in entry["trusted"])
                    calibrated = float(entry["calibrated"])
                    _check_times(calibrated, [one.until for one in trusts])
                except (KeyError, TypeError, ValueError) as error:
                    raise FitError(
                        f"the age in the history of a model cannot be read ({error}): estimate it "
                        "again with parallel-cal drift"
                    ) from None
                return cls(calibrated, trusts, DriftRate.from_document(entry))
            if "dataset" in entry:
                stated = any(one.get("step") == "drift" for one in model.history)
                return cls(unknown=OUTDATED if stated else UNKNOWN)
        return cls(unknown=UNKNOWN)


def _check_times(calibrated: float, ends: Sequence[float]) -> None:
    for end in ends:
        if not calibrated <= end < np.inf:
            raise ValueError(f"trusted until {end}, calibrated at {calibrated}")


@dataclass(frozen=True)
class Calibration:
    """The last fit of a model: the `hashes` of its recordings, and its rms validation `errors` (m,
    rad) by kind."""

    hashes: frozenset[str]
    errors: Mapping[str, float]


def find_calibration(model: Model) -> Calibration:
    """Find the last fit in the history of a model that has a validation error.

    FitError if there is none, or if the last fit has none."""
    for entry in reversed(model.history):
        if "dataset" not in entry:
            continue
        held_out = (entry.get("held_out") or {}).get("after") or {}
        errors = {kind: held_out.get(f"{kind}_rms") for kind in KINDS}
        dataset = entry["dataset"]
        hashes = frozenset(dataset.get("recordings") or [dataset.get("sha256", "")])
        return Calibration(hashes, {k: v for k, v in errors.items() if v})
    raise FitError("the model was never fitted: calibrate it first, then estimate its drift")


def predict_age(
    model: Model,
    rate: DriftRate,
    calibrated: float,
    errors: Mapping[str, float],
    limits: Mapping[str, float] | None = None,
) -> Age:
    """Predict until when a calibration can be trusted.

    After a time t, the mean square of the error is e^2 + u^T M u: e is the validation error, u the
    drift of the parameters, and M the mean of J^T J over poses of the workspace (J: the pose by the
    parameters). u is normal, and its parts have the sizes of `rate`. The end is the last t at which
    the error is within its limit with `PROBABILITY`, at most the time that the sessions span:
    growth that nobody has seen is not extrapolated.

    Parameters
    ----------
    model : Model
        The calibrated robot.
    rate : DriftRate
    calibrated : float
        When its recording was made, s since 1970.
    errors : mapping of str to float
        Rms validation errors, `position` (m) and `orientation` (rad).
    limits : mapping of str to float, optional
        Limits of these. Default: `USUAL_FACTOR` times each error.

    Returns
    -------
    Age

    Raises
    ------
    FitError
        If no validation error is known, or a limit is below its error.
    """
    known = {kind: errors[kind] for kind in KINDS if errors.get(kind)}
    limits = limits or {kind: USUAL_FACTOR * error for kind, error in known.items()}
    if missing := set(limits) - set(known):
        raise FitError(f"the model states no validation error of the {' and '.join(missing)}")
    if not limits:
        raise FitError("the model states no validation error: fit it with held-out poses first")
    rng = np.random.default_rng(0)
    squares = draw_squares(model, rng)
    growths, scales = rate.draw(DRAWS, rng)
    found = []
    for kind, limit in limits.items():
        if limit <= known[kind]:
            raise FitError(
                f"the limit of the {kind} error, {limit:.4g}, is not above the validation error, "
                f"{known[kind]:.4g} (m or rad): the calibration does not hold it today"
            )
        room = limit**2 - known[kind] ** 2

        def holds(t: float, kind: str = kind, room: float = room) -> bool:
            """Whether the error is within its limit after t spans."""
            size = scales * t**growths
            q = np.einsum("sa,sab,sb->s", size, squares[kind], size)
            return bool(np.mean(q <= room) >= PROBABILITY)

        last = 1.0 if holds(1.0) else _find_last(holds)
        found.append(
            Trust(kind, known[kind], limit, calibrated + last * rate.span, is_seen=last < 1)
        )
    return Age(calibrated, tuple(found), rate)


def _find_last(holds: Callable[[float], bool]) -> float:
    """Find the last t between 0 and 1 at which a condition holds that fails from some t on."""
    low, high = 0.0, 1.0
    while high - low > RESOLUTION:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def draw_squares(model: Model, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw u_a^T M u_b (DRAWS, 4, 4) of the usual drifts u of the parts, for position (m^2) and
    orientation (rad^2)."""
    robot = model.robot()
    r, R = poses_in_workspace(robot.mechanism, PLACES, np.random.default_rng(0))
    poses = Kinematics(robot).inverse(r, R)
    rows = poses.configuration.rows[np.flatnonzero(poses.ok)]
    if not len(rows):
        raise FitError("the robot reaches no pose of its workspace")
    C, J = robot.structure.jacobians(rows, robot.condition_rows(None, len(rows)), robot.values)
    by = np.zeros((len(rows), 6, J.shape[2]))
    by[:, robot.mechanism.moved], _ = follow_closure(robot, C, J)
    # Errors of the measuring device do not move the robot.
    device = [effect.name for effect in robot.effects if effect.of_device]
    own = np.array([name.split(".")[0] not in device for name in robot.table.names])
    drawn = [
        rng.standard_normal((DRAWS, len(one))) @ (one * own)
        for one in list_drift_parts(model).values()
    ]
    found = {}
    for kind, part in zip(KINDS, (by[:, :3], by[:, 3:]), strict=True):
        flat = part.reshape(-1, part.shape[2])
        change = np.array([one @ flat.T for one in drawn])
        found[kind] = np.einsum("asx,bsx->sab", change, change) / len(rows)
    return found
