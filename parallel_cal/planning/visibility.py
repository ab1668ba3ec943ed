"""Which poses the sensors that show poses, such as cameras, can see, and what they read there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.model.model import Model
from parallel_cal.model.sensor import Sensor

MIN_VISIBLE_SHARE = 0.5  # of the corners of a board: a pose with fewer tells little

# What one image of a board at 0.6 m tells about a pose, along the axis of the camera: before the
# first samples, no camera has a place, and the plan assumes a device that measures poses.
IMAGE_POSITION_SIGMA_M, IMAGE_ORIENTATION_SIGMA_RAD = 0.2e-3, 1e-3


def list_planned_sensors(model: Model) -> list[Sensor]:
    """List the sensors whose readings a plan counts: those that show poses and have a place."""
    return [sensor for sensor in model.sensors if sensor.shows_pose and sensor.is_placed]


def stand_in_pose_device(model: Model) -> Model:
    """Replace sensors that show poses, but have no place yet, by a device that measures poses."""
    if list_planned_sensors(model) or not any(sensor.shows_pose for sensor in model.sensors):
        return model
    noise = replace(
        model.noise, position=IMAGE_POSITION_SIGMA_M, orientation=IMAGE_ORIENTATION_SIGMA_RAD
    )
    others = tuple(sensor for sensor in model.sensors if not sensor.shows_pose)
    return replace(model.with_sensors(others), noise=noise)


def predict_shown_readings(model: Model, x: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Predict the readings (N, n_channels) at configurations x (N, nq+12).

    They are NaN where a sensor sees nothing, and for all sensors that do not show poses: contact
    constrains the poses of these.
    """
    channels = np.array(model.structure.channels)
    reading = np.full((len(x), len(channels)), np.nan)
    planned = list_planned_sensors(model)
    if not planned:
        return reading
    rows = model.structure.residuals(x, a, model.values)[0]
    predicted = rows[:, rows.shape[1] - len(channels) :]
    for sensor in planned:
        own = np.isin(channels, sensor.channels)
        visible = sensor.find_visible(predicted[:, own])
        reading[:, own] = np.where(visible, predicted[:, own], np.nan)
    return reading


def find_seen_poses(model: Model, poses: Solutions) -> np.ndarray:
    """Return the mask (N,) of the poses at which some sensor sees enough of its board; all of them
    if the model has no placed sensor that shows poses."""
    planned = list_planned_sensors(model)
    if not planned:
        return np.ones(len(poses), dtype=bool)
    x = poses.configuration.rows
    reading = predict_shown_readings(model, x, model.condition_rows(None, len(poses)))
    channels = np.array(model.structure.channels)
    shares = [
        np.isfinite(reading[:, np.isin(channels, sensor.channels)]).mean(axis=1)
        for sensor in planned
    ]
    return np.asarray(np.max(shares, axis=0) >= MIN_VISIBLE_SHARE)
