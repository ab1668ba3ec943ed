"""Make samples from channels, with the conditions of each sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.channels import find_channel
from parallel_cal.recordings.dwells import approach, still_tolerance
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.pairing import paired_samples
from parallel_cal.recordings.readings import reading_columns
from parallel_cal.recordings.recording import Array, JointStream, Recording
from parallel_cal.recordings.samples import Samples, broadcast_to_joints
from parallel_cal.recordings.standstill import drop_odd_readings, standstill_samples
from parallel_cal.recordings.travel import travel


def find_tolerance(joints: JointStream, options: SampleOptions) -> Array:
    """Return how far each joint (nq,) may deviate while it stands still."""
    if options.still_tolerance is None:
        return still_tolerance(joints.time, joints.position, options.min_dwell)
    return broadcast_to_joints(options.still_tolerance, joints.names, "still_tolerance")


def join_standstills(recording: Recording, options: SampleOptions) -> Recording:
    """Return the recording without the odd joint readings that cut a standstill in two."""
    if options.mode == "continuous":
        return recording
    return drop_odd_readings(recording, options, find_tolerance(recording.joints, options))


def samples_of(recording: Recording, options: SampleOptions) -> Samples:
    """Make the samples of a recording; DatasetError if there are none."""
    joints = recording.joints
    tolerance = find_tolerance(joints, options)
    if options.mode == "continuous":
        return paired_samples(recording, options, tolerance)
    samples = standstill_samples(recording, options, tolerance)
    if not samples.kept:
        reasons = sorted({d.reason for d in samples.dropped})
        raise DatasetError(
            f"{recording.source}: no usable dwell of at least {options.min_dwell} s "
            f"(dropped candidates: {'; '.join(reasons) or 'none found'}; standstill "
            f"tolerance of the joints: {', '.join(f'{t:.2g}' for t in tolerance)}). Let the robot "
            "stand still at each pose, adjust min_dwell, trim_start, trim_end or still_tolerance, "
            "read by log time if clocks differ (stamps='log'), or pair every pose with the moving "
            "joints: mode='continuous'." + "".join(f" {warning}." for warning in samples.warnings)
        )
    return samples


def conditions_of(
    recording: Recording, samples: Samples, warnings: list[str]
) -> dict[str, NDArray[np.float64]]:
    """Return the conditions (N,) of each sample by name, each in its unit."""
    joints, kept = recording.joints, samples.kept
    time = np.array([s.time for s in kept])
    conditions = {"time": time}
    for name, stream in recording.conditions.items():
        channel = find_channel(name)
        if channel is None or not channel.held:
            conditions[name] = np.interp(time, stream.time, stream.value)
            continue
        latest = np.searchsorted(stream.time, time, side="right") - 1
        if (latest < 0).any():
            text = (
                f"{stream.topic}: {int((latest < 0).sum())} samples are earlier than its first "
                "message and use that message's value"
            )
            warnings.append(KeyedWarning(text, "samples before first message", stream.topic))
        conditions[name] = stream.value[latest.clip(0)]
    level = np.array([s.q for s in kept])
    # A motion counts if it exceeds the tolerance of a standstill.
    before = [s.first_reading for s in kept]
    direction = approach(joints.position, before, level, samples.tolerance)
    distance = travel(joints.position, before, level, direction, samples.tolerance)
    effort = np.array([s.effort for s in kept])
    for j, name in enumerate(joints.names):
        conditions[f"direction.{name}"] = direction[:, j].astype(float)
        conditions[f"travel.{name}"] = distance[:, j]
        conditions[f"velocity.{name}"] = np.array([s.velocity[j] for s in kept])
        if moving := [s.acceleration[j] for s in kept if s.acceleration is not None]:
            conditions[f"acceleration.{name}"] = np.array(moving)
        if np.isfinite(effort[:, j]).all():
            conditions[f"effort.{name}"] = effort[:, j]
    return conditions | reading_columns(kept)
