"""Find the joints that leave the commanded path, from one reading of all joints."""

from __future__ import annotations

import numpy as np

from parallel_cal.campaign.checking import ARRIVAL_TOLERANCE
from parallel_cal.campaign.trajectory import Trajectory

MAX_PATH_DEVIATION = 0.03  # share of its range by which a joint may deviate from its path
N_MOMENTS = 400  # moments of the motion at which the reading is compared with the path


def compute_path_deviation(q: np.ndarray, path: np.ndarray, ranges: np.ndarray) -> float:
    """Return how far joints (nq,) are from a path (n, nq), at whatever time: the largest deviation
    of a joint as a share of its range (nq,), at the nearest point."""
    scaled, here = path / ranges, q / ranges
    starts, steps = scaled[:-1], np.diff(scaled, axis=0)
    squares = np.maximum(np.sum(steps**2, axis=1), 1e-18)  # no division by zero at a standstill
    # The point of each straight segment that is nearest to the joints.
    share = np.clip(np.sum((here - starts) * steps, axis=1) / squares, 0.0, 1.0)
    off = np.abs(here - starts - share[:, None] * steps)
    return float(off.max(axis=1).min())


def find_deviating_joints(
    q: np.ndarray,
    start: np.ndarray,
    trajectory: Trajectory,
    elapsed: float,
    ranges: np.ndarray,
) -> list[int]:
    """Return the joints (indices) that left the path; the joint furthest from it comes first.

    The point of the path that is nearest to all joints does not tell: if one joint stands still,
    that point lies between it and the others, and another joint may be further from it. So the
    reading is compared with the moment of the motion at which the most joints are where they were
    sent. Of several such moments the latest counts: a robot lags, but not by a whole motion.

    Parameters
    ----------
    q : ndarray (nq,)
        The reading, in rad or m.
    start : ndarray (nq,)
        Where the motion began.
    trajectory : Trajectory
        The commanded motion.
    elapsed : float
        Time since the start of the motion, s, on the robot's clock.
    ranges : ndarray (nq,)
        The ranges of the joints.
    """
    times = np.concatenate([[0.0], trajectory.time])
    positions = np.vstack([start, trajectory.positions])
    moments = np.linspace(0.0, np.clip(elapsed, 0.0, trajectory.seconds), N_MOMENTS)
    there = np.stack([np.interp(moments, times, column) for column in positions.T], axis=1)
    off = np.abs(there - q) / ranges
    n_off = np.sum(off > ARRIVAL_TOLERANCE, axis=1)
    latest = np.flatnonzero(n_off == n_off.min())[-1]
    order = np.argsort(-off[latest], kind="stable")
    return [int(i) for i in order if off[latest, i] > MAX_PATH_DEVIATION] or [int(order[0])]
