"""Predict what the device shows at the measured joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from parallel_cal.identification.observations import Observations
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model


def apply_pose_device(model: Model, solutions: Solutions) -> Solutions:
    """Poses of {P} in {B} as the model's pose device shows them."""
    pose = solutions.configuration.rows[:, len(model.joints) :]
    r, R9 = model.structure.to_device(pose, model.values)
    return replace(solutions, position=r, rotation=R9.reshape(-1, 3, 3))


def condition_columns(model: Model, observations: Observations) -> dict[str, Any]:
    return {name: observations.a[:, k] for k, name in enumerate(model.conditions)}


def predict_configurations(model: Model, observations: Observations) -> np.ndarray:
    """Configurations (N, nq+12) with the predicted pose as the device shows it; the measured pose
    if forward kinematics has no solution."""
    n = len(model.joints)
    joints = observations.x[:, :n]
    pose = apply_pose_device(
        model, Kinematics(model).direct(joints, condition_columns(model, observations))
    )
    x = Configuration(joints, pose.position, pose.rotation).rows
    return np.where(np.isfinite(x).all(axis=1)[:, None], x, observations.x)


def predict_positions(model: Model, observations: Observations) -> np.ndarray:
    """Positions (N, 3) of {P} in {B} at the joint readings, NaN if there is no solution.

    They do not depend on what was measured, and where the device stands.
    """
    joints = observations.x[:, : len(model.joints)]
    at = condition_columns(model, observations)
    return np.asarray(Kinematics(model).direct(joints, at).position)


def reading_residuals(model: Model, observations: Observations, x: np.ndarray) -> np.ndarray:
    """Sensor readings minus predictions at x (N, nq+12): (N, n_channels) m, NaN if not read."""
    if not model.structure.channels:
        return np.empty((len(observations), 0))
    rows = model.structure.residuals(x, observations.a, model.values)[0]
    return np.asarray(observations.reading - rows[:, model.structure.phi.shape[0] :])
