"""Model uncertainty of the platform's position over the workspace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model

POSES_PER_AXIS = 7  # poses from one end of the workspace to the other


@dataclass(frozen=True)
class PositionUncertainty:
    """Platform positions (M, 3) m in {B}, and the covariance (M, 3, 3) that follows from the
    identified parameters; `across` names the coordinates that were varied."""

    places: np.ndarray
    covariance: np.ndarray
    across: str

    @classmethod
    def of(cls, model: Model) -> PositionUncertainty | None:
        """Three grids through the middle of the workspace, at right angles; None if the model was
        not identified or controls fewer than two coordinates of a position."""
        mechanism, robot = model.mechanism, model.robot()
        axes = [k for k in range(3) if POSE[k] in mechanism.controls]
        if model.covariance is None or len(axes) < 2:
            return None
        low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
        grids = []
        for one, other in ((a, b) for a in axes for b in axes if a < b):
            i, j = mechanism.controls.index(POSE[one]), mechanism.controls.index(POSE[other])
            grid = np.tile((low + high) / 2, (POSES_PER_AXIS**2, 1))
            grid[:, [i, j]] = np.stack(
                np.meshgrid(*np.linspace(low[[i, j]], high[[i, j]], POSES_PER_AXIS).T), axis=-1
            ).reshape(-1, 2)
            grids.append(grid)
        kinematics = Kinematics(robot)
        found = kinematics.inverse(*mechanism.poses(np.unique(np.vstack(grids), axis=0)))
        solved = found[found.solved]
        if not len(solved):
            return None
        spread = kinematics.direct_covariance(solved)[:, :3, :3]
        return cls(solved.position, spread, "".join(POSE[k] for k in axes))
