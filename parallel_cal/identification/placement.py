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
from parallel_cal.identification.predictions import reach
from parallel_cal.identification.thresholds import (
    MIN_DOUBTFUL_SHARE,
    MIN_FRAME_POSES,
    MIN_PLACEMENT_TILT_RAD,
    MIN_UNREGISTERED_ERROR_RATIO,
)
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.model import Model
from parallel_cal.model.sensor import Sensor


def place_sensors(model: Model, observations: Observations, insist: bool = False) -> Model:
    """Return the model with start values for those of its sensors that have none.

    FitError if too few samples show a pose, or, unless insisted, if other options of a sensor
    (`variants`) fit much better.
    """
    started = {sensor.name for sensor in model.sensors if not sensor.is_placed}
    if not started:
        return model
    reached = reach(model, observations)
    channels = np.array(model.structure.channels)
    sensors = []
    for sensor in model.sensors:
        reading = observations.reading[:, np.isin(channels, sensor.channels)]
        new = sensor.name in started
        sensors.append(_place(model, sensor, reading, reached, insist) if new else sensor)
    fresh = model.with_sensors(tuple(sensors))
    own = [name.partition(".")[0] in started for name in fresh.table.names]
    return fresh.with_values(np.where(own, fresh.table.nominal, fresh.values), fresh.covariance)


def _place(
    model: Model, sensor: Sensor, reading: np.ndarray, reached: Solutions, insist: bool
) -> Sensor:
    """Return the sensor with the options and frames for which its poses fit the robot's best."""
    found = _fit_views(model, sensor, reading, reached)
    if not found:
        shown = max((int(view.seen.sum()) for view in sensor.views(reading)), default=0)
        raise FitError(
            f"{sensor.name}: {shown} of {len(reading)} samples show enough of the board for a "
            f"pose, expected at least {MIN_FRAME_POSES} that the robot can reach: take more "
            "images of the whole board, or state where camera and board are in the model file"
        )
    error, best, there = min(found, key=lambda one: one[0])
    if not insist and error > MIN_DOUBTFUL_SHARE * model.mechanism.length:
        left, words = min(
            (
                (one[0], words)
                for words, other in sensor.variants()
                for one in _fit_views(model, other, reading, reached)
            ),
            default=(error, ""),
        )
        if left * MIN_UNREGISTERED_ERROR_RATIO < error:
            raise FitError(
                f"{sensor.name}: the poses in the images are {error / MM:.3g} mm from those of the "
                f"robot (median). With the options {words} they are {left / MM:.3g} mm: correct "
                "the sensor in the model file, or pass --force (insist)"
            )
    frames, usual = there.frames, nearest_rotation(there.R[there.placed].sum(axis=0))
    return best.placed(frames.f, frames.F, frames.t, frames.T, usual)


def _fit_views(
    model: Model, sensor: Sensor, reading: np.ndarray, reached: Solutions
) -> list[tuple[float, Sensor, PosePairs]]:
    """Return the error (m) of each view with enough poses, its sensor, and its poses beside those
    that the robot predicts."""
    found = []
    for view in sensor.views(reading):
        used = view.seen & reached.solved & np.isfinite(view.r).all(axis=1)
        if used.sum() < MIN_FRAME_POSES:
            continue
        away = turns_from_mean(reached.rotation[used])
        turned = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        there = PosePairs(
            reached.position,
            reached.rotation,
            view.r,
            view.R,
            measured=np.repeat(used[:, None], 6, axis=1),
            length=model.mechanism.length,
            target_is_free=turned > MIN_PLACEMENT_TILT_RAD,
        )
        found.append((there.compute_closed_form_error(), view.sensor, there))
    return found
