"""Check whether the path to a target is safe, and compute its duration. Does not use ROS.

joint_trajectory_controller moves each joint by a cubic polynomial in time, from its present
position and velocity to the target at rest. From rest, this is a straight line in joint space. The
check solves points on this path. The path must not cross a singularity, come near one, leave the
workspace or leave the joint limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.singularity import distances
from parallel_cal.model.mechanism import POSE, Mechanism

N_CHECKED_POINTS = 12  # points on the path, including both ends
SLACK = 1e-6  # m or rad by which a target at the edge of the workspace may lie outside
MIN_DURATION_S = 1e-6  # where the search for a duration begins if nothing else bounds it
DURATION_STEP = 1.02  # ratio of two durations tried
N_DURATIONS = 1400  # tried durations: up to 1e12 times the first one
LOAD_SLACK = 1e-12  # of a limit: rounding
N_BISECTIONS = 40  # between the last duration that breaks a limit and the first that keeps them


@dataclass(frozen=True)
class Bounds:
    """Limits of a motion.

    `crossing` is the shortest time [s] in which a joint without a velocity limit in the model file
    may cross its range. `singularity` is the smallest allowed scaled singular value.
    """

    crossing: float
    singularity: float


@dataclass(frozen=True)
class CheckedPath:
    """The shortest duration [s], the joint that limits it, and the smallest singular value."""

    seconds: float
    why: str
    singularity: float


def check_path(
    kinematics: Kinematics,
    start: np.ndarray,
    target: Solutions,
    at: Mapping[str, float] | None,
    bounds: Bounds,
    speed: np.ndarray | None = None,
    requested: float = 0.0,
) -> CheckedPath:
    """Check the path from joints `start` (nq,) to a target; raise SolveError if it is not safe.

    `speed` (nq,) is the robot's present joint velocity; None: it is at rest. The duration is the
    shortest one, not below `requested` [s], in which no joint exceeds its limits. From rest over a
    distance d with the velocity limit v and the acceleration limit a, it is the larger of 1.5 d / v
    and sqrt(6 d / a).
    """
    mechanism = kinematics.model.mechanism
    move = target.joints - start
    begin = np.zeros(len(start)) if speed is None else speed
    seconds, why = _compute_duration(mechanism, move, begin, bounds.crossing, requested)
    path = _sample_cubic(start, move, begin * seconds)
    found = kinematics.direct(path, at)
    usable = np.isin(found.status, (Status.CONVERGED, Status.OUTSIDE_LIMITS))
    if not usable[0]:
        raise SolveError(
            "the direct problem has no solution at the robot's present joints: "
            "no path from there is known"
        )
    if not usable.all():
        word = Status(int(found.status[int(np.argmin(usable))])).text.replace("_", " ")
        raise SolveError(f"the path to the target is {word} {_part(int(np.argmin(usable)))}")
    _check_joint_limits(mechanism, path)
    _check_workspace(mechanism, found)
    margins = distances(kinematics.model, found, at)
    least = np.minimum(margins.direct, margins.inverse)
    # A determinant that changes its sign was zero in between: a singularity between two points.
    for signs in (margins.direct_sign, margins.inverse_sign):
        if (signs != signs[0]).any():
            raise SolveError(
                "the path to the target passes a singularity "
                f"{_part(int(np.argmax(signs != signs[0])))}"
            )
    # A path that begins near a singularity is allowed if it never comes closer to it.
    bad = (least < bounds.singularity) & (least < least[0])
    if bad.any():
        i = int(np.argmax(bad))
        raise SolveError(
            f"the path to the target is too near a singularity {_part(i)}: {least[i]:.3g}, "
            f"allowed {bounds.singularity:g}"
        )
    return CheckedPath(seconds, why, float(least.min()))


def _sample_cubic(start: np.ndarray, move: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Return points (n, nq) of the cubic from `start`, where a joint at its first speed would move
    by `begin` (nq,), to rest at start + move. Without that speed they are equally spaced."""
    share = np.linspace(0.0, 1.0, N_CHECKED_POINTS)[:, None]
    s = 0.5 - np.sin(np.arcsin(1 - 2 * share) / 3)  # of the time: s^2 (3 - 2 s) = share
    points: np.ndarray = start + share * move + s * (1 - s) ** 2 * begin
    return points


