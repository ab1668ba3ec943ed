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
class LobedRing(Effect):
    """An encoder ring pulled out of round by its screws: the reading waves `lobes` times a turn."""

    lobes: int
    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + np.array(self.size) * np.cos(self.lobes * (reading - np.array(self.phase)))


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
class LateStamp(Effect):
    """Poses are stamped late: what is shown was so when the joints were not yet so far."""

    delay: float

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        return reading - self.delay * at.velocity


@dataclass(frozen=True)
class HomedAnew(Effect):
    """Before the second recording the joints were homed again, not quite to the same zero."""

    by: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        return np.where(at.session[:, None] == 0, reading, reading + np.array(self.by))


@dataclass(frozen=True)
class CreepingStand(Effect):
    """The robot's stand slides and turns slowly under the device's eyes."""

    slide: tuple[float, float, float]
    spin: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        turned = turn(at.time[:, None] * np.array(self.spin))
        return apply(turned, r) + at.time[:, None] * np.array(self.slide), turned @ R


@dataclass(frozen=True)
class CrookedAxes(Effect):
    """A machine whose slides do not meet at right angles, nor measure in one metre.

    Its axes as columns: going by its own reading along them leads to the true point.
    """

    x: tuple[float, float, float]
    y: tuple[float, float, float]
    z: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        axes = np.column_stack([self.x, self.y, self.z])
        return apply(np.linalg.inv(axes), r), R


@dataclass(frozen=True)
class Knock(Effect):
    """Somebody runs into the tripod at `time`: what it shows has since been turned and shifted."""

    time: float
    shift: tuple[float, float, float]
    spin: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        after = (at.time > self.time)[:, None]
        turned = turn(after * np.array(self.spin))
        return apply(turned, r) + after * np.array(self.shift), turned @ R


@dataclass(frozen=True)
class BentSpace(Effect):
    """Light that curves and slides that are not straight, about `centre`.

    Where the device shows s from there, the point is at s + bend_i . s s, a form (1/m) each axis.
    """

    bend: tuple[tuple[tuple[float, ...], ...], ...]
    centre: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        true = r - np.array(self.centre)
        shown = true
        for _ in range(6):  # the bend is of what is shown, and that is what is asked for
            shown = true - np.einsum("ijk,...j,...k->...i", np.array(self.bend), shown, shown)
        return shown + np.array(self.centre), R


@dataclass(frozen=True)
class LeaningBase(Effect):
    """A base that tips towards the side on which the robot holds its weight, rad per metre aside.

    `lean` about x and about y: a weight at +x lowers that side, one at +y the other.
    """

    lean: tuple[float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        about_x, about_y = self.lean
        tipped = np.stack([-about_x * r[..., 1], about_y * r[..., 0], 0 * r[..., 0]], -1)
        return apply(turn(tipped), r), turn(tipped) @ R


@dataclass(frozen=True)
class MisplacedTarget(Effect):
    """The reflector sits beside the platform's origin."""

    at_platform: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        return r + apply(R, np.array(self.at_platform)), R
