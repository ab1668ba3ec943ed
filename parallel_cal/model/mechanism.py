"""The base class of mechanisms: a parameter table and one closure phi(q, x, p) = 0."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix, rotation_vector
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.content import ByContent
from parallel_cal.model.drawing import Line
from parallel_cal.model.drive import Drive, Spool
from parallel_cal.model.parameters import Named, ParameterTable

POSE = ("x", "y", "z", "rx", "ry", "rz")
SCALES = "scales"  # what measures the joints whose readings are lengths


@dataclass(frozen=True)
class Home:
    """A configuration in the assembly mode in which the robot works.

    If a problem has several solutions (elbow in or out, platform above or below), the solution on
    the branch of home is chosen: the one that a motion from home reaches without passing a
    singularity. So home belongs to the model file, not to a solver.

    Parameters
    ----------
    joints : tuple of float
        Joint readings, rad or m.
    position : tuple of 3 float
        Position of {P} in {B}, m. Default: the origin.
    quaternion : tuple of 4 float
        Orientation of {P} in {B}, x y z w. Default: no rotation.
    passive : tuple of float
        Passive coordinates of a mechanism that declares some, each in its unit. Default: none.
    """

    joints: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    passive: tuple[float, ...] = ()

    @cached_property
    def configuration(self) -> np.ndarray:
        """(q, r, R row-major, u) as one read-only vector."""
        q, r, u = (np.array(v, dtype=float) for v in (self.joints, self.position, self.passive))
        row = Configuration(q, r, quaternion_to_matrix(self.quaternion), u).rows
        row.setflags(write=False)
        return row

    @cached_property
    def rotation_vector(self) -> np.ndarray:
        """Rotation vector (3,) of the orientation, rad; read-only."""
        w = rotation_vector(quaternion_to_matrix(self.quaternion))
        w.setflags(write=False)
        return w


@dataclass(frozen=True)
class Workspace:
    """A box of controlled coordinates, for sampling and planning.

    Parameters
    ----------
    low, high : tuple of float
        Limits of each controlled coordinate in {B}: positions (m) and components of the rotation
        vector (rad). They are absolute, not relative to home.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> pc.Workspace(low=(-0.1, -0.1, -0.4), high=(0.1, 0.1, -0.3)).high
    (0.1, 0.1, -0.3)
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def around(
        cls, centre: np.ndarray, reach: float | np.ndarray, turns: Sequence[float] = ()
    ) -> Workspace:
        """Return the box that `reach` (m; one number, or one for each coordinate) spans to each
        side of the position `centre` (m), and `turns` (rad) to each side of the level platform.

        Examples
        --------
        >>> import numpy as np
        >>> import parallel_cal as pc
        >>> pc.Workspace.around(np.array([0.0, 0.0, 0.5]), 0.125, (0.1,))
        Workspace(low=(-0.125, -0.125, 0.375, -0.1), high=(0.125, 0.125, 0.625, 0.1))
        """
        return cls(
            low=(*map(float, centre - reach), *(-turn for turn in turns)),
            high=(*map(float, centre + reach), *turns),
        )


