"""Check whether the path to a target is safe, and compute its duration. Does not use ROS.

A controller moves along a straight line in joint space between two joint commands. The check solves
points on this line. The path must not cross a singularity, come near one, or leave the workspace.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.singularity import distances
from parallel_cal.model.mechanism import Mechanism

N_CHECKED_POINTS = 12  # points on the path, including both ends
SLACK = 1e-6  # m or rad by which a target at the edge of the workspace may lie outside


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
) -> CheckedPath:
    """Check the path from joints `start` (nq,) to a target; raise SolveError if it is not safe.

    A cubic in time from rest to rest over a distance d with the velocity limit v and the
    acceleration limit a takes at least 1.5 d / v and sqrt(6 d / a).
    """
    mechanism = kinematics.model.mechanism
    share = np.linspace(0.0, 1.0, N_CHECKED_POINTS)[:, None]
    found = kinematics.direct(start + share * (target.joints - start), at)
    usable = np.isin(found.status, (Status.CONVERGED, Status.OUTSIDE_LIMITS))
    if not usable[0]:
        raise SolveError(
            "the direct problem has no solution at the robot's present joints: "
            "no path from there is known"
        )
    if not usable.all():
        word = Status(int(found.status[int(np.argmin(usable))])).text.replace("_", " ")
        raise SolveError(f"the path to the target is {word} {_part(int(np.argmin(usable)))}")
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
    return CheckedPath(
        *_compute_duration(mechanism, np.abs(target.joints - start), bounds), float(least.min())
    )


def _part(i: int) -> str:
    return f"at {100 * i / (N_CHECKED_POINTS - 1):.0f} % of its length"


def _check_workspace(mechanism: Mechanism, found: Solutions) -> None:
    """Refuse a path that leaves the workspace, or that leads further out if it begins outside."""
    poses = np.hstack([found.position, rotation_vector(found.rotation)])[:, mechanism.controlled]
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    out = np.maximum(low - poses, poses - high).max(axis=1)
    bad = out > max(SLACK, float(out[0]) + SLACK)
    if bad.any():
        i = int(np.argmax(bad))
        raise SolveError(
            f"the path to the target leaves the model file's workspace {_part(i)}, by {out[i]:.3g} "
            "m or rad"
        )


def _compute_duration(mechanism: Mechanism, moved: np.ndarray, bounds: Bounds) -> tuple[float, str]:
    """Return the duration [s] of the slowest joint, and a sentence about its limit."""
    needed = []
    rates = mechanism.joint_rates or ((math.inf, math.inf),) * len(moved)
    limits = zip(mechanism.joints, moved, mechanism.joint_ranges, rates, strict=True)
    for joint, d, width, (velocity, acceleration) in limits:
        speed, whose = velocity, "the model file's"
        if not math.isfinite(speed):
            speed, whose = width / bounds.crossing, "one range in full_travel"
        for seconds, what in (
            (1.5 * d / speed, f"velocity {speed:.3g} ({whose})"),
            (
                math.sqrt(6 * d / acceleration),
                f"acceleration {acceleration:.3g} (the model file's)",
            ),
        ):
            needed.append((float(seconds), f"{joint} moves {d:.3g}, limited to {what}"))
    return max(needed)
