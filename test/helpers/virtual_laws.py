"""Laws of nobody's catalogue, hidden in virtual robots of any kind.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package. It draws laws
from physics, not from the terms that a search for formulas knows: powers that are no integers,
waves of an angle in a gear, dents, friction that grows with load.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from parallel_cal.virtual.joint_effects import Visit
from parallel_cal.virtual.load_effects import Weights
from parallel_cal.virtual.robot import Array, Effect, Parameters, SampleConditions

Law = Callable[[Array, Array, Any], Array]
AT_PAYLOAD = 1.0  # kg, at which a law of the payload has its size


@dataclass(frozen=True)
class JointLaw(Effect):
    """`law(reading, loads, at)` (N, nq), of size one, times `size` (rad or m) is added to the
    joints; the loads are those of the payload's weight (N m or N)."""

    size: float
    law: Law
    loaded: bool = True

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        loads = Weights().torques(robot, reading, at.payload) if self.loaded else reading * 0
        return reading + self.size * self.law(reading, loads, at)


@dataclass(frozen=True)
class PartTemperatures(Effect):
    """Parts of each chain that warm up one after the other, each with its own time constant."""

    size: float  # m
    parameter: str
    chains: tuple[str, ...]
    shares: tuple[float, ...]  # of the session, in which each part warms up

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        end = float(at.time.max())
        own = {
            f"{chain}.{self.parameter}": self.size * (1 - np.exp(-at.time / (share * end)))
            for chain, share in zip(self.chains, self.shares, strict=True)
        }
        return {k: v + own[k] if k in own else v for k, v in parameters.items()}


@dataclass(frozen=True)
class Sag(Effect):
    """A platform that sinks with the payload and a power of its distance from the middle, or of
    its height."""

    size: float  # m at 1 kg and the `reach`
    reach: float
    power: float
    height: float | None = None  # m: sinks with the height above it instead

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        away = np.hypot(r[:, 0], r[:, 1])
        if self.height is not None:
            away = np.abs(r[:, 2] - self.height) * np.sign(r[:, 2] - self.height)
        share = np.sign(away) * np.abs(away / self.reach) ** self.power
        return r - (self.size * at.payload * share)[:, None] * np.array([0, 0, 1.0]), R


@dataclass(frozen=True)
class PlayInRods(Effect):
    """Rods whose balls have play: each length depends on the way its joint came."""

    size: float  # m
    parameter: str
    chains: tuple[str, ...]

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        own = {
            f"{chain}.{self.parameter}": self.size * at.direction[:, i]
            for i, chain in enumerate(self.chains)
        }
        return {k: v + own[k] if k in own else v for k, v in parameters.items()}


@dataclass(frozen=True)
class WornSeats(Effect):
    """Rods or legs in ball joints whose seats are worn in one direction: there, each is longer."""

    size: float  # m
    level: tuple[float, float]  # the range of the cosine of the angle to the horizontal plane
    middle: float  # of the wear, as a share of this range
    width: float

    def arm(self, reading: Array, robot: Any, at: SampleConditions) -> Array:
        if hasattr(robot, "rods"):
            return reading
        r, R = robot.forward(reading)
        heads = r[:, None] + np.einsum("nij,kj->nki", R, robot.platform)
        return reading + self._wear(heads - robot.base)

    def loaded_robot(self, robot: Any, angle: Array, at: SampleConditions) -> Any:
        if not hasattr(robot, "rods"):
            return robot
        worn = copy.copy(robot)
        along = robot.platform_points(*robot.forward(angle)) - robot.joint_points(angle)
        worn.rods = robot.rods + self._wear(along)
        return worn

    def _wear(self, along: Array) -> Array:
        level = np.hypot(along[..., 0], along[..., 1]) / np.linalg.norm(along, axis=-1)
        low, high = self.level
        share = (level - low) / (high - low)
        return np.asarray(self.size / np.cosh((share - self.middle) / self.width))


@dataclass(frozen=True)
class Hidden:
    """A law that was drawn: `make(size)` is its physics, `places` and `drivers` what an answer may
    call the place, and must call the drivers."""

    kind: str
    make: Callable[[float], Effect]
    places: frozenset[str]
    drivers: frozenset[str]
    needs: frozenset[str] = frozenset()  # what is recorded beside direction, travel, time and loads


@dataclass(frozen=True)
class Kin:
    """What the laws need to know of a robot: its joints and their middle, range (rad or m), chains
    with the parameter that warms up and the one of its rods, and the platform's reach (m)."""

    joints: tuple[str, ...]
    middle: Array
    span: Array
    load: float  # N m or N, of a typical load
    loaded: tuple[int, ...]  # joints that carry weight
    chains: tuple[str, ...] = ()
    warm: str = ""
    rod: str = ""
    reach: float = 0.06
    height: float = 0.2
    level: tuple[float, float] = (0.0, 1.0)  # of the cosine of rods' angles to the horizontal plane
    equal: tuple[tuple[str, ...], ...] = ()  # of each joint, lengths that err in the same way


