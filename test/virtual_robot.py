"""The truth in the tests: robots built from points and rods, solved by plain root finding.

This file shares no line and no idea with the package: no closure, no derivative, no CasADi.
A robot is where its balls sit and how long its rods are. An effect is a piece of physics on the
way from the encoder reading to the measured pose. A session is a day at the measuring machine.
Everything is in SI, and every function takes a batch: arrays of shape (..., 3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Parameters = Mapping[str, ArrayLike]

ARCSEC = np.pi / 180 / 3600

# ---------------------------------------------------------------------------------------------
# The thesis' tables, as printed: millimetres and degrees

COLUMNS = [
    *("D_x", "D_y", "D_z", "theta", "alpha", "La_x", "La_y", "Lb"),
    *("d_z", "dalpha", "dbeta", "dC_x", "dC_y", "dC_z", "dLb", "b_x", "b_y", "b_z"),
]
ANGLES = {"theta", "alpha", "dalpha", "dbeta"}


def table(*chains: str) -> dict[str, float]:
    """Three printed rows (mm, degrees) as named SI parameters."""
    unit = {name: np.pi / 180 if name in ANGLES else 1e-3 for name in COLUMNS}
    rows = [zip(COLUMNS, map(float, row.split()), strict=True) for row in chains]
    return {f"chain{i}.{k}": v * unit[k] for i, row in enumerate(rows, 1) for k, v in row}


# Table 5.12: the nominal mock-up, which is what a controller believes. D_x is illegible in the
# scan; 76 mm is the value at which tables 5.12 and 5.18 give the errors that table 5.15 measured.
TABLE_5_12 = table(
    "76 -16.5 0   0 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 120 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 240 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
)
# Table 5.18: the mock-up as identified, which is what the virtual robot is.
TABLE_5_18 = table(
    "75.902 -16.318 -0.642  -0.517 89.513 119.967 -3.693 240.074"
    "   20  0.343 0.582 -0.023 -0.005 -0.006  0.092  24 0 0",
    "76.116 -16.716 -0.793 119.372 90.263 119.943 -3.236 240.108"
    "   20 -0.235 0.610 -0.049  0.069  0.023  0.009  24 0 0",
    "76.063 -16.792 -0.658 239.573 90.093 119.976 -2.673 240.009"
    "   20 -0.080 0.404 -0.049  0.076 -0.012 -0.062  24 0 0",
)

# ---------------------------------------------------------------------------------------------
# Geometry


def turn(w: ArrayLike) -> Array:
    """Rotation matrix about the direction of `w` by its length (Rodrigues), exact at w = 0."""
    w = np.asarray(w, dtype=float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    zero = np.zeros_like(w[..., 0])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*w.shape, 3)
    half = np.sinc(angle / 2 / np.pi)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * (cross @ cross)


def about(axis: str, angle: ArrayLike) -> Array:
    """Rotation matrix about the coordinate axis `x`, `y` or `z`."""
    return turn(np.asarray(angle)[..., None] * np.eye(3)["xyz".index(axis)])


def apply(rotation: Array, vector: Array) -> Array:
    """Rotate a batch of vectors."""
    return (rotation @ vector[..., None])[..., 0]


def stack(values: Iterable[ArrayLike]) -> Array:
    """Numbers, or equal batches of them, along a new last axis."""
    return np.stack(np.broadcast_arrays(*[np.asarray(v, float) for v in values]), -1)


def solve(gap: Callable[[Array], Array], u: Array, step: float = 1e-6) -> Array:
    """A root of `gap` near `u`: Newton's method with slopes measured by central differences."""
    for _ in range(50):
        slopes = [(gap(u + e) - gap(u - e)) / (2 * step) for e in step * np.eye(u.shape[-1])]
        move = apply(np.linalg.inv(np.stack(slopes, -1)), -gap(u))
        size = np.linalg.norm(move, axis=-1, keepdims=True)
        u = u + move * np.minimum(1, 0.1 / np.maximum(size, 1e-300))
        if np.max(size, initial=0) < 1e-12:
            return u
    raise ValueError("the robot cannot be assembled there: its rods do not meet")


