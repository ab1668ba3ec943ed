"""Hidden physics of encoders, gears, clocks and measuring devices, for the virtual robots.

Each is told as a mechanic would tell it, and nothing of it comes from other rooms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.virtual.robot import Array, Effect, SampleConditions, apply, turn


@dataclass(frozen=True)
class Visit(SampleConditions):
    """Circumstances of each sample; also each joint's way since it last turned back, its speed,
    and the number of the recording."""

    travel: Array
    velocity: Array
    session: NDArray[np.int64]


@dataclass(frozen=True)
class OvalDisc(Effect):
    """An oval encoder disc: the reading runs ahead and behind twice a turn, most at `phase`."""

    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + np.array(self.size) * np.cos(2 * (reading - np.array(self.phase)))


@dataclass(frozen=True)
class WrongPitch(Effect):
    """A spindle or belt that moves the joint by a little more than it says."""

    excess: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading * (1 + np.array(self.excess))


@dataclass(frozen=True)
class DraggedNeighbours(Effect):
    """Shafts led through one another: `drag[i][j]` of what joint j has turned is added to i."""

    drag: tuple[tuple[float, ...], ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + reading @ np.array(self.drag).T


@dataclass(frozen=True)
class UnevenScrew(Effect):
    """Screws that wobble once per lead (m), whose pitch grows along them by 2 `bend` a metre."""

    lead: float
    size: tuple[float, ...]
    phase: tuple[float, ...]
    bend: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        turned = 2 * np.pi * reading / self.lead + np.array(self.phase)
        return reading + np.array(self.size) * np.sin(turned) + np.array(self.bend) * reading**2


@dataclass(frozen=True)
class GearRipple(Effect):
    """A gear whose output runs ahead and behind once, and a third as much twice, an input turn."""

    ratio: float
    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        turned = self.ratio * reading + np.array(self.phase)
        return reading + np.array(self.size) * (np.sin(turned) + np.sin(2 * turned) / 3)


@dataclass(frozen=True)
class WindUp(Effect):
    """A drive that lags behind after a reversal, the more the further it has come since."""

    lag: tuple[float, ...]
    width: float

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        fading = np.exp(-2 * np.abs(at.travel) / self.width)
        return reading - np.array(self.lag) * at.direction * (1 - fading) / (1 + fading)


@dataclass(frozen=True)
class CreepingStand(Effect):
    """The robot's stand slides and turns slowly under the device's eyes."""

    slide: tuple[float, float, float]
    spin: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        turned = turn(at.time[:, None] * np.array(self.spin))
        return apply(turned, r) + at.time[:, None] * np.array(self.slide), turned @ R
