"""Channels -> one sample per standstill, and the reason for each standstill that is not used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.recordings.dwells import (
    CEILING,
    Indices,
    Interval,
    drift,
    encoder_step,
    jitter,
    still_intervals,
    still_tolerance,
)
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.readings import held_words, readings_between
from parallel_cal.recordings.recording import (
    Array,
    Bools,
    Dropped,
    JointStream,
    PoseStream,
    Recording,
)
from parallel_cal.recordings.samples import (
    Sample,
    Samples,
    max_gap,
    mean_rotation,
    sample_sd,
    slope,
)


@dataclass
class _Dwell:
    """A standstill under examination: its readings, its pose messages and what they measure,
    the words that held the tip meanwhile and what other sensors showed (m). Messages that measure
    `less` than most are not among its poses."""

    interval: Interval
    start: float
    end: float
    readings: slice
    poses: Indices
    less: Indices
    measured: Bools
    held: list[str]
    shown: dict[str, float]


def standstill_samples(recording: Recording, options: SampleOptions, tolerance: Array) -> Samples:
    """One sample per standstill, and the reason for each that is not used."""
    joints, pose = recording.joints, recording.pose
    found = Samples("dwell", [], tolerance, [], _too_slow(joints, options))
    intervals = still_intervals(
        joints.time, joints.position, tolerance, options.min_dwell / 3, max_gap(joints, options)
    )
    windows = [_window(recording, interval, options) for interval in intervals]
    minimum = _min_pose_messages(windows, options, found.warnings)
    dwells = []
    for dwell in windows:
        reason = _unusable(recording, dwell, options, tolerance, minimum)
        if reason:
            found.dropped.append(Dropped(0.5 * (dwell.start + dwell.end), *reason))
        else:
            dwells.append(dwell)
    R = quaternion_to_matrix(pose.quaternion)
    limits = _pose_limits(pose, R, dwells, options.min_dwell)
    for dwell in dwells:
        found.dropped += _partial(pose, dwell)
        if _calm_pose(pose, R, dwell, limits, minimum, found.dropped):
            found.kept.append(_dwell_sample(joints, pose, R, dwell))
    _report_lonely_poses(pose, windows, options, found)
    return found


def _too_slow(joints: JointStream, options: SampleOptions) -> list[str]:
    """A sentence if the readings come so rarely that short standstills look like motion."""
    period = float(np.median(np.diff(joints.time))) if len(joints.time) > 1 else 0.0
    if period <= options.min_dwell:
        return []
    return [
        f"{joints.topic}: one message in {period:.2g} s; only standstills of {10 * period:.2g} s "
        "and more are sure to be seen. Publish faster, or stand longer"
    ]


def _window(recording: Recording, interval: Interval, options: SampleOptions) -> _Dwell:
    """The trimmed part of an interval: the robot settles at its start and may leave at its end."""
    joints, pose = recording.joints, recording.pose
    start = joints.time[interval.first] + options.trim_start
    end = joints.time[interval.last] - options.trim_end
    a, b = np.searchsorted(joints.time, [start, end])
    c, d = np.searchsorted(pose.time, [start, end])
    poses = np.arange(c, max(c, d))
    # a coordinate counts as measured when most messages measure it; the others are left out
    measured = pose.measured[poses].mean(axis=0) > 0.5 if len(poses) else np.zeros(6, bool)
    enough = (pose.measured[poses] | ~measured).all(axis=1)
    readings = slice(int(a), int(max(a, b)))
    held = held_words(recording.constraint, start, end)
    shown = readings_between(recording, start, end)
    return _Dwell(
        interval, start, end, readings, poses[enough], poses[~enough], measured, held, shown
    )


def _min_pose_messages(windows: list[_Dwell], options: SampleOptions, warnings: list[str]) -> int:
    """How many pose messages a dwell needs: 3, or 1 for a device that is triggered once a pose."""
    if options.min_pose_messages is not None:
        return max(1, options.min_pose_messages)
    counts = [len(w.poses) for w in windows if len(w.poses)]
    if counts and np.median(counts) < 3:
        warnings.append("most dwells have fewer than 3 pose messages; one is taken as enough")
        return 1
    return 3


def _unusable(
    recording: Recording,
    dwell: _Dwell,
    options: SampleOptions,
    tolerance: Array,
    minimum: int,
) -> tuple[str, str] | None:
    """(reason, detail) if the dwell cannot be used."""
    joints, pose = recording.joints, recording.pose
    whole = slice(dwell.interval.first, dwell.interval.last + 1)
    length = joints.time[dwell.interval.last] - joints.time[dwell.interval.first]
    if length < options.min_dwell and (np.abs(drift(joints.position[whole])) <= tolerance).all():
        return "too short", f"{length:.2f} s; expected at least {options.min_dwell} s"
    readings = joints.position[dwell.readings if length >= options.min_dwell else whole]
    if len(readings) < options.min_joint_messages:
        return "too few joint readings", f"{len(readings)} of {options.min_joint_messages}"
    moved = np.abs(drift(readings))
    if (moved > 0.5 * tolerance).any():
        j = int(np.argmax(moved / tolerance))
        return "moving while measured", f"{joints.names[j]} crept by {moved[j]:.2g} rad or m"
    if len(dwell.held) > 1:
        words = ", then ".join(f"'{word}'" for word in dwell.held)
        return "constraint changed", f"held by {words}"
    if dwell.shown and not dwell.measured.any():
        return None
    if not pose.topic:
        return "nothing measured", "no pose, and neither a constraint nor a distance"
    if not len(dwell.poses):
        return "no pose messages", f"on {pose.topic}"
    if not dwell.measured.any():
        return "nothing measured", f"{pose.topic}: all variances above 1e3"
    if len(dwell.poses) < minimum:
        return "too few pose messages", f"{len(dwell.poses)} of {minimum} on {pose.topic}"
    return None


def _deviation(pose: PoseStream, R: Array, dwell: _Dwell) -> Array:
    """Deviations (n, 6) of a dwell's messages from their middle; 0 where not measured."""
    r = pose.position[dwell.poses]
    middle = mean_rotation(R[dwell.poses])
    turned = rotation_vector(R[dwell.poses] @ middle.T)
    both = np.hstack([r - np.median(r, axis=0), turned - np.median(turned, axis=0)])
    return np.where(dwell.measured, both, 0.0)


