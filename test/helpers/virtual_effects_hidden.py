"""The physics hidden in the recordings beyond eccentric discs and play, one class an effect.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.virtual.robot import Array, Effect, Parameters, SampleConditions, apply, turn

GRAVITY = 9.81  # m/s^2, along -z of the base


@dataclass(frozen=True)
class GearRipple(Effect):
    """Teeth that are not alike: once per turn of the gear's input the arm runs ahead and behind."""

    amplitude: tuple[float, ...]
    phase: tuple[float, ...]
    ratio: float

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        wave = np.sin(self.ratio * reading + np.array(self.phase))
        return reading + np.array(self.amplitude) * wave


@dataclass(frozen=True)
class JointCompliance(Effect):
    """Shafts that twist, rad/Nm each, under the payload's weight; robot and platform weigh nothing.

    A small turn of joint j lifts the payload by dz: its torque is the weight times dz per turn,
    measured by turning the robot's joints one after the other.
    """

    compliance: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        angle = reading
        for _ in range(3):  # twist and torque settle at once: a twist is a thousandth of a turn
            torque = -GRAVITY * at.payload[:, None] * lift(robot, angle)
            angle = reading + np.array(self.compliance) * torque
        return angle


def lift(robot: Any, angle: Array, step: float = 1e-5) -> Array:
    """Height that the platform gains per turn of each joint, m/rad, shape (..., joints)."""
    turns = step * np.eye(angle.shape[-1])
    gains = [robot.forward(angle + t)[0] - robot.forward(angle - t)[0] for t in turns]
    return np.stack([gain[..., 2] for gain in gains], -1) / (2 * step)


@dataclass(frozen=True)
class ThermalGrowth(Effect):
    """Arms, rods and base of a Delta that grow by so much per kelvin above the reference, degC."""

    arms: float
    rods: float
    base: float
    reference: float = 20.0

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        warmer = at.temperature - self.reference
        return {k: v * (1 + self.growth(k) * warmer) for k, v in parameters.items()}

    def growth(self, name: str) -> float:
        """What a dimension's part grows by, 1/K; an angle and the platform do not."""
        parts = {"La": self.arms, "Lb": self.rods, "dLb": self.rods, "D": self.base}
        return parts.get(name.split(".")[1].split("_")[0], 0.0)


@dataclass(frozen=True)
class BaseDrift(Effect):
    """A base that creeps away from the device by v (m/s) and turns by w (rad/s) as time goes by."""

    v: tuple[float, float, float]
    w: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        turned = turn(np.array(self.w) * at.time[:, None])
        return apply(turned, r) + np.array(self.v) * at.time[:, None], turned @ R


@dataclass(frozen=True)
class LeaningAxes(Effect):
    """A device whose y leans towards x by xy (rad), and whose z leans towards x and y."""

    xy: float
    xz: float
    yz: float

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        axes = np.array([[1, self.xy, self.xz], [0, 1, self.yz], [0, 0, 1.0]])  # columns
        return apply(np.linalg.inv(axes), r), R


@dataclass(frozen=True)
class LateStamp(Effect):
    """A device that stamps a pose so many seconds after it took it."""

    delay: float

    def taken(self, stamp: Array) -> Array:
        return stamp - self.delay


@dataclass(frozen=True)
class CrossTalk(Effect):
    """Wiring laid side by side: each joint's signal ripples with the angle of the next joint."""

    amplitude: tuple[float, ...]
    waves: float

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + np.array(self.amplitude) * np.sin(self.waves * np.roll(reading, -1, -1))
