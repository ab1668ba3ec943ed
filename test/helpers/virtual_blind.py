"""What a blind study hides: devices that err, stands that give way, noise that is not as stated.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.robot import Array, Effect, SampleConditions


@dataclass(frozen=True)
class Refraction(Effect):
    """Light that bends in layers of air: what is seen shifts with the square of the height."""

    size: float  # m at the top of the workspace
    across: tuple[float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        layer = ((r[:, 2:] - 0.2) / 0.06) ** 2
        return r + self.size * layer * np.array([*self.across, 1.0]), R


@dataclass(frozen=True)
class YieldingStand(Effect):
    """A tracker's stand on the robot's own frame, which the arms' weight bends as they swing."""

    size: float  # m for all three arms out

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        lean = self.size * np.concatenate([r[:, :2], np.hypot(r[:, :1], r[:, 1:2])], 1) / 0.06
        return r + lean * np.abs(r[:, 2:] / 0.2) ** 3, R


@dataclass(frozen=True)
class Bump(Effect):
    """Somebody leans on the stand: from one moment on the device is elsewhere."""

    size: float
    when: float  # share of the session

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        late = at.time > self.when * at.time.max()
        return r + self.size * late[:, None] * np.array([0.7, -0.5, 0.5]), R


@dataclass(frozen=True)
class Wander(Effect):
    """A device that walks at random; its walk is drawn from `seed`."""

    size: float  # m, rms over the session
    seed: int

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        walk = np.cumsum(np.random.default_rng(self.seed).standard_normal((len(r), 3)), axis=0)
        walk -= walk.mean(axis=0)
        return r + self.size * walk / np.sqrt((walk**2).mean()), R


DEVICE: dict[str, Callable[[float, np.random.Generator], Effect]] = {
    "refraction": lambda s, rng: Refraction(s, tuple(rng.uniform(-0.4, 0.4, 2))),
    "yielding stand": lambda s, rng: YieldingStand(s),
    "bump": lambda s, rng: Bump(s, rng.uniform(0.3, 0.7)),
    "wander": lambda s, rng: Wander(s, int(rng.integers(1 << 30))),
}


# What any of them may be called without the robot learning it.
OF_DEVICE = {"device_bump", "device_field", "device_axes", "base_drift"}


def white(n: int, r: Array, rng: np.random.Generator) -> Array:
    """Unit noise (n, 9) of joints, position and orientation."""
    return rng.standard_normal((n, 9))


def twice(n: int, r: Array, rng: np.random.Generator) -> Array:
    return 2 * white(n, r, rng)


def correlated(n: int, r: Array, rng: np.random.Generator) -> Array:
    """Each error nine tenths of the one before."""
    fresh, out = white(n, r, rng), np.empty((n, 9))
    out[0] = fresh[0]
    for k in range(1, n):
        out[k] = 0.9 * out[k - 1] + np.sqrt(1 - 0.81) * fresh[k]
    return out


def growing(n: int, r: Array, rng: np.random.Generator) -> Array:
    """One in the middle of the workspace, three at its border."""
    away = np.linalg.norm(r - [0, 0, 0.2], axis=1) / 0.1
    return white(n, r, rng) * (1 + 2 * np.minimum(away, 1))[:, None]


NOISE = {"stated half": twice, "correlated": correlated, "grows outwards": growing}
CALLED = {
    "stated half": "times the stated noise",
    "correlated": "correlated over",
    "grows outwards": "larger far from the centre",
}


def draw(noise: vr.Noise, units: Array) -> tuple[Array, Array, Array]:
    """Unit noise (n, 9) as errors of joints, position and rotation vector."""
    return (
        units[:, :3] * noise.joint,
        units[:, 3:6] * noise.position,
        units[:, 6:] * noise.orientation,
    )
