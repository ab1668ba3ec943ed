"""The bodies of a chain: how joints grow a tree from the base, and rows that close its loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import exponential, rot_x, rot_y, rot_z
from parallel_cal.mechanisms._chain_reading import End, Joint, Loop
from parallel_cal.model.parameters import Named, Parameter

Pose = tuple[Any, Any]  # position (3, 1) m and rotation (3, 3)
SHIFTS, TURNS = ("x", "y", "z"), ("rx", "ry", "rz")
BALLS = ("spherical", "universal")  # joints at which a rod may hang


@dataclass(frozen=True)
class Step:
    """A joint of the tree, passed from its parent to its child, or the other way."""

    joint: Joint
    forward: bool

    @property
    def reached(self) -> str:
        """The body that the joint reaches."""
        return self.joint.child if self.forward else self.joint.parent


@dataclass(frozen=True)
class Skeleton:
    """Bodies and loops of a chain: `steps` grow the tree from `base`, and from `platform` if no
    joint joins it to the base (`floats`); `cuts` are the joints that close a loop."""

    base: str
    platform: str
    steps: tuple[Step, ...]
    cuts: tuple[Joint, ...]
    loops: tuple[Loop, ...]
    floats: bool

    @classmethod
    def of(
        cls, base: str, platform: str, joints: Sequence[Joint], loops: Sequence[Loop]
    ) -> Skeleton:
        """Grow the tree; ModelError for a body that hangs on nothing."""
        joints, loops = replace_rods(joints, loops, {base, platform})
        known = {b for j in joints for b in (j.parent, j.child)}
        known |= {end.body for loop in loops for end in (loop.a, loop.b)}
        if base == platform:
            raise ModelError(f"platform is {platform!r}, the base; expected another body")
        for key, body in (("base", base), ("platform", platform)):
            if body not in known:
                raise ModelError(
                    f"{key} is {body!r}, expected a body of a joint or a loop: "
                    f"{', '.join(sorted(known)) or 'there are none'}"
                )
        steps = _grow(base, joints)
        floats = platform not in {base, *(step.reached for step in steps)}
        if floats:
            steps += _grow(platform, joints)
        reached = {base, platform, *(step.reached for step in steps)}
        if lost := sorted(known - reached):
            raise ModelError(
                f"no joint joins the body {lost[0]} to the base {base}, expected one (only the "
                "platform may hang on loops alone)"
            )
        used = [step.joint for step in steps]
        cuts = tuple(joint for joint in joints if joint not in used)
        loops += tuple(as_point(joint) for joint in cuts if joint.type == "spherical")
        cuts = tuple(joint for joint in cuts if joint.type != "spherical")
        return cls(base, platform, tuple(steps), cuts, tuple(loops), floats)

    @property
    def bodies(self) -> set[str]:
        """Names of all bodies."""
        return {self.base, self.platform, *(step.reached for step in self.steps)}

    @property
    def joints(self) -> list[Joint]:
        """Joints of the tree, then those that close a loop."""
        return [*(step.joint for step in self.steps), *self.cuts]

    @cached_property
    def driven(self) -> list[Joint | Loop]:
        """Joints, then rods, that have a reading."""
        parts: list[Joint | Loop] = [*self.joints, *self.loops]
        return [part for part in parts if part.driven]

    @cached_property
    def passive(self) -> list[tuple[str, str, float]]:
        """Name, unit and value at home of every passive coordinate."""
        return [
            coordinate
            for joint in self.joints
            if not joint.driven
            for coordinate in zip(joint.coordinates, joint.units, joint.home, strict=True)
        ]

    # ------------------------------------------------------------------ parameters

    def parameters(self, target: Parameters, tolerance: Mapping[str, float]) -> list[Parameter]:
        """Return all geometric parameters: zeros and lengths first, then points, places of joints,
        directions of joints, and the target."""
        zeros = [
            (f"{j.name}.zero", u, j.zero, "encoder zero")
            for j in self.joints
            if j.driven
            for u in j.units
        ]
        lengths = [
            (f"{k.name}.length", "m", k.length or 0.0, "length")
            for k in self.loops
            if k.type == "distance"
        ]
        points = [
            (f"{loop.name}.{side}_{axis}", "m", value, f"point on {end.body}")
            for loop in self.loops
            for side, end in (("a", loop.a), ("b", loop.b))
            for axis, value in zip(SHIFTS, end.point, strict=True)
        ]
        moving = [joint for joint in self.joints if joint.type != "fixed"]
        places = [
            (f"{joint.name}.{axis}", "m", value, "place of the joint")
            for joint in moving
            for axis, value in zip(SHIFTS, joint.origin.position, strict=True)
        ]
        turns = [
            (f"{joint.name}.{axis}", "rad", 0.0, "turn of the joint")
            for joint in moving
            for axis in TURNS
        ]
        rows = [*zeros, *lengths, *points, *places, *turns, *target]
        return [
            Parameter(name, unit, float(value), tolerance[unit], label=label)
            for name, unit, value, label in rows
        ]

    # ------------------------------------------------------------------ frames of the bodies

    def frames(self, values: Mapping[str, Any], p: Named, platform: Pose) -> dict[str, Pose]:
        """Compute the frame of every body in {B} from the values of all coordinates; `platform`
        is the frame of a platform that floats."""
        found: dict[str, Pose] = {self.base: (ca.DM.zeros(3), ca.DM.eye(3))}
        if self.floats:
            found[self.platform] = platform
        for step in self.steps:
            joint = step.joint
            moved = _transform(joint, values, p)
            if step.forward:
                found[joint.child] = multiply(found[joint.parent], moved)
            else:
                found[joint.parent] = multiply(found[joint.child], invert(moved))
        return found

    def rows(self, frames: Mapping[str, Pose], values: Mapping[str, Any], p: Named) -> list[Row]:
        """Return the rows that close all loops."""
        found = [row for loop in self.loops for row in close_loop(loop, frames, values, p)]
        for joint in self.cuts:
            reached = multiply(frames[joint.parent], _transform(joint, values, p))
            found += join_poses(joint.name, reached, frames[joint.child])
        return found

    def rod_ends(self, loop: Loop, frames: Mapping[str, Pose], p: Named) -> tuple[Any, Any]:
        """Compute both ends in {B} of a rod, (3, 1) m each."""
        a, b = (_point(loop.name, side, frames, p, end) for side, end in _sides(loop))
        return a, b


@dataclass(frozen=True)
class Row:
    """A row of the closure, in its unit, and the loop or joint that it belongs to."""

    owner: str
    unit: str
    value: Any


Parameters = Sequence[tuple[str, str, float, str]]


def replace_rods(
    joints: Sequence[Joint], loops: Sequence[Loop], kept: set[str]
) -> tuple[tuple[Joint, ...], tuple[Loop, ...]]:
    """Replace each body that hangs on two balls alone by a rod between them: one distance."""
    joints, loops = list(joints), list(loops)
    for body in dict.fromkeys(b for j in joints for b in (j.parent, j.child)):
        at_joints = [j for j in joints if body in (j.parent, j.child)]
        at_loops = [k for k in loops if body in (k.a.body, k.b.body)]
        balls = [j for j in at_joints if j.type in BALLS]
        points = [k for k in at_loops if k.type == "point"]
        free = [*points, *(j for j in balls if j.type == "spherical")]
        if body in kept or len(at_joints) + len(at_loops) != 2 or not free:
            continue
        if len(balls) + len(points) != 2:
            continue
        ends = [_ball_ends(body, joint) for joint in balls]
        ends += [(k.a, k.b) if k.a.body == body else (k.b, k.a) for k in points]
        (own, other), (own2, other2) = ends
        if other.body == other2.body:
            continue
        length = float(np.linalg.norm(own.point - own2.point))
        joints = [j for j in joints if j not in balls]
        at = min([loops.index(k) for k in points], default=len(loops))
        loops = [k for k in loops if k not in points]
        loops.insert(at, Loop(body.replace(".", "_"), "distance", other, other2, length))
    return tuple(joints), tuple(loops)


def _ball_ends(body: str, joint: Joint) -> tuple[End, End]:
    """Return the ball's point on this body, and on the other one."""
    at_child = _end(joint.child, joint.anchor)
    at_parent = _end(joint.parent, joint.origin.position + joint.origin.rotation @ joint.anchor)
    return (at_child, at_parent) if joint.child == body else (at_parent, at_child)


