"""Start values of sensors that show poses, such as cameras: where they stand and what they are.

The readings show poses for each possible set of a sensor's options, such as focal lengths. As with
a pose device, a closed form finds the frames for which these poses are nearest to those that the
robot predicts. The set of options for which they are nearest is the start.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import nearest_rotation, turns_from_mean
from parallel_cal.base.units import MM
from parallel_cal.identification.frames import PosePairs
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import condition_columns
from parallel_cal.identification.thresholds import (
    MIN_DOUBTFUL_SHARE,
    MIN_PLACEMENT_POSES,
    MIN_PLACEMENT_TILT_RAD,
    MIN_UNREGISTERED_ERROR_RATIO,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.model import Model
from parallel_cal.model.sensor import Sensor, View


def place_sensors(model: Model, observations: Observations, insist: bool = False) -> Model:
    """Return the model with start values for those of its sensors that have none.

    FitError if too few samples show a pose, or, unless insisted, if other options of a sensor
    (`variants`) fit much better.
    """
    if all(sensor.is_placed for sensor in model.sensors):
        return model
    joints = observations.x[:, : len(model.joints)]
    reached = Kinematics(model).direct(joints, condition_columns(model, observations))
    channels = np.array(model.structure.channels)
    sensors = []
    for sensor in model.sensors:
        own = np.isin(channels, sensor.channels)
        placed = sensor.is_placed
        sensors.append(
            sensor
            if placed
            else _place(model, sensor, observations.reading[:, own], reached, insist)
        )
    fresh = model.with_sensors(tuple(sensors))
    placed_now = [s.name for s in model.sensors if not s.is_placed]
    started = [name.partition(".")[0] in placed_now for name in fresh.table.names]
    return fresh.with_values(np.where(started, fresh.table.nominal, fresh.values), fresh.covariance)


def _place(
    model: Model, sensor: Sensor, reading: np.ndarray, reached: Solutions, insist: bool
) -> Sensor:
    """Return the sensor with the options and frames for which its poses fit the robot's best."""
    found, shown = _fit_views(model, sensor, reading, reached)
    if not found:
        raise FitError(
            f"{sensor.name}: {shown} of {len(reading)} samples show enough of the board for a "
            f"pose, expected at least {MIN_PLACEMENT_POSES} that the robot can reach: take more "
            "images of the whole board, or state where camera and board are in the model file"
        )
    error, best, there = min(found, key=lambda one: one[0])
    if not insist and error > MIN_DOUBTFUL_SHARE * model.mechanism.length:
        _require_no_better_variant(model, sensor, reading, reached, error)
    frames, usual = there.frames, nearest_rotation(there.R[there.placed].sum(axis=0))
    return best.placed(frames.f, frames.F, frames.t, frames.T, usual)


def _fit_views(
    model: Model, sensor: Sensor, reading: np.ndarray, reached: Solutions
) -> tuple[list[tuple[float, Sensor, PosePairs]], int]:
    """Return the error (m) of each view with enough poses, its sensor and its poses; and how many
    samples show a pose."""
    shown, found = 0, list[tuple[float, Sensor, PosePairs]]()
    for view in sensor.views(reading):
        shown = max(shown, int(view.seen.sum()))
        if (there := _compare(model, view, reached)) is not None:
            error = there.compute_closed_form_error()
            found.append((error, view.sensor, there))
    return found, shown


def _require_no_better_variant(
    model: Model, sensor: Sensor, reading: np.ndarray, reached: Solutions, error: float
) -> None:
    """Raise FitError if options that people mix up fit much better than the stated ones, whose
    error (m) is given."""
    errors = {
        words: min((one[0] for one in _fit_views(model, other, reading, reached)[0]), default=error)
        for words, other in sensor.variants()
    }
    words = min(errors, key=lambda one: errors[one], default="")
    if words and errors[words] * MIN_UNREGISTERED_ERROR_RATIO < error:
        raise FitError(
            f"{sensor.name}: the poses in the images are {error / MM:.3g} mm from those of the "
            f"robot (median). With the options {words} they are {errors[words] / MM:.3g} mm: "
            "correct the sensor in the model file, or pass --force (insist)"
        )


def _compare(model: Model, view: View, reached: Solutions) -> PosePairs | None:
    """Poses of a sensor beside those that the robot predicts; None for too few of them."""
    used = view.seen & reached.solved & np.isfinite(view.r).all(axis=1)
    if used.sum() < MIN_PLACEMENT_POSES:
        return None
    away = turns_from_mean(reached.rotation[used])
    turned = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
    return PosePairs(
        reached.position,
        reached.rotation,
        view.r,
        view.R,
        measured=np.repeat(used[:, None], 6, axis=1),
        length=model.mechanism.length,
        target_is_free=turned > MIN_PLACEMENT_TILT_RAD,
    )
