"""The part of a workspace that the joints of an imported machine can reach."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from parallel_cal.model.mechanism import Workspace
from parallel_cal.recordings.recording import Array

SHRINK = np.linspace(1.0, 0.02, 50)  # of the default workspace


def shrink_workspace(
    box: Workspace, home: Array, joints: Callable[[Array], Array], limits: Array
) -> Workspace:
    """Return the largest part of a workspace about `home` that the joints reach.

    Its corners and the middles of its sides are inside the `limits` (n, 2) of the joints. The
    workspace is unchanged if even home is outside.

    Parameters
    ----------
    box : Workspace
        Box of the coordinates of a pose, (k,) each.
    home : ndarray, shape (k,)
        Coordinates of a pose in the box.
    joints : callable
        Return the joints (N, n) at coordinates (N, k); NaN where the machine does not reach.
    limits : ndarray, shape (n, 2)
        The joint limits, in the unit of the joints.
    """
    low, high = limits.T
    sides = np.array([box.low, box.high]) - home
    around = np.array([*product(*np.insert(sides, 1, 0.0, axis=0).T)])

    def fits(part: float) -> bool:
        q = joints(home + part * around)
        return bool(((q >= low) & (q <= high)).all())

    if not fits(0.0):
        return box
    part = next((part for part in SHRINK if fits(part)), SHRINK[-1])
    return Workspace(*(tuple(map(float, home + part * side)) for side in sides))
