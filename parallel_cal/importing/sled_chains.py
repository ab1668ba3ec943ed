"""Sleds on two chains as the firmware of the Maslow (up to version 3) computes them.

A chain is measured from 12 o'clock of its sprocket. `Triangular` chains point to the bit, and the
rotation radius is taken off their lengths. `Quadrilateral` chains end at two mounts of a sled that
tilts; the firmware finds the tilt, but the place where a chain leaves its sprocket with
sin(sin(angle)) in place of sin(angle) of the mount (_YOffsetEqn), which makes chains up to 1 mm
wrong. Source: MaslowCNC/Firmware fad6ad31, cnc_ctrl_v1/Kinematics.cpp (triangularInverse,
quadrilateralInverse, recomputeGeometry).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism, load_sensor
from parallel_cal.recordings.recording import Array

NEWTON_STEPS, STEP = 20, 1e-6  # rad
SAG_UNIT = 1e-12 / MM**2  # of chainSagCorrection, in 1/m^2
SAG_OF_EFFECT = 24.0  # (w / weight)^2 of line_sag per unit of the firmware's


@dataclass(frozen=True)
class SledChains:
    """A Maslow: the motors `spacing` apart and `height` above the middle of the sheet, m; `radius`
    of the sprockets, m."""

    spacing: float
    height: float
    radius: float

    @property
    def homed(self) -> Array:
        """Chains have no end-stops: they are counted from 12 o'clock."""
        return np.zeros(2)

    def sled(self, **sizes: Any) -> Model:
        """Return the model of a sled on these sprockets. What is measured are marks of the bit, so
        that nothing on the sled is away from the origin of {P}."""
        anchors = [[side * self.spacing / 2, self.height] for side in (-1, 1)]
        sled = load_mechanism("hanging_sled", anchors=anchors, radius=self.radius, **sizes)
        marks = load_sensor("device_frame", fixed=("target.*",))
        return new_model(sled, sensors=(marks,))

    def ways(self, r: Array) -> tuple[Array, Array]:
        """Return how far (N, 2) m the bit at r (N, 3) m is beside each motor, and below it."""
        beside = self.spacing / 2 + r[:, :1] * np.array([1, -1])
        return beside, np.broadcast_to(self.height - r[:, 1:2], beside.shape)


@dataclass(frozen=True)
class Triangular(SledChains):
    """`rotation` (m) is the radius on which the chains end, `over` whether they leave the sprockets
    at the top; `sag` is the correction of their sag (1/m^2). The chains are longer than stated by
    the fractions `left` and `right`."""

    rotation: float
    over: bool = True
    sag: float = 0.0
    left: float = 0.0
    right: float = 0.0

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the lengths of chain (N, 2) m for the bit at r (N, 3) m."""
        beside, below = self.ways(r)
        away, side = np.hypot(beside, below), 1 if self.over else -1
        angle = np.arcsin(below / away) + side * np.arcsin(self.radius / away)
        arc = self.radius * (angle if self.over else np.pi - angle)
        straight = np.sqrt(away**2 - self.radius**2)
        flat, other = np.cos(angle), angle[:, ::-1]
        pull = (np.tan(other) * flat + np.sin(angle)) ** 2
        straight = straight * (1 + self.sag * (flat * straight) ** 2 * pull)
        return np.asarray(arc + straight / (1 + np.array([self.left, self.right])) - self.rotation)

    def model(self) -> Model:
        """Return the model; a correction of sag is that of the effect line_sag.

        A chain of the weight w per metre under the tension t sags by w^2 S^3 cos^2 / (24 t^2).
        """
        middle = np.zeros((1, 3))
        sags = float(np.mean(self.joints(middle) - replace(self, sag=0.0).joints(middle)))
        ends = [[0.0, 0.0], [0.0, 0.0]]
        plain = self.sled(mounts=ends, over=self.over, retracted=self.rotation - sags)
        if not self.sag:
            return plain
        model = plain.with_effect("line_sag")
        sag = np.array([name == "line_sag.sag" for name in model.table.names])
        return model.with_values(np.where(sag, SAG_OF_EFFECT * self.sag, model.values))


@dataclass(frozen=True)
class Quadrilateral(SledChains):
    """The mounts are `width` apart and `above` the bit, the centre of gravity `below` it, m."""

    width: float
    above: float
    below: float

    def joints(self, r: Array, R: Array | None = None) -> Array:
        """Return the lengths of chain (N, 2) m for the bit at r (N, 3) m."""
        tilt = np.zeros(len(r))
        with np.errstate(invalid="ignore"):  # NaN where a mount would be inside a sprocket
            for _ in range(NEWTON_STEPS):
                moment, ahead, back = (
                    self._balance(r, tilt + step)[0] for step in (0.0, STEP, -STEP)
                )
                tilt = tilt - np.clip(moment * 2 * STEP / (ahead - back), -0.2, 0.2)
            return self._balance(r, tilt)[1]

    def _balance(self, r: Array, tilt: Array) -> tuple[Array, Array]:
        """Return the lever (N,) m that the chains do not balance, and their lengths (N, 2) m, of
        sleds that are turned to the right."""
        beside, below = self.ways(r)
        arm = np.hypot(self.width / 2, self.above)
        psi = np.arctan2(2 * self.above, self.width) + tilt[:, None] * np.array([-1, 1])
        flat, tall = arm * np.cos(psi), arm * np.sin(psi)
        across = beside - flat
        # The slope t of the tangent of a sprocket: t across - drop = R sqrt(1 + t^2).
        drop = below - arm * np.sin(np.sin(psi))  # the firmware's
        square = across**2 - self.radius**2
        root = np.sqrt(across**2 + drop**2 - self.radius**2)
        tangent = (drop * across + self.radius * root) / square
        top = self.radius * np.sqrt(1 + tangent**2)  # above the motor: the chain's line crosses x 0
        fall = below - tall + top
        slope = fall / across
        lift = slope[:, 0] * np.cos(psi[:, 0]) - slope[:, 1] * np.cos(psi[:, 1])
        lever = arm / slope.sum(axis=1) * (np.sin(psi[:, 1]) - np.sin(psi[:, 0]) + lift)
        arc = self.radius * (np.arctan(slope) - slope)
        return self.below * np.sin(tilt) + lever, np.hypot(across, fall) + arc

    def model(self) -> Model:
        mounts = [[side * self.width / 2, self.above] for side in (-1, 1)]
        return self.sled(mounts=mounts, below=self.below, retracted=0.0)
