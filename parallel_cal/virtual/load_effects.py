"""Hidden physics of weight and temperature, for the virtual robots; it uses no other room.

Forces are differences of the potential energy: move one joint, or lengthen one rod, and compute how
much all masses rise.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.virtual.robot import Array, Effect, Parameters, SampleConditions, apply, turn

DOWN = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Weights:
    """Masses (kg) of the platform, of each arm and of each rod, without payload; gravity in m/s^2.

    Arms and rods are uniform bars: their centres of mass are in the middle.
    """

    platform: float = 0.0
    arm: float = 0.0
    rod: float = 0.0
    gravity: tuple[float, float, float] = DOWN

    def energy(self, robot: Any, angle: Array, payload: Array) -> Array:
        """Compute the potential energy (J) of all moving masses, with the joints at `angle`."""
        r, R = robot.forward(angle)
        height = -np.array(self.gravity)
        energy = (self.platform + payload) * (r @ height)
        if self.arm or self.rod:
            C, B = robot.joint_points(angle), robot.platform_points(r, R)
            arms = robot.hub + (C[..., :3, :] + C[..., 3:, :]) / 2
            energy = energy + self.arm * (arms @ height).sum(-1) / 2
            energy = energy + self.rod * ((C + B) @ height).sum(-1) / 2
        return energy

    def torques(self, robot: Any, angle: Array, payload: Array, step: float = 1e-5) -> Array:
        """Compute the load of the weights on each joint, Nm (N): energy lost per rad (m)."""
        turns = step * np.eye(angle.shape[-1])[:, None]
        before, after = (self.energy(robot, angle + t, payload) for t in (-turns, turns))
        return np.moveaxis(before - after, 0, -1) / (2 * step)

    def tensions(self, robot: Any, angle: Array, payload: Array, step: float = 1e-6) -> Array:
        """Compute the tension of each rod, N: energy lost per metre of its elongation."""
        more = step * np.eye(robot.rods.shape[-1])[:, None]
        angle = np.broadcast_to(angle, (len(more), *angle.shape))
        short, long = (
            self.energy(with_rods(robot, robot.rods + m), angle, payload) for m in (-more, more)
        )
        return np.moveaxis(short - long, 0, -1) / (2 * step)


def with_rods(robot: Any, rods: Array) -> Any:
    """Return the robot with other rods, one set for all samples or one per sample."""
    other = copy.copy(robot)
    other.rods = rods
    return other


@dataclass(frozen=True)
class ShaftTwist(Effect):
    """Shafts (or spindles) that deflect by `compliance` (rad/Nm or m/N) under load."""

    compliance: tuple[float, ...]
    weights: Weights = field(default_factory=Weights)

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        angle = reading
        for _ in range(4):  # fixed point: the load depends on the deflection
            torque = self.weights.torques(robot, angle, at.payload)
            angle = reading + np.array(self.compliance) * torque
        return angle


@dataclass(frozen=True)
class SoftRods(Effect):
    """Rods that are springs: `compliance` (m/N) times their tension is their elongation."""

    compliance: float
    weights: Weights = field(default_factory=Weights)

    def loaded_robot(self, robot: Any, angle: Array, at: SampleConditions) -> Any:
        soft = robot
        for _ in range(3):
            tension = self.weights.tensions(soft, angle, at.payload)
            soft = with_rods(robot, robot.rods + self.compliance * tension)
        return soft


@dataclass(frozen=True)
class Warmth(Effect):
    """Named dimensions that grow by `growth` (1/K) above 20 degC: {"Lb": 1e-6}.

    The screws or scales that measure sliding joints grow by `scales` (1/K): a joint slides further
    than it reads.
    """

    growth: dict[str, float]
    scales: float = 0.0

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        def warm(name: str, value: Any) -> Any:
            part = name.split(".")[1].split("_")[0]
            return value * (1 + self.growth.get(part, 0.0) * (at.temperature - 20.0))

        return {name: warm(name, value) for name, value in parameters.items()}

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading * (1 + self.scales * (at.temperature[..., None] - 20.0))


@dataclass(frozen=True)
class SoftFrame(Effect):
    """A frame on legs: it sinks by `settle` (m/N) and leans by `tilt` (rad/Nm) of the moment."""

    settle: float
    tilt: float

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        weight = at.payload[:, None] * np.array(DOWN)
        lean = turn(self.tilt * np.cross(r, weight))
        return apply(lean, r) + self.settle * weight, lean @ R
