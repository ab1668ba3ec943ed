"""A controller and its drives: set points within limits, and joints that follow them late."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.virtual.robot import Array

REST_TOLERANCE = (
    1e-9  # rad or m, and a hundred times that a second: nearer than that it stands still
)


@dataclass(frozen=True)
class Limits:
    """Of every joint: velocity (rad/s or m/s), acceleration, the brake's deceleration, mechanical
    stops, how fast the loop follows (1/s), and the lag at which a drive gives up."""

    velocity: float
    acceleration: float
    brake: float
    low: float
    high: float
    bandwidth: float
    trip: float


@dataclass(frozen=True, eq=False)
class SetPointTrajectory:
    """Set points (n, nq) at times (n,), the first where the robot was told to be when it came.

    Cubic from point to point where there are velocities (n, nq), else straight: as
    joint_trajectory_controller interpolates.
    """

    time: list[float]
    positions: Array
    velocities: Array | None

    def at(self, time: float) -> Array:
        """The set point (nq,) then; the last one ever after."""
        k = bisect_left(self.time, time)
        if k >= len(self.time):
            return self.positions[-1]
        if k == 0:
            return self.positions[0]
        width = self.time[k] - self.time[k - 1]
        s = (time - self.time[k - 1]) / width
        a, b = self.positions[k - 1], self.positions[k]
        if self.velocities is None:
            return a + s * (b - a)
        va, vb = width * self.velocities[k - 1], width * self.velocities[k]
        rise = s * s * (3 - 2 * s)
        return a + rise * (b - a) + s * (1 - s) * ((1 - s) * va - s * vb)


@dataclass(frozen=True, eq=False)
class State:
    """Of the drives at a time: the limited set point and its speed, the joints and theirs."""

    time: float
    target: Array
    target_speed: Array
    q: Array
    speed: Array

    @property
    def is_at_rest(self) -> bool:
        """Whether the joints stand still where they are told to be."""
        return not self.target_speed.any() and not self.speed.any()


class Drive:
    """Joints that follow a course: a set point that keeps the limits, and a critically damped loop
    behind it, which cannot overshoot and so keeps them, too.

    `stuck` joints stay where they are. One that lags by more than `limits.trip` makes the drives
    give up: the course is forgotten, and the robot holds where it is.
    """

    def __init__(self, q: Array, limits: Limits, period: float):
        self.limits, self.period = limits, period
        self.state = State(0.0, q, np.zeros(len(q)), q, np.zeros(len(q)))
        self.stuck = np.zeros(len(q), dtype=bool)
        self.tripped = 0
        self._course: SetPointTrajectory | None = None
        self._goal, self._braking = q, False

    def follow(self, time: Array, positions: Array, velocities: Array | None = None) -> None:
        """Take a course of points (n, nq) at times (n,) s from now on; the one before is over."""
        now = self.state
        if velocities is not None:
            velocities = np.vstack([now.target_speed, velocities])
        self._course = SetPointTrajectory(
            [now.time, *(now.time + time)], np.vstack([now.target, positions]), velocities
        )
        self._goal, self._braking = positions[-1], False

    def stop(self) -> None:
        """Brake, and hold where that ends."""
        now = self.state
        way = now.target_speed * np.abs(now.target_speed) / (2 * self.limits.brake)
        self._course, self._goal, self._braking = None, now.target + way, True

    def step(self, held: bool = False) -> State:
        """One period further; `held` where something is in the way of all joints."""
        self.state = self._move_joints(self._compute_set_point(), self.stuck | held)
        now = self.state
        if np.abs(now.target - now.q).max() > self.limits.trip:
            self.give_up()
        return self.state

    def rest(self) -> None:
        """One period further without a motion to come."""
        self.state = replace(self.state, time=self.state.time + self.period)

    def mark(self) -> tuple[Any, ...]:
        """What `back_to` goes back to."""
        return self.state, self._course, self._goal, self._braking, self.tripped

    def back_to(self, mark: tuple[Any, ...]) -> None:
        """As if nothing had happened since the mark."""
        self.state, self._course, self._goal, self._braking, self.tripped = mark

    @property
    def idle(self) -> bool:
        """Whether nothing moves, and nothing will until somebody says so."""
        there = bool((self._goal == self.state.q).all())
        return self._course is None and self.state.is_at_rest and there

    def give_up(self) -> None:
        """Hold where the joints are."""
        now, zero = self.state, np.zeros(len(self.stuck))
        self.state = replace(now, target=now.q, target_speed=zero, speed=zero)
        self._course, self._goal = None, now.q
        self.tripped += 1

    def _compute_set_point(self) -> State:
        """The next set point: what the course says, or nearer to it as fast as the limits allow."""
        now, dt, limits = self.state, self.period, self.limits
        time = now.time + dt
        if self._course is None:
            before, after = self._goal, self._goal
        else:
            before, after = self._course.at(now.time), self._course.at(time)
            if time >= self._course.time[-1]:
                self._course = None
        most = limits.brake if self._braking else limits.acceleration
        missing = before - now.target
        # The speed from which whole periods of braking end there, and no more than gets there now.
        size = np.abs(missing)
        catch = most * dt * (np.sqrt(0.25 + 2 * size / (most * dt**2)) - 0.5)
        wanted = (after - before) / dt + np.sign(missing) * np.minimum(size / dt, catch)
        speed = np.clip(wanted, now.target_speed - most * dt, now.target_speed + most * dt)
        speed = np.clip(speed, -limits.velocity, limits.velocity)
        return replace(now, time=time, target=now.target + dt * speed, target_speed=speed)

    def _move_joints(self, now: State, held: NDArray[np.bool_]) -> State:
        """The joints a period later: y'' + 2 w y' + w^2 y = 0 of the lag y, solved exactly."""
        w, dt, limits = self.limits.bandwidth, self.period, self.limits
        lag = now.q - now.target
        push = now.speed + w * lag
        fade = np.exp(-w * dt)
        q = now.target + fade * (lag + push * dt)
        speed = fade * (now.speed - w * push * dt)
        stopped = held | (q < limits.low) | (q > limits.high)
        q = np.where(held, now.q, np.clip(q, limits.low, limits.high))
        speed = np.where(stopped, 0.0, speed)
        there = (np.abs(q - now.target) < REST_TOLERANCE) & (np.abs(speed) < 100 * REST_TOLERANCE)
        there &= now.target_speed == 0
        return replace(now, q=np.where(there, now.target, q), speed=np.where(there, 0.0, speed))
