"""Serial arm of any length, a chain of DH and Hayati links (section 3.2.2, table 3.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import matrix_to_quaternion, rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.mechanism import POSE, Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

UNITS = {"theta": "rad", "d": "m", "a": "m", "b": "m", "alpha": "rad", "beta": "rad"}
# Table 3.5: position of the next axis relative to this frame's z, and its kind -> parameters of
# the link. Two rows are ours: {B} on the first axis (Hayati's theta is undefined there), and {P}.
TOPOLOGY = {
    ("perpendicular", "R"): ("theta", "d", "a", "alpha"),  # DH
    ("parallel", "R"): ("theta", "a", "alpha", "beta"),  # H
    ("perpendicular", "P"): ("theta", "alpha"),
    ("parallel", "P"): ("alpha", "beta"),
    ("coincident", "R"): ("a", "b", "alpha", "beta"),
    ("frame", None): ("theta", "d", "a", "b", "alpha", "beta"),
}
KEYS = {*UNITS, "joint", "axes", "free", "low", "high", "name", "driven_by", "offset", "reading"}
EXAMPLE = "[{joint: R, axes: parallel, a: 0.3}, {joint: R, a: 0.2}]"
MAX_TURN = 0.2  # rad, of each component of the default workspace, to both sides of home
DEFAULT_LIMITS = {"R": (-170 * DEGREE, 170 * DEGREE), "P": (-0.5, 0.5)}
JOINT_UNITS = {"R": "rad", "P": "m"}
FACTOR_TOLERANCE = 1e-3  # of a factor of `driven_by`: a linkage or belt is that wrong at worst


@dataclass(frozen=True)
class Link:
    """One transformation of the chain; its joint turns about (R) or slides along (P) its z.

    `driven_by` has the factors of the readings that move the joint, by the name of their link:
    usually the link's own, times 1. `offset` (rad or m) is its position where they are zero.
    """

    name: str
    joint: str | None
    free: tuple[str, ...]
    nominal: Mapping[str, float]
    limits: tuple[float, float]
    driven_by: Mapping[str, float]
    offset: float = 0.0
    reading: str = ""

    @property
    def has_reading(self) -> bool:
        """Whether a reading of its own moves the joint."""
        return self.name in self.driven_by

    @property
    def length(self) -> float:
        """Nominal distance from its frame to the next (m), with a prismatic joint at zero."""
        return float(np.linalg.norm([self.nominal[key] for key in ("a", "b", "d")]))

    def position(self, readings: Mapping[str, Any], p: Named) -> Any:
        """Return the position of its joint, rad or m: the sum of the readings times their factors,
        and the offset; 0 without a joint."""
        factors = {
            name: factor if name == self.name else p[f"{self.name}.by_{name}"]
            for name, factor in self.driven_by.items()
        }
        return sum((factors[name] * readings[name] for name in factors), self.offset)

    def transform(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Compute rotation and translation of eq. 3.6: Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta).

        q is the position of its joint. b is a shift along y', zero in the thesis.
        """
        t = {
            key: p[f"{self.name}.{key}"] if key in self.free else self.nominal[key] for key in UNITS
        }
        turn = rot_z(t["theta"] + q if self.joint == "R" else t["theta"])
        rise = t["d"] + q if self.joint == "P" else t["d"]
        return turn @ rot_x(t["alpha"]) @ rot_y(t["beta"]), turn @ ca.vertcat(t["a"], t["b"], rise)