def only(kin: Kin, joint: int, values: Array) -> Array:
    out = np.zeros((len(values), len(kin.joints)))
    out[:, joint] = values
    return out


def _one(kin: Kin, joint: int) -> frozenset[str]:
    """What an error of one joint's reading may be called."""
    return frozenset((kin.joints[joint], *(kin.equal[joint] if kin.equal else ())))


def _all(kin: Kin) -> frozenset[str]:
    lengths = {name.partition(".")[2] for own in kin.equal for name in own}
    return frozenset({"joints", "joints, each its own", *lengths})


def spring(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A shaft that is softer or stiffer the more it is loaded."""
    k, power = int(rng.choice(kin.loaded)), float(rng.choice([1.6, 2.0, 2.5, 3.0]))

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        return only(kin, k, np.sign(t[:, k]) * np.abs(t[:, k] / kin.load) ** power)

    name = kin.joints[k]
    return Hidden("spring", lambda s: JointLaw(s, law), _one(kin, k), frozenset({f"load.{name}"}))


def gap(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A shaft that is stiff until its play is taken up by the load, and then gives way as the cube
    of what exceeds it."""
    k, share = int(rng.choice(kin.loaded)), rng.uniform(0.1, 0.5)

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        beyond = np.maximum(np.abs(t[:, k] / kin.load) - share, 0.0)
        return only(kin, k, np.sign(t[:, k]) * beyond**3)

    name = kin.joints[k]
    return Hidden("gap", lambda s: JointLaw(s, law), _one(kin, k), frozenset({f"load.{name}"}))


def lag(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A lag behind the drive that grows with the payload."""
    growth = rng.uniform(1.0, 3.0)

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        return -at.direction * (1 + growth * at.payload[:, None] / AT_PAYLOAD)

    drivers = frozenset({"direction", "payload"})
    return Hidden("lag", lambda s: JointLaw(s, law, False), _all(kin), drivers)


def friction(kin: Kin, rng: np.random.Generator) -> Hidden:
    """Friction that grows with the load on each joint."""
    power = float(rng.choice([1.0, 1.5]))

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        return -at.direction * np.abs(t / kin.load) ** power

    drivers = frozenset({"direction", "load"})
    return Hidden("friction", lambda s: JointLaw(s, law), _all(kin), drivers)


def cross(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A joint that is bent by the product of two others' angles."""
    k, a, b = (int(i) for i in rng.choice(len(kin.joints), 3, replace=False))

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        x = (q - kin.middle) / kin.span * 3
        return only(kin, k, x[:, a] * x[:, b])

    drivers = frozenset({kin.joints[a], kin.joints[b]})
    return Hidden("cross", lambda s: JointLaw(s, law, False), _one(kin, k), drivers)


def coupling(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A cable that pulls at a joint as a neighbour turns: a smooth curve of its angle."""
    k, a = (int(i) for i in rng.choice(len(kin.joints), 2, replace=False))
    turn, phase = rng.uniform(4.0, 9.0), rng.uniform(0, 6)

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        x = (q[:, a] - kin.middle[a]) / kin.span[a]
        return only(kin, k, np.sin(turn * x + phase) * (1 + x))

    return Hidden(
        "coupling", lambda s: JointLaw(s, law, False), _one(kin, k), frozenset({kin.joints[a]})
    )


def dent(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A dent of one encoder disc: a notch with straight flanks."""
    k, centre, width = int(rng.integers(len(kin.joints))), rng.uniform(-0.2, 0.2), 0.12

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        x = (q[:, k] - kin.middle[k]) / kin.span[k] - centre
        return only(kin, k, np.maximum(1 - np.abs(x) / width, 0.0))

    name = kin.joints[k]
    return Hidden("dent", lambda s: JointLaw(s, law, False), _one(kin, k), frozenset({name}))


def cogging(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A gear or motor that runs ahead and behind once per tooth, not quite as a sine."""
    k, periods, phase = int(rng.integers(len(kin.joints))), rng.uniform(4, 12), rng.uniform(0, 6)

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        angle = 2 * np.pi * periods * (q[:, k] - kin.middle[k]) / kin.span[k] + phase
        return only(kin, k, np.sin(angle + 0.3 * np.sin(angle)))

    name = kin.joints[k]
    return Hidden("cogging", lambda s: JointLaw(s, law, False), _one(kin, k), frozenset({name}))


def scratch(kin: Kin, rng: np.random.Generator) -> Hidden:
    """An encoder track with a scratch: beyond an angle everything is counted a little more."""
    k, centre = int(rng.integers(len(kin.joints))), rng.uniform(-0.2, 0.2)

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        x = (q[:, k] - kin.middle[k]) / kin.span[k] - centre
        return only(kin, k, (x > 0) - 0.5)

    name = kin.joints[k]
    return Hidden("scratch", lambda s: JointLaw(s, law, False), _one(kin, k), frozenset({name}))


def warm_joint(kin: Kin, rng: np.random.Generator) -> Hidden:
    """An encoder whose zero drifts with the temperature of the hall, more when it is warm."""
    k = int(rng.integers(len(kin.joints)))

    def law(q: Array, t: Array, at: SampleConditions) -> Array:
        return only(kin, k, np.expm1((at.temperature - 20) / 6))

    return Hidden(
        "warm joint", lambda s: JointLaw(s, law, False), _one(kin, k), frozenset({"temperature"})
    )


def warm_parts(kin: Kin, rng: np.random.Generator) -> Hidden:
    """Each chain has a temperature of its own, and one sensor does not show it."""
    shares = tuple(float(s) for s in rng.permutation(np.linspace(0.08, 0.9, len(kin.chains))))
    places = frozenset({f"{kin.warm}, each its own", "joints, each its own"})
    return Hidden(
        "warm parts",
        lambda s: PartTemperatures(s, kin.warm, kin.chains, shares),
        places,
        frozenset({"time"}),
    )


def sag(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A platform that sinks with the payload far out."""
    power = float(rng.choice([1.5, 2.0, 2.5]))
    return Hidden(
        "sag",
        lambda s: Sag(s, kin.reach, power),
        frozenset({"pose.z"}),
        frozenset({"payload", "radius"}),
    )


def soft_column(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A column that gives way to the payload the more the higher the platform is."""
    power = float(rng.choice([1.0, 2.0]))
    return Hidden(
        "soft column",
        lambda s: Sag(s, kin.reach, power, kin.height),
        frozenset({"pose.z"}),
        frozenset({"payload", "z"}),
    )


def rod_play(kin: Kin, rng: np.random.Generator) -> Hidden:
    """Rods whose length depends on the way the joint came."""
    return Hidden(
        "rod play",
        lambda s: PlayInRods(s, kin.rod, kin.chains),
        frozenset({kin.rod, *_all(kin)}),
        frozenset({"direction"}),
    )


def thick_grease(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A gear whose grease holds it back as it passes, by a power of its speed."""
    k, power = int(rng.integers(len(kin.joints))), rng.uniform(0.4, 0.8)

    def law(q: Array, t: Array, at: Visit) -> Array:
        speed = at.velocity[:, k]
        return only(kin, k, -np.sign(speed) * np.abs(speed / kin.span[k]) ** power)

    needs, driver = frozenset({"velocity"}), frozenset({f"velocity.{kin.joints[k]}"})
    make = partial(JointLaw, law=law, loaded=False)
    return Hidden("thick grease", make, _one(kin, k), driver, needs)


def stretched_belt(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A belt that follows the further it was pulled one way, with a power of this way."""
    k, power = int(rng.integers(len(kin.joints))), rng.uniform(0.3, 0.6)

    def law(q: Array, t: Array, at: Visit) -> Array:
        way = at.travel[:, k]
        return only(kin, k, np.sign(way) * np.abs(way / kin.span[k]) ** power)

    driver = frozenset({f"travel.{kin.joints[k]}"})
    make = partial(JointLaw, law=law, loaded=False)
    return Hidden("stretched belt", make, _one(kin, k), driver)


def new_zero(kin: Kin, rng: np.random.Generator) -> Hidden:
    """A joint that was referenced anew before the second session, and not at the same angle."""
    k, sign = int(rng.integers(len(kin.joints))), float(rng.choice([-1, 1]))

    def law(q: Array, t: Array, at: Visit) -> Array:
        return only(kin, k, sign * (at.session > 0))

    make = partial(JointLaw, law=law, loaded=False)
    drivers = frozenset({"session"})
    return Hidden("new zero", make, _one(kin, k), drivers, drivers)


def worn_seats(kin: Kin, rng: np.random.Generator) -> Hidden:
    """Ball joints of rods or legs, all alike, that are worn in one direction."""
    middle, width = rng.uniform(0.35, 0.65), rng.uniform(0.08, 0.15)
    return Hidden(
        "worn seats",
        lambda s: WornSeats(s, kin.level, middle, width),
        frozenset({"rods", kin.rod, *_all(kin)}),
        frozenset({"inclination"}),
    )


JOINT_KINDS = (
    spring,
    gap,
    lag,
    friction,
    cross,
    coupling,
    dent,
    cogging,
    scratch,
    warm_joint,
    thick_grease,
    stretched_belt,
    new_zero,
)
CHAIN_KINDS = (*JOINT_KINDS, warm_parts, sag, soft_column, rod_play, worn_seats)
