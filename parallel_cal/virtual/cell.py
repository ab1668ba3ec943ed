"""A robot, its controller and a tracker in simulated time.

Time advances only by `advance`, which returns all messages of that time. Equal seeds and commands
give equal messages, however the time is divided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.virtual.drive import REST_TOLERANCE, Drive, State
from parallel_cal.virtual.joint_effects import Visit
from parallel_cal.virtual.kinds import hide
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import Array, apply_device_effects, solve_true_pose, turn
from parallel_cal.virtual.tracker import Tracker

# rad (times `lever` for sliding joints): travel after which the instruments' errors decorrelate
ERROR_CORRELATION_TRAVEL = 0.01
CENTIKELVIN = 2  # decimal places of a temperature

Box = tuple[Array, Array]  # opposite corners (3,) in {B}, m


@dataclass(frozen=True)
class Circumstances:
    """Conditions and faults of the cell. Joints are counted from 1; 0 means none.

    `slipped`: slip of the first joint's coupling relative to its encoder (rad or m).
    """

    payload: float = 0.0
    temperature: float = 22.0
    stuck_axis: int = 0
    stuck_encoder: int = 0
    drives_off: bool = False
    crossed_axes: bool = False
    slipped: float = 0.0
    lost_target: bool = False
    swapped_target: bool = False
    obstacles: tuple[Box, ...] = ()
    homed: int = 0


@dataclass(frozen=True, eq=False)
class Messages:
    """Messages of a time span: joint states at `time` (n,), q and speed (n, nq); poses r (m, 3),
    R (m, 3, 3) with the tracker's time stamps `stamp` (m,)."""

    time: Array
    q: Array
    speed: Array
    stamp: Array
    r: Array
    R: Array

    @staticmethod
    def concatenate(parts: Sequence[Messages]) -> Messages:
        return Messages(*(np.concatenate([getattr(p, f) for p in parts]) for f in FIELDS))


FIELDS = ("time", "q", "speed", "stamp", "r", "R")


class Moment(NamedTuple):
    """State of the drives, direction and travel of each joint, and the instruments' errors."""

    state: State
    direction: Array
    travel: Array
    errors: Array


