"""Bring a robot into contact: poses at which a contact of a sensor reads zero."""

from __future__ import annotations

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import MAX_CLOSED_RESIDUAL_M, Solutions, Status
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model

MAX_STEPS = 30
SAME_POSE_M = 1e-7


def list_contacts(model: Model) -> dict[str, np.ndarray]:
    """Return the mask (n_channels,) of the channels of every contact that the model's sensors
    know, by the name of the contact."""
    channels = np.array(model.structure.channels)
    return {
        name: np.isin(channels, held)
        for sensor in model.sensors
        for name, held in sensor.contacts.items()
    }


def make_contact(
    model: Model, poses: Solutions, held: np.ndarray, target: np.ndarray, a: np.ndarray
) -> Solutions:
    """Move robots from N solved poses until the held channels have their target readings.

    Every step is the shortest one (angles times the mechanism's length) that closes the mechanism
    and its contact, to first order.

    Parameters
    ----------
    model : Model
    poses : Solutions
        Poses (N) from which to start.
    held : ndarray of bool (N, n_channels)
        The channels of the contact of each pose.
    target : ndarray (N, n_channels)
        Readings of the held channels, m: zero, or the seating error.
    a : ndarray (N, n_conditions)
        Conditions at the poses.

    Returns
    -------
    Solutions
        The poses in contact. Their status is `not_converged` where none was found.
    """
    s, m = model.structure, model.mechanism
    n, rows = len(model.joints), s.phi.shape[0]
    moving = [*range(n), *m.dependent_columns]
    scale = s.scale[moving]
    shown = s.to_device(np.hstack([poses.position, poses.rotation.reshape(-1, 9)]), model.values)
    x = Configuration(poses.joints, shown[0], shown[1].reshape(-1, 3, 3), poses.passive)
    left = np.full(len(poses), np.inf)
    for _ in range(MAX_STEPS):
        values, J, _ = s.rows_batch(x.rows, a, model.values)
        J = J.reshape(len(values), -1, values.shape[1]).transpose(0, 2, 1)[:, :, moving] / scale
        values[:, rows:] = np.where(held, values[:, rows:] - target, 0.0)
        J[:, rows:] *= held[:, :, None]
        bad = ~(np.isfinite(values).all(axis=1) & np.isfinite(J).all(axis=(1, 2)))
        values[bad], J[bad] = 0.0, 0.0
        step = -np.einsum("nij,nj->ni", np.linalg.pinv(J, rcond=1e-9), values)
        left = np.where(bad, np.inf, np.linalg.norm(values, axis=1))
        if (left < MAX_CLOSED_RESIDUAL_M).all():
            break
        change = np.zeros((len(values), len(s.scale)))
        change[:, moving] = np.clip(step, -m.length / 4, m.length / 4) / scale
        x = x.apply_change(change)
    position, rotation = s.to_base(x.rows[:, n : n + 12], model.values)
    status = np.where(left < MAX_CLOSED_RESIDUAL_M, poses.status, Status.NOT_CONVERGED)
    return Solutions(
        joints=x.rows[:, :n],
        position=position,
        rotation=rotation.reshape(-1, 3, 3),
        residual=left,
        status=status.astype(np.int8),
        passive=x.rows[:, n + 12 :],
    )


def find_nearest_contacts(model: Model, poses: Solutions, a: np.ndarray) -> np.ndarray:
    """Return the contact (N,) whose readings are smallest at each pose, as its place in
    `list_contacts`."""
    rows, s = model.structure.phi.shape[0], model.structure
    shown = s.to_device(np.hstack([poses.position, poses.rotation.reshape(-1, 9)]), model.values)
    x = Configuration(poses.joints, shown[0], shown[1].reshape(-1, 3, 3), poses.passive)
    values = s.residuals(x.rows, a, model.values)[0][:, rows:]
    sizes = [np.linalg.norm(values[:, held], axis=1) for held in list_contacts(model).values()]
    return np.asarray(np.argmin(sizes, axis=0))


def spread_over_contacts(
    model: Model, poses: Solutions, a: np.ndarray
) -> tuple[Solutions, np.ndarray]:
    """Bring N poses into the contacts of the model in turn; return the poses that are reached on
    the branch of home, inside the joint limits, and their contacts (places in `list_contacts`)."""
    contacts = list(list_contacts(model).values())
    which = np.arange(len(poses)) % len(contacts)
    held = np.array(contacts)[which]
    found = make_contact(model, poses, held, np.zeros(held.shape), a)
    back = Kinematics(model).direct(np.where(found.solved[:, None], found.joints, np.nan))
    agree = np.abs(back.position - found.position).max(axis=1) < SAME_POSE_M
    reached = np.flatnonzero(back.ok & agree)
    return found[reached], which[reached]
