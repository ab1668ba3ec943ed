"""Poses of a hexapod by Newton's method in NumPy, which shares no code with the package's."""

import numpy as np

from parallel_cal.base.rotation import rotation_matrix

ITERATIONS = 60


def find_ends(feet, heads, length, rng, starts):
    """Poses (n, 3), (n, 3, 3) at which the method ends with the rods (6,) closed between feet and
    heads (6, 3), from random starts."""
    r, R = rng.uniform(-1, 1, (starts, 3)), rotation_matrix(rng.normal(0, 2, (starts, 3)))
    for _ in range(ITERATIONS):
        arm = heads @ R.swapaxes(1, 2)
        leg = r[:, None] + arm - feet
        error = ((leg**2).sum(axis=-1) - length**2) / 2
        slopes = np.concatenate([leg, np.cross(arm, leg)], axis=-1)
        step = -np.linalg.solve(slopes, error[..., None])[..., 0]
        step /= np.maximum(1.0, 2 * np.linalg.norm(step, axis=1))[:, None]
        r, R = r + step[:, :3], rotation_matrix(step[:, 3:]) @ R
    ends = np.abs(error).max(axis=1) < 1e-12
    return r[ends], R[ends]