def _check_joint_limits(mechanism: Mechanism, path: np.ndarray) -> None:
    """Refuse a path that leaves the joint limits, or leads further out if it begins outside."""
    low, high = np.array(mechanism.joint_limits, dtype=float).T
    out = np.maximum(low - path, path - high)
    bad = out > np.maximum(SLACK, out[0] + SLACK)
    if bad.any():
        i, joint = (int(k[0]) for k in np.nonzero(bad))
        raise SolveError(
            f"the path to the target leaves the limits of {mechanism.joints[joint]} {_part(i)}, by "
            f"{out[i, joint]:.3g}: the joint is too fast to stop before; wait until it rests"
        )


def _part(i: int) -> str:
    return f"at {100 * i / (N_CHECKED_POINTS - 1):.0f} % of its length"


def _check_workspace(mechanism: Mechanism, found: Solutions) -> None:
    """Refuse a path that leaves the workspace, or that leads further out if it begins outside."""
    poses = mechanism.controlled_coordinates(found.position, found.rotation)
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    beyond = np.maximum(low - poses, poses - high)
    out = beyond.max(axis=1)
    bad = out > max(SLACK, float(out[0]) + SLACK)
    if bad.any():
        i = int(np.argmax(bad))
        k = int(np.argmax(beyond[i]))
        name = mechanism.controls[k]
        unit, si = ("mm", MM) if name in POSE[:3] else ("deg", DEGREE)
        end = low[k] if poses[i, k] < low[k] else high[k]
        raise SolveError(
            f"the path to the target leaves the model file's workspace {_part(i)}: {name} "
            f"{poses[i, k] / si:.4g} {unit} is {out[i] / si:.3g} {unit} beyond {end / si:.4g} "
            f"{unit}. If the robot may move there, enlarge workspace in the model file"
        )


def _compute_duration(
    mechanism: Mechanism, move: np.ndarray, begin: np.ndarray, crossing: float, requested: float
) -> tuple[float, str]:
    """Return the shortest duration [s] from `requested` on in which all joints keep their limits,
    and a sentence about the limit that a shorter one would break."""
    rates = mechanism.joint_rates or ((math.inf, math.inf),) * len(move)
    given, acceleration = np.array(rates, dtype=float).T
    velocity = np.where(np.isfinite(given), given, mechanism.joint_ranges / crossing)
    least = max(requested, float(np.max(np.abs(move) / velocity)), MIN_DURATION_S)
    tried = least * DURATION_STEP ** np.arange(N_DURATIONS)
    # A joint that is too fast already may not become faster.
    limits = np.stack([np.maximum(velocity, np.abs(begin)), acceleration])

    def load(seconds: np.ndarray | float) -> np.ndarray:
        """Peak velocity and acceleration as shares of their limits: (2, n, nq)."""
        return _peaks(move, begin, np.reshape(seconds, (-1, 1))) / limits[:, None]

    kept = (load(tried) <= 1 + LOAD_SLACK).all(axis=(0, 2))
    if not kept.any():
        raise SolveError("no duration keeps the joints' velocity and acceleration limits")
    first = int(np.argmax(kept))
    low, high = float(tried[max(first - 1, 0)]), float(tried[first])
    for _ in range(N_BISECTIONS if first else 0):
        middle = (low + high) / 2
        if (load(middle) <= 1 + LOAD_SLACK).all():
            high = middle
        else:
            low = middle
    kind, _, joint = np.unravel_index(int(np.argmax(load(low))), (2, 1, len(move)))
    name, limit = mechanism.joints[joint], limits[kind, joint]
    whose = (
        "the model file's" if kind or math.isfinite(given[joint]) else "one range in full_travel"
    )
    what = f"{('velocity', 'acceleration')[kind]} {limit:.3g} ({whose})"
    return high, f"{name} moves {abs(move[joint]):.3g}, limited to {what}"


def _peaks(move: np.ndarray, begin: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Return the peak velocity and acceleration (2, n, nq) of the cubics that move by `move` (nq,)
    from the velocity `begin` (nq,) to rest, for durations (n, 1)."""
    mean = move / seconds
    # At the share s of the time: v = begin (1 - 4 s + 3 s^2) + 6 mean (s - s^2).
    bend = 3 * begin - 6 * mean
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (2 * begin - 3 * mean) / bend
    s = np.where((s > 0) & (s < 1), s, 0.0)
    turning = begin * (1 - 4 * s + 3 * s**2) + 6 * mean * (s - s**2)
    ends = np.abs(np.stack([6 * mean - 4 * begin, 2 * begin - 6 * mean])) / seconds
    return np.stack([np.maximum(np.abs(begin), np.abs(turning)), ends.max(axis=0)])
