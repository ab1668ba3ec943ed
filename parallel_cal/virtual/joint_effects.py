"""Hidden physics of encoders, gears and measuring devices, for the virtual robots.

Each class is written from the mechanics alone; it uses nothing from other rooms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.virtual.robot import Array, Effect, SampleConditions, apply, turn


@dataclass(frozen=True)
class Visit(SampleConditions):
    """Conditions of each sample, with the travel and velocity of each joint and the session."""

    travel: Array
    velocity: Array
    session: NDArray[np.int64]


@dataclass(frozen=True)
class OvalDisc(Effect):
    """An oval encoder disc: the reading leads and lags twice per turn, most at `phase` (rad)."""

    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + np.array(self.size) * np.cos(2 * (reading - np.array(self.phase)))


@dataclass(frozen=True)
class WrongPitch(Effect):
    """A spindle or belt that moves the joint by a factor 1 + `excess` of the reading."""

    excess: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading * (1 + np.array(self.excess))


@dataclass(frozen=True)
class DraggedNeighbours(Effect):
    """Coaxial shafts: joint i also moves by `drag[i][j]` times the reading of joint j."""

    drag: tuple[tuple[float, ...], ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + reading @ np.array(self.drag).T


@dataclass(frozen=True)
class UnevenScrew(Effect):
    """Screws that wobble once per lead (m); their pitch grows by a factor 2 `bend` per metre."""

    lead: float
    size: tuple[float, ...]
    phase: tuple[float, ...]
    bend: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        turned = 2 * np.pi * reading / self.lead + np.array(self.phase)
        return reading + np.array(self.size) * np.sin(turned) + np.array(self.bend) * reading**2


@dataclass(frozen=True)
class GearRipple(Effect):
    """A gear whose output ripples once per input turn, and a third as much twice per turn."""

    ratio: float
    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        turned = self.ratio * reading + np.array(self.phase)
        return reading + np.array(self.size) * (np.sin(turned) + np.sin(2 * turned) / 3)


@dataclass(frozen=True)
class WindUp(Effect):
    """A drive that lags after a reversal; the lag grows with the travel since the reversal."""

    lag: tuple[float, ...]
    width: float

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        e = np.exp(-2 * np.abs(at.travel) / self.width)
        return reading - np.array(self.lag) * at.direction * (1 - e) / (1 + e)  # lag * tanh


@dataclass(frozen=True)
class CreepingStand(Effect):
    """The robot's stand slides (m/s) and turns (rad/s) slowly relative to the device."""

    slide: tuple[float, float, float]
    spin: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        turned = turn(at.time[:, None] * np.array(self.spin))
        return apply(turned, r) + at.time[:, None] * np.array(self.slide), turned @ R
