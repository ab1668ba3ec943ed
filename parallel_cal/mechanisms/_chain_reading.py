"""The options of the mechanism `chain`: joints, loops and where the platform is, checked."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import cos, inf, isfinite, sin
from numbers import Real
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError, format_suggestion
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.model.mechanism import POSE

# Unit of each coordinate of a joint, in order.
COORDINATES: Mapping[str, tuple[str, ...]] = {
    "revolute": ("rad",),
    "prismatic": ("m",),
    "universal": ("rad", "rad"),
    "spherical": ("rad", "rad", "rad"),
    "cylindrical": ("rad", "m"),
    "planar": ("m", "m", "rad"),
    "fixed": (),
}
LOOPS = ("point", "axis", "pose", "distance")
DRIVABLE = ("revolute", "prismatic")
POSE_KEYS = {"origin", "quaternion", "rpy"}
JOINT_KEYS = POSE_KEYS | {
    "name",
    "type",
    "parent",
    "child",
    "anchor",
    "axis",
    "axes",
    "driven",
    "home",
    "limits",
    "zero",
}
LOOP_KEYS = {"name", "type", "a", "b", "length", "driven", "home", "limits"}
END_KEYS = {"body", "point", "axis", "quaternion", "rpy"}


@dataclass(frozen=True)
class Frame:
    """A frame: position (3,) m and rotation (3, 3) in another frame."""

    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Joint:
    """A joint between two bodies; see `Chain` for the meaning of each part."""

    name: str
    type: str
    parent: str
    child: str
    origin: Frame
    anchor: np.ndarray
    axes: tuple[np.ndarray, ...]
    driven: bool
    home: tuple[float, ...]
    limits: tuple[float, float]
    zero: float

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each of its coordinates."""
        return COORDINATES[self.type]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of its coordinates: its own, or NAME.1, NAME.2 ... of several."""
        n = len(self.units)
        return (self.name,) if n == 1 else tuple(f"{self.name}.{i + 1}" for i in range(n))


@dataclass(frozen=True)
class End:
    """One end of a loop: a body, a point (3,) m in its frame, and there an axis or a rotation."""

    body: str
    point: np.ndarray
    axis: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Loop:
    """A condition that closes a loop between two bodies; see `Chain`."""

    name: str
    type: str
    a: End
    b: End
    length: float | None = None
    driven: bool = False
    home: float = 0.0
    limits: tuple[float, float] = (-inf, inf)


class Entry:
    """A mapping of the options, read key by key; errors name the entry, the key and the value."""

    def __init__(self, where: str, given: Any, keys: Collection[str]):
        if not isinstance(given, Mapping):
            raise ModelError(f"{where}: found {given!r}, expected a mapping with {_list(keys)}")
        self.given, self.where = given, where
        if isinstance(given.get("name"), str):
            self.where = f"{where} '{given['name']}'"
        for key in given:
            if key not in keys:
                raise ModelError(
                    f"{self.where}: unknown key '{key}'{format_suggestion(str(key), list(keys))}; "
                    f"expected some of {_list(keys)}"
                )

    def error(self, key: str, expected: str) -> ModelError:
        """Make the error of a key."""
        found = f"is {self.given[key]!r}" if key in self.given else "is missing"
        return ModelError(f"{self.where}: {key} {found}, expected {expected}")

    def text(self, key: str, choices: Sequence[str] = ()) -> str:
        """Return a name, of a list if there is one."""
        value = self.given.get(key)
        expected = f"one of {', '.join(choices)}" if choices else "a name"
        if not isinstance(value, str) or not value or (choices and value not in choices):
            raise self.error(key, expected)
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        value = self.given.get(key, default)
        if not _is_number(value):
            raise self.error(key, "a number")
        return float(value)

    def flag(self, key: str) -> bool:
        """Return true or false; false if it is not given."""
        value = self.given.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, "true or false")
        return value

    def vector(self, key: str, default: Sequence[float] | None = None, size: int = 3) -> np.ndarray:
        """Return some numbers."""
        value = self.given.get(key, default)
        if not is_numbers(value, size):
            raise self.error(key, f"{size} numbers")
        return np.array(value, dtype=float)

    def direction(self, key: str, value: Any = None) -> np.ndarray:
        """Return a unit vector."""
        value = self.given.get(key) if value is None else value
        if not is_numbers(value, 3) or not np.linalg.norm(value) > 1e-9:
            raise self.error(key, "a direction of 3 numbers, not all of them zero")
        return np.array(value, dtype=float) / np.linalg.norm(value)

    def rotation(self, quaternion: str = "quaternion", rpy: str = "rpy") -> np.ndarray:
        """Return the rotation (3, 3) of a quaternion x y z w, or of roll, pitch and yaw."""
        if quaternion in self.given and rpy in self.given:
            raise ModelError(
                f"{self.where}: {quaternion} and {rpy} are given, expected one of both"
            )
        if rpy in self.given:
            return rotation_from_rpy(self.vector(rpy))
        value = self.vector(quaternion, (0.0, 0.0, 0.0, 1.0), 4)
        if not np.linalg.norm(value) > 1e-9:
            raise self.error(quaternion, "a rotation x y z w")
        return quaternion_to_matrix(value)

    def limits(self) -> tuple[float, float]:
        """Return the lower and the upper limit; infinite if they are not given."""
        if "limits" not in self.given:
            return -inf, inf
        low, high = self.vector("limits", size=2)
        if not low < high:
            raise self.error("limits", "the lower limit first")
        return float(low), float(high)


def read_joints(given: Any) -> tuple[Joint, ...]:
    """Read the option `joints`."""
    joints = tuple(
        read_joint(f"joints[{i}]", entry) for i, entry in enumerate(_entries("joints", given))
    )
    _require_unique("joints", [joint.name for joint in joints])
    return joints


def read_loops(given: Any) -> tuple[Loop, ...]:
    """Read the option `loops`."""
    loops = tuple(
        read_loop(f"loops[{i}]", entry) for i, entry in enumerate(_entries("loops", given))
    )
    _require_unique("loops", [loop.name for loop in loops])
    return loops


def read_joint(where: str, given: Any) -> Joint:
    """Read one joint."""
    entry = Entry(where, given, JOINT_KEYS)
    kind = entry.text("type", tuple(COORDINATES))
    n = len(COORDINATES[kind])
    driven = entry.flag("driven")
    if driven and kind not in DRIVABLE:
        raise entry.error(
            "driven",
            f"false for a {kind} joint: a reading is the value of a revolute or prismatic joint "
            "(split the joint into such joints, with a body between them)",
        )
    if "zero" in entry.given and not driven:
        raise entry.error("zero", "no encoder zero of a joint without reading")
    home = entry.given.get("home", 0.0 if n == 1 else [0.0] * n)
    home = [home] if n == 1 and _is_number(home) else home
    if not is_numbers(home, n):
        raise entry.error("home", f"{n} numbers, one for each coordinate")
    name = _plain(entry, "name")
    parent, child = entry.text("parent"), entry.text("child")
    if parent == child:
        raise entry.error("child", "another body than the parent")
    return Joint(
        name,
        kind,
        parent,
        child,
        Frame(entry.vector("origin", (0.0, 0.0, 0.0)), entry.rotation()),
        entry.vector("anchor", (0.0, 0.0, 0.0)),
        read_axes(entry, kind),
        driven,
        tuple(float(v) for v in home),
        entry.limits(),
        entry.number("zero", 0.0),
    )


def read_axes(entry: Entry, kind: str) -> tuple[np.ndarray, ...]:
    """Return the axes of a joint: one, two of a universal joint, or none."""
    if kind == "universal":
        axes = entry.given.get("axes")
        if not isinstance(axes, Sequence) or len(axes) != 2:
            raise entry.error("axes", "two directions, such as [[1, 0, 0], [0, 1, 0]]")
        first, second = (entry.direction("axes", axis) for axis in axes)
        if np.linalg.norm(np.cross(first, second)) < 1e-6:
            raise entry.error("axes", "two directions that are not parallel")
        return first, second
    if kind in ("spherical", "fixed"):
        return ()
    return (entry.direction("axis"),)


def read_loop(where: str, given: Any) -> Loop:
    """Read one loop."""
    entry = Entry(where, given, LOOP_KEYS)
    kind = entry.text("type", LOOPS)
    name = _plain(entry, "name")
    a, b = (read_end(entry, key, kind) for key in ("a", "b"))
    if a.body == b.body:
        raise entry.error("b", f"another body than that of a ({a.body})")
    driven = entry.flag("driven")
    for key in ("length", "driven", "home", "limits"):
        if key in entry.given and kind != "distance":
            raise entry.error(key, f"no such key of a loop of the type {kind}")
    length = entry.number("length") if "length" in entry.given else None
    if length is not None and not (length > 0 or (driven and length >= 0)):
        raise entry.error("length", "a length above 0 m")
    return Loop(name, kind, a, b, length, driven, entry.number("home", 0.0), entry.limits())


def read_end(entry: Entry, key: str, kind: str) -> End:
    """Read one end of a loop."""
    own = Entry(f"{entry.where}: {key}", entry.given.get(key), END_KEYS)
    axis = own.direction("axis") if kind == "axis" else np.zeros(3)
    return End(own.text("body"), own.vector("point", (0.0, 0.0, 0.0)), axis, own.rotation())


def _plain(entry: Entry, key: str) -> str:
    """Return a name that parameters can begin with."""
    name = entry.text(key)
    if any(character in name for character in ".*?[] \t\n"):
        raise entry.error(key, "a name without dots, blanks and the characters * ? [ ]")
    return name


def _entries(key: str, given: Any) -> Sequence[Any]:
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise ModelError(f"{key} is {given!r}, expected a list")
    return given


def _require_unique(key: str, names: Sequence[str]) -> None:
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise ModelError(f"{key}: the name '{twice[0]}' occurs twice, expected different names")


def rotation_from_rpy(angles: np.ndarray) -> np.ndarray:
    """Turn about the fixed axes x, y, z by roll, pitch and yaw, rad."""
    (a, b, c), (u, v, w) = ([f(angle) for angle in angles] for f in (sin, cos))
    return np.array(
        [
            [w * v, w * b * a - c * u, w * b * u + c * a],
            [c * v, c * b * a + w * u, c * b * u - w * a],
            [-b, v * a, v * u],
        ]
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def is_numbers(value: Any, n: int) -> bool:
    """Whether a value is a list of n finite numbers."""
    listed = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
    return listed and len(value) == n and all(_is_number(v) for v in value)


def _list(keys: Collection[str]) -> str:
    return ", ".join(sorted(keys))


def read_coordinates(key: str, given: Any) -> list[str]:
    """Return coordinates of the platform, in their usual order."""
    known = not isinstance(given, str) and isinstance(given, Sequence)
    if not known or not given or not set(given) <= set(POSE):
        raise ModelError(f"{key} is {given!r}, expected some of {', '.join(POSE)}")
    return [c for c in POSE if c in given]


@dataclass(frozen=True)
class Centre:
    """Where a mass is: at a point (3,) m in the frame of a body, or on a rod, at a distance (m)
    from one of its ends, a or b, towards the other."""

    owner: str
    point: np.ndarray
    end: str = ""
    distance: float = 0.0


def read_masses(
    given: Mapping[str, Any] | None, bodies: Collection[str], rods: Collection[str]
) -> tuple[dict[str, float], dict[str, Centre]]:
    """Return the mass and the centre of each part that has one.

    A part has the name of its body. That of a body `platform` is `platform_body`, because the mass
    `platform` acts at the origin of {P}. Parts of a rod have any other name.
    """
    entries = Entry("masses", given or {}, {*(given or {})})
    found, centres = dict[str, float](), dict[str, Centre]()
    for name, value in entries.given.items():
        on_rod = isinstance(value, Mapping) and "rod" in value
        if not on_rod and name not in bodies:
            raise ModelError(f"masses: unknown body {name!r}, expected some of {sorted(bodies)}")
        keys = {"mass", "rod", "end", "distance"} if on_rod else {"mass", "centre"}
        own = Entry(f"masses: {name}", value, keys)
        part = "platform_body" if name == "platform" else str(name)
        if part in found:
            raise ModelError(f"masses: rename the body {name!r}: there are two parts {part!r}")
        found[part] = own.number("mass")
        if on_rod:
            rod, end = own.text("rod", sorted(rods)), own.text("end", ("a", "b"))
            centres[part] = Centre(rod, np.zeros(3), end, own.number("distance", 0.0))
        else:
            centres[part] = Centre(str(name), own.vector("centre", (0.0, 0.0, 0.0)))
    return found, centres