@dataclass(eq=False)
class Cell:
    """One robot by its name in MACHINES; `effects` are names of KINDS, `hidden` for a random one.

    `noise` is a factor on the instruments' errors, `air` the amplitude (degC) of the temperature's
    variation, `period` (s) that of controller and joint states.
    """

    robot: str = "delta"
    seed: int = 0
    effects: Sequence[str] = ()
    noise: float = 1.0
    tracker: Tracker = field(default_factory=Tracker)
    period: float = 0.01
    air: float = 0.3
    now: Circumstances = field(default_factory=Circumstances)

    def __post_init__(self) -> None:
        self.machine = MACHINES[self.robot]
        self.built, drawn = self.machine.make_built(self.seed), self.machine.make_nominal()
        self.hidden, self._effects = hide(self.robot, self.effects, self.seed)
        home, n = np.asarray(drawn.home_joints, dtype=float), len(self.machine.joints)
        self.drive = Drive(home, self.machine.limits, self.period)
        scale = self.machine.noise
        self._sigma = self.noise * np.repeat(
            [scale.joint, scale.position, scale.orientation], [n, 3, 3]
        )
        self._quantum = self.noise * scale.joint / 2
        self._walk, self._jitter, self._blinks, self._shaken = (
            np.random.default_rng([self.seed, 50 + k]) for k in range(4)
        )
        self._moment = Moment(
            self.drive.state, np.ones(n), np.zeros(n), self._walk.standard_normal(n + 6)
        )
        self._frozen = home
        self._blocked = False
        self._known: tuple[Any, Any] = (None, None)
        self._pose: tuple[Array, Array] = self.built.forward(home)  # start of the next solution
        self._due: list[tuple[float, dict[str, Any]]] = []

    # ------------------------------------------------------------------ commands

    @property
    def time(self) -> float:
        """Time since the beginning (s), by the robot's clock."""
        return self.drive.state.time

    @property
    def idle(self) -> bool:
        """Whether nothing moves, and nothing will before the next command."""
        return self.drive.idle

    def follow(self, time: Any, positions: Any, velocities: Any = None) -> None:
        """Follow a trajectory with points (n, nq) at times (n,) s from now."""
        positions, velocities = (
            None if part is None else np.asarray(part, dtype=float)
            for part in (positions, velocities)
        )
        if self.now.crossed_axes:
            swap = [1, 0, *range(2, len(self.machine.joints))]
            positions, velocities = (
                None if part is None else part[:, swap] for part in (positions, velocities)
            )
        self.drive.follow(np.asarray(time, dtype=float), positions, velocities)

    def stop(self) -> None:
        """Brake and hold the position."""
        self.drive.stop()

    def change(self, **circumstances: Any) -> None:
        """Change fields of Circumstances from now on."""
        self.now = replace(self.now, **circumstances)
        axes = np.arange(1, len(self.machine.joints) + 1)
        self.drive.stuck = (axes == self.now.stuck_axis) | self.now.drives_off

    def change_at(self, time: float, **circumstances: Any) -> None:
        """Change fields of Circumstances at a future time."""
        self._due = sorted([*self._due, (time, circumstances)], key=lambda due: due[0])

    # ------------------------------------------------------------------ results

    def temperature(self, time: Array | float) -> Array:
        """Return the air temperature (degC); it varies, so that it is not proportional to time."""
        t = 2 * np.pi * np.asarray(time)
        wander = 0.7 * np.sin(t / 97 + 0.4) + 0.3 * np.sin(t / 41 + 2)
        return np.asarray(np.round(self.now.temperature + self.air * wander, CENTIKELVIN))

    def true_pose(self, q: Any = None, direction: Any = None) -> tuple[Array, Array]:
        """Compute the true pose of the platform, (3,) and (3, 3) in {B}.

        `q` (nq,) are readings and `direction` (nq,) their last directions; by default the present
        ones.
        """
        moment = self._moment
        q = moment.state.q if q is None else np.asarray(q, dtype=float)
        direction = moment.direction if direction is None else np.asarray(direction, dtype=float)
        at = self._make_visit(
            np.array([self.time]), direction[None], moment.travel[None], 0 * q[None]
        )
        _, r, R = solve_true_pose(self.built, self._effects, self._arms(q[None]), at, self._pose)
        return r[0], R[0]

    def advance(self, until: float) -> Messages:
        """Simulate up to a time; ValueError if the robot would have to come apart."""
        parts = []
        while self._due and self._due[0][0] <= until:
            time, circumstances = self._due.pop(0)
            parts.append(self._advance_to(time))
            self.change(**circumstances)
        return Messages.concatenate([*parts, self._advance_to(until)])

    def _advance_to(self, until: float) -> Messages:
        n = max(int(np.floor((until - self.time) / self.period + 1e-6)), 0)
        before, path = self._moment, self._path(n)
        self._moment = path[-1] if path else before
        readings = self._readings(path)
        taken = self.tracker.sampling_times(before.state.time, self._moment.state.time)
        return Messages(
            np.array([moment.state.time for moment in path]),
            readings,
            np.array([moment.state.speed for moment in path]).reshape(readings.shape),
            *self._poses([before, *path], taken),
        )

    # ------------------------------------------------------------------ motion

    def _path(self, n: int) -> list[Moment]:
        """The next n moments; the robot stops before an obstacle."""
        errors = self._walk.standard_normal((n, len(self._sigma)))
        if not (self.now.obstacles and n):
            self._blocked = False
            return self._step_drives(errors)
        if self._blocked:
            self._blocked = bool(self._is_in_obstacle(self.drive.state.target[None]).any())
        begin, first = self.drive.mark(), self._moment
        path = self._step_drives(errors)
        inside = self._is_in_obstacle(np.array([moment.state.q for moment in path]))
        if self._blocked or not inside.any():
            return path
        self.drive.back_to(begin)
        self._moment = first
        path = self._step_drives(errors[: int(np.argmax(inside))])
        self._moment, self._blocked = (path or [first])[-1], True
        return path + self._step_drives(errors[len(path) :])

    def _step_drives(self, errors: Array) -> list[Moment]:
        """One moment for each row of new errors."""
        path, now = list[Moment](), self._moment
        correlation = ERROR_CORRELATION_TRAVEL * self.machine.lever
        for k, fresh in enumerate(errors):
            if self.drive.idle and (now.state.q == self.drive.state.q).all():
                for _ in range(len(errors) - k):
                    self.drive.rest()
                    path.append(now._replace(state=self.drive.state))
                return path
            state = self.drive.step(self._blocked)
            moved = state.q - now.state.q
            moved[np.abs(moved) < REST_TOLERANCE] = 0.0  # a rounding error is not a reversal
            if moved.any():
                sign = np.where(moved == 0, now.direction, np.sign(moved))
                travel = np.where(sign == now.direction, now.travel + moved, moved)
                size = np.abs(moved)
                keep = np.exp(-np.append(size, np.full(6, size.max())) / correlation)
                wandered = keep * now.errors + np.sqrt(1 - keep**2) * fresh
                now = Moment(state, sign, travel, wandered)
            now = now._replace(state=state)
            path.append(now)
        return path

    def _is_in_obstacle(self, q: Array) -> Array:
        """Whether the platform's origin is inside an obstacle at joints (n, nq)."""
        n = len(q)
        still = np.broadcast_to(self._moment.direction, q.shape)
        at = self._make_visit(np.full(n, self.time), still, 0 * q, 0 * q)
        _, r, _ = solve_true_pose(self.built, self._effects, self._arms(q), at, self._pose)
        boxes = [((low <= r) & (r <= high)).all(axis=1) for low, high in self.now.obstacles]
        return np.any(boxes, axis=0)

    # ------------------------------------------------------------------ instruments

    def _readings(self, path: Sequence[Moment]) -> Array:
        """Readings of the encoders, (n, nq)."""
        n = len(self.machine.joints)
        if not path:
            return np.zeros((0, n))
        jitter = self.machine.noise.jitter * self._jitter.standard_normal((len(path), n))
        shown = np.array([m.state.q for m in path])
        shown += self._sigma[:n] * (np.array([m.errors[:n] for m in path]) + jitter)
        if self._quantum:
            shown = self._quantum * np.round(shown / self._quantum)
        stuck = np.arange(1, n + 1) == self.now.stuck_encoder
        shown = np.where(stuck, self._frozen, shown)
        self._frozen = shown[-1]
        return shown

    def _poses(self, path: Sequence[Moment], taken: Array) -> tuple[Array, Array, Array]:
        """Time stamps and poses of the tracker at times (m,) between the first and last moment."""
        n, jitter = len(self.machine.joints), self.machine.noise.jitter
        gaps = self._blinks.random(len(taken))
        shaken = jitter * self._shaken.standard_normal((len(taken), 6))
        seen = (gaps >= self.tracker.missing) & (not self.now.lost_target)
        taken, shaken = taken[seen], shaken[seen]
        if not len(taken):
            return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3))
        times = np.array([m.state.time for m in path])
        k = np.minimum(np.searchsorted(times, taken), len(times) - 1)
        columns = np.array([[*m.state.q, *m.state.speed, *m.errors[n:]] for m in path]).T
        q, speed, errors = np.split(
            np.stack([np.interp(taken, times, c) for c in columns], 1), [n, 2 * n], axis=1
        )
        direction = np.array([path[i].direction for i in k])
        travel = np.array([path[i].travel for i in k])
        at = self._make_visit(taken, direction, travel, speed)
        r, R = apply_device_effects(self._effects, *self._solve_true_poses(q, at), at)
        errors = self._sigma[n:] * (errors + shaken)
        r, R = self.tracker.observe(r, R, self.now.swapped_target)
        return self.tracker.stamps(taken), r + errors[:, :3], turn(errors[:, 3:]) @ R

    def _solve_true_poses(self, q: Array, at: Visit) -> tuple[Array, Array]:
        """True poses (m, 3), (m, 3, 3); solved once if the robot is at rest."""
        same = not at.velocity.any() and bool((at.temperature == at.temperature[0]).all())
        key = q[0].tobytes(), at.direction[0].tobytes(), float(at.temperature[0]), self.now
        if same and key == self._known[0]:
            r, R = self._known[1]
        else:
            rows = slice(0, 1) if same else slice(None)
            few = Visit(*(getattr(at, name)[rows] for name in at.__dataclass_fields__))
            _, r, R = solve_true_pose(
                self.built, self._effects, self._arms(q[rows]), few, self._pose
            )
            self._pose = r[-1], R[-1]
            if same:
                self._known = key, (r, R)
        m = len(q)
        return np.broadcast_to(r, (m, 3)), np.broadcast_to(R, (m, 3, 3))

    def _arms(self, q: Array) -> Array:
        """Readings (n, nq) minus the slip."""
        return q - self.now.slipped * np.eye(1, q.shape[1])

    def _make_visit(self, time: Array, direction: Array, travel: Array, speed: Array) -> Visit:
        payload = np.full(len(time), self.now.payload)
        session = np.full(len(time), self.now.homed)
        return Visit(time, self.temperature(time), payload, direction, travel, speed, session)
