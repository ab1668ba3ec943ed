"""Rank what may have moved between two recordings: the device, the target, or the zeros."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.base.units import MM
from parallel_cal.identification.frames import Frames, PosePairs
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import condition_columns
from parallel_cal.identification.thresholds import ROUNDING
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

ZERO_STEPS = 3  # of Gauss-Newton: zeros shift by little
ZERO_DIFFERENCE = 1e-6  # rad or m, of a numerical derivative

DEVICE = "the device, or the base under the robot, moved"
TARGET = "the target moved"
BOTH = "device and target moved"
ZEROS = "the zeros of the joints changed"


@dataclass(frozen=True)
class Explanation:
    """What may have moved between two recordings: its number of parameters, the rms error that
    remains (m; rad if only orientations were measured), and its information criterion."""

    what: str
    parameters: int
    rms: float
    criterion: float


def describe_what_moved(model: Model, observations: Observations, there: PosePairs) -> str:
    """Say what is likeliest to have moved since the frames `there.now` were found, with the errors
    that each explanation leaves, and which measurement decides."""
    best, *others = rank_what_moved(model, observations, there)
    unit, scale = ("mm", 1 / MM) if there.placed.any() else ("mrad", 1e3)

    def show(one: Explanation) -> str:
        error = one.rms * scale
        return f"{f'{error:.0f}' if error >= 100 else f'{error:.3g}'} {unit}"

    left = ", ".join(f"{show(one)} if {one.what}" for one in others)
    clear = others[0].criterion - best.criterion > 2 * EQUAL_EVIDENCE
    return (
        f"likeliest{'' if clear else ', but not clearly'}, {best.what} (rms error {show(best)}; "
        f"{left}). To be sure, measure three fixed points of the base in every recording: if they "
        "stay where they were, the target moved or the zeros of the joints changed"
    )


def rank_what_moved(
    model: Model, observations: Observations, there: PosePairs
) -> list[Explanation]:
    """Rank what may have moved since the frames `there.now` were found, the likeliest first.

    Each is fitted alone, with the robot and all the rest as they were. The Bayesian information
    criterion ranks them.
    """
    everything = np.ones(len(there.r), dtype=bool)
    device, target = np.arange(12) < 6, np.arange(12) >= 6
    near = there.start_of_device()
    fits: list[tuple[str, np.ndarray, Frames]] = [
        (DEVICE, device, there.descend(near, everything, device)),
        (TARGET, target, there.descend(there.now, everything, target)),
        (BOTH, device | target, there.frames),
    ]
    found = [
        _explain(what, there, frames, there.count_free(frames, free)) for what, free, frames in fits
    ]
    with_zeros, zeros = _with_other_zeros(model, observations, there)
    found.append(_explain(ZEROS, with_zeros, there.now, zeros))
    return sorted(found, key=lambda one: one.criterion)


def _explain(what: str, there: PosePairs, frames: Frames, parameters: int) -> Explanation:
    errors = there.compute_errors(frames)
    rows = errors.size
    squares = max(float(np.sum(errors**2)), 1e-300)
    criterion = rows * float(np.log(squares / rows)) + parameters * float(np.log(rows))
    return Explanation(what, parameters, there.compute_rms(frames), criterion)


def _with_other_zeros(
    model: Model, observations: Observations, there: PosePairs
) -> tuple[PosePairs, int]:
    """The poses that the robot predicts with the zeros of its joints that fit best, and how many
    zeros the poses determine. Zeros shift by no more than the range of a joint."""
    q = observations.x[:, : len(model.joints)]
    solver, at = Kinematics(model), condition_columns(model, observations)
    span = np.ptp(np.array(model.mechanism.joint_limits), axis=1)

    def predicted(zeros: np.ndarray) -> PosePairs:
        reached = solver.direct(q + zeros, at)
        return replace(there, r=reached.position, R=reached.rotation)

    zeros, rank = np.zeros(q.shape[1]), 0
    here = there
    for _ in range(ZERO_STEPS):
        errors = here.compute_errors(there.now)
        columns = [
            (predicted(zeros + step).compute_errors(there.now) - errors) / ZERO_DIFFERENCE
            for step in ZERO_DIFFERENCE * np.eye(len(zeros))
        ]
        change, _, rank, _ = np.linalg.lstsq(np.stack(columns, axis=1), -errors, rcond=ROUNDING)
        if np.any(np.abs(zeros + change) > span):  # no zeros: the robot could not be there
            break
        zeros = zeros + change
        here = predicted(zeros)
    return here, int(rank)
