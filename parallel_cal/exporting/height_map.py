"""What a firmware's numbers leave of the heights of a bed, as a map that it adds to z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.exporting.projection import Machine
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

HALF_CELLS = 5  # from the middle to the edge
ROUNDS = 4  # of the heights; each leaves about a hundredth of the error


@dataclass(frozen=True)
class HeightMap:
    """Heights (n, n) m by y and x at coordinates (n,) m on both axes; NaN outside of the `radius`
    (m) and out of reach."""

    at: np.ndarray
    radius: float
    heights: np.ndarray

    @classmethod
    def of(cls, model: Model, machine: Machine) -> HeightMap:
        """Find the firmware's heights at which the nozzle of the full model is on the bed."""
        box = np.array([model.mechanism.workspace.low, model.mechanism.workspace.high])[:, :2]
        radius = float(np.floor(np.ptp(box, axis=0).min() / 2**0.5 / MM)) * MM
        at = np.round(np.arange(-HALF_CELLS, HALF_CELLS + 1) * radius / HALF_CELLS, 5)
        x, y = (each.ravel() for each in np.meshgrid(at, at))
        kinematics, frame = Kinematics(model, quick=True), machine.frame
        r, R = np.column_stack([x, y, 0 * x]), np.broadcast_to(np.eye(3), (len(x), 3, 3))
        inside = x**2 + y**2 < radius**2
        for _ in range(ROUNDS):
            q = machine.readings(frame.origin + r @ frame.axes.T, frame.turn @ R)
            found = kinematics.direct(np.where(np.isfinite(q), q, np.nan))
            above = frame.poses(found.position, found.rotation)[0][:, 2]
            r[:, 2] -= np.where(found.solved & inside, above, np.nan)
        return cls(at, radius, r[:, 2].reshape(len(at), -1))
