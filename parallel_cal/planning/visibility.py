"""Which poses the sensors can read: images of a board, contacts, and what reads everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.model.model import Model
from parallel_cal.model.sensor import Sensor

IN_CONTACT_M = 1e-8  # readings of a contact that is made

MIN_VISIBLE_SHARE = 0.5  # of the corners of a board: a pose with fewer tells little

# What one image of a board at 0.6 m tells about a pose, along the axis of the camera: before the
# first samples, no camera has a place, and the plan assumes a device that measures poses.
IMAGE_POSITION_SIGMA_M, IMAGE_ORIENTATION_SIGMA_RAD = 0.2e-3, 1e-3


def list_planned_sensors(model: Model) -> list[Sensor]:
    """List the sensors whose readings a plan counts: those that show poses and have a place, those
    with contacts, and those that read wherever the robot moves."""
    return [
        sensor
        for sensor in model.sensors
        if sensor.contacts or sensor.reads_always or (sensor.shows_pose and sensor.is_placed)
    ]


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

    They are NaN where a sensor sees nothing, in contacts that are not made, and for sensors of
    which a plan cannot know whether they read.
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
        if sensor.contacts:
            visible = np.zeros(visible.shape, dtype=bool)
            for held in sensor.contacts.values():
                columns = np.isin(sensor.channels, held)
                made = np.abs(predicted[:, own][:, columns]).max(axis=1) < IN_CONTACT_M
                visible[:, columns] = made[:, None]
        reading[:, own] = np.where(visible, predicted[:, own], np.nan)
    return reading


def find_seen_poses(model: Model, poses: Solutions) -> np.ndarray:
    """Return the mask (N,) of the poses at which some sensor reads enough: most of a board, or a
    contact; all of them if the model has no placed sensor that shows poses and no contact."""
    planned = [s for s in list_planned_sensors(model) if s.shows_pose or s.contacts]
    if not planned:
        return np.ones(len(poses), dtype=bool)
    x = poses.configuration.rows
    reading = predict_shown_readings(model, x, model.condition_rows(None, len(poses)))
    channels = np.array(model.structure.channels)
    shares = [
        np.isfinite(reading[:, np.isin(channels, held)]).mean(axis=1)
        for sensor in planned
        for held in (sensor.contacts.values() or [sensor.channels])
    ]
    return np.asarray(np.max(shares, axis=0) >= MIN_VISIBLE_SHARE)