class Serial(Mechanism):
    """Serial arm; the model file lists its links.

    Options: `links` is needed. `parallel-cal new --from ROBOT.urdf` writes a
    model with it.

    - `links`: from the base to the flange. Each link has a `joint` (R, P or null), `axes` (the
      direction of the next axis relative to this one: parallel, perpendicular or coincident; not
      for the last link), the numbers theta, d, a, b, alpha, beta (m, rad), and the joint limits
      `low` and `high`. `free` lists which of theta, d, a, b, alpha and beta a fit identifies. Give
      it only if you want another selection than that of table 3.5 of Vischer (1996).
      `driven_by: {link2: -1, link3: 1}` states that readings of these links' joints move the joint,
      each times a factor, to which `offset` (rad or m) is added. A link that does not name itself
      has no reading. The factors are fixed by default.
    - `home`: readings of the joints at home. Default: zero.
    - `controls`: the coordinates of the platform that the arm controls. Default:
      the first of x, y, z, rx, ry and rz, as many as there are joints.
    - `length_tolerance`, `angle_tolerance`: 1 sigma of the geometry, m and rad.
    """

    moves = POSE
    closed_forms = ("direct",)

    def __init__(
        self,
        links: Sequence[Mapping[str, Any]],
        home: Sequence[float] | None = None,
        controls: Sequence[str] | None = None,
        length_tolerance: float = 0.5e-3,
        angle_tolerance: float = 0.5 * DEGREE,
    ):
        self.links = read_links(links)
        self.driven = [link for link in self.links if link.has_reading]
        self.joints = tuple(f"joint{i + 1}" for i in range(len(self.driven)))
        self.joint_limits = tuple(self._narrow_limits(k) for k in self.driven)
        tolerance = {"m": length_tolerance, "rad": angle_tolerance}
        geometry = [
            Parameter(f"{link.name}.{key}", unit, link.nominal[key], tolerance[unit])
            for link in self.links
            for key, unit in UNITS.items()
            if key in link.free
        ]
        units = {link.name: link.reading for link in self.driven}
        factors = [
            Parameter(
                f"{link.name}.by_{name}",
                "1" if own == units[name] else f"{own}/{units[name]}",
                factor,
                FACTOR_TOLERANCE * abs(factor),
                label="factor",
            )
            for link in self.links
            for own in (JOINT_UNITS.get(link.joint or "", ""),)
            for name, factor in link.driven_by.items()
            if name != link.name
        ]
        self.parameters = ParameterTable([*geometry, *factors])
        self.fixed = tuple(factor.name for factor in factors)
        self.bodies = {"links": [p.name for p in self.parameters if p.unit == "m"]}
        self.controls = tuple(controls) if controls else POSE[: len(self.driven)]
        at = tuple(np.zeros(len(self.joints)) if home is None else home)
        if len(at) != len(self.joints):
            raise ModelError(f"home has {len(at)} joints, the arm has {len(self.joints)}")
        position, rotation = self.pose(
            ca.DM(at), Named(self.parameters.names, ca.DM(self.parameters.nominal))
        )
        x, y, z = np.array(position).ravel().tolist()
        a, b, c, w = matrix_to_quaternion(np.array(rotation)).tolist()
        self.home = Home(tuple(float(q) for q in at), (x, y, z), (a, b, c, w))
        reach = max(sum(link.length for link in self.links), 0.1)
        self.length = 0.3 * reach
        # A tenth of the reach around home's position, MAX_TURN around its orientation
        centre = np.array([*self.home.position, *self.home.rotation_vector])[self.controlled]
        half = np.array([0.1 * reach] * 3 + [MAX_TURN] * 3)[self.controlled]
        self.workspace = Workspace(tuple((centre - half).tolist()), tuple((centre + half).tolist()))

    def complete_workspace(self, workspace: Workspace) -> Workspace:
        """Centre the orientations of the workspace on that of home.

        An older version centred them on the zero rotation, where the arm may not work.
        """
        low, high = np.array(workspace.low), np.array(workspace.high)
        turns = np.array(self.controlled) >= 3
        home = np.array([*self.home.position, *self.home.rotation_vector])[self.controlled]
        around_zero = bool(turns.any() and (low == -MAX_TURN)[turns].all())
        around_zero &= bool((high == MAX_TURN)[turns].all())
        if not around_zero or (np.abs(home) <= MAX_TURN)[turns].all():
            return workspace
        shift = np.where(turns, home, 0.0)
        return Workspace(tuple((low + shift).tolist()), tuple((high + shift).tolist()))

    @property
    def joint_units(self) -> tuple[str, ...]:
        return tuple(link.reading for link in self.driven)

    @property
    def joint_periods(self) -> np.ndarray:
        """Period of each joint (nq,): 0 if its full turn does not turn every joint fully."""
        periods = super().joint_periods
        for link in self.links:
            for name, factor in link.driven_by.items():
                if link.joint == "P" or factor != round(factor):
                    periods[[one.name for one in self.driven].index(name)] = 0.0
        return periods

    def _narrow_limits(self, driven: Link) -> tuple[float, float]:
        """Return the range of a link's reading that keeps the joints that it alone moves within
        their limits; its own if there is none."""
        low, high = driven.limits
        for link in self.links:
            if link is not driven and [*link.driven_by] == [driven.name]:
                factor = link.driven_by[driven.name]
                ends = sorted((end - link.offset) / factor for end in link.limits)
                low, high = max(low, ends[0]), min(high, ends[1])
        return (low, high) if low < high else driven.limits

    def positions(self, q: Any, p: Named) -> list[Any]:
        """Return the position (rad, m) of the joint of every link; 0 for a link without one."""
        readings = {link.name: q[i] for i, link in enumerate(self.driven)}
        return [link.position(readings, p) for link in self.links]

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Eq. 3.7 as a closure: position difference (m) and rotation difference (rad)."""
        position, rotation = self.pose(q, p)
        return ca.vertcat(r - position, rotation_difference(rotation, R))

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw every link from its frame to the next, and the axes of its joints."""
        lines, at, turned = [], ca.DM.zeros(3), ca.DM.eye(3)
        for link, position in zip(self.links, self.positions(q, p), strict=True):
            turn, shift = link.transform(position, p)
            if link.joint:
                lines.append(axis(at, turned[:, 2], 0.2 * self.length, f"{link.name}.alpha"))
            after, kind = at + turned @ shift, "driven" if link.joint else "base"
            lines.append(Line(kind, (at, after), (f"{link.name}.*",)))
            at, turned = after, turned @ turn
        return lines

    def pose(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Compute position and rotation of {P} in {B}: the product of the links (eq. 3.7)."""
        return self.frames(q, p)[-1]

    def frames(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Compute position and rotation in {B} of the frame of every link, and of {P}."""
        position, rotation = ca.DM.zeros(3), ca.DM.eye(3)
        frames = [(position, rotation)]
        for link, moved in zip(self.links, self.positions(q, p), strict=True):
            turn, shift = link.transform(moved, p)
            position, rotation = position + rotation @ shift, rotation @ turn
            frames.append((position, rotation))
        return frames

    def spans(self, q: Any, p: Named) -> list[tuple[float, Any, Any]]:
        """Return length and ends of every link: the origins of its frame and of the next."""
        origins = [position for position, _ in self.frames(q, p)]
        pairs = zip(self.links, origins[:-1], origins[1:], strict=True)
        return [(link.length, foot, head) for link, foot, head in pairs]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Evaluate the arm: this solves its direct problem."""
        return [self.pose(q, p)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Propose starts for Newton's method: home, then revolute joints turned away from it."""
        n = 4 if len(self.joints) <= 3 else 2
        turns = [i * 2 * np.pi / n for i in range(n)]
        choices = zip(self.driven, self.home.joints, strict=True)
        return [tuple(h + t for t in turns) if k.reading == "rad" else (h,) for k, h in choices]

    def start_inverse(self, r: Any, R: Any, p: Named) -> Any:
        """Return home: a general arm's inverse problem has no closed form."""
        return ca.DM(self.home.joints)


def rotation_difference(model: Any, R: Any) -> Any:
    """Compute the remaining rotation E = model^T R as 2 tan(angle / 2) times its axis (rad).

    The skew part of E alone is sin(angle); it would also vanish half a turn away.
    """
    E = model.T @ R
    return (
        2 / (1 + ca.trace(E)) * ca.vertcat(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1])
    )


