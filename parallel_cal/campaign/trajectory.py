"""Plan motions from rest to rest for a joint trajectory controller, without ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from parallel_cal.model.mechanism import Mechanism

# If the model file gives no velocity: the time in which a joint crosses its range.
DEFAULT_CROSSING_TIME_S = 4.0
# If the model file gives no acceleration: the time in which a joint reaches its velocity.
DEFAULT_RISE_TIME_S = 0.5
WAYPOINT_PAUSE_S = 0.15  # of rest at a waypoint, so that a controller that lags reaches it
MIN_POINT_SPACING_S = 1e-6  # points nearer to each other are merged
STEP = 0.05  # s between points: dense enough for a controller that interpolates linearly


@dataclass(frozen=True)
class Trajectory:
    """A motion of the joints.

    Parameters
    ----------
    time : array (n,)
        Times after the start, s.
    positions : array (n, nq)
        Joint positions, rad or m.
    velocities : array (n, nq)
        Joint velocities, rad/s or m/s.
    """

    time: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return float(self.time[-1])


def rates(
    mechanism: Mechanism, crossing: float = DEFAULT_CROSSING_TIME_S
) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum velocity and acceleration of the joints (nq,): those of the model file, or
    defaults. `crossing`: the time [s] in which a joint without a velocity crosses its range."""
    given = mechanism.joint_rates or ((math.inf, math.inf),) * len(mechanism.joints)
    velocity, acceleration = np.array(given, dtype=float).T
    spans = zip(mechanism.joint_limits, mechanism.joint_units, strict=True)
    endless = {"rad": 2 * math.pi, "m": mechanism.length}
    width = [high - low if math.isfinite(high - low) else endless[u] for (low, high), u in spans]
    velocity = np.where(np.isfinite(velocity), velocity, np.array(width) / crossing)
    return velocity, np.where(
        np.isfinite(acceleration), acceleration, velocity / DEFAULT_RISE_TIME_S
    )


def trapezoid(
    start: np.ndarray, end: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> Trajectory:
    """Plan a straight move between joints (nq,); all joints start and stop together.

    The share s of the path has |s'| <= V = min v/d and |s''| <= A = min a/d. Its speed rises for
    V/A, or for sqrt(1/A) if the path is too short to reach V (V^2 > A), and falls for as long.
    """
    d = np.abs(end - start)
    if not d.any():
        return Trajectory(np.array([STEP]), end[None].copy(), np.zeros((1, len(end))))
    moving = d > 0
    A = float(np.min(acceleration[moving] / d[moving]))
    rise = min(float(np.min(velocity[moving] / d[moving])) / A, math.sqrt(1 / A))
    top = A * rise
    seconds = rise + 1 / top
    corners = [rise, seconds - rise, seconds]
    time = np.unique([*np.arange(STEP, seconds, STEP), *corners])
    time = time[np.diff(time, append=np.inf) > MIN_POINT_SPACING_S]
    left = np.maximum(seconds - time, 0.0)
    share = np.where(time <= rise, A * time**2 / 2, top * (time - rise / 2))
    share = np.where(left < rise, 1 - A * left**2 / 2, share)
    speed = np.minimum(np.minimum(A * time, A * left), top)
    move = (end - start)[None]
    return Trajectory(time, start + share[:, None] * move, speed[:, None] * move)


def plan_trajectory(stops: Sequence[np.ndarray], mechanism: Mechanism) -> Trajectory:
    """Plan a trajectory through joints (nq,), with a rest of WAYPOINT_PAUSE_S at each of them."""
    limits, end = rates(mechanism), 0.0
    time, positions, velocities = [], [], []
    for a, b in pairwise(stops):
        leg = trapezoid(a, b, *limits)
        time += [*(leg.time + end), leg.seconds + end + WAYPOINT_PAUSE_S]
        positions += [*leg.positions, b]
        velocities += [*leg.velocities, np.zeros(len(b))]
        end = time[-1]
    return Trajectory(np.array(time), np.array(positions), np.array(velocities))
