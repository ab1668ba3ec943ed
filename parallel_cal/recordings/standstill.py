"""Make one sample per standstill, with the reason for each standstill that is not used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.recordings.dwells import Interval, drift, find_interruptions, still_intervals
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.pose_outliers import drop_outliers, find_strays, pose_limits
from parallel_cal.recordings.recording import Array, Dropped, JointStream, PoseStream, Recording
from parallel_cal.recordings.samples import (
    Sample,
    Samples,
    max_gap,
    mean_rotation,
    sample_sd,
    slope,
)
from parallel_cal.recordings.windows import Dwell, make_dwell


def standstill_samples(recording: Recording, options: SampleOptions, tolerance: Array) -> Samples:
    """Return one sample per standstill, and the reason for each that is not used."""
    joints, pose = recording.joints, recording.pose
    found = Samples("dwell", [], tolerance, [])
    if joints.period > options.min_dwell:  # short standstills look like motion
        text = (
            f"{joints.topic}: one message per {joints.period:.2g} s; only standstills of "
            f"{10 * joints.period:.2g} s or more are detected reliably. Publish faster, or stand "
            "still longer"
        )
        found.warnings.append(KeyedWarning(text, "slow joint states", joints.topic))
    intervals = _standstills(joints, options, tolerance)
    windows = [make_dwell(recording, interval, options) for interval in intervals]
    minimum = _min_pose_messages(windows, options, found.warnings)
    dwells = []
    for dwell in windows:
        why = _unusable(recording, dwell, options, tolerance, minimum)
        if why:
            found.dropped.append(Dropped(0.5 * (dwell.start + dwell.end), *why))
        else:
            dwells.append(dwell)
    strays = [find_strays(pose, dwell) for dwell in dwells]
    limits = pose_limits(pose, dwells, strays, options.min_dwell)
    for dwell, stray in zip(dwells, strays, strict=True):
        if len(dwell.less):
            count, first = len(dwell.less), float(pose.time[dwell.less[0]])
            reason = "measures fewer coordinates than the rest of its dwell"
            found.dropped.append(Dropped(first, reason, f"{count} messages of {pose.topic}", count))
        if drop_outliers(pose, dwell, stray, limits, minimum, found.dropped):
            found.kept.append(_dwell_sample(joints, pose, dwell))
    _report_lonely_poses(pose, windows, options, found)
    return found


def _standstills(joints: JointStream, options: SampleOptions, tolerance: Array) -> list[Interval]:
    return still_intervals(
        joints.time, joints.position, tolerance, options.min_dwell / 3, max_gap(joints, options)
    )


def drop_odd_readings(recording: Recording, options: SampleOptions, tolerance: Array) -> Recording:
    """Drop the joint readings that cut a standstill in two although nothing moved."""
    joints = recording.joints
    intervals = _standstills(joints, options, tolerance)
    odd = find_interruptions(joints.time, joints.position, intervals, tolerance, options.min_dwell)
    if not odd.any():
        return recording
    i, count = int(np.argmax(odd)), int(odd.sum())
    shown = " ".join(f"{v:.6g}" for v in joints.position[i])
    detail = f"{joints.topic}: {count} of {len(odd)} messages; the first is message {i}: {shown}"
    reason = "odd joint reading while the robot rests"
    dropped = (*recording.dropped, Dropped(float(joints.time[i]), reason, detail, count))
    return replace(recording, joints=joints.select(~odd), dropped=dropped)


def _min_pose_messages(windows: list[Dwell], options: SampleOptions, warnings: list[str]) -> int:
    """Return how many pose messages a dwell needs: 3, or 1 if the device is triggered per pose."""
    if options.min_pose_messages is not None:
        return max(1, options.min_pose_messages)
    counts = [len(w.poses) for w in windows if len(w.poses)]
    if counts and np.median(counts) < 3:
        warnings.append(
            "most dwells have fewer than 3 pose messages; one message per dwell is accepted"
        )
        return 1
    return 3


def _unusable(
    recording: Recording,
    dwell: Dwell,
    options: SampleOptions,
    tolerance: Array,
    minimum: int,
) -> tuple[str, str] | None:
    """Return (reason, detail) if the dwell cannot be used."""
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
        return (
            "moving while measured",
            f"{joints.names[j]} moved by {moved[j]:.2g} rad or m",
        )
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


def _dwell_sample(joints: JointStream, pose: PoseStream, dwell: Dwell) -> Sample:
    """Average a dwell's readings and its pose messages; placeholders for a pose without any."""
    q, at = joints.position[dwell.readings], dwell.poses
    r, R = np.zeros(3), np.eye(3)
    pose_cov, scatter_pose = np.full((6, 6), np.nan), np.full(6, np.nan)
    if len(at):
        mean, middle = pose.position[at].mean(axis=0), mean_rotation(pose.rotation[at])
        off = np.hstack([pose.position[at] - mean, rotation_vector(pose.rotation[at] @ middle.T)])
        r = np.where(dwell.measured[:3], mean, 0.0)
        R = middle if dwell.measured[3:].any() else R
        pose_cov = pose.covariance[at].mean(axis=0)
        scatter_pose = np.where(dwell.measured, sample_sd(off), np.nan)
    return Sample(
        time=0.5 * (dwell.start + dwell.end),
        duration=dwell.end - dwell.start,
        q=q.mean(axis=0),
        effort=joints.effort[dwell.readings].mean(axis=0),
        velocity=slope(joints.time[dwell.readings], q),
        scatter_q=sample_sd(q),
        r=r,
        R=R,
        measured=dwell.measured,
        pose_cov=pose_cov,
        scatter_pose=scatter_pose,
        count_q=len(q),
        count_pose=len(at),
        first_reading=dwell.interval.first,
        readings=dwell.shown,
    )


def _report_lonely_poses(
    pose: PoseStream, windows: list[Dwell], options: SampleOptions, found: Samples
) -> None:
    """Report poses outside every dwell, if the device gives single poses rather than a stream."""
    period = np.median(np.diff(pose.time)) if len(pose.time) > 1 else np.inf
    if period < options.min_dwell:
        return  # in a stream, messages between dwells are expected
    used = np.zeros(len(pose.time), bool)
    for dwell in windows:
        a, b = np.searchsorted(pose.time, [dwell.start, dwell.end])
        used[a:b] = True
    for i in np.flatnonzero(~used):
        time, detail = float(pose.time[i]), f"message {i} of {pose.topic} is in no dwell"
        found.dropped.append(Dropped(time, "moving while measured", detail))
