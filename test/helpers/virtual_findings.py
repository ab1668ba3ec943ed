"""Sessions with hidden physics at a wanted size, for finding it again; no bag in between.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import virtual_day as vd
import virtual_effects_hidden as hidden
import virtual_sessions as days

from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.robot import Array, Effect, SampleConditions

FINE = vr.Noise(joint=5 * vr.ARCSEC, position=2e-6, orientation=3 * vr.ARCSEC)
FINEST = vr.Noise(joint=2 * vr.ARCSEC, position=0.8e-6, orientation=1.2 * vr.ARCSEC)


@dataclass(frozen=True)
class Kind:
    """A kind of hidden physics: `make(size, rng)` draws one, `names` are what it may be called."""

    names: tuple[str, ...]
    make: Callable[[float, np.random.Generator], Effect]
    size: float
    noise: vr.Noise = vr.THESIS_NOISE


def three(size: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """One number a joint, none of them small."""
    a, b, c = size * rng.uniform(0.6, 1.4, 3) * rng.choice([-1, 1], 3)
    return a, b, c


def widths(size: float, rng: np.random.Generator) -> tuple[float, float, float]:
    a, b, c = size * rng.uniform(0.6, 1.4, 3)
    return a, b, c


HARMONICS = ("encoder_eccentricity", "encoder_second_harmonic", "encoder_gain")
KINDS = {
    "eccentricity": Kind(
        HARMONICS, lambda s, rng: vr.EncoderEccentricity(three(s, rng), three(s, rng)), 3e-3
    ),
    "gear ripple": Kind(
        ("gear_transmission_error",),
        lambda s, rng: hidden.GearRipple(three(s, rng), three(3, rng), rng.uniform(15, 60)),
        0.2e-3,
    ),
    "backlash": Kind(
        ("backlash", "hysteresis"), lambda s, rng: vr.Backlash(widths(s, rng)), 0.3e-3
    ),
    "joint compliance": Kind(
        ("joint_compliance", "rod_compliance", "payload_sag"),
        lambda s, rng: hidden.JointCompliance(widths(s, rng)),
        0.5e-3,
    ),
    "thermal growth": Kind(
        ("thermal_expansion",),
        lambda s, rng: hidden.ThermalGrowth(*widths(s, rng)),
        10e-6,
        FINE,
    ),
    "base drift": Kind(
        ("base_drift",),
        lambda s, rng: hidden.BaseDrift(three(s, rng), three(5 * s, rng)),
        0.05e-6,
    ),
    "leaning axes": Kind(
        ("device_axes",), lambda s, rng: hidden.LeaningAxes(*three(s, rng)), 0.2e-3, FINEST
    ),
}


@dataclass(frozen=True)
class Outside(Effect):
    """Something no catalogue has: `way(reading, size)` is added to the joints."""

    way: Callable[[Array, float], Array]
    size: float

    def arm(self, reading: Array, robot: object, at: SampleConditions) -> Array:
        return reading + self.way(reading, self.size)


@dataclass(frozen=True)
class Dented(Effect):
    """A device with a dent in its field: positions are pulled towards a place in the workspace."""

    size: float
    centre: tuple[float, float, float]

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        away = r - np.array(self.centre)
        near = np.exp(-np.sum(away**2, axis=-1, keepdims=True) / (2 * 0.02**2))
        return r + self.size * near * np.array([0.6, -0.5, 0.6]), R


def step(reading: Array, size: float) -> Array:
    """A scratched encoder track: beyond an angle everything is counted a little more."""
    return size * np.tanh((reading - np.median(reading, axis=0)) / 0.01)


def of_first(way: Callable[[Array], Array]) -> Callable[[Array, float], Array]:
    """An error of the first joint alone, in proportion to a `way` of its readings."""
    return lambda reading, size: size * way(reading) * np.array([1, 0, 0])


OUTSIDE = {
    "cross-talk": lambda s, rng: hidden.CrossTalk(three(s, rng), rng.uniform(5, 9)),
    "products of joints": lambda s, rng: Outside(
        lambda q, size: size * np.sin(4 * q) * np.cos(5 * np.roll(q, 1, -1)), s
    ),
    "scratched tracks": lambda s, rng: Outside(step, s),
    "a dented field": lambda s, rng: Dented(
        0.12 * s, tuple(np.array([0, 0, 0.2]) + rng.uniform(-0.03, 0.03, 3))
    ),
    "chirping gears": lambda s, rng: Outside(lambda q, size: size * np.sin(25 * q**2 + 3), s),
    "a dented joint": lambda s, rng: Outside(of_first(lambda q: np.exp(-((q / 0.12) ** 2))), s),
    "a kinked joint": lambda s, rng: Outside(of_first(np.abs), s),
    "a joint that jumps": lambda s, rng: Outside(of_first(np.sign), 0.5 * s),
}


def session(seed: int, n_poses: int = 120, n_replicates: int = 30) -> vd.Session:
    """Ten seconds a pose in a hall that warms and cools, with and without a load."""
    visits = n_poses + n_replicates
    masses = np.where(np.arange(visits) * 6 // visits % 2, 1.2, 0.2)
    return vd.plan(n_poses, n_replicates, seed, dwell=10.0, air=days.wandering, payload=masses)


def samples(
    day: vd.Session, effects: Sequence[Effect], noise: vr.Noise, seed: int
) -> dict[str, Array]:
    """What is measured on such a day, a row a dwell."""
    at = day.at(day.arrive + day.dwell / 2)
    _, r, R = vr.truth(vr.MOCK_UP, effects, day.reading, at)
    q_error, r_error, w_error = noise.draw(np.random.default_rng(seed), len(r))
    measured = {"q": day.reading + q_error, "r": r + r_error, "R": vr.turn(w_error) @ R}
    return measured | vars(at) | {"pose_index": day.pose_index, "home": day.home}
