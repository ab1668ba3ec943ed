"""Find poses that were visited more than once, estimate noise from them, and make folds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.model.configuration import Configuration
from parallel_cal.recordings.recording import Array, Bools
from parallel_cal.recordings.samples import mean_rotation

Ids = NDArray[np.int64]
MIN_POSITION_TOLERANCE_M = 1e-3  # m; a device's noise separates two visits by less
MAX_ROTATION_RAD = 0.1  # rad between two visits; it only has to separate assembly modes
VISIT_CONDITIONS = ("direction.", "payload", "temperature", "time")  # may differ between visits


@dataclass(frozen=True)
class ReplicateNoise:
    """Pooled 1-sigma scatter of revisited poses about their group's mean.

    `joint` (nq,) in rad or m and `pose` (6,) in m and rad, NaN where not measured or without
    replicates; `dof` = samples in groups minus groups. A robot does not return to exactly the same
    joints, so part of `pose` is motion of the robot.
    """

    joint: Array
    pose: Array
    dof: int


MIN_MOVE = 0.05  # of 0.2 % of the travel: a smaller step is no move to another pose


def replicate_ids(
    at: Configuration, measured: Bools, scatter_q: Array, tolerance: float | None = None
) -> Ids:
    """Return the group number (N,) of each sample; samples of one pose share it.

    A sample joins the first earlier pose whose joints all lie within the tolerance: 0.2 % of the
    joint's travel (backlash and encoder errors stay below), but at most a fifth of the robot's
    usual step, so that a fine sweep is not merged, and at least 20 times the scatter within a
    dwell.

    The measured pose must agree to 5 % of its range (at least 1 mm, because some robots only turn)
    and to 0.1 rad. These wide limits only separate assembly modes: the effects that replicates
    reveal (backlash, warming) must not split a group.
    """
    from scipy.spatial import cKDTree

    q, r, R = at.q, at.r, at.R
    # The largest joint difference (nq,) between two visits of one pose.
    if tolerance is not None:
        scale = np.full(q.shape[1], float(tolerance))
    elif len(q) < 2:
        scale = np.full(q.shape[1], 1e-12)
    else:
        noise = 20.0 * np.nan_to_num(np.median(scatter_q, axis=0)) + 1e-12
        part = 2e-3 * np.ptp(q, axis=0) + 1e-12
        steps = (np.abs(np.diff(q, axis=0)) / part).max(axis=1)
        moves = steps[steps > MIN_MOVE]  # visits in succession differ by the noise only
        usual_step = np.quantile(moves if len(moves) else steps, 0.75)
        scale = np.maximum(noise, part * min(1.0, 0.2 * usual_step))
    reach = max(0.05 * np.ptp(r, axis=0).max(initial=0.0), MIN_POSITION_TOLERANCE_M)
    neighbours, ids, count = cKDTree(q / scale), np.full(len(q), -1), 0
    for i in range(len(q)):
        if ids[i] >= 0:
            continue
        # A little more than the tolerance, which is checked exactly below.
        near = np.array(neighbours.query_ball_point(q[i] / scale, 1.001, p=np.inf))
        near = near[ids[near] < 0]  # these are later samples, and i itself
        same = (np.abs(q[near] - q[i]) <= scale).all(axis=1)
        apart = np.abs(r[near] - r[i]) * (measured[near, :3] & measured[i, :3])
        same &= (apart <= reach).all(axis=1)
        turns = measured[near, 3:].all(axis=1) & measured[i, 3:].all()
        angle = np.linalg.norm(R[near] - R[i], axis=(1, 2)) / np.sqrt(2.0)  # if it is small
        same &= ~turns | (angle <= MAX_ROTATION_RAD)
        ids[near[same]] = ids[i] = count
        count += 1
    return ids


def replicate_noise(ids: Ids, at: Configuration, measured: Bools) -> ReplicateNoise:
    """Pool the deviations of all samples that share a pose with another."""
    _, ids, visits = np.unique(ids, return_inverse=True, return_counts=True)
    index = np.flatnonzero(visits[ids] > 1)
    members, group = np.unique(ids[index], return_inverse=True)
    complete, turned = measured[index].copy(), at.R[index].copy()
    for g in range(len(members)):
        complete[group == g] = complete[group == g].all(axis=0)
        turned[group == g] = turned[group == g] @ mean_rotation(turned[group == g]).T
    pose = np.hstack([_subtract_group_means(at.r[index], group), rotation_vector(turned)])
    pose[~complete] = np.nan
    joint = _pool_scatter(_subtract_group_means(at.q[index], group), group)
    return ReplicateNoise(joint, _pool_scatter(pose, group), len(index) - len(members))


def _subtract_group_means(values: Array, group: NDArray[np.intp]) -> Array:
    """Subtract from rows (M, k) the mean of their group; groups are numbered from 0."""
    return values - average_groups(values, group)[group]


def average_groups(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Average rows (N, k) within groups; one row per group."""
    names, inverse, count = np.unique(group, return_inverse=True, return_counts=True)
    sums = np.zeros((len(names), values.shape[1]))
    np.add.at(sums, inverse, values)
    return np.asarray(sums / count[:, None])


def subtract_visits_mean(
    values: Array, group: Ids, conditions: Mapping[str, Array]
) -> tuple[Array, int]:
    """Return how far rows (N, k) are from the mean of their group, and the degrees of freedom.

    What depends linearly on the conditions of a visit (direction, payload, temperature, time) is
    not measurement noise: it is removed, and takes degrees of freedom.
    """
    if not len(values):
        return values, 0
    known = [
        column
        for name, column in conditions.items()
        if name.startswith(VISIT_CONDITIONS) and np.isfinite(column).all()
    ]
    # (N, n_conditions), each condition in units of its own spread.
    circumstances = np.reshape(known, (len(known), len(values))).T
    circumstances = circumstances / np.maximum(circumstances.std(axis=0), 1e-12)
    names, visited = np.unique(group, return_inverse=True)
    other = _subtract_group_means(circumstances, visited)
    apart = _subtract_group_means(values, visited)
    share, _, rank, _ = np.linalg.lstsq(other, apart, rcond=1e-9)
    return apart - other @ share, max(len(values) - len(names) - int(rank), 0)


def _pool_scatter(deviation: Array, group: NDArray[np.intp]) -> Array:
    """Return the standard deviation per column; each group takes one degree of freedom."""
    known = np.isfinite(deviation)
    groups = np.array([len(np.unique(group[column])) for column in known.T])
    dof = known.sum(axis=0) - groups
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(np.where(dof > 0, np.nansum(deviation**2, axis=0) / dof, np.nan))


def make_folds(
    groups: Ids, fraction: float, seed: int
) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return (train, test) indices of round(1/fraction) folds that never split a group."""
    if not 0.0 < fraction <= 0.5:
        raise DatasetError(f"hold-out fraction {fraction}; expected above 0 and at most 0.5")
    names, size = np.unique(groups, return_counts=True)
    count = min(round(1.0 / fraction), len(names))
    if count < 2:
        raise DatasetError(
            f"all {len(groups)} samples are of one pose: none can be held out. Measure other poses."
        )
    order = np.random.default_rng(seed).permutation(len(names))
    order = order[np.argsort(-size[order], kind="stable")]  # large groups first, then fill up
    load, fold_of = np.zeros(count, np.int64), np.zeros(len(names), np.int64)
    for g in order:
        fold_of[g] = np.argmin(load)
        load[fold_of[g]] += size[g]
    fold = fold_of[np.searchsorted(names, groups)]
    return [(np.flatnonzero(fold != k), np.flatnonzero(fold == k)) for k in range(count)]