def read_links(given: Sequence[Mapping[str, Any]]) -> tuple[Link, ...]:
    """Check the links of a model file and give them the parameters of table 3.5."""
    if not isinstance(given, list | tuple) or not all(isinstance(k, Mapping) for k in given):
        raise ModelError(f"links {given!r}, expected a list such as {EXAMPLE}")
    last = max((i for i, link in enumerate(given) if link.get("joint")), default=-1)
    if last < 0:
        raise ModelError("a serial arm needs at least one link with joint: R or P")
    names, driven = [], 0  # by default `base`, then `link1`.., and `platform` after the last joint
    for i, link in enumerate(given):
        driven += 1 if link.get("joint") else 0
        default = f"link{driven}" if link.get("joint") else ("platform" if i > last else "base")
        names.append(str(link.get("name", default)))
    following = [*(link.get("joint") for link in given[1:]), None]
    rows = zip(names, given, following, strict=True)
    links = tuple(_link(name, link, next_joint) for name, link, next_joint in rows)
    read = [link.name for link in links if link.has_reading]
    for link in links:
        if missing := [name for name in link.driven_by if name not in read]:
            raise ModelError(
                f"{link.name}: driven_by names {missing[0]}, expected links whose joints have "
                f"readings of their own: {', '.join(read) or 'none'}"
            )
    return links


