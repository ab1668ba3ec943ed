"""The kinds of physics that a cell may hide, each drawn at a size that matters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.virtual import joint_effects as joints
from parallel_cal.virtual import load_effects as loads
from parallel_cal.virtual.machines import MACHINES, Machine
from parallel_cal.virtual.robot import Backlash, Effect, EncoderEccentricity

HIDDEN = "hidden"  # a kind that is drawn, and told to nobody
TURNING, SLIDING = ("delta", "argos"), ("stewart", "linear_delta")
LOADED, RODS = ("delta", "stewart", "linear_delta"), ("delta", "linear_delta")


@dataclass(frozen=True)
class Kind:
    """Physics of some machines: `names` are what a diagnosis may call it, `make` draws one.

    `asks` are the circumstances that must change for it to show: temperature, payload or time.
    """

    names: tuple[str, ...]
    make: Callable[[Machine, np.random.Generator], Effect]
    machines: tuple[str, ...] = (*TURNING, *SLIDING)
    asks: str = ""


def signed(size: float, machine: Machine, rng: np.random.Generator) -> tuple[float, ...]:
    """One number a joint, none of them small."""
    return tuple(sized(size, machine, rng) * rng.choice([-1, 1], len(machine.joints)))


def sized(size: float, machine: Machine, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(size * machine.lever * rng.uniform(0.6, 1.4, len(machine.joints)))


def around(machine: Machine, rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(rng.uniform(-np.pi, np.pi, len(machine.joints)))


def _eccentricity(machine: Machine, rng: np.random.Generator) -> Effect:
    sin, cos = (signed(3e-3, machine, rng) for _ in "sc")
    return EncoderEccentricity(sin, cos)  # type: ignore[arg-type]


def _creep(machine: Machine, rng: np.random.Generator) -> Effect:
    slide, spin = (rng.uniform(0.6, 1.4, 3) * rng.choice([-1, 1], 3) for _ in "ss")
    return joints.CreepingStand(tuple(2e-7 * slide), tuple(1e-6 * spin))


def _warmth(machine: Machine, rng: np.random.Generator) -> Effect:
    arms, rods, base = rng.permutation([23e-6, 12e-6, 1e-6])
    parts = {"La": arms, "Lb": rods, "dLb": rods, "L0": rods, "B": arms, "D": base, "b": base}
    return loads.Warmth(parts | {"C": base})


KINDS = {
    "eccentricity": Kind(("encoder_eccentricity",), _eccentricity, TURNING),
    "oval_disc": Kind(
        ("encoder_second_harmonic",),
        lambda m, rng: joints.OvalDisc(signed(2e-3, m, rng), around(m, rng)),
        TURNING,
    ),
    "gain": Kind(
        ("encoder_gain",),
        lambda m, rng: joints.WrongPitch(signed(4e-3 / m.lever, m, rng)),
    ),
    "gear_ripple": Kind(
        ("gear_transmission_error",),
        lambda m, rng: joints.GearRipple(
            rng.uniform(15, 40), signed(0.6e-3, m, rng), around(m, rng)
        ),
        TURNING,
    ),
    "screw_wobble": Kind(
        ("screw_pitch_error",),
        lambda m, rng: joints.UnevenScrew(
            5e-3, signed(0.4e-3, m, rng), around(m, rng), signed(2e-2, m, rng)
        ),
        SLIDING,
    ),
    "backlash": Kind(("backlash",), lambda m, rng: Backlash(tuple(sized(1.2e-3, m, rng)))),
    "wind_up": Kind(
        ("hysteresis",),
        lambda m, rng: joints.WindUp(tuple(sized(0.8e-3, m, rng)), 0.15 * m.lever),
    ),
    "cross_talk": Kind(
        ("encoder_crosstalk",),
        lambda m, rng: joints.DraggedNeighbours(
            tuple(tuple(row) for row in _beside(len(m.joints)) * rng.uniform(2e-3, 4e-3))
        ),
    ),
    "shaft_twist": Kind(
        ("joint_compliance",),
        lambda m, rng: loads.ShaftTwist(tuple(sized(1.5e-3, m, rng) * m.lever)),
        LOADED,
        "payload",
    ),
    "soft_rods": Kind(
        ("rod_compliance",),
        lambda m, rng: loads.SoftRods(rng.uniform(8e-6, 16e-6)),
        RODS,
        "payload",
    ),
    "leaning_base": Kind(
        ("base_compliance",),
        lambda m, rng: joints.LeaningBase(tuple(rng.uniform(5e-3, 1e-2, 2))),  # type: ignore[arg-type]
        LOADED,
    ),
    "warmth": Kind(("thermal_expansion",), _warmth, LOADED, "temperature"),
    "creep": Kind(("base_drift",), _creep, asks="time"),
}


def _beside(n: int) -> np.ndarray:
    """1 where a joint's neighbour drags it, else 0."""
    return np.asarray(np.eye(n, k=1) - np.eye(n, k=-1))


def kinds_of(robot: str) -> list[str]:
    """What may be hidden in a robot."""
    return [name for name, kind in KINDS.items() if robot in kind.machines]


def hide(robot: str, words: Sequence[str], seed: int) -> tuple[list[str], list[Effect]]:
    """Names and physics of the kinds named; `hidden` stands for one that `seed` draws.

    ValueError for a word that names none of this robot's kinds.
    """
    rng, names = np.random.default_rng([seed, 42]), list[str]()
    may = kinds_of(robot)
    for word in words:
        if word != HIDDEN and word not in may:
            raise ValueError(f"effect {word}: a {robot} may have {', '.join(may)} or {HIDDEN}")
        left = [name for name in may if name not in (*names, *words)]
        names.append(str(rng.choice(left)) if word == HIDDEN else word)
    return names, [KINDS[name].make(MACHINES[robot], rng) for name in names]
