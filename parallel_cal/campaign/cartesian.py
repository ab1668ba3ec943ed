"""Plan a joint trajectory along a path of poses, within the limits of the joints. Without ROS.

The platform moves from its present pose through all poses. Between two poses it moves along a
straight line and turns about a fixed axis. Where the path turns by less than MAX_CURVE_ANGLE at a
pose, the poses are points of a curve, and the platform passes without a stop. Elsewhere it stops.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.campaign.trajectory import DEFAULT_CROSSING_TIME_S, Trajectory, rates
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solutions import stack_solutions

MAX_CURVE_ANGLE = np.radians(20.0)  # a sharper turn is a corner, at which the robot stops
MAX_CURVE_TURN = np.radians(170.0)  # of a curve: unique below half a turn
SAMPLE_STEP = 1 / 200  # largest motion of a joint between two points, as a share of its range
MIN_SAMPLES = 40  # points of each part between two stops
MAX_SAMPLES = 5000  # points of one part, which take about 1 s
MAX_JOINT_JUMP = 0.1  # share of a joint's range: more between two points is another branch
MIN_LENGTH = 1e-9  # m: nearer poses are the same
# A joint's range that moves by less than this share along the path is at rest.
NEGLIGIBLE_MOTION = 1e-9


def plan_cartesian_path(
    guard: Guard,
    start: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, float] | None = None,
    crossing: float = DEFAULT_CROSSING_TIME_S,
) -> Trajectory:
    """Plan the trajectory from joints at rest through poses, and check all of it.

    Parameters
    ----------
    guard
        The model, and what is forbidden: joint limits, workspace, singularities, keep-out boxes.
    start
        Present joints (nq,) [rad or m].
    position, rotation
        Poses (n, 3) m and (n, 3, 3); coordinates that the robot cannot command are ignored.
        Without rotation: that of home.
    at
        Conditions, constant along the path. The last direction of each joint counts for all of it.
    crossing
        Time [s] in which a joint without a velocity limit may cross its range.

    Returns
    -------
    Trajectory
        Joint positions and velocities. A controller that interpolates them by cubic polynomials,
        such as joint_trajectory_controller, exceeds no limit of velocity or acceleration.

    Raises
    ------
    PathError
        If the path is not allowed, with the reason and the place.
    """
    kinematics = Kinematics(guard.model, quick=True)
    here = kinematics.direct(start, at)
    if here.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS):
        word = Status(int(here.status)).text.replace("_", " ")
        raise PathError(f"the direct problem at the robot's present joints is {word}")
    if not len(position):
        raise PathError("the path has no poses: expected at least one")
    turned = np.broadcast_to(here.rotation if rotation is None else rotation, (len(position), 3, 3))
    r, R = np.vstack([here.position, position]), np.concatenate([here.rotation[None], turned])
    moved = [i for i in guard.model.mechanism.controlled if i < 3]
    r[:, np.setdiff1d(np.arange(3), moved)] = here.position[np.setdiff1d(np.arange(3), moved)]
    if not any(i >= 3 for i in guard.model.mechanism.controlled):
        R = np.broadcast_to(here.rotation, R.shape)
    length = guard.model.mechanism.length
    moves = np.concatenate([[True], np.linalg.norm(_steps(r, R, length), axis=1) > MIN_LENGTH])
    r, R = r[moves], R[moves]
    if len(r) == 1:
        raise PathError("the robot is already at the pose: the path has no length")
    limits = rates(guard.model.mechanism, crossing)
    parts, last = [], here
    for first, end in pairwise(_find_stops(r, R, length)):
        curve = _Curve(r[first : end + 1], R[first : end + 1], length)
        where = _Numbering(first, len(r) - 1, curve.knots)
        found = _solve_curve(kinematics, curve, last, at, where)
        violation = guard.find_violation(found.joints)
        if violation is not None:
            share, words = violation
            raise PathError(f"the path is {words} {where.before(share)}")
        parts.append(_time_optimal(found.joints, *limits))
        last = found[-1]
    # Join the motions from rest to rest; the first point is the start, at time 0.
    time, positions, velocities = [parts[0].time], [parts[0].positions], [parts[0].velocities]
    for part in parts[1:]:
        time.append(part.time[1:] + time[-1][-1])
        positions.append(part.positions[1:])
        velocities.append(part.velocities[1:])
    return Trajectory(np.concatenate(time), np.vstack(positions), np.vstack(velocities))


def _steps(r: np.ndarray, R: np.ndarray, length: float) -> np.ndarray:
    """Motions (n - 1, 6) m from each pose to the next; a rotation counts by the length."""
    turns = rotation_vector(R[1:] @ np.swapaxes(R[:-1], -1, -2))
    return np.hstack([np.diff(r, axis=0), length * turns])


def _find_stops(r: np.ndarray, R: np.ndarray, length: float) -> list[int]:
    """Return the indices of the poses at which the robot rests: both ends and the corners."""
    steps = _steps(r, R, length)
    ways = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    turn = np.arccos(np.clip(np.sum(ways[:-1] * ways[1:], axis=1), -1.0, 1.0))
    return [0, *(np.flatnonzero(turn > MAX_CURVE_ANGLE) + 1).tolist(), len(r) - 1]


@dataclass(frozen=True)
class _Numbering:
    """The number of the pose at which a part begins, that of the last pose of all, and the lengths
    of the way at the poses of the part."""

    first: int
    n: int
    knots: np.ndarray

    def before(self, share: float) -> str:
        """Name the pose that follows a share of the part's way; the start is pose 0."""
        i = int(np.searchsorted(self.knots, share * self.knots[-1] * (1 - 1e-12)))
        return f"before pose {self.first + max(i, 1)} of {self.n}"


