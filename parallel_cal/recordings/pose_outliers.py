"""Find pose readings that stray from their dwell: the device must stand as still as the joints."""

from __future__ import annotations

import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.recordings.dwells import (
    MAX_TOLERANCE_SHARE,
    encoder_step,
    jitter,
    still_tolerance,
)
from parallel_cal.recordings.recording import Array, Dropped, PoseStream
from parallel_cal.recordings.samples import mean_rotation
from parallel_cal.recordings.windows import Dwell


def find_strays(pose: PoseStream, dwell: Dwell) -> Array:
    """Return how far (n, 6) a dwell's messages lie from their middle; 0 where not measured."""
    if not len(dwell.poses):
        return np.zeros((0, 6))
    r = pose.position[dwell.poses]
    middle = mean_rotation(pose.rotation[dwell.poses])
    turned = rotation_vector(pose.rotation[dwell.poses] @ middle.T)
    both = np.hstack([r - np.median(r, axis=0), turned - np.median(turned, axis=0)])
    return np.where(dwell.measured, np.abs(both), 0.0)


def pose_limits(pose: PoseStream, dwells: list[Dwell], strays: list[Array], length: float) -> Array:
    """Return how far (2,) a single reading may lie from its dwell's middle, in m and rad.

    The limit is eight times the largest deviation that is usual in a dwell. If the device's clock
    differs from the joints' clock, no dwell is calm and that would allow anything. So the limit is
    at most the larger of two: 20 times the deviation that half the readings keep (up to 5e-2 of the
    device's range), and the standstill tolerance of the device's own stream. It is at least 1.5
    steps of the device, 1e-4 of the workspace, and 1e-4 rad.
    """
    dwells = [d for d in dwells if len(d.poses)]
    strays = [stray for stray in strays if len(stray)]
    if not dwells:
        return np.zeros(2)
    largest = np.median([s.max(axis=0) for s in strays], axis=0)
    half = np.median([np.median(s, axis=0) for s in strays], axis=0)
    # Position and rotation about the middle of all messages, a few wild ones clipped.
    turned = rotation_vector(pose.rotation @ mean_rotation(pose.rotation).T)
    seen = np.hstack([pose.position, turned])
    seen = np.clip(seen, *np.quantile(seen, [0.01, 0.99], axis=0))
    calm = np.minimum(20.0 * half, MAX_TOLERANCE_SHARE * np.ptp(seen, axis=0))
    calm = np.maximum(calm, still_tolerance(pose.time, seen, length))
    calm = np.maximum(calm, 6.0 * jitter(pose.time, seen, length))  # if nothing ever moves
    limits = np.maximum(np.minimum(8.0 * largest, calm), 1.5 * encoder_step(seen))
    centres = np.array([np.median(pose.position[d.poses], axis=0) for d in dwells])
    extent = np.ptp(np.quantile(centres, [0.05, 0.95], axis=0), axis=0).max()
    return np.maximum([limits[:3].max(), limits[3:].max()], [1e-4 * extent + 1e-9, 1e-4])


def drop_outliers(
    pose: PoseStream,
    dwell: Dwell,
    stray: Array,
    limits: Array,
    minimum: int,
    dropped: list[Dropped],
) -> bool:
    """Remove a few outlying readings from the dwell; False if it is not calm even then."""
    if not len(dwell.poses):
        return True
    far = (stray[:, :3].max(axis=1) > limits[0]) | (stray[:, 3:].max(axis=1) > limits[1])
    if not far.any():
        return True
    middle, worst = 0.5 * (dwell.start + dwell.end), stray.max(axis=0)
    size = f"by {1e3 * worst[:3].max():.3g} mm, {1e3 * worst[3:].max():.3g} mrad"
    if far.mean() > 0.2 or (~far).sum() < minimum:
        detail = (
            f"{pose.topic} deviates {size} while the joints stand still; do their clocks agree?"
        )
        dropped.append(Dropped(middle, "moving while measured", detail))
        return False
    first = float(pose.time[dwell.poses[far][0]])
    detail = f"{pose.topic} deviates {size} from the other readings of the dwell"
    dropped.append(Dropped(first, "pose reading is an outlier", detail, int(far.sum())))
    dwell.poses = dwell.poses[~far]
    return True
