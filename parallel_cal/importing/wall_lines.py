"""Machines whose lines or belts hold a sled in a plane, as FluidNC computes them.

- WallPlotter: a motor lets out |r - A_i| - |A_i|, from the origin.
- Maslow (version 4): r counts from the crossing of the anchors' diagonals. A belt ends on an arm
  that points to its anchor: in the plane it is |r - A_i| - offset long, and its whole length is the
  hypotenuse over its height.

Source: bdring/FluidNC e952f33f, FluidNC/src/Kinematics/WallPlotter.cpp; BarbourSmith/FluidNC
10d7de0b, FluidNC/src/Maslow/Maslow.cpp (computeTL, updateCenterXY).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array


@dataclass(frozen=True)
class PlotterLines:
    """Anchors (2, 2) m, left and right; readings are lengths let out from the origin."""

    anchors: Array

    @property
    def homed(self) -> Array:
        return np.zeros(len(self.anchors))

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the lengths (N, 2) m for the pen at r (N, 3) m."""
        away = np.linalg.norm(r[:, None, :2] - self.anchors, axis=2)
        return np.asarray(away - np.linalg.norm(self.anchors, axis=1))

    def model(self) -> Model:
        return new_model(load_mechanism("cable", anchors=self.anchors.tolist()))


@dataclass(frozen=True)
class MaslowBelts:
    """Anchors (4, 2) m at top left, top right, bottom left and bottom right.

    `offset` (m) is from the middle of the sled to where a belt is measured from. Readings are
    lengths of belt in the plane.
    """

    anchors: Array
    offset: float

    @property
    def homed(self) -> Array:
        return np.zeros(len(self.anchors))

    @property
    def centre(self) -> Array:
        """The origin (2,) m of positions: the crossing of the diagonals."""
        top_left, top_right, bottom_left, bottom_right = self.anchors
        up, down = top_right - bottom_left, bottom_right - top_left
        along, _ = np.linalg.solve(np.column_stack([up, -down]), top_left - bottom_left)
        return np.asarray(bottom_left + along * up)

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the lengths (N, 4) m for the sled at r (N, 3) m."""
        places = self.anchors - self.centre
        return np.asarray(np.linalg.norm(r[:, None, :2] - places, axis=2) - self.offset)

    def model(self) -> Model:
        mechanism = load_mechanism(
            "cable", anchors=(self.anchors - self.centre).tolist(), zero="anchors", home=[0.0, 0.0]
        )
        nominal = {f"line{i}.offset": self.offset for i in range(1, len(self.anchors) + 1)}
        mechanism.parameters = mechanism.parameters.with_nominal(nominal)
        return new_model(mechanism)
