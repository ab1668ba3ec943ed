"""Whether the way to a target may be driven, and in what time; no ROS in it.

Between two joint commands a controller goes straight in the joints. So does the check: some points
of that line are solved, and none may be near a singularity, beyond it, or outside the workspace.
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

N_CHECKED_POINTS = 12  # of the way that are looked at, its ends among them
SLACK = 1e-6  # m or rad that a target at the workspace's very edge may be beyond it


@dataclass(frozen=True)
class Bounds:
    """What a motion must keep: s in which a joint that the model file gives no velocity may cross
    its range, and the least scaled singular value."""

    crossing: float
    singularity: float


@dataclass(frozen=True)
class CheckedPath:
    """s that the motion needs at least, which joint says so, and the smallest singular value."""

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
    """The way from joints (nq,) to a target; SolveError where it must not be driven.

    A motion from rest to rest over d takes 1.5 d / velocity and sqrt(6 d / acceleration), as a
    cubic in time does.
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
    near = distances(kinematics.model, found, at)
    least = np.minimum(near.direct, near.inverse)
    for signs in (near.direct_sign, near.inverse_sign):
        if (signs != signs[0]).any():
            raise SolveError(
                "the path to the target passes a singularity "
                f"{_part(int(np.argmax(signs != signs[0])))}"
            )
    # Out of a singularity is allowed: the way must not lead further in.
    bad = (least < bounds.singularity) & (least < least[0])
    if bad.any():
        i = int(np.argmax(bad))
        raise SolveError(
            f"the path to the target is too near a singularity {_part(i)}: {least[i]:.3g}, "
            f"allowed {bounds.singularity:g}"
        )
    return CheckedPath(*_time(mechanism, np.abs(target.joints - start), bounds), float(least.min()))


def _part(i: int) -> str:
    return f"at {100 * i / (N_CHECKED_POINTS - 1):.0f} % of its length"


def _check_workspace(mechanism: Mechanism, found: Solutions) -> None:
    """No point may be further out than where the robot is: back in is allowed."""
    here = np.hstack([found.position, rotation_vector(found.rotation)])[:, mechanism.controlled]
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    out = np.maximum(low - here, here - high).max(axis=1)
    bad = out > max(SLACK, float(out[0]) + SLACK)
    if bad.any():
        i = int(np.argmax(bad))
        raise SolveError(
            f"the path to the target leaves the model file's workspace {_part(i)}, by {out[i]:.3g} "
            "m or rad"
        )


def _time(mechanism: Mechanism, moved: np.ndarray, bounds: Bounds) -> tuple[float, str]:
    """The time the slowest joint needs, and a sentence."""
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
