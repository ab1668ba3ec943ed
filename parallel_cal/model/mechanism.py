"""What a mechanism is: a parameter table and one closure phi(q, x, p) = 0."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix, rotation_vector
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.drawing import Line
from parallel_cal.model.parameters import Named, ParameterTable

POSE = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Home:
    """A configuration in the assembly mode that the robot works in.

    Every choice between branches (elbow in or out, platform above or below) goes to the
    solution nearest to it, so it belongs to the model file, not to a solver.
    """

    joints: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @cached_property
    def configuration(self) -> np.ndarray:
        """(q, r, R row-major) as one read-only vector."""
        q, r = np.array(self.joints, dtype=float), np.array(self.position, dtype=float)
        row = Configuration(q, r, quaternion_to_matrix(self.quaternion)).rows
        row.setflags(write=False)
        return row


@dataclass(frozen=True)
class Workspace:
    """A box of controlled coordinates for sampling and planning: positions (m) and components of
    the rotation vector (rad) in {B}, absolute."""

    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True)
class Box:
    """A box in {B} that no part of the robot may enter: opposite corners, m."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __str__(self) -> str:
        """Its sides in mm."""
        sides = zip("xyz", self.low, self.high, strict=True)
        return ", ".join(f"{axis} {1e3 * a:g}..{1e3 * b:g}" for axis, a, b in sides) + " mm"


