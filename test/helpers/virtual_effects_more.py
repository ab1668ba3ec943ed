"""Hidden physics that only tests and benchmarks use: no virtual cell hides it.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.virtual.joint_effects import Visit
from parallel_cal.virtual.load_effects import Weights, with_rods
from parallel_cal.virtual.robot import Array, Effect, SampleConditions, apply, turn


@dataclass(frozen=True)
class LobedRing(Effect):
    """An encoder ring that its screws pull out of round: the error has `lobes` waves per turn."""

    lobes: int
    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        return reading + np.array(self.size) * np.cos(self.lobes * (reading - np.array(self.phase)))


@dataclass(frozen=True)
class LateStamp(Effect):
    """A device that stamps poses `delay` s late: it shows where the joints were before."""

    delay: float

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        return reading - self.delay * at.velocity


@dataclass(frozen=True)
class LateDrives(Effect):
    """Position loops of the gains K_v (1/s): y' = K_v (x - y) behind a command x that has long
    moved at the velocity of the sample. The reading is the command."""

    gain: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        step, steps = 0.01, 2500  # in units of 1 / K_v
        command = reading - steps * step * at.velocity / np.array(self.gain)
        angle = command
        for _ in range(steps):
            ahead = command + step / 2 * at.velocity / np.array(self.gain)  # in mid-step
            angle = (angle * (1 - step / 2) + step * ahead) / (1 + step / 2)
            command = command + step * at.velocity / np.array(self.gain)
        return angle


@dataclass(frozen=True)
class Motion(Visit):
    """Visits in motion, with the acceleration of each joint (rad/s^2 or m/s^2)."""

    acceleration: Array

    @classmethod
    def of(cls, at: Visit, fastest: float, seed: int) -> Motion:
        """Accelerations up to `fastest`, whatever the velocities are."""
        drawn = np.random.default_rng([seed, 12]).uniform(-fastest, fastest, at.velocity.shape)
        return cls(**vars(at), acceleration=drawn)


@dataclass(frozen=True)
class BentByInertia(Effect):
    """An arm of the inertia J behind a spring k with a damper, of the natural frequencies sqrt(k/J)
    (rad/s): the reading, before the spring, has speeded up evenly for a long time."""

    frequency: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: Motion) -> Array:  # type: ignore[override]
        step, damping = 0.01, 1.0  # step in units of 1 / frequency
        push = at.acceleration / np.array(self.frequency) ** 2
        behind, rate = np.zeros_like(push), np.zeros_like(push)
        for _ in range(3000):
            # The arm's own acceleration is what spring and damper give it.
            rate = rate + step * (push - behind - 2 * damping * rate)
            behind = behind + step * rate
        return reading - behind


@dataclass(frozen=True)
class RubbingGears(Effect):
    """Gears whose friction is the share `mu` of their load, before shafts of the compliance `soft`
    (rad/Nm or m/N): the arm stops where the shaft's twist is balanced by the friction."""

    mu: float
    soft: tuple[float, ...]
    weights: Weights = field(default_factory=Weights)

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        angle = reading
        for _ in range(4):  # fixed point: the load depends on where the arm stops
            pressed = np.abs(self.weights.torques(robot, angle, at.payload))
            angle = reading - np.array(self.soft) * self.mu * pressed * at.direction
        return angle


@dataclass(frozen=True)
class StiffeningGears(Effect):
    """Gears that twist by e under the load k1 e + k3 e^3 (Nm/rad, Nm/rad^3)."""

    k1: tuple[float, ...]
    k3: tuple[float, ...]
    weights: Weights = field(default_factory=Weights)

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        k1, k3 = np.array(self.k1), np.array(self.k3)
        angle = reading
        for _ in range(4):  # fixed point: the load depends on the twist
            load = self.weights.torques(robot, angle, at.payload)
            low, high = -np.abs(load) / k1, np.abs(load) / k1
            for _ in range(60):
                middle = (low + high) / 2
                over = k1 * middle + k3 * middle**3 > load
                low, high = np.where(over, low, middle), np.where(over, middle, high)
            angle = reading + (low + high) / 2
        return angle


@dataclass(frozen=True)
class BeatingGears(Effect):
    """Strain-wave gears of a ratio: both ends of the wave generator pass an error of the same size
    on either spline. What they show is a fast wave whose size rises and falls with the arm."""

    ratio: float
    size: tuple[float, ...]
    fast: tuple[float, ...]
    slow: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        envelope = np.array(self.size) * np.cos(reading - np.array(self.slow))
        return reading + envelope * np.cos((2 * self.ratio + 1) * reading - np.array(self.fast))


@dataclass(frozen=True)
class UnevenPitch(Effect):
    """Poles or teeth at a `pitch` (m): the joint runs ahead by `size` (m) at `phase` (rad), and
    half as much, there and in the middle of the pitch, by the next wave."""

    pitch: float
    size: tuple[float, ...]
    phase: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        turned = 2 * np.pi * reading / self.pitch - np.array(self.phase)
        return reading + np.array(self.size) * (np.cos(turned) + np.cos(2 * turned) / 2)


