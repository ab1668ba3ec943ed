"""A controller and its drives: set points within limits, and joints that follow with a lag."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.virtual.robot import Array

REST_TOLERANCE = 1e-9  # rad or m (and 100 times that per s); below it a joint is at rest


@dataclass(frozen=True)
class Limits:
    """Limits of every joint.

    `velocity` (rad/s or m/s), `acceleration`, deceleration of the `brake`, mechanical stops `low`
    and `high`, `bandwidth` (1/s) of the loop, and the lag `trip` at which a drive gives up.
    """

    velocity: float
    acceleration: float
    brake: float
    low: float
    high: float
    bandwidth: float
    trip: float


@dataclass(frozen=True, eq=False)
class SetPointTrajectory:
    """Set points (n, nq) at times (n,); the first is the set point when the trajectory began.

    Like in joint_trajectory_controller, the interpolation is cubic with velocities (n, nq), else
    linear.
    """

    time: list[float]
    positions: Array
    velocities: Array | None

    def at(self, time: float) -> Array:
        """Interpolate the set point (nq,) at a time; the last one remains afterwards."""
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
    """State of the drives at a time: limited set point and joints, each with its speed."""

    time: float
    target: Array
    target_speed: Array
    q: Array
    speed: Array

    @property
    def is_at_rest(self) -> bool:
        """Whether set point and joints do not move."""
        return not self.target_speed.any() and not self.speed.any()


class Drive:
    """Joints that follow a trajectory.

    The set point respects the limits. A critically damped loop follows it; it cannot overshoot, so
    it respects the limits, too. `stuck` joints do not move. If a joint lags by more than
    `limits.trip`, the drives give up: they drop the trajectory, and the robot holds its position.
    """

    def __init__(self, q: Array, limits: Limits, period: float):
        self.limits, self.period = limits, period
        self.state = State(0.0, q, np.zeros(len(q)), q, np.zeros(len(q)))
        self.stuck = np.zeros(len(q), dtype=bool)
        self.tripped = 0
        self._course: SetPointTrajectory | None = None
        self._goal, self._braking = q, False

    def follow(self, time: Array, positions: Array, velocities: Array | None = None) -> None:
        """Replace the trajectory by points (n, nq) at times (n,) s from now."""
        now = self.state
        if velocities is not None:
            velocities = np.vstack([now.target_speed, velocities])
        self._course = SetPointTrajectory(
            [now.time, *(now.time + time)], np.vstack([now.target, positions]), velocities
        )
        self._goal, self._braking = positions[-1], False

    def stop(self) -> None:
        """Brake, and hold the position where braking ends."""
        now = self.state
        distance = now.target_speed * np.abs(now.target_speed) / (2 * self.limits.brake)
        self._course, self._goal, self._braking = None, now.target + distance, True

    def step(self, held: bool = False) -> State:
        """Advance by one period; if `held`, an obstacle stops all joints."""
        self.state = self._move_joints(self._compute_set_point(), self.stuck | held)
        now = self.state
        if np.abs(now.target - now.q).max() > self.limits.trip:
            self.give_up()
        return self.state

    def rest(self) -> None:
        """Advance by one period without motion."""
        self.state = replace(self.state, time=self.state.time + self.period)

    def mark(self) -> tuple[Any, ...]:
        """Save the state for `back_to`."""
        return self.state, self._course, self._goal, self._braking, self.tripped

    def back_to(self, mark: tuple[Any, ...]) -> None:
        """Restore the state of a mark."""
        self.state, self._course, self._goal, self._braking, self.tripped = mark

    @property
    def idle(self) -> bool:
        """Whether nothing moves, and nothing will before the next command."""
        there = bool((self._goal == self.state.q).all())
        return self._course is None and self.state.is_at_rest and there

    def give_up(self) -> None:
        """Hold the present position of the joints."""
        now, zero = self.state, np.zeros(len(self.stuck))
        self.state = replace(now, target=now.q, target_speed=zero, speed=zero)
        self._course, self._goal = None, now.q
        self.tripped += 1

    def _compute_set_point(self) -> State:
        """The next set point: that of the trajectory, or as near as the limits allow."""
        now, dt, limits = self.state, self.period, self.limits
        time = now.time + dt
        if self._course is None:
            before, after = self._goal, self._goal
        else:
            before, after = self._course.at(now.time), self._course.at(time)
            if time >= self._course.time[-1]:
                self._course = None
        rate = limits.brake if self._braking else limits.acceleration
        missing = before - now.target
        # Catch up at the speed from which braking in whole periods ends at the set point, but do
        # not pass it within this period.
        size = np.abs(missing)
        catch = rate * dt * (np.sqrt(0.25 + 2 * size / (rate * dt**2)) - 0.5)
        wanted = (after - before) / dt + np.sign(missing) * np.minimum(size / dt, catch)
        speed = np.clip(wanted, now.target_speed - rate * dt, now.target_speed + rate * dt)
        speed = np.clip(speed, -limits.velocity, limits.velocity)
        return replace(now, time=time, target=now.target + dt * speed, target_speed=speed)

    def _move_joints(self, now: State, held: NDArray[np.bool_]) -> State:
        """The joints a period later: exact solution of y'' + 2 w y' + w^2 y = 0 for the lag y."""
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