class Mechanism(ABC):
    """A robot's geometry: parameters, joints, moved and controlled coordinates, closure.

    Subclass it in a file of its own; the file's name is the mechanism's name.
    """

    joints: tuple[str, ...]
    joint_unit: str = "rad"
    periodic: bool = True  # a whole turn of a joint changes nothing (a spool's does)
    moves: tuple[str, ...] = POSE
    controls: tuple[str, ...] = POSE
    parameters: ParameterTable
    fixed: tuple[str, ...] = ()
    home: Home
    workspace: Workspace
    joint_limits: tuple[tuple[float, float], ...]
    joint_rates: tuple[tuple[float, float], ...] = ()  # velocity, acceleration; inf = not known
    keep_out: tuple[Box, ...] = ()
    joint_gearing: tuple[float, ...] = ()  # of the reading to the joint behind the gear; none = 1
    closed_forms: tuple[str, ...] = ()  # "direct", "inverse": whose candidates are all there are
    length: float = 0.1
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)  # m/s^2 in {B}
    bodies: Mapping[str, Sequence[str]] = {}  # patterns of the lengths that are of one material
    parts: tuple[str, ...] = ()  # kinds of links whose centres of mass it knows
    options: Mapping[str, Any] = {}

    @abstractmethod
    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """phi(q, x, p): a CasADi column, zero where the mechanism closes, in m or rad.

        q (n_joints, 1), r (3, 1) position and R (3, 3) rotation of {P} in {B}.
        """

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Poses near the solutions of the direct problem: [(r, R)]; home by default.

        Exact where the documents give a closed form; else where Newton's method starts.
        """
        return [(ca.DM(self.home.position), ca.DM(quaternion_to_matrix(self.home.quaternion)))]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """The same for the inverse problem: for each joint its possible values."""
        return [(joint,) for joint in self.home.joints]

    def start(self, q: Any, p: Named) -> tuple[Any, Any]:
        """The candidate pose nearest to home: the robot's assembly mode."""
        position, rotation = Mechanism.candidates(self, q, p)[0]

        def apart(pose: tuple[Any, Any]) -> Any:
            turned = ca.sumsqr(pose[1] - rotation) / 2  # the angle squared, where it is small
            return ca.sumsqr(pose[0] - position) + self.length**2 * turned

        return nearest(self.candidates(q, p), apart)

    def start_inverse(self, r: Any, R: Any, p: Named) -> Any:
        """For each joint the candidate nearest to home."""
        return self.nearest_home(self.joint_candidates(r, R, p))

    def nearest_home(self, candidates: list[tuple[Any, ...]]) -> Any:
        """Of each joint's values the one nearest to home, angles compared on the circle."""
        choices = zip(self.wrap_to_home(candidates), self.home.joints, strict=True)
        return ca.vertcat(
            *[nearest(c, partial(lambda h, q: ca.fabs(q - h), home)) for c, home in choices]
        )

    def wrap_to_home(self, candidates: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Each joint's values, angles within half a turn of home."""
        if not self.periodic:
            return candidates
        choices = zip(candidates, self.joint_units, self.home.joints, strict=True)
        return [
            tuple(_wrap_angle_to_home(q, home) for q in joint) if unit == "rad" else joint
            for joint, unit, home in choices
        ]

    def rod_lengths(self, p: Named) -> list[Any]:
        """Length of every rod that no motor drives, a pair's common one twice (m)."""
        return []

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Of each kind in `parts` the links' centres of mass in {B}, (3, 1) m each."""
        return {}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """The lines of its picture at (q, r, R), points as CasADi columns of the same symbols."""
        return []

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """The larger model this one is a special case of, and its parameter values."""
        raise ModelError(f"{self.name} is not a special case of a larger model")

    @property
    def joint_ranges(self) -> np.ndarray:
        """How far each joint may go (nq,), rad or m; 2 pi where its limits are not known."""
        low, high = np.array(self.joint_limits, dtype=float).reshape(-1, 2).T
        return np.where(np.isfinite(high - low), high - low, 2 * np.pi)

    @property
    def name(self) -> str:
        """The name in model files: the file's name, or the Python path of a user's file."""
        module = type(self).__module__
        return module.removeprefix("parallel_cal.mechanisms.")

    @property
    def winds(self) -> tuple[float, ...]:
        """m of line that a radian of each joint lets out; empty where none winds a line."""
        return ()

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Each joint's unit, rad or m; a mechanism that has both overrides this."""
        return (self.joint_unit,) * len(self.joints)

    @property
    def moved(self) -> list[int]:
        return _places(self.moves)

    @property
    def controlled(self) -> list[int]:
        return _places(self.controls)

    @property
    def passive(self) -> list[int]:
        """Moved coordinates that follow by themselves (the Delta's orientation)."""
        return [i for i in self.moved if i not in self.controlled]

    @property
    def joint_periods(self) -> np.ndarray:
        """By how much each joint (nq,) may be off without a difference: 2 pi, or 0."""
        return 2 * np.pi * np.array([self.periodic and unit == "rad" for unit in self.joint_units])

    def poses(self, controlled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3) and rotations (n, 3, 3) that differ from home in what is controlled,
        (n, n_controlled) as `Workspace` has it."""
        home = rotation_vector(quaternion_to_matrix(np.array(self.home.quaternion)))
        rows = np.tile([*self.home.position, *home], (len(controlled), 1))
        rows[:, self.controlled] = controlled
        return rows[:, :3], rotation_matrix(rows[:, 3:])

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """n uniform draws of the controlled coordinates in the workspace, (n, n_controlled)."""
        low, high = np.array(self.workspace.low), np.array(self.workspace.high)
        return rng.uniform(low, high, size=(n, len(self.controls)))


def _places(coordinates: Sequence[str]) -> list[int]:
    if unknown := [c for c in coordinates if c not in POSE]:
        raise ModelError(f"coordinates {unknown}, expected some of {' '.join(POSE)}")
    return [POSE.index(c) for c in coordinates]


def _wrap_angle_to_home(q: Any, home: float) -> Any:
    return q - 2 * ca.pi * ca.floor((q - home) / (2 * ca.pi) + 0.5)


def nearest(candidates: Sequence[Any], distance: Callable[[Any], Any]) -> Any:
    """The candidate of least distance, decided when the expression is evaluated; one that is NaN
    is never nearer."""
    best = candidates[0]
    for other in candidates[1:]:
        closer = distance(other) < distance(best)
        if isinstance(best, tuple):
            best = tuple(ca.if_else(closer, o, b) for o, b in zip(other, best, strict=True))
        else:
            best = ca.if_else(closer, other, best)
    return best


def poses_in_workspace(
    mechanism: Mechanism, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) and rotations (n, 3, 3) drawn from the workspace."""
    return mechanism.poses(mechanism.sample(n, rng))
