"""A day at the measuring machine: which poses a virtual robot visits, and what is recorded.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.virtual.joint_effects import Visit
from parallel_cal.virtual.robot import (
    MOCK_UP,
    NOMINAL,
    THESIS_NOISE,
    Array,
    Effect,
    Noise,
    RodRobot,
    SampleConditions,
    truth,
    turn,
)


def temperature(time: ArrayLike) -> Array:
    """A workshop's air in degC: it wanders, so that it is not merely another clock."""
    t = 2 * np.pi * np.asarray(time)
    return 22.5 + 0.8 * np.sin(t / 97 + 0.4) + 0.3 * np.sin(t / 41 + 2)


def targets(n: int, seed: int, side: float = 0.12) -> Array:
    """Points that fill a cube at (0, 0, 0.2) m evenly, however many (a golden-ratio lattice)."""
    ratio = 1.2207440846057596  # root of x^4 = x + 1
    shift = np.random.default_rng(seed).random(3)
    steps = np.outer(np.arange(n), ratio ** -np.arange(1.0, 4))
    return np.asarray([0, 0, 0.2] + side * ((shift + steps) % 1 - 0.5))


class Day:
    """What a robot does before the measuring device; a sibling says how it goes about.

    `arrive`, `leave`, `pose_index` and `ways` (visits, joints) tell of its visits, if it stops.
    """

    arrive: Array
    leave: Array
    pose_index: NDArray[np.int64]
    ways: Array
    end: float
    air: Callable[[Array], Array]

    def joints(self, time: Array) -> Array:
        """What errorless encoders read, shape (times, joints)."""
        raise NotImplementedError

    def direction(self, time: Array) -> Array:
        """The sign of each joint's last motion."""
        raise NotImplementedError

    def load(self, time: Array) -> Array:
        """What the platform carries, kg."""
        raise NotImplementedError

    def held(self, time: Array, errors: Array) -> Array:
        """Errors (visits, n) that stay while the robot rests, at these times."""
        raise NotImplementedError

    def at(self, time: Array) -> SampleConditions:
        """The circumstances at these times."""
        return SampleConditions(time, self.air(time), self.load(time), self.direction(time))


@dataclass(frozen=True)
class Session(Day):
    """Which pose is visited when, and the encoder reading the controller holds there.

    `payload` is one mass or one a visit; it changes as the robot sets out.
    """

    pose_index: NDArray[np.int64]
    reading: Array
    home: Array
    dwell: float = 1.0
    payload: ArrayLike = 0.2
    air: Callable[[Array], Array] = temperature
    arrive: Array = field(init=False)

    def __post_init__(self) -> None:
        # The longest way takes 0.8 s, the shortest 0.5 s; whole milliseconds for tidy stamps.
        way = np.max(np.abs(self.ways), axis=-1)
        moving = np.round(0.5 + 0.3 * way / max(way.max(), 1e-9), 3)
        object.__setattr__(self, "arrive", np.cumsum(moving + self.dwell) - self.dwell)

    @property
    def ways(self) -> Array:
        """Joint travel to each visit from the one before."""
        return np.diff(self.reading, axis=0, prepend=self.home[None])

    @property
    def leave(self) -> Array:
        return self.arrive + self.dwell

    @property
    def end(self) -> float:
        return self.leave[-1]

    def locate(self, time: Array) -> tuple[NDArray[np.int64], Array]:
        """At each time, the visit under way or held, and the fraction of the way behind."""
        k = np.minimum(np.searchsorted(self.leave, time, "right"), len(self.leave) - 1)
        depart = np.concatenate([[0.0], self.leave])[k]
        s = np.clip((time - depart) / (self.arrive[k] - depart), 0, 1)
        return k, s**3 * (10 - 15 * s + 6 * s**2)

    def follow(self, time: Array, values: Array, first: Array) -> Array:
        """What is held at each visit, blended smoothly on the ways between; `first` at home."""
        visit, s = self.locate(time)
        before = np.concatenate([first[None], values])[visit]
        return before + s[:, None] * (values[visit] - before)

    def joints(self, time: Array) -> Array:
        return self.follow(time, self.reading, self.home)

    def direction(self, time: Array) -> Array:
        return np.sign(self.ways)[self.locate(time)[0]]

    def load(self, time: Array) -> Array:
        return np.broadcast_to(self.payload, len(self.arrive))[self.locate(time)[0]]

    def held(self, time: Array, errors: Array) -> Array:
        return self.follow(time, errors, np.zeros(errors.shape[1]))