def _partial(pose: PoseStream, dwell: _Dwell) -> list[Dropped]:
    """The messages of a dwell that are not averaged because a coordinate is missing in them."""
    if not len(dwell.less):
        return []
    count, first = len(dwell.less), float(pose.time[dwell.less[0]])
    detail = f"{count} messages of {pose.topic}"
    return [Dropped(first, "measures less than the rest of its dwell", detail, count)]


def _pose_limits(pose: PoseStream, R: Array, dwells: list[_Dwell], length: float) -> Array:
    """How far (2,) a single reading may lie off its dwell's middle, in m and rad.

    Eight times what is usual over all dwells; but where the device's clock is not the joints', no
    dwell is calm: at most 20 times what half its readings keep to (up to 5e-2 of all that the
    device saw), or what stands still by its own stream. At least 1.5 of the device's steps, 1e-4 of
    the workspace and 1e-4 rad.
    """
    dwells = [d for d in dwells if len(d.poses)]
    if not dwells:
        return np.zeros(2)
    strays = [np.abs(_deviation(pose, R, d)) for d in dwells]
    largest = np.median([s.max(axis=0) for s in strays], axis=0)
    half = np.median([np.median(s, axis=0) for s in strays], axis=0)
    seen = _seen(pose, R)
    calm = np.minimum(20.0 * half, CEILING * np.ptp(seen, axis=0))
    calm = np.maximum(calm, still_tolerance(pose.time, seen, length))
    calm = np.maximum(calm, 6.0 * jitter(pose.time, seen, length))  # where nothing ever moves
    limits = np.maximum(np.minimum(8.0 * largest, calm), 1.5 * encoder_step(seen))
    centres = np.array([np.median(pose.position[d.poses], axis=0) for d in dwells])
    extent = np.ptp(np.quantile(centres, [0.05, 0.95], axis=0), axis=0).max()
    return np.maximum([limits[:3].max(), limits[3:].max()], [1e-4 * extent + 1e-9, 1e-4])


