"""Hidden laws of nobody's catalogue, for the virtual Delta.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package. No formula here
comes from the search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import virtual_effects_hidden as hidden

from parallel_cal.virtual.robot import Array, Effect, Parameters, SampleConditions


def loads(robot: Any, reading: Array, at: SampleConditions) -> Array:
    """Torque of the payload's weight on each joint, N m."""
    return -hidden.GRAVITY * at.payload[:, None] * hidden.lift(robot, reading)


@dataclass(frozen=True)
class JointLaw(Effect):
    """`law(reading, torques, at)` (N, 3) in units of `size` (rad) is added to the joints."""

    size: float
    law: Callable[[Array, Array, SampleConditions], Array]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + self.size * self.law(reading, loads(robot, reading, at), at)


@dataclass(frozen=True)
class ArmTemperatures(Effect):
    """Arms that warm up one after the other, each with a temperature of its own."""

    size: float  # m

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        end = float(at.time.max())
        warmth = {
            f"chain{i}.La_x": self.size * (1 - np.exp(-at.time / (share * end)))
            for i, share in ((1, 0.1), (2, 0.3), (3, 1.0))
        }
        return {k: v + warmth[k] if k in warmth else v for k, v in parameters.items()}


@dataclass(frozen=True)
class Sag(Effect):
    """A platform that sinks with the payload and the square of its distance from the middle."""

    size: float  # m at 1 kg and 0.06 m

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        sunk = self.size * at.payload * (r[:, 0] ** 2 + r[:, 1] ** 2) / 0.06**2
        return r - sunk[:, None] * np.array([0, 0, 1.0]), R


@dataclass(frozen=True)
class RodsByDirection(Effect):
    """Rods whose joints have play: each pair's length depends on the way its arm came."""

    size: float  # m

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        rods = {f"chain{i}.Lb": self.size * at.direction[:, i - 1] for i in (1, 2, 3)}
        return {k: v + rods[k] if k in rods else v for k, v in parameters.items()}


def only(joint: int, values: Array) -> Array:
    """One column of three, the others zero."""
    out = np.zeros((len(values), 3))
    out[:, joint] = values
    return out


def dent(reading: Array, torque: Array, at: SampleConditions) -> Array:
    middle = np.median(reading[:, 1]) + 0.1 * np.ptp(reading[:, 1])
    width = 0.06 * np.ptp(reading[:, 1])
    return only(1, np.exp(-(((reading[:, 1] - middle) / width) ** 2)))


def cross(reading: Array, torque: Array, at: SampleConditions) -> Array:
    q = reading - reading.mean(axis=0)
    return only(0, q[:, 1] * q[:, 2] / np.std(q[:, 1]) / np.std(q[:, 2]))


def lag(reading: Array, torque: Array, at: SampleConditions) -> Array:
    return -at.direction * (1 + 2 * at.payload[:, None])


LAWS: dict[str, Callable[[float, np.random.Generator], Effect]] = {
    "cubic spring in joint 3": lambda s, rng: JointLaw(
        s, lambda q, t, at: only(2, (t[:, 2] / 0.5) ** 3)
    ),
    "joint lag that grows with payload": lambda s, rng: JointLaw(s, lag),
    "joint 1 errs with joints 2 and 3": lambda s, rng: JointLaw(s, cross),
    "dent of one encoder disc": lambda s, rng: JointLaw(s, dent),
    "each arm with a temperature of its own": lambda s, rng: ArmTemperatures(s),
    "sag with payload and radius squared": lambda s, rng: Sag(s),
    "rod length depends on direction": lambda s, rng: RodsByDirection(s),
    "cogging of joint 2": lambda s, rng: JointLaw(
        s, lambda q, t, at: only(1, np.sin(37 * q[:, 1] + 0.4))
    ),
}
