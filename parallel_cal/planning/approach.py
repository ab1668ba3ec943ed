"""Plan approaches, so that every joint arrives from a known side over a known distance.

Backlash, hysteresis and latency depend on how a joint arrived. The robot overshoots the pose,
reverses at a place as far on its other side, and arrives from there. Every joint then has its last
reversal at that place, whatever the robot did before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions, concatenate_solutions
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named

KINDS = ("direction", "travel", "velocity")  # conditions that an approach brings about
STEPS = (1 / 4, 1 / 32, 1 / 256, 1 / 1024)  # of the workspace: from long distances to a mrad
POSE_TOLERANCE = 1e-6  # m and rad
MIN_APPROACH_SIGMAS = 5.0  # sigmas of a joint's reading: a shorter travel has no certain sign


@dataclass(frozen=True)
class Waypoint:
    """A place on the path to a pose: position (3,) m, joints (nq,)."""

    position: np.ndarray
    joints: np.ndarray


@dataclass(frozen=True)
class Approaches:
    """For each of N poses, where the robot overshoots and where it reverses, the joint travels (N,
    nq) from there to the pose, and whether all of it can be driven (N,)."""

    past: Solutions
    turn: Solutions
    ways: np.ndarray
    ok: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Approaches:
        return Approaches(self.past[rows], self.turn[rows], self.ways[rows], self.ok[rows])

    def waypoints(self, i: int) -> tuple[Waypoint, Waypoint]:
        """Waypoints before pose i, in order."""
        past, turn = (Waypoint(s.position[i], s.joints[i]) for s in (self.past, self.turn))
        return past, turn


def needs_approach(model: Model) -> bool:
    """Whether the predictions of a model depend on how its joints arrived."""
    return any(name.startswith(KINDS) for name in model.conditions)


def approaches(
    model: Model,
    poses: Solutions,
    rng: np.random.Generator,
    reach: float = 1.0,
    usable: np.ndarray | None = None,
    least_travels: np.ndarray | float = 0.0,
) -> Approaches:
    """Make approaches along random lines, each with a length of STEPS that can be driven in the
    workspace (`reach` times as large), selected at random. Those to poses (N,) that are not
    `usable` are not `ok`. Each joint moves further than `find_least_travels` of the model says, and
    further than `least_travels` (nq,)."""
    least = np.maximum(find_least_travels(model), least_travels)
    m, n = model.mechanism, len(poses)
    low, high = np.array(m.workspace.low), np.array(m.workspace.high)
    side = rng.uniform(-1, 1, (n, len(m.controlled)))
    side /= np.abs(side).max(axis=1, keepdims=True)
    away = np.array(STEPS)[:, None, None] * side * (high - low)  # (steps, n, controlled)
    here = m.controlled_coordinates(poses.position, poses.rotation)
    furthest = np.abs(here - (low + high) / 2) + np.abs(away)
    inside = (furthest <= reach * (high - low) / 2 + POSE_TOLERANCE).all(axis=2)
    if usable is not None:
        inside &= usable
    priority = rng.uniform(0.5, 1, (len(STEPS), n)) * inside
    # Solve those that come first; the next ones only where these cannot be driven.
    order, left, parts = np.argsort(-priority, axis=0), np.arange(n), list[Approaches]()
    place, rows = np.zeros(n, dtype=int), 0
    for step in order:
        part = _drive(model, poses[left], away[step[left], left], least)
        part = replace(part, ok=part.ok & (priority[step[left], left] > 0))
        place[left] = rows + np.arange(len(left))
        parts, rows = [*parts, part], rows + len(left)
        left = left[~part.ok & (priority[:, left] > 0).any(axis=0)]
        if not len(left):
            break
    return Approaches(
        concatenate_solutions([part.past for part in parts]),
        concatenate_solutions([part.turn for part in parts]),
        np.concatenate([part.ways for part in parts]),
        np.concatenate([part.ok for part in parts]),
    )[place]


def _drive(model: Model, poses: Solutions, away: np.ndarray, least: np.ndarray) -> Approaches:
    """Overshoot poses by `away` (N, controlled coordinates) and turn as far on their other side.
    Approaches in which a joint moves less than `least` (nq,) are not `ok`."""
    m, robot = model.mechanism, Kinematics(model, quick=True)
    here = m.controlled_coordinates(poses.position, poses.rotation)
    past, turn = (robot.inverse(*m.poses(here + sign * away)) for sign in (1, -1))
    ways = poses.joints - turn.joints
    reverses = ways * (turn.joints - past.joints) < 0
    certain = MIN_APPROACH_SIGMAS * np.nan_to_num(model.joint_noise)
    significant = np.abs(ways) > np.maximum(certain, least)
    return Approaches(past, turn, ways, past.ok & turn.ok & (reverses & significant).all(axis=1))


def find_least_travels(model: Model) -> np.ndarray:
    """Return how far each joint (nq,) must move after a reversal until the model's effects have
    their full size: a shorter move does not take up a backlash."""
    numbers = Named(model.table.names, model.values)
    travels = [
        [effect.least_travel(numbers[effect.name], joint) for joint in model.joints]
        for effect in model.effects
    ]
    return np.array([[0.0] * len(model.joints), *travels]).max(axis=0)


def fill(a: np.ndarray, model: Model, ways: np.ndarray, speed: np.ndarray | float = 0.0) -> None:
    """Fill conditions a (N, n_conditions) for joint travels (N, nq): direction, travel, and
    velocity if the fastest joint moves at `speed` (N,)."""
    each = {
        "direction": np.sign(ways),
        "travel": ways,
        "velocity": ways / np.abs(ways).max(axis=1, keepdims=True) * np.reshape(speed, (-1, 1)),
    }
    for k, name in enumerate(model.conditions):
        kind, _, joint = name.partition(".")
        if kind in each:
            a[:, k] = each[kind][:, model.joints.index(joint)]
