"""Morgan's SCARA as Smoothieware computes it: two arms, each at the angle of its own motor.

r = origin + arm1 (cos theta, sin theta) + arm2 (cos psi, sin psi), with psi between theta and theta
+ 180 degrees. Source: Smoothieware/Smoothieware bb41e992, arm_solutions/MorganSCARASolution.cpp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.importing.reach import shrink_workspace
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

LEVER = 0.2  # of arm 1: the assumed length of the crank that is parallel to the forearm
SWING = 1.2  # rad, to both sides of home
REACH = 0.25  # of arm 1: half the side of the workspace


@dataclass(frozen=True)
class MorganArms:
    """Arms and origin (2,) m; theta and psi (2,) rad when homed, and the largest and the smallest
    cosine (2,) of the angle between the arms."""

    arms: Array
    origin: Array
    homed: Array
    cosines: tuple[float, float] = (0.95, -0.95)

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return theta and psi (N, 2) in rad for the end point at r (N, 3); NaN out of reach."""
        (first, second), away = self.arms, np.asarray(r)[:, :2] - self.origin
        cosine = ((away**2).sum(axis=1) - first**2 - second**2) / (2 * first * second)
        reached = (cosine <= self.cosines[0]) & (cosine >= self.cosines[1])
        bend = np.arccos(np.where(reached, cosine, np.nan))
        aside = np.arctan2(second * np.sin(bend), first + second * np.cos(bend))
        theta = np.arctan2(away[:, 1], away[:, 0]) - aside
        return np.column_stack([theta, theta + bend])

    def mechanism(self) -> Mechanism:
        """Return the five-bar with these numbers, whose readings are psi and theta, with a right
        angle between the arms at home."""
        away = -self.origin if self.origin.any() else np.array([0.0, 1.0])
        point = self.origin + np.hypot(*self.arms) * away / np.linalg.norm(away)
        at = np.array([*point, 0.0])
        theta, psi = map(float, self.joints(at[None])[0])
        (first, second), lever = map(float, self.arms), LEVER * float(self.arms[0])
        found = load_mechanism(
            "five_bar",
            base=0.0,
            crank=[lever, first],
            rod=[first, lever],
            tool=[-(lever + second), 0.0],
            carrier="right",
            home=[psi + np.pi, theta],
            below=True,
            switches=self.homed[::-1].tolist(),
        )
        x, y = map(float, self.origin)
        nominal = {"left.q0": np.pi} | {f"{side}.x": x for side in ("left", "right")}
        nominal |= {f"{side}.y": y for side in ("left", "right")}
        found.parameters = found.parameters.with_nominal(nominal)
        found.home = Home((psi, theta), (float(point[0]), float(point[1]), 0.0))
        found.joint_limits = ((psi - SWING, psi + SWING), (theta - SWING, theta + SWING))
        half = REACH * first
        box = Workspace(tuple((point - half).tolist()), tuple((point + half).tolist()))
        limits = np.array(found.joint_limits)
        found.workspace = shrink_workspace(box, point, lambda r: self.joints(r)[:, ::-1], limits)
        return found
