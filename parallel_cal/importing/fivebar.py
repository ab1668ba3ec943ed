"""Five-bars as RepRapFirmware computes them: a rod joins each crank's elbow to the point.

A crank has two possible angles. With `turns` 1 the point lies to the left of the crank, with -1 to
its right. Source: Duet documentation, "M669" (K9) and "Five bar parallel SCARA".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

TURNS = {1: (1, 1), 2: (-1, 1), 4: (-1, -1)}  # work mode -> turns of left and right crank


@dataclass(frozen=True)
class FiveBars:
    """Axes (2, 2) m, cranks and rods (2,) m of left and right; angles at the switches (2,) rad."""

    axes: Array
    cranks: Array
    rods: Array
    turns: tuple[int, int]
    homed: Array
    limits: tuple[tuple[float, float], ...] = ((0.0, np.pi),) * 2

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the angles (N, 2) of the cranks from x, in rad from 0 to 2 pi."""
        offset = r[:, None, :2] - self.axes
        away = np.linalg.norm(offset, axis=2)
        cosine = (away**2 + self.cranks**2 - self.rods**2) / (2 * away * self.cranks)
        with np.errstate(invalid="ignore"):
            opened = np.arccos(cosine)
        aim = np.arctan2(offset[..., 1], offset[..., 0])
        return np.asarray((aim - np.array(self.turns) * opened) % (2 * np.pi))

    def mechanism(self) -> Mechanism:
        """Return the mechanism with these numbers, with home in front of the axes."""
        found = load_mechanism("five_bar", switches=self.homed.tolist())
        nominal: dict[str, float] = {}
        for k, side in enumerate(("left", "right")):
            numbers = (*self.axes[k], self.cranks[k], self.rods[k])
            names = (f"{side}.{name}" for name in ("x", "y", "crank", "rod"))
            nominal |= dict(zip(names, map(float, numbers), strict=True))
        found.parameters = found.parameters.with_nominal(nominal)
        found.joint_limits = self.limits
        middle, reach = self.axes.mean(axis=0), float((self.cranks + self.rods).min())
        across = self.axes[1] - self.axes[0]
        up = np.array([-across[1], across[0]]) / np.linalg.norm(across)
        x, y = (middle + 0.8 * reach * up).tolist()
        home = self.joints(np.array([[x, y, 0.0]]))[0]
        found.home = Home(tuple(map(float, home)), (x, y, 0.0))
        half = 0.12 * reach
        found.workspace = Workspace((x - half, y - half), (x + half, y + half))
        return found