def _seen(pose: PoseStream, R: Array) -> Array:
    """Position and rotation off the middle (m, 6) of all messages, a few wild ones clipped."""
    seen = np.hstack([pose.position, rotation_vector(R @ mean_rotation(R).T)])
    return np.clip(seen, *np.quantile(seen, [0.01, 0.99], axis=0))


def _calm_pose(
    pose: PoseStream,
    R: Array,
    dwell: _Dwell,
    limits: Array,
    minimum: int,
    dropped: list[Dropped],
) -> bool:
    """Remove a few outlying readings from the dwell; False if it is not calm even then."""
    if not len(dwell.poses):
        return True
    stray = np.abs(_deviation(pose, R, dwell))
    far = (stray[:, :3].max(axis=1) > limits[0]) | (stray[:, 3:].max(axis=1) > limits[1])
    if not far.any():
        return True
    middle, worst = 0.5 * (dwell.start + dwell.end), stray.max(axis=0)
    size = f"by {1e3 * worst[:3].max():.3g} mm, {1e3 * worst[3:].max():.3g} mrad"
    if far.mean() > 0.2 or (~far).sum() < minimum:
        detail = f"{pose.topic} strays {size} while the joints stand still; do their clocks agree?"
        dropped.append(Dropped(middle, "moving while measured", detail))
        return False
    first = float(pose.time[dwell.poses[far][0]])
    detail = f"{pose.topic} strays {size} from the other readings of the dwell"
    dropped.append(Dropped(first, "pose reading is an outlier", detail, int(far.sum())))
    dwell.poses = dwell.poses[~far]
    return True


def _dwell_sample(joints: JointStream, pose: PoseStream, R: Array, dwell: _Dwell) -> Sample:
    """Average a dwell's readings."""
    q = joints.position[dwell.readings]
    return Sample(
        time=0.5 * (dwell.start + dwell.end),
        duration=dwell.end - dwell.start,
        q=q.mean(axis=0),
        effort=joints.effort[dwell.readings].mean(axis=0),
        velocity=slope(joints.time[dwell.readings], q),
        scatter_q=sample_sd(q),
        measured=dwell.measured,
        count_q=len(q),
        count_pose=len(dwell.poses),
        first_reading=dwell.interval.first,
        readings=dwell.shown,
        **_mean_pose(pose, R, dwell),
    )


def _mean_pose(pose: PoseStream, R: Array, dwell: _Dwell) -> dict[str, Array]:
    """The averages of a dwell's pose messages; placeholders where there are none."""
    at = dwell.poses
    if not len(at):
        nothing = {"pose_cov": np.full((6, 6), np.nan), "scatter_pose": np.full(6, np.nan)}
        return {"r": np.zeros(3), "R": np.eye(3), **nothing}
    r, middle = pose.position[at].mean(axis=0), mean_rotation(R[at])
    off = np.hstack([pose.position[at] - r, rotation_vector(R[at] @ middle.T)])
    return {
        "r": np.where(dwell.measured[:3], r, 0.0),
        "R": middle if dwell.measured[3:].any() else np.eye(3),
        "pose_cov": pose.covariance[at].mean(axis=0),
        "scatter_pose": np.where(dwell.measured, sample_sd(off), np.nan),
    }


def _report_lonely_poses(
    pose: PoseStream, windows: list[_Dwell], options: SampleOptions, found: Samples
) -> None:
    """Report poses outside every dwell, if the device gives single poses rather than a stream."""
    period = np.median(np.diff(pose.time)) if len(pose.time) > 1 else np.inf
    if period < options.min_dwell:
        return  # a stream: most of the messages between dwells were never meant
    used = np.zeros(len(pose.time), bool)
    for dwell in windows:
        a, b = np.searchsorted(pose.time, [dwell.start, dwell.end])
        used[a:b] = True
    for i in np.flatnonzero(~used):
        time = float(pose.time[i])
        detail = f"message {i} of {pose.topic} falls in no dwell"
        found.dropped.append(Dropped(time, "moving while measured", detail))
