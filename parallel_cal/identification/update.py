"""Update a calibration: the result of the last one, and the usual drift since, are the prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.drift_rate import PARTS, DriftRate
from parallel_cal.identification.prior import Prior
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import load_effect

# Usual drift between two calibrations, 1 sigma. Zeros drift as reference switches repeat: the
# tolerance of the effect zero_shift. Lengths grow with the workshop's temperature: steel and
# aluminium expand by 12e-6 and 23e-6 per degC (ISO 1 refers lengths to 20 degC).
EXPANSION_PER_DEGC = 12e-6
TEMPERATURE_SIGMA_DEGC = 5.0
LOOSENING_SHARE = 0.1  # of a tolerance, for each parameter: a joint that settled, a rod that turned
SHOWN_SIGMAS = 3.0  # a drift of one sigma that moves the touches by so much is shown
PROBE_POSES = 40
RIDGE = 1e-6  # of the largest singular value, columns in tolerances
ESTIMATED_NOISE = "estimated_noise"  # of the fit, in the history of a model


@dataclass(frozen=True)
class RecalledNoise(Noise):
    """Noise that the last calibration estimated, beside what is `stated`."""

    stated: Noise = field(default_factory=Noise)

    @property
    def as_stated(self) -> Noise:
        return self.stated


def recall_noise(model: Model) -> Model:
    """The model with the noise that its last calibration estimated, where none is stated: that of
    few samples is hardly known, and the error of a robot that drifted would be counted as noise."""
    own = model.noise
    entry = next((one for one in reversed(model.history) if one.get(ESTIMATED_NOISE)), None)
    if entry is None or own.assumed:
        return model
    known = entry[ESTIMATED_NOISE]
    joint = own.joint if own.joint is not None else known.get("joint")
    if isinstance(joint, Mapping):
        joint = {**known.get("joint", {}), **joint}
    position = own.position or known.get("position")
    orientation = own.orientation or known.get("orientation")
    return replace(model, noise=RecalledNoise(joint, position, orientation, stated=own))


@dataclass(frozen=True)
class Culprit:
    """A usual drift: its name, the change (n_parameters,) of the parameters by one sigma, and this
    sigma in a `unit` (m, rad or K)."""

    name: str
    change: np.ndarray
    size: float
    unit: str


def list_culprits(model: Model) -> list[Culprit]:
    """List the usual drifts of a robot: the zero of each joint, and warm lengths.

    They are as large as the history of the model states for this robot or its fleet, if it does."""
    sizes, rows = _read_sizes(model), list_drift_parts(model)
    rate, warm = sizes["zeros"], sizes["temperature"]
    shown = zip(
        model.joints,
        rows["zeros"],
        _list_zero_sizes(model),
        model.mechanism.joint_units,
        strict=True,
    )
    return [
        *(
            Culprit(f"zero of {j}", rate * shift, rate * size, unit)
            for j, shift, size, unit in shown
        ),
        Culprit("temperature", warm * rows["temperature"][0], warm * TEMPERATURE_SIGMA_DEGC, "K"),
    ]


def _read_sizes(model: Model) -> dict[str, float]:
    """The size of each part of the usual drift that the history of a model states; 1 if none."""
    rate = DriftRate.of_model(model)
    return dict.fromkeys(PARTS, 1.0) if rate is None else rate.quantile(0.5)


def list_drift_parts(model: Model) -> dict[str, np.ndarray]:
    """List the parts of the usual drift: for each of `PARTS` independent changes (k, n_parameters),
    SI, by one sigma. Measuring set-ups and fixed parameters do not loosen."""
    table = model.table
    in_m = np.array([p.unit == "m" for p in table])
    geometry = np.array([p.group not in ("effect", "sensor") for p in table])
    growth = EXPANSION_PER_DEGC * TEMPERATURE_SIGMA_DEGC
    loose = list_robot_parameters(model) & ~np.asarray(model.fixed)
    settled = np.diag(LOOSENING_SHARE * table.tolerance)
    return {
        "zeros": _list_zero_sizes(model)[:, None] * _express_joint_shifts(model),
        "temperature": np.where(in_m & geometry, growth * model.values, 0.0)[None],
        "lengths": settled[loose & in_m],
        "others": settled[loose & ~in_m],
    }


def _list_zero_sizes(model: Model) -> np.ndarray:
    """List by how much the zero of each joint (nq,) usually drifts, rad or m."""
    zero = load_effect("zero_shift").table(model.mechanism)
    return np.array([zero[f"zero_shift.{joint}.since1"].tolerance for joint in model.joints])


def list_robot_parameters(model: Model) -> np.ndarray:
    """Return which parameters (n_parameters,) belong to the robot, not to a measuring set-up."""
    return np.array([p.group != "sensor" for p in model.table])


def _express_joint_shifts(model: Model) -> np.ndarray:
    """Return the changes (nq, n_parameters) of the geometry that act as a unit shift of each joint
    reading, as well as parameters can."""
    from parallel_cal.kinematics.kinematics import Kinematics

    r, R = poses_in_workspace(model.mechanism, PROBE_POSES, np.random.default_rng(0))
    poses = Kinematics(model).inverse(r, R)
    poses = poses[np.flatnonzero(poses.ok)]
    s, table = model.structure, model.table
    J_x, J_v = s.jacobians(
        poses.configuration.rows, model.condition_rows(None, len(poses)), model.values
    )
    geometry = np.array([p.group not in ("effect", "sensor") for p in table])
    tolerance = np.where(geometry, table.tolerance, 0.0)
    columns = (J_v * tolerance).reshape(-1, len(table))
    n = len(model.joints)
    wanted = J_x[:, :, :n].reshape(-1, n)
    return np.asarray((np.linalg.lstsq(columns, wanted, rcond=RIDGE)[0].T) * tolerance)


def update_prior(model: Model, scale: float = 1.0) -> Prior:
    """Return the knowledge of today: the last calibration, widened by `scale` times the usual
    drift. Parts of a measuring set-up stand somewhere else every day, and an effect may be new: of
    these only what is known before any data counts.

    Raises
    ------
    FitError
        If the model has no covariance from an earlier fit.
    """
    if model.covariance is None or not np.diag(model.covariance).any():
        raise FitError(
            "--update starts from the last calibration, but the model has no covariance of one: "
            "fit it without --update first, and give the written model"
        )
    table = model.table
    last = Prior.from_model(model).covariance
    never_fitted = np.array([p.group == "effect" for p in table]) & ~model.covariance.any(axis=1)
    unknown = ~list_robot_parameters(model) | never_fitted
    last[unknown] = 0.0
    last[:, unknown] = 0.0
    last[unknown, unknown] = table.prior_sigma[unknown] ** 2
    return Prior(table.names, model.values, last + scale**2 * usual_drift(model))


def usual_drift(model: Model) -> np.ndarray:
    """Return the covariance (n_parameters, n_parameters) of the usual drift, SI, of all parts: of
    this robot or its fleet, if the history of the model states it."""
    sizes, parts = _read_sizes(model), list_drift_parts(model).items()
    return np.asarray(sum(sizes[part] ** 2 * rows.T @ rows for part, rows in parts))