class _Curve:
    """The cubic spline through poses over the length of the way; a line through two poses."""

    def __init__(self, r: np.ndarray, R: np.ndarray, length: float):
        from scipy.interpolate import CubicSpline

        steps = _steps(r, R, length)
        turned = float(np.sum(np.linalg.norm(steps[:, 3:], axis=1))) / length
        if len(r) > 2 and turned > MAX_CURVE_TURN:
            raise PathError(
                f"the platform turns by {np.degrees(turned):.0f} degrees on one curve; "
                f"at most {np.degrees(MAX_CURVE_TURN):.0f} are possible: divide the path"
            )
        self.knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
        turns = rotation_vector(R @ R[0].T)
        ends = "natural" if len(r) == 2 else "not-a-knot"
        self._spline = CubicSpline(self.knots, np.hstack([r, turns]), bc_type=ends)
        self._first = R[0]

    def at(self, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (n, 3), (n, 3, 3) at lengths of the way (n,)."""
        here = self._spline(way)
        return here[:, :3], rotation_matrix(here[:, 3:]) @ self._first


def _solve_curve(
    kinematics: Kinematics,
    curve: _Curve,
    last: Solutions,
    at: Mapping[str, float] | None,
    where: _Numbering,
) -> Solutions:
    """Solve the joints along a curve, each from the one before, dense enough for every joint."""
    n = MIN_SAMPLES
    ranges = np.asarray(kinematics.model.mechanism.joint_ranges)
    while True:
        way = np.linspace(0.0, curve.knots[-1], n)
        found = _follow(kinematics, *curve.at(way), last, at)
        bad = ~np.isin(found.status, (Status.CONVERGED, Status.OUTSIDE_LIMITS))
        if bad.any():
            i = int(np.argmax(bad))
            word = Status(int(found.status[i])).text.replace("_", " ")
            raise PathError(f"the path is {word} {where.before(i / (n - 1))}")
        largest = float(np.max(np.abs(np.diff(found.joints, axis=0)) / ranges))
        if largest <= SAMPLE_STEP:
            return found
        if n == MAX_SAMPLES:
            if largest > MAX_JOINT_JUMP:
                i = int(np.argmax(np.max(np.abs(np.diff(found.joints, axis=0)) / ranges, axis=1)))
                raise PathError(
                    f"a joint jumps by {largest:.0%} of its range {where.before(i / (n - 1))}: the "
                    "path leads to another branch"
                )
            raise PathError(f"the path needs more than {MAX_SAMPLES} points: divide it")
        n = min(1 + int(np.ceil(1.1 * (n - 1) * largest / SAMPLE_STEP)), MAX_SAMPLES)


def _follow(
    kinematics: Kinematics,
    r: np.ndarray,
    R: np.ndarray,
    last: Solutions,
    at: Mapping[str, float] | None,
) -> Solutions:
    """Solve poses in their order; each begins at the one before and so stays on its branch."""
    found = []
    for position, rotation in zip(r, R, strict=True):
        last = kinematics.inverse(position, rotation, at, start=last, keep_branch=True)
        found.append(last)
    return stack_solutions(found)


# ------------------------------------------------------------------ time


def _time_optimal(q: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Trajectory:
    """Return the motion through joints (n, nq) from rest to rest, nearly as fast as the limits
    (nq,) allow.

    With the share s of the path, q' = dq/ds and q'' = d2q/ds2, the joints have the velocity q' s'
    and the acceleration q'' s'^2 + q' s''. The motion is as fast as |q' s'| <= velocity and
    |q''| s'^2 + |q'| |s''| <= acceleration allow, forwards from the start and backwards from the
    end. At last, the time is stretched until the cubics between the points keep the limits, too.
    """
    from scipy.interpolate import CubicSpline

    share = np.linspace(0.0, 1.0, len(q))
    spline = CubicSpline(share, q, bc_type="natural" if len(q) < 4 else "not-a-knot")
    slope, bend = np.abs(spline(share, 1)), np.abs(spline(share, 2))
    tiny = NEGLIGIBLE_MOTION * slope.max()
    square = np.min(
        np.minimum(
            (velocity / np.maximum(slope, tiny)) ** 2, acceleration / np.maximum(bend, tiny)
        ),
        axis=1,
    )
    square[[0, -1]] = 0.0
    for order in (1, -1):
        x, d, b = square[::order], slope[::order], bend[::order]
        for i in range(len(x) - 1):
            free = (acceleration - b[i] * x[i]) / np.maximum(d[i], tiny)
            x[i + 1] = min(x[i + 1], x[i] + 2 * share[1] * max(float(free.min()), 0.0))
    speed = np.sqrt(square)
    pace = speed[:-1] + speed[1:]
    time = np.concatenate([[0.0], np.cumsum(2 * share[1] / pace)])
    velocities = spline(share, 1) * speed[:, None]
    stretch = _needed_stretch(time, q, velocities, velocity, acceleration)
    return Trajectory(stretch * time, q, velocities / stretch)


def _needed_stretch(
    time: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    velocity: np.ndarray,
    acceleration: np.ndarray,
) -> float:
    """Return the factor >= 1 on the time with which the cubics between points keep the limits."""
    T = np.diff(time)[:, None]
    mean, a, b = np.diff(q, axis=0) / T, v[:-1], v[1:]
    ends = np.abs(np.concatenate([6 * mean - 4 * a - 2 * b, -6 * mean + 2 * a + 4 * b])) / np.tile(
        T, (2, 1)
    )
    # In the middle of a cubic the velocity is (6 mean - a - b) / 4; where it turns it may be more.
    curved = 3 * (a + b) - 6 * mean
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.clip(np.nan_to_num((2 * a + b - 3 * mean) / curved, posinf=0, neginf=0), 0.0, 1.0)
    turning = a * (1 - 4 * s + 3 * s**2) + b * (3 * s**2 - 2 * s) + 6 * mean * (s - s**2)
    fastest = np.maximum(np.abs(v).max(axis=0), np.abs(turning).max(axis=0))
    shares = [*(fastest / velocity), *np.sqrt(ends.max(axis=0) / acceleration)]
    return max(1.0, float(max(shares)))
