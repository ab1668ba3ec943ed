"""What the streams remember, and the joints for a target that follow from it; no ROS in it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solvers import newton
from parallel_cal.model.model import Model
from parallel_cal.nodes.model_server import ServedModel, describe_status

SAME_BRANCH = 1e-3  # rad or m: joints that solve the same pose on the same branch agree better


class DirectionTracker:
    """The sign of each joint's last motion, where smaller ones than `threshold` do not count."""

    def __init__(self, threshold: float):
        self.threshold = threshold
        self.direction: dict[str, float] = {}
        self._furthest: dict[str, float] = {}

    def follow(self, positions: Mapping[str, float]) -> None:
        """Take in a reading of each joint (rad or m)."""
        for joint, value in positions.items():
            furthest = self._furthest.setdefault(joint, value)
            moved, going = value - furthest, self.direction.get(joint, 0.0)
            if abs(moved) > self.threshold:
                self.direction[joint] = float(np.sign(moved))
            if abs(moved) > self.threshold or moved * going > 0:
                self._furthest[joint] = value


class Memory:
    """Last joints and conditions heard of on the topics."""

    def __init__(self, threshold: float):
        self.tracker = DirectionTracker(threshold)
        self.heard: dict[str, float] = {}
        self._joints: dict[str, float] = {}
        self._time: float | None = None

    def on_joint_state(
        self, model: Model, q: np.ndarray, stamp: float, velocity: np.ndarray | None
    ) -> None:
        """Take in a joint state: q and velocity (nq,) in the model's order, stamp in s."""
        now = dict(zip(model.joints, q.tolist(), strict=True))
        if velocity is None:
            velocity = self._velocity(now, stamp)
        self.tracker.follow(now)
        for joint, value in zip(model.joints, velocity, strict=True):
            self.heard[f"velocity.{joint}"] = float(value)
        self._joints, self._time = now, stamp

    def _velocity(self, now: dict[str, float], stamp: float) -> np.ndarray:
        lapse = 0.0 if self._time is None else stamp - self._time
        if lapse <= 0 or self._joints.keys() != now.keys():
            return np.zeros(len(now))
        return np.array([(value - self._joints[joint]) / lapse for joint, value in now.items()])

    def joints(self, model: Model) -> np.ndarray | None:
        """The last joints (nq,), None before the first joint state."""
        known = self._joints  # another thread may exchange it
        if any(joint not in known for joint in model.joints):
            return None
        return np.array([known[joint] for joint in model.joints])

    def conditions(self, model: Model) -> dict[str, float] | None:
        """What is known of the conditions the model's effects depend on."""
        if not model.conditions:
            return None
        directions = self.tracker.direction.copy()  # another thread may add to it
        going = {f"direction.{joint}": sign for joint, sign in directions.items()}
        known = self.heard | going
        return {name: known[name] for name in model.conditions if name in known}

    def unheard(self, model: Model) -> list[str]:
        """Conditions the model needs that nothing was heard of: their neutral value serves."""
        known = self.conditions(model) or {}
        return [name for name in model.conditions if name not in known]


def joints_for(
    served: ServedModel, memory: Memory, r: np.ndarray, R: np.ndarray | None
) -> Solutions:
    """Joints for a target, on the branch the robot is on and as approached from where it is.

    SolveError for every status but converged: nothing unsafe is ever commanded.
    """
    kinematics, model = served.kinematics, served.model
    last, at = memory.joints(model), memory.conditions(model)
    found = _solve_on_branch(kinematics, last, r, R, at)
    coming = _approach(model, memory.tracker, last, found.joints)
    if at is not None and not coming.items() <= at.items():
        found = _solve_on_branch(kinematics, last, r, R, at | coming)
    if found.status != Status.CONVERGED:
        raise SolveError(describe_status(found.status))
    return found


def _approach(
    model: Model, tracker: DirectionTracker, last: np.ndarray | None, q: np.ndarray
) -> dict[str, float]:
    """The directions in which the joints will move to the target, where the model needs them."""
    if last is None or not np.isfinite(q).all():
        return {}
    moves = zip(model.joints, (q - last).tolist(), strict=True)
    signs = {f"direction.{j}": float(np.sign(d)) for j, d in moves if abs(d) > tracker.threshold}
    return {name: sign for name, sign in signs.items() if name in model.conditions}


def _solve_on_branch(
    kinematics: Kinematics,
    last: np.ndarray | None,
    r: np.ndarray,
    R: np.ndarray | None,
    at: Mapping[str, float] | None,
) -> Solutions:
    """The home branch's solution; for a robot on another branch the one nearest to its joints."""
    found = kinematics.inverse(r, R, at)
    if last is None or _is_on_home_branch(kinematics, last, at):
        return found
    others = newton.inverse_all(kinematics.model, r, R, at, starts=0)  # in time for the stream
    usable = np.flatnonzero(others.status == Status.CONVERGED)
    if not len(usable):
        return found
    return others[usable[np.argmin(np.abs(others.joints[usable] - last).max(axis=1))]]


def _is_on_home_branch(
    kinematics: Kinematics, q: np.ndarray, at: Mapping[str, float] | None
) -> bool:
    """Whether the home branch's inverse of where the robot is gives its joints back."""
    here = kinematics.direct(q, at)
    if here.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS):
        return True  # nothing can be said; home is what the model file asks for
    back = kinematics.inverse(here.position, here.rotation, at)
    return bool(np.abs(back.joints - q).max() < SAME_BRANCH)