def plan(
    n_poses: int = 74,
    n_replicates: int = 20,
    seed: int = 0,
    controller: RodRobot = NOMINAL,
    **circumstances: Any,
) -> Session:
    """A session of the Delta robot in its cube; `circumstances` are further fields of Session."""
    if controller is NOMINAL:
        return replace(_plan_of_nominal(n_poses, n_replicates, seed), **circumstances)
    reading, _ = controller.inverse(targets(n_poses, seed))
    home, _ = controller.inverse(controller.home)
    return visit(reading, home, n_replicates, seed, **circumstances)


@cache
def _plan_of_nominal(n_poses: int, n_replicates: int, seed: int) -> Session:
    """The session of the nominal robot, drawn once for all tests: nobody may write into it."""
    reading, _ = NOMINAL.inverse(targets(n_poses, seed))
    home, _ = NOMINAL.inverse(NOMINAL.home)
    session = visit(reading, home, n_replicates, seed)
    for array in (session.pose_index, session.reading, session.home):
        array.flags.writeable = False
    return session


def visit(
    reading: Array, home: Array, n_replicates: int, seed: int, **circumstances: Any
) -> Session:
    """A session in which some poses are visited twice, the second time from the other side."""
    rng, n_poses = np.random.default_rng([seed, 1]), len(reading)
    order = [int(i) for i in rng.permutation(n_poses)]
    early = order[: max(1, 2 * n_poses // 3)]
    again = [int(i) for i in rng.choice(early, n_replicates, replace=n_replicates > len(early))]
    for pose in again:
        order.insert(_other_side(order, pose, reading, home, again), pose)
    return Session(np.array(order), reading[order], home, **circumstances)


def _other_side(order: list[int], pose: int, reading: Array, home: Array, spare: list[int]) -> int:
    """The later slot in the order from which most joints come to `pose` the other way round."""
    first = order.index(pose)
    came = np.sign(reading[pose] - (reading[order[first - 1]] if first else home))
    # A visit squeezed in before another changes that one's direction: not before the spared.
    slots = [s for s in range(first + 2, len(order)) if order[s] not in spare] + [len(order)]
    ways = reading[pose] - reading[[order[slot - 1] for slot in slots]]
    reversed_joints = (np.sign(ways) == -came).sum(axis=-1)
    best = np.flatnonzero(reversed_joints == reversed_joints.max())
    return slots[int(best[7 * pose % len(best)])]


def dwell_samples(
    robot: RodRobot = MOCK_UP,
    n_poses: int = 74,
    n_replicates: int = 20,
    seed: int = 0,
    effects: Sequence[Effect] = (),
    noise: Noise = THESIS_NOISE,
    pose_seed: int = 0,
) -> dict[str, NDArray[Any]]:
    """What a session yields, a row a dwell; `seed` draws the noise, `pose_seed` the poses."""
    session = plan(n_poses, n_replicates, pose_seed)
    at = session.at(session.arrive + session.dwell / 2)
    angle, r, R = truth(robot, effects, session.reading, at)
    q_error, r_error, w_error = noise.draw(np.random.default_rng(seed), len(r))
    measured = {"q": session.reading + q_error, "r": r + r_error, "R": turn(w_error) @ R}
    hidden = {"reading": session.reading, "true_q": angle, "true_r": r, "true_R": R}
    return measured | hidden | vars(at) | {"pose_index": session.pose_index}


def record(
    robot: RodRobot = MOCK_UP,
    n_poses: int = 74,
    n_replicates: int = 20,
    seed: int = 0,
    effects: Sequence[Effect] = (),
    noise: Noise = THESIS_NOISE,
    pose_seed: int = 0,
) -> dict[str, NDArray[Any]]:
    """The same session as streams: joints at 100 Hz, poses at 20 Hz (also while moving)."""
    return stream(robot, plan(n_poses, n_replicates, pose_seed), effects, noise, seed)


@dataclass(frozen=True)
class Clocks:
    """Seconds from message to message, and from the first joint reading to the first pose."""

    joint: float = 0.01
    pose: float = 0.05
    slow: float = 1.0
    # The devices' clocks tick side by side, not together.
    offset: float = 0.004


def stream(
    robot: Any,
    day: Day,
    effects: Sequence[Effect] = (),
    noise: Noise = THESIS_NOISE,
    seed: int = 0,
    clocks: Clocks = Clocks(),
) -> dict[str, NDArray[Any]]:
    """A day as streams of messages, and when each dwell was; `seed` draws the noise."""
    rng, joints = np.random.default_rng(seed), day.ways.shape[1]
    held = noise.draw(rng, len(day.arrive), joints)

    def errors(time: Array) -> list[Array]:
        jitter = noise.draw(rng, len(time), joints)
        return [day.held(time, e) + noise.jitter * j for e, j in zip(held, jitter, strict=True)]

    t_joint, t_slow = np.arange(0, day.end, clocks.joint), np.arange(0, day.end, clocks.slow)
    t_pose = taken = np.arange(clocks.offset, day.end, clocks.pose)
    q = day.joints(t_joint) + errors(t_joint)[0]
    for effect in effects:
        taken = effect.taken(taken)
    _, r, R = truth(robot, effects, day.joints(taken), day.at(taken))
    _, r_error, w_error = errors(t_pose)
    streams = {"joint_time": t_joint, "q": q, "pose_time": t_pose, "r": r + r_error}
    slow = {"temperature_time": t_slow, "temperature": day.air(t_slow)}
    dwells = {name: getattr(day, name) for name in ("arrive", "leave", "pose_index")}
    dwells |= {"direction": np.sign(day.ways)} | _changes(t_joint, day.load(t_joint))
    return streams | {"R": turn(w_error) @ R} | slow | dwells


def _changes(time: Array, mass: Array) -> dict[str, Array]:
    """The first mass and every new one, each from when on."""
    new = np.flatnonzero(np.diff(mass, prepend=np.nan) != 0)
    return {"payload_time": time[new], "payload": mass[new]}


# ---------------------------------------------------------------------------------------------
# A list of random visits instead of a day: what a joint did before a visit is drawn, not driven

SESSIONS = 2


def visits(n: int, joints: int, seed: int, reach: float) -> Visit:
    """n samples over an hour; ways from `reach` / 300 to `reach`, speeds up to `reach` a second."""
    rng = np.random.default_rng([seed, 7])
    direction = rng.choice([-1.0, 1.0], (n, joints))
    travel = direction * reach * np.exp(-rng.uniform(0, np.log(300), (n, joints)))
    velocity = direction * rng.uniform(0, reach, (n, joints))
    time = np.linspace(0, 3600, n)
    air, load = np.full(n, 20.0), np.zeros(n)
    session = np.arange(n) * SESSIONS // n
    return Visit(time, air, load, direction, travel, velocity, session)


def errors(noise: Noise, n: int, joints: int, seed: int) -> tuple[Array, Array, Array]:
    """Errors of n readings: joints, position, rotation vector about the base's axes."""
    rng = np.random.default_rng([seed, 8])
    q, r, w = (rng.normal(size=(n, k)) for k in (joints, 3, 3))
    return q * noise.joint, r * noise.position, w * noise.orientation


def circumstances(n: int, joints: int, seed: int, heaviest: float) -> SampleConditions:
    """n samples: one of four payloads each, air between 12 and 30 degC, in no order."""
    rng = np.random.default_rng([seed, 8])
    payload = heaviest * rng.choice([0.0, 0.25, 0.5, 1.0], n)
    return SampleConditions(
        np.arange(n) * 10.0, rng.uniform(12, 30, n), payload, np.ones((n, joints))
    )
