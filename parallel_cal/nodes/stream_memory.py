"""Remember joints and conditions of the streams, and solve targets with them, without ROS."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.campaign.path_guard import describe_exceeded_limits
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.model.effect import list_substitutes, parse_lag
from parallel_cal.model.model import Model
from parallel_cal.nodes.computing import solve_on_branch
from parallel_cal.nodes.model_server import ServedModel, describe_status
from parallel_cal.recordings.lagged import follow


class DirectionTracker:
    """The sign of each joint's last motion; motions below `threshold` do not count."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self.direction: dict[str, float] = {}
        self._furthest: dict[str, float] = {}

    def follow(self, positions: Mapping[str, float]) -> None:
        """Update with a reading of each joint [rad or m]."""
        for joint, value in positions.items():
            furthest = self._furthest.setdefault(joint, value)
            moved, going = value - furthest, self.direction.get(joint, 0.0)
            if abs(moved) > self.threshold:
                self.direction[joint] = float(np.sign(moved))
            if abs(moved) > self.threshold or moved * going > 0:
                self._furthest[joint] = value


class Memory:
    """The last joints and conditions received on the topics."""

    def __init__(self, threshold: float):
        self.tracker = DirectionTracker(threshold)
        self.heard: dict[str, float] = {}
        self._motion: dict[str, tuple[float, float]] = {}  # position and velocity of each joint
        self._time: float | None = None
        self.received = -math.inf  # time.monotonic() of the last joint state
        self._condition_times: dict[str, float] = {}

    def on_condition(self, model: Model | None, name: str, value: float, stamp: float) -> None:
        """Update with a condition at a time [s], and those that follow it with a time constant."""
        before = self.heard.get(name, value)
        step = stamp - self._condition_times.get(name, stamp)
        for lagged in model.conditions if model else ():
            lag = parse_lag(lagged)
            if lag is not None and lag[0] == name:
                last = self.heard.get(lagged, before)
                self.heard[lagged] = follow(last, before, value, step, lag[1])
        self.heard[name], self._condition_times[name] = value, stamp

    def on_joint_state(
        self, model: Model, q: np.ndarray, stamp: float, velocity: np.ndarray | None
    ) -> None:
        """Update with a joint state.

        Parameters
        ----------
        q
            Readings (nq,) in the model's order [rad or m].
        stamp
            Time of the readings [s].
        velocity
            Velocities (nq,); None: difference quotient with the readings before.
        """
        now = dict(zip(model.joints, q.tolist(), strict=True))
        lapse = 0.0 if self._time is None else stamp - self._time
        before = self._motion if lapse > 0 and self._motion.keys() == now.keys() else {}
        # Second differences of readings are mostly noise: only the driver's velocities have a rise.
        rises = {} if velocity is None else before
        if velocity is None:
            velocity = np.zeros(len(now))
            if before:
                velocity = (q - [before[joint][0] for joint in now]) / lapse
        self.tracker.follow(now)
        for joint, value in zip(model.joints, velocity.tolist(), strict=True):
            self.heard[f"velocity.{joint}"] = value
            self.heard.pop(f"acceleration.{joint}", None)
            if joint in rises:
                self.heard[f"acceleration.{joint}"] = (value - rises[joint][1]) / lapse
        self._motion = dict(zip(model.joints, zip(q, velocity, strict=True), strict=True))
        self._time, self.received = stamp, time.monotonic()

    def joints(self, model: Model) -> np.ndarray | None:
        """Return the last joints (nq,), or None before the first joint state."""
        motion = self.motion(model)
        return None if motion is None else motion[0]

    def motion(self, model: Model) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the last joints and velocities (nq,), or None before the first joint state."""
        known = self._motion  # another thread may exchange it
        if any(joint not in known for joint in model.joints):
            return None
        q, velocity = np.array([known[joint] for joint in model.joints]).T
        return q, velocity

    def conditions(self, model: Model) -> dict[str, float] | None:
        """Return the known conditions among those that the model's effects need."""
        if not model.conditions:
            return None
        directions = self.tracker.direction.copy()  # another thread may add to it
        known = self.heard | {f"direction.{joint}": sign for joint, sign in directions.items()}
        named = {name: (name, *list_substitutes(name)) for name in model.conditions}
        return {
            name: next(known[one] for one in names if one in known)
            for name, names in named.items()
            if any(one in known for one in names)
        }

    def unheard(self, model: Model) -> list[str]:
        """List the unknown conditions that the model needs; their neutral values are used."""
        known = self.conditions(model) or {}
        return [name for name in model.conditions if name not in known]


def joints_for(
    served: ServedModel, memory: Memory, r: np.ndarray, R: np.ndarray | None
) -> Solutions:
    """Solve the joints for a target on the robot's present branch.

    The approach directions are those of a motion from the present joints. Raise SolveError unless
    the solution converged inside the joint limits, so that nothing unsafe is ever commanded.
    """
    kinematics, model = served.kinematics, served.model
    last, at = memory.joints(model), memory.conditions(model)
    found = solve_on_branch(kinematics, last, r, R, at)
    if at is not None and last is not None and np.isfinite(found.joints).all():
        moves = zip(model.joints, (found.joints - last).tolist(), strict=True)
        moving = {f"direction.{j}": d for j, d in moves if abs(d) > memory.tracker.threshold}
        approach = {
            name: float(np.sign(d)) for name, d in moving.items() if name in model.conditions
        }
        # The first solution assumed the present directions: solve again if a joint will reverse.
        if not approach.items() <= at.items():
            found = solve_on_branch(kinematics, last, r, R, at | approach)
    if found.status == Status.OUTSIDE_LIMITS:
        exceeded = describe_exceeded_limits(model.mechanism, found.joints)
        raise SolveError(f"{describe_status(found.status)} ({exceeded})")
    if found.status != Status.CONVERGED:
        raise SolveError(describe_status(found.status))
    return found