@dataclass(frozen=True)
class HomedAnew(Effect):
    """Joints homed again before the second recording: their zeros are off by `by` (rad or m)."""

    by: tuple[float, ...]

    def arm(self, reading: Array, robot: Any, at: Visit) -> Array:  # type: ignore[override]
        return np.where(at.session[:, None] == 0, reading, reading + np.array(self.by))


@dataclass(frozen=True)
class CrookedAxes(Effect):
    """A measuring machine whose axes are not perpendicular and differ in scale.

    `x`, `y`, `z` are its axes in the base frame: the true point is axes @ reading.
    """

    x: tuple[float, float, float]
    y: tuple[float, float, float]
    z: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        axes = np.column_stack([self.x, self.y, self.z])
        return apply(np.linalg.inv(axes), r), R


@dataclass(frozen=True)
class Knock(Effect):
    """A push against the tripod at `time` (s): later poses are turned by `spin` and shifted."""

    time: float
    shift: tuple[float, float, float]
    spin: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        after = (at.time > self.time)[:, None]
        turned = turn(after * np.array(self.spin))
        return apply(turned, r) + after * np.array(self.shift), turned @ R


@dataclass(frozen=True)
class BentSpace(Effect):
    """A device whose error is quadratic in the position relative to `centre`.

    If the device shows s, the true position is s_i + s^T bend_i s, with one form (1/m) per axis i.
    """

    bend: tuple[tuple[tuple[float, ...], ...], ...]
    centre: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        true = r - np.array(self.centre)
        shown = true
        for _ in range(6):  # fixed point: the error depends on the shown position
            shown = true - np.einsum("ijk,...j,...k->...i", np.array(self.bend), shown, shown)
        return shown + np.array(self.centre), R


@dataclass(frozen=True)
class LeaningBase(Effect):
    """A base that tips towards the platform, in rad per metre of the platform's lateral position.

    `lean` has one number for turns about x and one for turns about y. The side under the platform
    sinks.
    """

    lean: tuple[float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        about_x, about_y = self.lean
        tipped = np.stack([-about_x * r[..., 1], about_y * r[..., 0], 0 * r[..., 0]], -1)
        return apply(turn(tipped), r), turn(tipped) @ R


@dataclass(frozen=True)
class PartsWarmth(Effect):
    """Named dimensions that grow by `growth` (1/K) with the temperature (degC) of their own part:
    {"Lb": (1e-6, temperatures)}, with one temperature for each sample. `scales` are the screws or
    scales that measure sliding joints."""

    growth: dict[str, tuple[float, Array]]
    scales: tuple[float, Any] = (0.0, 20.0)

    def geometry(self, parameters: Any, at: SampleConditions) -> Any:
        cold: tuple[float, Any] = (0.0, 20.0)
        larger = {}
        for name, value in parameters.items():
            rate, temperature = self.growth.get(name.split(".")[1].split("_")[0], cold)
            larger[name] = value * (1 + rate * (temperature - 20.0))
        return larger

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        rate, temperature = self.scales
        return reading * (1 + rate * (np.asarray(temperature)[..., None] - 20.0))


@dataclass(frozen=True)
class PartsOfAHall(Effect):
    """Arms near the motors, rods in the air and a base on a cold floor, each of which follows the
    morning in its own way and grows by its own rate (1/K): the dimensions La, Lb and D."""

    arms: float
    rods: float
    base: float

    @staticmethod
    def temperatures(time: Array) -> dict[str, Array]:
        """What a sensor on each part reads, degC."""
        t = time / max(float(np.max(time)), 1.0)
        return {
            "arms": 20.0 + 14.0 * (1 - np.exp(-4 * t)),
            "rods": 20.0 + 6.0 * np.sin(2 * np.pi * 1.5 * t),
            "base": 20.0 - 9.0 * t**2,
        }

    def geometry(self, parameters: Any, at: SampleConditions) -> Any:
        warm = self.temperatures(at.time)
        growth = {
            "La": (self.arms, warm["arms"]),
            "Lb": (self.rods, warm["rods"]),
            "D": (self.base, warm["base"]),
        }
        return PartsWarmth(growth).geometry(parameters, at)


@dataclass(frozen=True)
class MisplacedTarget(Effect):
    """A reflector at `at_platform` (m, in {P}) instead of the platform's origin."""

    at_platform: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        return r + apply(R, np.array(self.at_platform)), R


@dataclass(frozen=True)
class LooseBalls(Effect):
    """Ball joints with clearance `play` (m), which is taken up fully above some `force` (N)."""

    play: float
    force: float
    weights: Weights = field(default_factory=Weights)

    def loaded_robot(self, robot: Any, angle: Array, at: SampleConditions) -> Any:
        loose = robot
        for _ in range(3):
            e = np.exp(-2 * self.weights.tensions(loose, angle, at.payload) / self.force)
            # (1 - e) / (1 + e) is the tanh of tension / force.
            loose = with_rods(robot, robot.rods + self.play * (1 - e) / (1 + e))
        return loose
