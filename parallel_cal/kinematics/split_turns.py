"""Orientations of which a robot controls one coordinate and not the two others.

Newton's method turns the platform about the axes that are not controlled, a little in each step.
Small turns about two axes compose to one about the third, so the end would depend on the path. The
controlled coordinate is that of the rotation vector (`Mechanism.controlled_coordinates`), which
depends on the orientation alone.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.model.mechanism import Mechanism

TURN_TOLERANCE = 1e-12  # rad, of a controlled coordinate
# A correction leaves about half the angle of the pose (rad) of the last one: 12 are enough at 0.5.
MAX_CORRECTIONS = 50


def splits_turns(mechanism: Mechanism) -> bool:
    """Return whether the robot controls one coordinate of the orientation and moves in all."""
    turns = [sum(i >= 3 for i in part) for part in (mechanism.controlled, mechanism.parasitic)]
    return turns == [1, 2]


def turn_back(
    mechanism: Mechanism, asked: np.ndarray, found: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (N, 3, 3) with the controlled coordinate of those that were `asked` and the
    others of those that were `found`, and how far (N,) rad these are away."""
    w, wanted = rotation_vector(found), rotation_vector(asked)
    angle = np.linalg.norm(w, axis=1, keepdims=True)
    other = w * (1 - 2 * np.pi / np.where(angle > 0, angle, 2 * np.pi))  # the same rotation
    near = np.linalg.norm(w - wanted, axis=1) <= np.linalg.norm(other - wanted, axis=1)
    w = np.where(near[:, None], w, other)
    turned = [i - 3 for i in mechanism.controlled if i >= 3]
    away = np.abs(w - wanted)[:, turned].max(axis=1)
    w[:, turned] = wanted[:, turned]
    return rotation_matrix(w), away
