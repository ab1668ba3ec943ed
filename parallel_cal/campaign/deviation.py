"""Find the joints that leave the commanded path, from one reading of all joints."""

from __future__ import annotations

import numpy as np

MAX_PATH_DEVIATION = 0.03  # share of its range by which a joint may deviate from its path
N_MOMENTS = 400  # points of the path with which a reading is compared
EQUAL_DEVIATION = 2e-3  # share of its range; deviations that differ by less are equal
MIN_OWN_DEVIATION = 4e-3  # share of its range from which one joint deviates by itself


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


def compute_way_points(stops: np.ndarray) -> np.ndarray:
    """Return N_MOMENTS points on the straight legs between stops (n, nq), the stops included."""
    steps = np.linalg.norm(np.diff(stops, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    shares = np.union1d(np.linspace(0.0, along[-1], N_MOMENTS), along)
    return np.stack([np.interp(shares, along, column) for column in stops.T], axis=1)


def find_deviating_joints(q: np.ndarray, way: np.ndarray, ranges: np.ndarray) -> list[int]:
    """Return the joints (indices) that left the path, the one furthest from it first; none if all
    joints stopped at the same point of the path.

    The point of the path that is nearest to all joints does not tell: if one joint stands still,
    that point lies between it and the others, and another joint may be further from it. So the
    reading is compared with the point at which all joints but one are nearest to where they were
    sent. Of several such points the last one counts.

    Parameters
    ----------
    q : ndarray (nq,)
        The reading, in rad or m.
    way : ndarray (n, nq)
        Points of the path that the robot may have reached, in order.
    ranges : ndarray (nq,)
        The ranges of the joints.
    """
    off = np.abs(way - q) / ranges
    others = np.sort(off, axis=1)[:, :-1].max(axis=1, initial=0.0)
    last = np.flatnonzero(others <= others.min() + EQUAL_DEVIATION)[-1]
    order = np.argsort(-off[last], kind="stable")
    first = off[last, order[0]]
    if first < MIN_OWN_DEVIATION:
        return []
    limit = max(MAX_PATH_DEVIATION, 0.5 * first)
    return [int(order[0]), *(int(i) for i in order[1:] if off[last, i] > limit)]
