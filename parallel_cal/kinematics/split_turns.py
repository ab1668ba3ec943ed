"""Orientations of which a robot controls one coordinate and not the two others.

Newton's method turns the platform about the axes that are not controlled, a little in each step.
Small turns about two axes compose to one about the third, so the end would depend on the path. The
controlled coordinate is that of the rotation vector (`Mechanism.controlled_coordinates`), which
depends on the orientation alone.
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
    turns = [sum(i >= 3 for i in part) for part in (mechanism.controlled, mechanism.parasitic)]
    return turns == [1, 2]


def restore_turn(
    mechanism: Mechanism,
    given: np.ndarray,
    found: Solutions,
    iterate: Callable[[np.ndarray, np.ndarray], Solutions],
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
        Iterate from the solutions of some samples, a mask (N,), with other rows of `given`.

    Returns
    -------
    Solutions
        Those that have another coordinate after MAX_CORRECTIONS are not converged.
    """
    n = len(mechanism.joints)
    turns, turned = slice(n + 3, n + 12), [i - 3 for i in mechanism.controlled if i >= 3]
    asked = rotation_vector(given[:, turns].reshape(-1, 3, 3))
    for count in range(MAX_CORRECTIONS + 1):
        w = np.where(found.solved[:, None], rotation_vector(found.rotation), asked)
        angle = np.linalg.norm(w, axis=1, keepdims=True)
        other = w * (1 - 2 * np.pi / np.where(angle > 0, angle, 2 * np.pi))  # the same rotation
        near = np.linalg.norm(w - asked, axis=1) <= np.linalg.norm(other - asked, axis=1)
        w = np.where(near[:, None], w, other)
        off = (np.abs(w - asked)[:, turned] > TURN_TOLERANCE).any(axis=1)
        if not off.any() or count == MAX_CORRECTIONS:
            break
        w[:, turned] = asked[:, turned]
        again = given[off]
        again[:, turns] = rotation_matrix(w[off]).reshape(-1, 9)
        found = replace_rows(found, off, iterate(again, off))
    status = np.where(off, Status.NOT_CONVERGED, found.status).astype(np.int8)
    return replace(found, status=status)
