"""Deltesian printers as Klipper computes them.

The left rod's rail is at -A_l and the right one's at A_r, less the rods' joints on the effector:
q_l = z + sqrt(L_l^2 - (x + A_l)^2), q_r = z + sqrt(L_r^2 - (x - A_r)^2), and the bed moves by y.
When homed, a carriage is where the nozzle in the middle has the height position_endstop. Source:
Klipper3d/klipper 84104bbbd, klippy/kinematics/deltesian.py and klippy/chelper/kin_deltesian.c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing.reach import shrink_workspace
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

HOME_HEIGHT_M = 0.05  # above the bed
MIN_ANGLE = 5.0  # degrees between a rod and the horizontal, the default of Klipper's min_angle
WRITTEN_DECIMALS = 6  # of mm, of which whole numbers are made
SIGNS = np.array([-1.0, 1.0])  # of the rails along x


@dataclass(frozen=True)
class DeltesianArms:
    """Widths and rods (2,) m of left and right; joints (3,) m at the end-stops; the bed's range."""

    widths: Array
    rods: Array
    homed: Array
    y_limits: tuple[float, float]

    @property
    def heights(self) -> Array:
        """The nozzle's heights (2,) m on the axis with one carriage at its end-stop."""
        return self.homed[:2] - np.sqrt(self.rods**2 - self.widths**2)

    def max_print_width(self, min_angle: float) -> float:
        """Return the largest print_width, a whole number of mm, that Klipper accepts."""
        reach = (np.cos(min_angle * DEGREE) * self.rods - self.widths)[::-1]
        left, right = np.floor(np.round(np.minimum(self.widths, reach) / MM, WRITTEN_DECIMALS))
        return float(min(left + right, 2 * left, 2 * right))

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the joints (N, 3) in m for the nozzle at r (N, 3); NaN out of reach."""
        with np.errstate(invalid="ignore"):
            up = np.sqrt(self.rods**2 - (r[:, :1] - SIGNS * self.widths) ** 2)
        return np.column_stack([r[:, 2:] + up, r[:, 1]])

    def mechanism(self) -> Mechanism:
        """Return the mechanism with these numbers and with home over the middle of the bed."""
        found = load_mechanism("deltesian", switches=self.homed.tolist())
        names = [(k, side) for k, side in enumerate(("left", "right"))]
        nominal = {f"{side}.x": float(SIGNS[k] * self.widths[k]) for k, side in names}
        nominal |= {f"{side}.rod": float(self.rods[k]) for k, side in names}
        found.parameters = found.parameters.with_nominal(nominal)
        tops = [(-0.1, float(top)) for top in self.homed[:2]]
        found.joint_limits = (*tops, self.y_limits)
        at = np.array([0.0, float(np.mean(self.y_limits)), HOME_HEIGHT_M])
        found.home = Home(
            tuple(map(float, self.joints(at[None])[0])), (0.0, float(at[1]), HOME_HEIGHT_M)
        )
        reach = 0.8 * float((self.rods - self.widths).min())
        low, high = self.y_limits
        box = Workspace((-reach, low, 0.0), (reach, high, 2 * HOME_HEIGHT_M))
        limits = np.array(found.joint_limits)
        found.workspace = shrink_workspace(box, at, self.joints, limits)
        return found
