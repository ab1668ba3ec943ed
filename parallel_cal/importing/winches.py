"""Cable robots as Klipper's `kinematics: winch` computes them: a stepper is the length of its line.

A stepper is at |r - A_i| with its anchor A_i. There is no end-stop: when Klipper starts, and at
G28, the end point is taken to be at the origin. From its steppers, Klipper computes the point by
the first three alone (GET_POSITION, probing): of two, the one from which they are seen clockwise.
Source: Klipper3d/klipper 84104bbbd, klippy/kinematics/winch.py, klippy/chelper/kin_winch.c and
klippy/mathutil.py (trilateration).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

MIRRORED = (
    "the first three anchors are counter-clockwise as seen from the origin's side of their plane: "
    "what Klipper computes from its steppers (GET_POSITION, probing) is the mirror image of the "
    "point on the other side, {:.0f} mm away. Moves are right. To cure it, exchange the sections "
    "stepper_b and stepper_c"
)


@dataclass(frozen=True)
class Winches:
    """Anchors (n, 3) m, those of stepper_a, stepper_b and so on."""

    anchors: Array

    @property
    def homed(self) -> Array:
        """The steppers at the origin."""
        return np.asarray(np.linalg.norm(self.anchors, axis=1))

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the lengths (N, n) m of the lines for the end point at r (N, 3) m."""
        return np.asarray(np.linalg.norm(r[:, None] - self.anchors, axis=2))

    def model(self) -> Model:
        return new_model(load_mechanism("cable", anchors=self.anchors.tolist(), zero="anchors"))

    def describe_mirror(self) -> list[str]:
        """Return what is wrong with Klipper's forward kinematics at the origin; empty if nothing
        is."""
        a, b, c = self.anchors[:3]
        normal = np.cross(b - a, c - a)
        above = -float(normal @ a) / float(np.linalg.norm(normal))
        return [MIRRORED.format(2e3 * above)] if above > 0 else []