@dataclass(frozen=True)
class Box:
    """A box in {B} that no part of the robot may enter, given by two opposite corners (m)."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __str__(self) -> str:
        """Sides of the box, in mm."""
        sides = zip("xyz", self.low, self.high, strict=True)
        return ", ".join(f"{axis} {1e3 * a:g}..{1e3 * b:g}" for axis, a, b in sides) + " mm"


class Mechanism(ByContent, ABC):
    """Base class of a robot's geometry.

    Subclass it in a file of its own; the file name is the mechanism's name. Implement `closure`;
    the other methods have defaults. A mechanism that declares `passive` coordinates u implements
    `closure(q, u, r, R, p)`.

    Attributes
    ----------
    joints : tuple of str
        Names of the actuated joints.
    joint_unit : str
        Unit of all joint readings, `rad` or `m`. Default `rad`. A mechanism with both overrides
        `joint_units`, one unit for each joint.
    passive : tuple of str
        Names of the coordinates u of passive joints that the closure needs, because they cannot be
        eliminated by hand. They are unknowns of forward and inverse kinematics, and a fit
        eliminates them from the measurement equations. Their values at home are in `home`.
        Default: none.
    passive_units : tuple of str
        Unit of each passive coordinate, `rad` or `m`. Default `rad`.
    periodic : bool
        Whether a full turn of a joint changes nothing (False for a spool). Default True.
    moves : tuple of str
        Coordinates (x, y, z, rx, ry, rz) in which the platform moves. Default: all six.
    controls : tuple of str
        Coordinates that can be commanded independently. The other ones of `moves` follow from them
        (parasitic motion). Default: all six.
    parameters : ParameterTable
    fixed : tuple of str
        Name patterns of the parameters that are known constants. A fit does not identify them.
        Default none.
    home : Home
    workspace : Workspace
    joint_limits : tuple of (low, high)
        rad or m, one pair for each joint.
    joint_rates : tuple of (velocity, acceleration)
        Limits of the velocity (rad/s or m/s) and of the acceleration (rad/s^2 or m/s^2) of each
        joint; inf if unknown. Default: unknown.
    keep_out : tuple of Box
        Boxes that no part of the robot may enter. Default none.
    joint_gearing : tuple of float
        Joint reading divided by the angle of the joint after the gear. Default: 1 for each joint.
    drives : tuple of (Drive or None)
        For each joint whose readings are lengths: the transmission from the motor's angle to the
        length (spool, screw or belt). Default: unknown.
    closed_forms : tuple of str
        The problems (`direct`, `inverse`) that the mechanism solves in closed form, with every
        solution. Default none.
    length : float
        Characteristic length, m: angles are multiplied by it to compare them with positions.
        Default 0.1.
    gravity : tuple of 3 float
        Gravity in {B}, m/s^2. Default (0, 0, -9.81).
    bodies : dict
        Maps the name of a body of one material to the name patterns of the parameters that are its
        lengths. Effects of thermal expansion use it. Default none. `scales` is added to them if
        readings of joints are lengths: the linear scales, screws or belts that measure these.
    parts : tuple of str
        Kinds of links for which `centres` returns the centres of mass. Default none.
    masses : dict
        Known mass of each kind in `parts`, kg. Default: unknown (0).
    remarks : tuple of str
        What the user should check, because the options do not state it. Default none.
    options : dict
        Options that the model file passes to the class. Default none.
    """

    joints: tuple[str, ...]
    joint_unit: str = "rad"
    passive: tuple[str, ...] = ()
    periodic: bool = True  # a full turn of a joint changes nothing (False for a spool)
    moves: tuple[str, ...] = POSE
    controls: tuple[str, ...] = POSE
    parameters: ParameterTable
    fixed: tuple[str, ...] = ()
    home: Home
    workspace: Workspace
    joint_limits: tuple[tuple[float, float], ...]
    joint_rates: tuple[tuple[float, float], ...] = ()  # velocity, acceleration; inf = unknown
    keep_out: tuple[Box, ...] = ()
    joint_gearing: tuple[float, ...] = ()  # reading per joint angle behind the gear; empty = 1
    drives: tuple[Drive | None, ...] = ()  # empty = unknown
    closed_forms: tuple[str, ...] = ()  # "direct", "inverse"
    length: float = 0.1
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)  # m/s^2 in {B}
    bodies: Mapping[str, Sequence[str]] = {}  # patterns of the lengths of one material
    parts: tuple[str, ...] = ()  # kinds of links whose centres of mass are known
    masses: Mapping[str, float] = {}  # kg
    remarks: tuple[str, ...] = ()
    options: Mapping[str, Any] = {}

    @classmethod
    def complete_options(
        cls, options: Mapping[str, Any], parameters: Collection[str]
    ) -> dict[str, Any]:
        """Return the options of a model file, with those that an older file, which has these
        parameters, does not state."""
        return dict(options)

    def complete_workspace(self, workspace: Workspace) -> Workspace:
        """Return the workspace of a model file, corrected if an older version wrote it wrongly."""
        return workspace

    @abstractmethod
    def closure(self, *args: Any, **kwargs: Any) -> Any:
        """Return the closure phi(q, r, R, p): a CasADi column (m or rad), zero at a valid pose.

        A mechanism with `passive` coordinates u returns phi(q, u, r, R, p).

        Parameters
        ----------
        q : CasADi (n_joints, 1)
            Joint readings, rad or m.
        u : CasADi (n_passive, 1)
            Passive coordinates, rad or m; only of a mechanism that declares some.
        r : CasADi (3, 1)
            Position of {P} in {B}, m.
        R : CasADi (3, 3)
            Rotation of {P} in {B}.
        p : Named
            Geometric parameters by name.
        """

    def overstretch(self, *args: Any, **kwargs: Any) -> Any:
        """Return how far (m) a configuration with a closure of 0 is out of reach; None: never."""
        return None

    def arguments(self, q: Any, u: Any, r: Any, R: Any, p: Named) -> tuple[Any, ...]:
        """Return the arguments of `closure` and of what follows: u only if it is `passive`."""
        return (q, u, r, R, p) if self.passive else (q, r, R, p)

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return poses [(r, R)] near the solutions of the direct problem; by default, home.

        The poses are exact if the thesis or the paper has a closed-form solution. Otherwise they
        are starting points of Newton's method. Their order is the same for all readings: the k-th
        one is always on the same branch, as both roots of a quadratic equation are. Mechanisms
        without such an order override `start`.
        """
        return [(ca.DM(self.home.position), ca.DM(quaternion_to_matrix(self.home.quaternion)))]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Return joint values near the solutions of the inverse problem, in an order as that of
        `candidates`; by default, home."""
        return [(joint,) for joint in self.home.joints]

    def start(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Return the candidate pose on the branch of home."""
        at_home = self.candidates(ca.DM(self.home.joints), self._nominal)
        k = _index_of_least([self._distance_from_home(pose) for pose in at_home])
        found = self.candidates(q, p)
        return self.nearest_home_pose(found) if k is None else found[k]

    def nearest_home_pose(self, candidates: list[tuple[Any, Any]]) -> tuple[Any, Any]:
        """Return the candidate pose nearest to home: the branch of home only near home."""
        return nearest(candidates, self._distance_from_home)

    def start_inverse(self, r: Any, R: Any, p: Named) -> Any:
        """Return the candidate on the branch of home for each joint."""
        return self.select_home_branch(self.joint_candidates(r, R, p))

    def select_home_branch(self, candidates: list[tuple[Any, ...]]) -> Any:
        """Return for each joint the candidate on the branch of home, within half a turn of home;
        `candidates` are in the order of `joint_candidates`."""
        r, R = ca.DM(self.home.position), ca.DM(quaternion_to_matrix(self.home.quaternion))
        there = self.wrap_to_home(self.joint_candidates(r, R, self._nominal))
        chosen = []
        for joint, at_home, home in zip(
            self.wrap_to_home(candidates), there, self.home.joints, strict=True
        ):
            distance = partial(lambda h, q: ca.fabs(q - h), home)
            k = _index_of_least([distance(q) for q in at_home])
            chosen.append(nearest(joint, distance) if k is None else joint[k])
        return ca.vertcat(*chosen)

    @property
    def _nominal(self) -> Named:
        return Named(self.parameters.names, ca.DM(self.parameters.nominal))

    def _distance_from_home(self, pose: tuple[Any, Any]) -> Any:
        position, rotation = Mechanism.candidates(self, None, self._nominal)[0]
        turned = ca.sumsqr(pose[1] - rotation) / 2  # the squared angle, if it is small
        return ca.sumsqr(pose[0] - position) + self.length**2 * turned

    def wrap_to_home(self, candidates: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
        """Return each joint's values with angles moved to within half a turn of home."""
        if not self.periodic:
            return candidates
        turn, wrapped = 2 * ca.pi, list[tuple[Any, ...]]()
        for joint, period, home in zip(
            candidates, self.joint_periods, self.home.joints, strict=True
        ):
            wrapped.append(
                tuple(q - turn * ca.floor((q - home) / turn + 0.5) for q in joint)
                if period
                else joint
            )
        return wrapped

    def rod_lengths(self, p: Named) -> list[Any]:
        """Return the length (m) of every passive rod; a length that a pair shares occurs twice."""
        return []

    def struts(self, r: Any, R: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return foot and head in {B}, (3, 1) m each, of the strut whose length is the reading of
        each joint; empty if the joints are no struts between base and platform."""
        return []

    def centres(self, *args: Any, **kwargs: Any) -> Mapping[str, list[Any]]:
        """Return centres of mass in {B}, (3, 1) m each, of the links of each kind in `parts`, at
        (q, r, R, p), or (q, u, r, R, p) of a mechanism with passive coordinates."""
        return {}

    def spans(self, q: Any, p: Named) -> list[tuple[float, Any, Any]]:
        """Return the nominal length (m) and both ends in {B}, (3, 1) m each, of every link of a
        chain whose joints alone carry it, from base to platform; empty for other mechanisms."""
        return []

    def drawing(self, *args: Any, **kwargs: Any) -> list[Line]:
        """Return the lines that draw the mechanism at (q, r, R, p), or (q, u, r, R, p) of one
        with passive coordinates; their points are CasADi columns."""
        return []

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Return the larger model of which this one is a special case, and its parameter values."""
        raise ModelError(f"{self.name} is not a special case of a larger model")

    @property
    def joint_ranges(self) -> np.ndarray:
        """Range of each joint (nq,), rad or m; 2 pi if its limits are unknown."""
        low, high = np.array(self.joint_limits, dtype=float).reshape(-1, 2).T
        return np.where(np.isfinite(high - low), high - low, 2 * np.pi)

    @property
    def name(self) -> str:
        """The name in model files: the file's name, or the Python path of a user's file."""
        module = type(self).__module__
        return module.removeprefix("parallel_cal.mechanisms.")

    @property
    def winds(self) -> tuple[float, ...]:
        """Line (m) that a radian of each joint lets out; empty if no joint winds a line."""
        return ()

    def spool(self, joint: int, p: Named) -> Spool | None:
        """Return the spool that moves a joint, by its number; None if no spool does."""
        drive = self.drives[joint] if self.drives else None
        return drive.spool if drive else None

    @property
    def expanding_bodies(self) -> tuple[str, ...]:
        """Names of `bodies`, and `scales` if the readings of joints are lengths."""
        scales = [SCALES] if "m" in self.joint_units else []
        return tuple(dict.fromkeys([*self.bodies, *scales]))

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each joint, rad or m; a mechanism with both overrides this."""
        return (self.joint_unit,) * len(self.joints)

    @property
    def passive_units(self) -> tuple[str, ...]:
        """Unit of each passive coordinate, rad or m; a mechanism with lengths overrides this."""
        return ("rad",) * len(self.passive)

    @property
    def moved(self) -> list[int]:
        """Indices of the moved coordinates in x y z rx ry rz."""
        return _places(self.moves)

    @property
    def controlled(self) -> list[int]:
        """Indices of the controlled coordinates in x y z rx ry rz."""
        return _places(self.controls)

    @property
    def passive_columns(self) -> list[int]:
        """Columns of the passive coordinates in derivatives by (q, r, w, u)."""
        n = len(self.joints) + len(POSE)
        return list(range(n, n + len(self.passive)))

    @property
    def dependent_columns(self) -> list[int]:
        """Columns of what follows from the joints, in derivatives by (q, r, w, u): the moved
        coordinates of the pose, then the passive coordinates."""
        n = len(self.joints)
        return [*(n + i for i in self.moved), *self.passive_columns]

    @property
    def parasitic(self) -> list[int]:
        """Moved coordinates that are not controlled (the Delta's orientation)."""
        return [i for i in self.moved if i not in self.controlled]

    @property
    def joint_periods(self) -> np.ndarray:
        """Period of each joint (nq,): 2 pi if a full turn changes nothing, else 0."""
        return 2 * np.pi * np.array([self.periodic and unit == "rad" for unit in self.joint_units])

    def poses(self, controlled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, 3) and rotations (n, 3, 3) for controlled coordinates.

        `controlled` has the shape (n, n_controlled). The other coordinates are those of home.
        """
        rows = np.tile([*self.home.position, *self.home.rotation_vector], (len(controlled), 1))
        rows[:, self.controlled] = controlled
        return rows[:, :3], rotation_matrix(rows[:, 3:])

    def controlled_coordinates(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return the controlled coordinates (n, n_controlled) of poses, as in `workspace`.

        position (n, 3) in m, rotation (n, 3, 3). Of the two rotation vectors of a rotation (of w
        and of w minus a full turn), the one nearer to the middle of the workspace is returned:
        near half a turn, neighbouring poses would otherwise be far from each other.
        """
        middle = np.array([*self.home.position, *self.home.rotation_vector])
        middle[self.controlled] = np.add(self.workspace.low, self.workspace.high) / 2
        w = rotation_vector(rotation)
        angle = np.linalg.norm(w, axis=1, keepdims=True)
        other = w * (1 - 2 * np.pi / np.where(angle > 0, angle, 2 * np.pi))
        away, other_away = (np.linalg.norm(v - middle[3:], axis=1) for v in (w, other))
        w = np.where((other_away < away)[:, None], other, w)
        return np.asarray(np.hstack([position, w])[:, self.controlled])

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw controlled coordinates (n, n_controlled) uniformly from the workspace."""
        low, high = np.array(self.workspace.low), np.array(self.workspace.high)
        return rng.uniform(low, high, size=(n, len(self.controls)))


def _places(coordinates: Sequence[str]) -> list[int]:
    if unknown := [c for c in coordinates if c not in POSE]:
        raise ModelError(f"coordinates {unknown}, expected some of {' '.join(POSE)}")
    return [POSE.index(c) for c in coordinates]


def list_shown_displacements(moves: Sequence[str]) -> tuple[str, ...]:
    """Return the coordinates x y z rx ry rz of a small displacement of the frame {B}, or of a frame
    in which the poses are measured, that changes one of the coordinates in which a robot `moves`.

    A robot that moves in x and y shows x, y and rz. No pose of it shows the other three.
    """

    def is_shown(coordinate: str) -> bool:
        axis = coordinate[-1]
        others = [other for other in "xyz" if other != axis]
        # A turn about an axis exchanges motions along (or about) the two other axes.
        pairs = [[coordinate], others, [f"r{other}" for other in others]]
        return any(
            set(pair) <= set(moves) for pair in (pairs if coordinate[0] == "r" else pairs[:1])
        )

    return tuple(c for c in POSE if is_shown(c))


def _index_of_least(expressions: Sequence[Any]) -> int | None:
    """Return the index of the smallest number; None if all are NaN. They have no symbols."""
    numbers = np.array([float(ca.evalf(ca.SX(expression))) for expression in expressions])
    return None if np.isnan(numbers).all() else int(np.nanargmin(numbers))


def nearest(candidates: Sequence[Any], distance: Callable[[Any], Any]) -> Any:
    """Return the candidate of least distance, chosen when the expression is evaluated.

    A candidate whose distance is NaN is never chosen over another one.
    """
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
    """Draw positions (n, 3) and rotations (n, 3, 3) from the workspace."""
    return mechanism.poses(mechanism.sample(n, rng))