def _end(body: str, point: np.ndarray) -> End:
    return End(body, point, np.zeros(3), np.eye(3))


def as_point(joint: Joint) -> Loop:
    """Return a spherical joint that closes a loop as coinciding points: it needs no coordinates."""
    child, parent = _ball_ends(joint.child, joint)
    return Loop(joint.name, "point", parent, child)


def _grow(root: str, joints: Sequence[Joint]) -> list[Step]:
    """Pass every joint that reaches a new body, the nearest bodies first."""
    steps, reached, border = list[Step](), {root}, [root]
    while border:
        body = border.pop(0)
        for joint in joints:
            if body in (joint.parent, joint.child):
                step = Step(joint, joint.parent == body)
                if step.reached not in reached:
                    steps.append(step)
                    reached.add(step.reached)
                    border.append(step.reached)
    return steps


def with_lengths(skeleton: Skeleton, lengths: Mapping[str, float]) -> Skeleton:
    """Return the skeleton with lengths of rods that the options do not state."""
    loops = tuple(replace(k, length=lengths.get(k.name, k.length)) for k in skeleton.loops)
    return replace(skeleton, loops=loops)


# ---------------------------------------------------------------------- geometry


def multiply(one: Pose, other: Pose) -> Pose:
    """Compute the product of two poses."""
    return one[0] + one[1] @ other[0], one[1] @ other[1]


def invert(pose: Pose) -> Pose:
    """Compute the inverse of a pose."""
    return -(pose[1].T @ pose[0]), pose[1].T


