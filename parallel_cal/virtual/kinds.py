"""The kinds of physics that a cell may hide, with sizes of real machines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.virtual import joint_effects as joints
from parallel_cal.virtual import load_effects as loads
from parallel_cal.virtual.machines import MACHINES, Machine
from parallel_cal.virtual.robot import Array, Backlash, Effect, EncoderEccentricity

HIDDEN = "hidden"  # stands for a random, undisclosed kind
TURNING, SLIDING = ("delta", "argos"), ("stewart", "linear_delta")
LOADED, RODS = ("delta", "stewart", "linear_delta"), ("delta", "linear_delta")
PRINTED, CAST, ALUMINIUM = 90e-6, 60e-6, 23e-6  # 1/K; the first two are polymers
STEEL = 11.7e-6  # 1/K; screws


@dataclass(frozen=True)
class Kind:
    """One kind of physics, for the machines whose geometry cannot imitate it.

    `effect`: the effect of the catalogue that a diagnosis should name. `make` draws an example.
    `asks`: the condition that must change to make it visible: temperature, payload or time.
    """

    effect: str
    make: Callable[[Machine, np.random.Generator], Effect]
    machines: tuple[str, ...] = (*TURNING, *SLIDING)
    asks: str = ""


def draw_sizes(size: float, machine: Machine, rng: np.random.Generator) -> tuple[float, ...]:
    """Draw one number per joint near `size` (rad; for sliding joints times `lever`)."""
    return tuple(size * machine.lever * rng.uniform(0.6, 1.4, len(machine.joints)))


def draw_signed_sizes(size: float, machine: Machine, rng: np.random.Generator) -> tuple[float, ...]:
    signs = rng.choice([-1.0, 1.0], len(machine.joints))
    return tuple(signs * draw_sizes(size, machine, rng))


def draw_angles(machine: Machine, rng: np.random.Generator) -> tuple[float, ...]:
    """Draw one angle per joint."""
    return tuple(rng.uniform(-np.pi, np.pi, len(machine.joints)))


def make_wind_up(machine: Machine, rng: np.random.Generator) -> Effect:
    width = 20e-3 if machine.lever == 1 else 0.3e-3
    return joints.WindUp(draw_sizes(0.55e-3, machine, rng), width)


def make_shaft_twist(machine: Machine, rng: np.random.Generator) -> Effect:
    """Draw shaft compliances: rad/Nm, or m/N for sliding joints, which are stiffer."""
    size = 1.5e-3 if machine.lever == 1 else 0.4e-3 * machine.lever
    return loads.ShaftTwist(draw_sizes(size, machine, rng))


def make_creeping_stand(machine: Machine, rng: np.random.Generator) -> Effect:
    slide, spin = (rng.uniform(0.6, 1.4, 3) * rng.choice([-1, 1], 3) for _ in "vw")
    return joints.CreepingStand(tuple(2e-7 * slide), tuple(1e-6 * spin))


def make_warmth(machine: Machine, rng: np.random.Generator) -> Effect:
    """Draw the materials of arms (or platform), rods (or legs) and base, all different; screws are
    of steel."""
    arms, rods, base = rng.permutation([PRINTED, CAST, ALUMINIUM])
    parts = {"La": arms, "Lb": rods, "dLb": rods, "D": base, "b": base}
    screws = 0.0 if machine.lever == 1 else STEEL
    return loads.Warmth(parts | {"B": arms, "L0": rods, "C": base}, screws)


KINDS = {
    "eccentricity": Kind(
        "encoder_eccentricity",
        lambda m, rng: EncoderEccentricity(
            draw_signed_sizes(4e-3, m, rng), draw_signed_sizes(4e-3, m, rng)
        ),
        TURNING,
    ),
    "oval_disc": Kind(
        "encoder_second_harmonic",
        lambda m, rng: joints.OvalDisc(draw_signed_sizes(2.5e-3, m, rng), draw_angles(m, rng)),
        TURNING,
    ),
    "gain": Kind(
        "encoder_gain",
        lambda m, rng: joints.WrongPitch(
            draw_signed_sizes(2.5e-3 if m.lever == 1 else 0.6e-3 / m.lever, m, rng)
        ),
        ("argos", *SLIDING),
    ),
    "gear_ripple": Kind(
        "gear_transmission_error",
        lambda m, rng: joints.GearRipple(
            rng.uniform(15, 40), draw_signed_sizes(0.6e-3, m, rng), draw_angles(m, rng)
        ),
        TURNING,
    ),
    "screw_wobble": Kind(
        "screw_pitch_error",
        lambda m, rng: joints.UnevenScrew(
            5e-3,
            draw_signed_sizes(0.4e-3, m, rng),
            draw_angles(m, rng),
            draw_signed_sizes(2e-2, m, rng),
        ),
        SLIDING,
    ),
    "backlash": Kind("backlash", lambda m, rng: Backlash(draw_sizes(1e-3, m, rng))),
    "wind_up": Kind("hysteresis", make_wind_up),
    "cross_talk": Kind(
        "encoder_crosstalk",
        lambda m, rng: joints.DraggedNeighbours(_draw_drag(len(m.joints), rng)),
        SLIDING,
    ),
    "shaft_twist": Kind("joint_compliance", make_shaft_twist, RODS, "payload"),
    "soft_rods": Kind(
        "rod_compliance", lambda m, rng: loads.SoftRods(rng.uniform(3e-6, 6e-6)), RODS, "payload"
    ),
    "soft_frame": Kind(
        "payload_sag",
        lambda m, rng: loads.SoftFrame(rng.uniform(4e-6, 8e-6), rng.uniform(3e-5, 6e-5)),
        LOADED,
        "payload",
    ),
    "warmth": Kind("thermal_expansion", make_warmth, LOADED, "temperature"),
    "creep": Kind("base_drift", make_creeping_stand, asks="time"),
}


def _draw_drag(n: int, rng: np.random.Generator) -> tuple[tuple[float, ...], ...]:
    """Couplings of n joints in a ring with their two neighbours."""
    drag: Array = rng.uniform(0.8e-3, 1.5e-3, (n, n)) * rng.choice([-1, 1], (n, n))
    neighbours = np.roll(np.eye(n), 1, axis=1) + np.roll(np.eye(n), -1, axis=1)
    return tuple(map(tuple, drag * (neighbours > 0)))


def kinds_of(robot: str) -> list[str]:
    """List the kinds that a robot may hide."""
    return [name for name, kind in KINDS.items() if robot in kind.machines]


def words_of(text: str) -> list[str]:
    """Split a text with commas into names of kinds."""
    return [word.strip() for word in text.split(",") if word.strip()]


def hide(robot: str, words: Sequence[str], seed: int) -> tuple[list[str], list[Effect]]:
    """Draw the physics of the named kinds; `hidden` stands for a kind that `seed` draws.

    ValueError for a word that is not a kind of this robot.
    """
    rng, names = np.random.default_rng([seed, 42]), list[str]()
    known = kinds_of(robot)
    for word in words:
        if word != HIDDEN and word not in known:
            supported = f"{', '.join(known)} or {HIDDEN}"
            raise ValueError(f"effect {word}: a {robot} supports {supported}")
        others = [name for name in known if name not in (*names, *words)]
        names.append(str(rng.choice(others)) if word == HIDDEN else word)
    return names, [KINDS[name].make(MACHINES[robot], rng) for name in names]