class RodRobot:
    """A platform held by six rods; a sibling says where the balls sit and how long rods are."""

    home = np.array([0.0, 0.0, 0.2])
    home_joints: Array

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters

    def joint_points(self, q: ArrayLike) -> Array:
        """Ball centres on the driven side, shape (..., rods, 3)."""
        raise NotImplementedError

    def platform_points(self, r: ArrayLike, R: ArrayLike) -> Array:
        """Ball centres on the platform at pose (r, R), shape (..., rods, 3)."""
        raise NotImplementedError

    def lengths(self, q: ArrayLike) -> Array:
        """Rod lengths, shape (..., rods)."""
        raise NotImplementedError

    def gaps(self, q: ArrayLike, r: ArrayLike, R: ArrayLike) -> Array:
        """How far each rod is too short to reach from ball to ball, metres."""
        rods = self.platform_points(r, R) - self.joint_points(q)
        return np.linalg.norm(rods, axis=-1) - self.lengths(q)

    def forward(
        self, q: ArrayLike, start: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """The pose (r, R) that the joints `q` hold, nearest to `start`."""
        q = np.asarray(q, dtype=float)
        r0, R0 = start or (self.home, np.eye(3))
        u = np.zeros((*q.shape[:-1], 6))
        u[..., :3] = r0
        u = solve(lambda u: self.gaps(q, u[..., :3], turn(u[..., 3:]) @ R0), u)
        return u[..., :3], turn(u[..., 3:]) @ R0

    def inverse(
        self, r: ArrayLike, start: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """The joints that put the platform at `r`, and the orientation R that follows."""
        r = np.asarray(r, dtype=float)
        q0, R0 = start or (self.home_joints, np.eye(3))
        u = np.zeros((*r.shape[:-1], 6))
        u[..., :3] = q0
        u = solve(lambda u: self.gaps(u[..., :3], r, turn(u[..., 3:]) @ R0), u)
        return u[..., :3], turn(u[..., 3:]) @ R0


class Delta(RodRobot):
    """Three motor-driven arms, each carrying the platform by two rods (figure 3.9, table 3.10).

    An arm is one solid body with two balls, hinged on its motor's axis: a line in space.
    A parameter may be an array, one value a sample, where the geometry changes on the way.
    """

    home_joints = np.full(3, np.radians(30.65))

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)

        def value(name: str) -> Array:
            return stack(parameters[f"chain{i}.{name}"] if name else 0.0 for i in (1, 2, 3))

        def vector(*names: str) -> Array:
            return stack(value(name) for name in names)

        frame = about("z", value("theta")) @ about("x", value("alpha"))
        motor = frame @ about("x", value("dalpha")) @ about("y", value("dbeta"))
        ball, half = vector("b_x", "b_y", "b_z"), vector("", "", "d_z")
        arm, error = vector("La_x", "La_y", ""), vector("dC_x", "dC_y", "dC_z")
        self.hub = apply(frame, ball + vector("D_x", "D_y", "D_z"))
        self.axis = motor[..., :, 2]
        # Ball centres at q = 0 as seen from the hub; first and second ball of each chain.
        self.arms = [apply(motor, arm + s * (half + error)) for s in (1, -1)]
        self.balls = [apply(frame, ball + s * half) for s in (1, -1)]
        self.rods = np.concatenate([value("Lb") + s * value("dLb") for s in (1, -1)], -1)

    def joint_points(self, q: ArrayLike) -> Array:
        """C_11 C_21 C_31 C_12 C_22 C_32: the arms' balls, turned about the motor lines by q."""
        swing = turn(self.axis * np.asarray(q)[..., None])
        return np.concatenate([self.hub + apply(swing, arm) for arm in self.arms], -2)

    def platform_points(self, r: ArrayLike, R: ArrayLike) -> Array:
        """B_11 B_21 B_31 B_12 B_22 B_32: the platform's balls at pose (r, R)."""
        turned = [apply(np.asarray(R)[..., None, :, :], ball) for ball in self.balls]
        return np.asarray(r)[..., None, :] + np.concatenate(turned, -2)

    def lengths(self, q: ArrayLike) -> Array:
        """Lb + dLb of the first rods, then Lb - dLb of the second."""
        return self.rods


NOMINAL, MOCK_UP = Delta(TABLE_5_12), Delta(TABLE_5_18)

# ---------------------------------------------------------------------------------------------
# Hidden physics: one class an effect


@dataclass(frozen=True)
class At:
    """The circumstances of each sample: seconds, degC, kg, and each joint's last direction."""

    time: Array
    temperature: Array
    payload: Array
    direction: Array


@dataclass(frozen=True)
class Effect:
    """One disturbance; it overrides the stage of the measuring chain at which it acts."""

    def geometry(self, parameters: Parameters, at: At) -> Parameters:
        """The dimensions the robot has under these circumstances."""
        return parameters

    def arm(self, reading: Array, robot: RodRobot, at: At) -> Array:
        """The angle at which the arm stands when its encoder shows `reading`."""
        return reading

    def device(self, r: Array, R: Array, at: At) -> tuple[Array, Array]:
        """The pose that the measuring device shows for the true pose."""
        return r, R

    def taken(self, stamp: Array) -> Array:
        """When the poses were taken that the measuring device stamps `stamp`."""
        return stamp


@dataclass(frozen=True)
class EncoderEccentricity(Effect):
    """An encoder disc mounted off-centre: once per turn the reading runs ahead and behind."""

    sin: tuple[float, float, float]
    cos: tuple[float, float, float]

    def arm(self, reading: Array, robot: RodRobot, at: At) -> Array:
        return reading + np.array(self.sin) * np.sin(reading) + np.array(self.cos) * np.cos(reading)


@dataclass(frozen=True)
class Backlash(Effect):
    """Play in the gear: the encoder, on the motor's side, leads the arm by half the width."""

    width: tuple[float, ...]

    def arm(self, reading: Array, robot: RodRobot, at: At) -> Array:
        return reading - np.array(self.width) / 2 * at.direction


def truth(
    robot: Any, effects: Sequence[Effect], reading: Array, at: At
) -> tuple[Array, Array, Array]:
    """From encoder readings to (arm angles, position, rotation) as an errorless device shows."""
    parameters, angle = robot.parameters, reading
    for effect in effects:
        parameters = effect.geometry(parameters, at)
    robot = type(robot)(parameters)
    for effect in effects:
        angle = effect.arm(angle, robot, at)
    r, R = robot.forward(angle)
    for effect in effects:
        r, R = effect.device(r, R, at)
    return angle, r, R


# ---------------------------------------------------------------------------------------------
# The session at the measuring machine


@dataclass(frozen=True)
class Noise:
    """Section 4.2's instruments, 1 sigma: an error a dwell, and a fraction of it each message."""

    joint: float = 25 * ARCSEC
    position: float = 10e-6
    orientation: float = 15 * ARCSEC
    jitter: float = 0.2

    def draw(self, rng: np.random.Generator, n: int, joints: int = 3) -> tuple[Array, Array, Array]:
        """Errors of n readings: joints, position, rotation vector about the base's axes."""
        q, r, w = (rng.normal(size=(n, size)) for size in (joints, 3, 3))
        return q * self.joint, r * self.position, w * self.orientation


THESIS_NOISE = Noise()


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

    def at(self, time: Array) -> At:
        """The circumstances at these times."""
        return At(time, self.air(time), self.load(time), self.direction(time))


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
    reading, _ = controller.inverse(targets(n_poses, seed))
    home, _ = controller.inverse(controller.home)
    return visit(reading, home, n_replicates, seed, **circumstances)


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