def _link(name: str, given: Mapping[str, Any], next_joint: str | None) -> Link:
    if unknown := set(given) - KEYS:
        raise ModelError(f"{name}: unknown key {sorted(unknown)}; a link has {sorted(KEYS)}")
    joint = given.get("joint")
    if joint not in ("R", "P", None):
        raise ModelError(f"{name}: joint '{joint}', expected R, P or null")
    low, high = DEFAULT_LIMITS.get(joint or "", (0.0, 0.0))
    if joint is None and "offset" in given:
        raise ModelError(f"{name}: offset is {given['offset']!r}, expected none without a joint")
    driven_by = _read_drives(name, joint, given.get("driven_by"))
    if name not in driven_by:  # limits of its own only if they are stated
        low, high = -inf, inf
    numbers = {**dict.fromkeys(UNITS, 0.0), "low": low, "high": high, "offset": 0.0}
    numbers |= {key: _number(name, key, given[key]) for key in numbers.keys() & given.keys()}
    nominal = {key: numbers[key] for key in UNITS}
    if "free" in given:
        free = given["free"]
    else:
        axes = given.get("axes", "frame" if next_joint is None else None)
        if (axes, next_joint) not in TOPOLOGY:
            known = ", ".join(known for known, joint in TOPOLOGY if joint == next_joint)
            raise ModelError(f"{name}: axes is '{axes}' for a joint {next_joint}, expected {known}")
        free = TOPOLOGY[axes, next_joint]
    if not isinstance(free, list | tuple) or not set(free) <= set(UNITS):
        raise ModelError(f"{name}: free is {free!r}, expected a list of some of {list(UNITS)}")
    _check_regular(name, free, nominal)
    own = JOINT_UNITS.get(joint or "", "")
    reading = given.get("reading", own)
    if reading not in ((own, *JOINT_UNITS.values()) if name in driven_by else (own,)):
        raise ModelError(
            f"{name}: reading is {reading!r}, expected rad or m, at a link with its own reading"
        )
    limits = numbers["low"], numbers["high"]
    return Link(name, joint, tuple(free), nominal, limits, driven_by, numbers["offset"], reading)


def _read_drives(name: str, joint: str | None, given: Any) -> dict[str, float]:
    """Return the factors of the readings that move a link's joint: by default its own, times 1."""
    if given is None:
        return {name: 1.0} if joint else {}
    if joint is None or not isinstance(given, Mapping) or not given:
        raise ModelError(
            f"{name}: driven_by is {given!r}, expected names of links with factors, as in "
            "{link2: -1, link3: 1}, at a link with a joint"
        )
    drives = {str(other): _number(name, f"driven_by {other}", v) for other, v in given.items()}
    if zero := [other for other, factor in drives.items() if factor == 0]:
        raise ModelError(f"{name}: the factor of {zero[0]} in driven_by is 0, expected another one")
    return drives


def _number(name: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real) or not isfinite(value):
        unit = "" if key.startswith("driven_by") else f" in {UNITS.get(key, 'rad or m')}"
        raise ModelError(f"{name}: {key} is {value!r}, expected a number{unit}")
    return float(value)


def _check_regular(name: str, free: Sequence[str], nominal: Mapping[str, float]) -> None:
    """Refuse parameters that would jump at a small change of the geometry (section 3.2.2)."""
    polar = {"theta", "a", "beta"} <= set(free) and "b" not in free
    if polar and abs(nominal["a"]) < 1e-6:
        raise ModelError(
            f"{name}: Hayati's theta is undefined if both axes coincide (a = 0); use "
            "axes: coincident or other free parameters"
        )
    if {"d", "a"} <= set(free) and "b" not in free and abs(np.sin(nominal["alpha"])) < 0.1:
        raise ModelError(f"{name}: DH's d is undefined for parallel axes; use axes: parallel")
    if {"theta", "alpha", "beta"} <= set(free) and abs(np.cos(nominal["alpha"])) < 0.1:
        raise ModelError(f"{name}: theta and beta are the same rotation at alpha = 90 degrees")
