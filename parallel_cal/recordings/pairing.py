"""Make one sample per pose message of a moving robot, with joints interpolated to its time."""

from __future__ import annotations

import numpy as np

from parallel_cal.base.errors import DatasetError, UnfitError
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.recording import Array, Bools, Dropped, JointStream, Recording
from parallel_cal.recordings.samples import Sample, Samples, max_gap

ACCELERATION_PERIODS = 5  # of the joint readings, to each side of a sample


def paired_samples(recording: Recording, options: SampleOptions, tolerance: Array) -> Samples:
    """Return one sample per pose message, with the joints interpolated to its time."""
    joints, pose = recording.joints, recording.pose
    if recording.constraint or recording.distances:
        raise UnfitError(
            f"{recording.source}: a constraint or a distance belongs to a dwell, but "
            "mode is 'continuous': use mode='dwell', or disable their topics "
            "(constraint= distance=)"
        )
    found = Samples("continuous", [], tolerance, [])
    gap = max_gap(joints, options)
    usable = find_bracketed(joints, pose.time, gap)
    if (~usable).any():
        first, count = float(pose.time[np.argmin(usable)]), int((~usable).sum())
        detail = f"{count} of {len(usable)} messages on {pose.topic}"
        found.dropped.append(
            Dropped(first, "no joint readings before and after the pose", detail, count)
        )
    at = np.flatnonzero(usable)
    if not len(at):
        raise DatasetError(
            f"{recording.source}: no message on {pose.topic} has joint states on "
            f"{joints.topic} within {gap:.2g} s before and after it. Record both "
            "together, or set max_gap"
        )
    columns = _interpolate_joints(joints, pose.time[at])
    acceleration = compute_acceleration(joints, pose.time[at])
    nowhere = np.full(len(joints.names), np.nan)
    encoded = {
        name: np.interp(pose.time[at], stream.time, stream.value)
        for name, stream in recording.passive.items()
    }
    reading = np.searchsorted(joints.time, pose.time[at])
    for k, i in enumerate(at):
        q, effort, velocity = (column[k] for column in columns)
        found.kept.append(
            Sample(
                time=float(pose.time[i]),
                duration=0.0,
                q=q,
                effort=effort,
                velocity=velocity,
                scatter_q=nowhere,
                r=pose.position[i],
                R=pose.rotation[i],
                measured=pose.measured[i],
                pose_cov=pose.covariance[i],
                scatter_pose=np.full(6, np.nan),
                count_q=1,
                count_pose=1,
                first_reading=int(reading[k]),
                readings={name: float(values[k]) for name, values in encoded.items()},
                acceleration=acceleration[k],
            )
        )
    return found


def find_bracketed(joints: JointStream, time: Array, gap: float) -> Bools:
    """Mark (m,) the poses between two joint readings close in time, or at the time of one."""
    after = np.searchsorted(joints.time, time).clip(0, len(joints.time) - 1)
    before = (after - 1).clip(0)
    inside = (joints.time[before] <= time) & (time <= joints.time[after])
    coincides = joints.time[after] == time
    return coincides | (inside & (joints.time[after] - joints.time[before] <= gap))


def _interpolate_joints(joints: JointStream, time: Array) -> tuple[Array, Array, Array]:
    """Return joint position, effort and velocity (m, nq) at the given times."""

    def at(values: Array, when: Array) -> Array:
        return interpolate(joints.time, values, when)

    # At the ends of the recording the difference spans less time.
    late = np.minimum(time + 2 * joints.period, joints.time[-1])
    early = np.maximum(time - 2 * joints.period, joints.time[0])
    span = np.maximum(late - early, 1e-9)[:, None]
    velocity = (at(joints.position, late) - at(joints.position, early)) / span
    return at(joints.position, time), at(joints.effort, time), velocity


def compute_acceleration(joints: JointStream, time: Array) -> Array:
    """Return the acceleration (m, nq) at the given times: the curvature of the parabola through
    eleven periods of readings. Fewer would mean more noise, which grows with their spacing to the
    power -2; at the ends of the recording the periods are the last ones within it."""
    k = np.arange(-ACCELERATION_PERIODS, ACCELERATION_PERIODS + 1)
    weights = k**2 - np.mean(k**2)
    weights *= 2 / (weights @ weights)
    reach = ACCELERATION_PERIODS * joints.period
    first, last = joints.time[0] + reach, joints.time[-1] - reach
    middle = np.minimum(np.maximum(time, first), max(last, first))
    positions = [interpolate(joints.time, joints.position, middle + i * joints.period) for i in k]
    return np.tensordot(weights, positions, axes=1) / max(joints.period, 1e-9) ** 2


def interpolate(time: Array, values: Array, when: Array) -> Array:
    """Return values (n, nq), given at the times (n,), at other times (m,)."""
    return np.stack([np.interp(when, time, column) for column in values.T], axis=1)