def turn_about(axis: np.ndarray, angle: Any) -> Any:
    """Compute the rotation (3, 3) about a unit vector; simple about an axis of coordinates."""
    for k, turned in enumerate((rot_x, rot_y, rot_z)):
        if abs(axis[k]) == 1.0:
            return turned(float(axis[k]) * angle)
    S = ca.skew(ca.DM(axis))
    return ca.DM.eye(3) + ca.sin(angle) * S + (1 - ca.cos(angle)) * (S @ S)


def _transform(joint: Joint, values: Mapping[str, Any], p: Named) -> Pose:
    """Compute the frame of the child in that of the parent."""
    if joint.type == "fixed":
        return ca.DM(joint.origin.position), ca.DM(joint.origin.rotation)
    own = p[joint.name]
    rotation, anchor = ca.DM(joint.origin.rotation), ca.DM(joint.anchor)
    turned = rotation @ exponential(own.vector(*TURNS))
    shift, turn = compute_motion(joint, [values[name] for name in joint.coordinates])
    at = own.vector(*SHIFTS) + rotation @ anchor
    return at + turned @ (shift - turn @ anchor), turned @ turn


def compute_motion(joint: Joint, values: Sequence[Any]) -> Pose:
    """Compute shift and turn of a joint, in the frame of its child at value 0."""
    none, same = ca.DM.zeros(3), ca.DM.eye(3)
    if joint.type == "spherical":
        return none, rot_x(values[0]) @ rot_y(values[1]) @ rot_z(values[2])
    axis = joint.axes[0]
    if joint.type == "revolute":
        return none, turn_about(axis, values[0])
    if joint.type == "prismatic":
        return ca.DM(axis) * values[0], same
    if joint.type == "cylindrical":
        return ca.DM(axis) * values[1], turn_about(axis, values[0])
    if joint.type == "universal":
        return none, turn_about(axis, values[0]) @ turn_about(joint.axes[1], values[1])
    first, second = across(axis)
    return ca.DM(first) * values[0] + ca.DM(second) * values[1], turn_about(axis, values[2])


def across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that complete an axis to a right-handed frame: the first one is the
    axis x, y or z that is most across it, made perpendicular."""
    nearest = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = nearest - axis * (axis @ nearest)
    first = first / np.linalg.norm(first)
    return first, np.cross(axis, first)


def rotation_rows(R: Any, other: Any) -> list[Any]:
    """Compute the rotation from R to another one, in {B}, as 2 tan(angle / 2) times its axis: three
    rows (rad), zero where both are equal."""
    E = other @ R.T
    factor = 2 / (1 + ca.trace(E))
    return [
        factor * (E[2, 1] - E[1, 2]),
        factor * (E[0, 2] - E[2, 0]),
        factor * (E[1, 0] - E[0, 1]),
    ]


def _sides(loop: Loop) -> tuple[tuple[str, End], tuple[str, End]]:
    return ("a", loop.a), ("b", loop.b)


def _point(name: str, side: str, frames: Mapping[str, Pose], p: Named, end: End) -> Any:
    """Compute the point of one end of a loop in {B}."""
    position, rotation = frames[end.body]
    return position + rotation @ p[name].vector(*(f"{side}_{axis}" for axis in SHIFTS))


def join_poses(owner: str, one: Pose, other: Pose) -> list[Row]:
    """Return the six rows that let two frames coincide."""
    shifts = ca.vertsplit(ca.SX(other[0] - one[0]))
    turns = rotation_rows(ca.SX(one[1]), ca.SX(other[1]))
    return [*(Row(owner, "m", v) for v in shifts), *(Row(owner, "rad", v) for v in turns)]


def close_loop(
    loop: Loop, frames: Mapping[str, Pose], values: Mapping[str, Any], p: Named
) -> list[Row]:
    """Return the rows that close one loop: 1 of a rod, 3 of a point, 5 of an axis, 6 of a pose."""
    a, b = (_point(loop.name, side, frames, p, end) for side, end in _sides(loop))
    if loop.type == "distance":
        length, gap = p[loop.name].length, b - a
        if loop.driven:
            return [Row(loop.name, "m", ca.norm_2(gap) - (values[loop.name] + length))]
        return [Row(loop.name, "m", (ca.dot(gap, gap) - length**2) / (2 * length))]
    one, other = frames[loop.a.body][1], frames[loop.b.body][1]
    if loop.type == "pose":
        turned = one @ ca.DM(loop.a.rotation), other @ ca.DM(loop.b.rotation)
        return join_poses(loop.name, (a, turned[0]), (b, turned[1]))
    rows = [Row(loop.name, "m", v) for v in ca.vertsplit(ca.SX(b - a))]
    if loop.type == "axis":
        along = other @ ca.DM(loop.b.axis)
        rows += [
            Row(loop.name, "rad", ca.dot(one @ ca.DM(side), along)) for side in across(loop.a.axis)
        ]
    return rows
