"""Orientations of which a robot controls some coordinates and not the others.

Newton's method turns the platform about the axes that are not controlled, a little in each step.
If there is one such axis, the controlled coordinates are kept. Small turns about two axes compose
to one about the third, so the end would depend on the path. The controlled coordinate is then that
of the rotation vector (`Mechanism.controlled_coordinates`), which depends on the orientation alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.kinematics.solutions import Solutions, Status, replace_rows
from parallel_cal.model.mechanism import Mechanism

TURN_TOLERANCE = 1e-12  # rad, of a controlled coordinate
# A correction leaves about half the angle of the pose (rad) of the last one: 12 are enough at 0.5.
MAX_CORRECTIONS = 50


def splits_turns(mechanism: Mechanism) -> bool:
    """Return whether the robot controls one coordinate of the orientation and moves in all."""
    controlled, free = _split(mechanism)
    return (len(controlled), len(free)) == (1, 2)


def free_turn(mechanism: Mechanism) -> int:
    """Return the axis about which inverse kinematics turns a given orientation, 3 for any axis; -1
    if it turns about none."""
    controlled, free = _split(mechanism)
    if len(free) == 1:
        return free[0]
    return 3 if free and not controlled else -1


def _split(mechanism: Mechanism) -> tuple[list[int], list[int]]:
    """Return the axes about which the robot controls a turn, and about which it follows."""
    controlled, free = (
        [i - 3 for i in part if i >= 3] for part in (mechanism.controlled, mechanism.parasitic)
    )
    return controlled, free


def turn_towards(mechanism: Mechanism, given: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Turn orientations towards those of a start, about the axes that are not controlled.

    Parameters
    ----------
    mechanism : Mechanism
    given, start : ndarray, shape (..., 3, 3)
        The orientations that were asked, and those from which iterations begin.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Orientations with the controlled coordinates of `given`.
    """
    controlled, free = _split(mechanism)
    if not free:
        return given
    if len(free) == 1:
        (axis,) = free
        one, other = (axis + 1) % 3, (axis + 2) % 3
        apart = start @ np.swapaxes(given, -1, -2)
        angle = np.arctan2(
            apart[..., other, one] - apart[..., one, other],
            apart[..., one, one] + apart[..., other, other],
        )
        turned: np.ndarray = rotation_matrix(angle[..., None] * np.eye(3)[axis]) @ given
        return turned
    if not controlled:
        return start
    asked = rotation_vector(given)
    w = _nearest_vectors(start, asked)
    w[..., controlled] = asked[..., controlled]
    return rotation_matrix(w)


def _nearest_vectors(R: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3) of R that are nearest to those asked."""
    w = rotation_vector(R)
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    other = w * (1 - 2 * np.pi / np.where(angle > 0, angle, 2 * np.pi))  # the same rotation
    near = np.linalg.norm(w - asked, axis=-1) <= np.linalg.norm(other - asked, axis=-1)
    return np.where(near[..., None], w, other)


def restore_turn(
    mechanism: Mechanism,
    given: np.ndarray,
    found: Solutions,
    iterate: Callable[[np.ndarray, Solutions], Solutions],
) -> Solutions:
    """Return solutions with the controlled coordinate of the orientation that was asked.

    Parameters
    ----------
    mechanism : Mechanism
    given : ndarray, shape (N, nq + 12)
        Joints, and the positions and rotations that were asked.
    found : Solutions
        N solutions of the inverse problem.
    iterate : callable
        Iterate for some samples, a mask (N,), from solutions of them.

    Returns
    -------
    Solutions
        Those that have another coordinate after MAX_CORRECTIONS are not converged.
    """
    n = len(mechanism.joints)
    turned, _ = _split(mechanism)
    asked = rotation_vector(given[:, n + 3 : n + 12].reshape(-1, 3, 3))
    for count in range(MAX_CORRECTIONS + 1):
        w = np.where(found.solved[:, None], _nearest_vectors(found.rotation, asked), asked)
        off = (np.abs(w - asked)[:, turned] > TURN_TOLERANCE).any(axis=1)
        if not off.any() or count == MAX_CORRECTIONS:
            break
        found = replace_rows(found, off, iterate(off, found[off]))
    status = np.where(off, Status.NOT_CONVERGED, found.status).astype(np.int8)
    return replace(found, status=status)
