"""Rank what may have moved between two recordings: the device, the target, or the zeros."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.base.units import MM
from parallel_cal.identification.frames import Frames, PosePairs
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import condition_columns
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

ZERO_STEPS = 5  # of the search: zeros shift by little

DEVICE = "the device, or the base under the robot, moved"
TARGET = "the target moved"
BOTH = "device and target moved"
ZEROS = "the zeros of the joints changed"


@dataclass(frozen=True)
class Explanation:
    """What may explain errors of measured poses (rows,), in m: the errors that remain, and how many
    parameters were found from them. `rms` is the error of a pose (m; rad if only orientations were
    measured)."""

    what: str
    errors: np.ndarray
    parameters: int
    rms: float

    @classmethod
    def of(cls, what: str, there: PosePairs, frames: Frames, parameters: int) -> Explanation:
        return cls(what, there.compute_errors(frames), parameters, there.compute_rms(frames))

    @property
    def criterion(self) -> float:
        """The Bayesian information criterion, for errors of unknown size; smaller is likelier."""
        rows, squares = self.errors.size, max(float(np.sum(self.errors**2)), 1e-300)
        return rows * float(np.log(squares / rows)) + self.parameters * float(np.log(rows))


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

    Each is fitted alone, with the robot and all the rest as they were.
    """
    found = [
        explain_by_frames(what, there, there.find_frames(device, target), device, target)
        for what, device, target in ((DEVICE, True, False), (TARGET, False, True))
    ]
    found.append(explain_by_frames(BOTH, there, there.frames))
    found.append(_explain_by_zeros(model, observations, there))
    return sorted(found, key=lambda one: one.criterion)


def explain_by_frames(
    what: str, there: PosePairs, frames: Frames, device: bool = True, target: bool = True
) -> Explanation:
    """Explain errors by frames, of which those of the `device` or of the `target` were found."""
    free = np.repeat([device, target], 6)
    return Explanation.of(what, there, frames, there.count_free(frames, free))


def _explain_by_zeros(model: Model, observations: Observations, there: PosePairs) -> Explanation:
    """Explain errors by the zeros of the joints that fit best. They shift by no more than the range
    of a joint, and explain nothing at poses that the robot could not reach with them."""
    from scipy.optimize import least_squares

    q = observations.x[:, : len(model.joints)]
    solver, at = Kinematics(model, quick=True), condition_columns(model, observations)
    span = np.ptp(np.array(model.mechanism.joint_limits), axis=1)

    def predicted(zeros: np.ndarray) -> PosePairs:
        found = solver.direct(q + zeros, at)
        known = found.solved[:, None, None]
        r = np.where(known[:, 0], found.position, there.r)
        return replace(there, r=r, R=np.where(known, found.rotation, there.R))

    found = least_squares(
        lambda zeros: predicted(zeros).compute_errors(there.now),
        np.zeros(q.shape[1]),
        bounds=(-span, span),
        x_scale=model.mechanism.joint_ranges,
        max_nfev=ZERO_STEPS,
    )
    zeros = int(np.linalg.matrix_rank(found.jac))
    return Explanation.of(ZEROS, predicted(found.x), there.now, zeros)
