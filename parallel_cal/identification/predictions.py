"""Predict what the device shows at the measured joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.identification.observations import Observations
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.solutions import replace_rows
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model

MAX_BRANCH_TURN_RAD = 1.0  # a pose that is predicted further away is on another branch


def apply_pose_device(model: Model, solutions: Solutions) -> Solutions:
    """Poses of {P} in {B} as the model's pose device shows them."""
    n = len(model.joints)
    pose = solutions.configuration.rows[:, n : n + 12]
    r, R9 = model.structure.to_device(pose, model.values)
    return replace(solutions, position=r, rotation=R9.reshape(-1, 3, 3))


def axes_of_device(model: Model) -> np.ndarray:
    """The axes of the device in {B}, as columns (3, 3)."""
    rows = np.hstack([np.vstack([np.zeros(3), np.eye(3)]), np.tile(np.eye(3).ravel(), (4, 1))])
    places = np.asarray(model.structure.to_base(rows, model.values)[0])
    return (places[1:] - places[0]).T


def condition_columns(model: Model, observations: Observations) -> dict[str, Any]:
    return {name: observations.a[:, k] for k, name in enumerate(model.conditions)}


def predict_poses(model: Model, observations: Observations) -> tuple[Solutions, Solutions]:
    """Predict the poses at the measured joints in {B}, and as the pose device shows them, on the
    branch on which the robot was measured."""
    n, at = len(model.joints), condition_columns(model, observations)
    kinematics, seen = Kinematics(model), model.configuration(observations.x)
    reached = kinematics.direct(seen.q, at)
    pose = apply_pose_device(model, reached)
    turned = observations.measured[:, n + 3 : n + 6].all(axis=1)
    angle = np.linalg.norm(turns_between(seen.R, pose.rotation), axis=1)
    if (away := turned & (angle > MAX_BRANCH_TURN_RAD)).any():
        reached = _follow_measured_branch(kinematics, observations, reached, np.flatnonzero(away))
        pose = apply_pose_device(model, reached)
    return reached, pose


def turns_between(R: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rotation vectors (N, 3) from other rotations to R; unknown ones count as the identity."""
    known = np.where(np.isfinite(other), other, np.eye(3))
    return rotation_vector(R @ known.transpose(0, 2, 1))


def _follow_measured_branch(
    kinematics: Kinematics, observations: Observations, reached: Solutions, away: np.ndarray
) -> Solutions:
    """Solve samples (indices) that were predicted on another branch again, from the measured pose:
    the robot was there. A solution that is not nearer to it is not taken."""
    model, some = kinematics.model, observations.select(away)
    n, home = len(model.joints), np.array(model.mechanism.home.position)
    position, turned = model.structure.to_base(some.x[:, n : n + 12], model.values)
    placed = np.asarray(some.measured[:, n : n + 3].all(axis=1))
    start = replace(
        reached[away],
        position=np.where(placed[:, None], position, home),
        rotation=turned.reshape(-1, 3, 3),
    )
    at = condition_columns(model, some)
    again = kinematics.direct(some.x[:, :n], at, start, keep_branch=True)
    turn = turns_between(start.rotation, again.rotation)
    better = again.solved & (np.linalg.norm(turn, axis=1) < MAX_BRANCH_TURN_RAD)
    return replace_rows(reached, away[better], again[better])


def predict_configurations(model: Model, observations: Observations) -> np.ndarray:
    """Configurations (N, nq+12+nu) with the predicted pose as the device shows it; the measured
    pose if forward kinematics has no solution."""
    _, pose = predict_poses(model, observations)
    joints = observations.x[:, : len(model.joints)]
    x = Configuration(joints, pose.position, pose.rotation, pose.passive).rows
    return np.where(np.isfinite(x).all(axis=1)[:, None], x, observations.x)


def reach(model: Model, observations: Observations, quick: bool = False) -> Solutions:
    """Poses of {P} in {B} at the joint readings; `quick` as in `Kinematics`.

    They do not depend on what was measured, and where the device stands.
    """
    joints = observations.x[:, : len(model.joints)]
    return Kinematics(model, quick=quick).direct(joints, condition_columns(model, observations))


def predict_positions(model: Model, observations: Observations) -> np.ndarray:
    """Positions (N, 3) of {P} in {B} at the joint readings, NaN if there is no solution."""
    return np.asarray(reach(model, observations).position)


def reading_residuals(model: Model, observations: Observations, x: np.ndarray) -> np.ndarray:
    """Sensor readings minus predictions at x (N, nq+12+nu): (N, n_channels) m, NaN if not read."""
    if not model.structure.channels:
        return np.empty((len(observations), 0))
    rows = model.structure.residuals(x, observations.a, model.values)[0]
    return np.asarray(observations.reading - rows[:, model.structure.phi.shape[0] :])
