"""A closed linkage as a file of a simulator describes it: bodies, joints, loops and drives.

Readers of MJCF, SDF and URDF make a `Linkage`; `closed_chain` makes the mechanism `chain` of it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.chain import motion_of

Array = np.ndarray

FIXED = "fixed"
COORDINATES = {
    "revolute": 1,
    "prismatic": 1,
    "universal": 2,
    "spherical": 3,
    "cylindrical": 2,
    "planar": 3,
    FIXED: 0,
}
DRIVABLE = ("revolute", "prismatic")


@dataclass(frozen=True, eq=False)
class LinkageJoint:
    """A joint between two bodies: child in parent = origin * T(anchor) M(value) T(-anchor).

    `origin` (4, 4) is the child's frame in the parent's at value 0. `anchor` (m) and `axes` are in
    the child's frame. The value is the reading + `zero`. `refusal` says why a joint cannot be part
    of a chain.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    anchor: Array = field(default_factory=lambda: np.zeros(3))
    axes: tuple[Array, ...] = ()
    limits: tuple[float, float] = (-np.inf, np.inf)
    velocity: float = np.inf
    zero: float = 0.0
    home: tuple[float, ...] = ()  # values; empty = 0
    rest: float | None = None  # value at which its spring has no force; None without a spring
    where: str = ""
    refusal: str = ""
    parts: tuple[LinkageJoint, ...] = ()  # if several joints of the file act as this one


@dataclass(frozen=True, eq=False)
class Place:
    """A frame (4, 4) in that of a body."""

    body: str
    frame: Array


@dataclass(frozen=True, eq=False)
class Rod:
    """What a distance between two bodies stands for: the body of a rod with both points in its
    frame and the balls at them, or the slide between two balls, with the masses of its halves."""

    body: str
    points: tuple[Array, Array]
    balls: tuple[LinkageJoint | LinkageLoop, LinkageJoint | LinkageLoop]
    slide: LinkageJoint | None = None
    masses: tuple[tuple[str, float, str, float], ...] = ()  # see `masses_on_strut`


@dataclass(frozen=True, eq=False)
class LinkageLoop:
    """A condition between two bodies: point, pose, or distance."""

    name: str
    kind: str
    a: Place
    b: Place
    length: float | None = None
    limits: tuple[float, float] = (-np.inf, np.inf)
    where: str = ""
    refusal: str = ""
    rod: Rod | None = None
    drawn: bool = False  # the file has one end only: the other is where the bodies are drawn


@dataclass(frozen=True, eq=False)
class Linkage:
    """What a file describes. `frames` are the bodies and the frames on them, by their names.

    `driven` are the joints and rods that the file gives an actuator. `roots` are bodies that
    nothing holds: the world, and what floats.
    """

    path: Path
    roots: tuple[str, ...]
    joints: tuple[LinkageJoint, ...]
    loops: tuple[LinkageLoop, ...]
    frames: Mapping[str, Place]
    poses: Mapping[str, Array]  # of the bodies as the file draws them, (4, 4)
    driven: tuple[str, ...] = ()
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    masses: Mapping[str, tuple[float, Array]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def parts(self) -> list[LinkageJoint | LinkageLoop]:
        """Joints, then loops."""
        return [*self.joints, *self.loops]


def locate(linkage: Linkage, name: str, role: str) -> Place:
    """Return the body or frame of a name; DatasetError lists the names."""
    if name not in linkage.frames:
        known = ", ".join(sorted(linkage.frames))
        raise DatasetError(f"{linkage.path}: {role} '{name}' is not there, expected one of {known}")
    return linkage.frames[name]


def fuse(linkage: Linkage, base: str) -> Linkage:
    """Join the bodies that fixed joints and poses connect.

    A joined body has the name and the frame of the body that is nearest to the root, or at a pose
    that of the heavier one; that of the base has the name and the frame of `base`.
    """
    at = joined_bodies(linkage, base)

    def move(place: Place) -> Place:
        where = at[place.body]
        return Place(where.body, where.frame @ place.frame)

    joints = [
        replace(joint, **moved_joint(joint, at[joint.parent], at[joint.child]))
        for joint in linkage.joints
        if joint.kind != FIXED
    ]
    loops = tuple(
        replace(loop, a=move(loop.a), b=move(loop.b))
        for loop in linkage.loops
        if loop.kind != "pose"
    )
    masses: dict[str, tuple[float, Array]] = {}
    for name, (mass, centre) in linkage.masses.items():
        add_mass(masses, at[name].body, mass, (at[name].frame @ [*centre, 1.0])[:3])
    frames = {name: move(place) for name, place in linkage.frames.items()}
    poses = {
        place.body: linkage.poses[name] @ np.linalg.inv(place.frame)
        for name, place in at.items()
        if name in linkage.poses
    }
    return replace(
        linkage, joints=tuple(joints), loops=loops, frames=frames, poses=poses, masses=masses
    )


def with_locked(linkage: Linkage, names: Collection[str]) -> Linkage:
    """Return the linkage with passive joints that do not move: at rest of their spring, or home."""
    known = {joint.name: joint for joint in linkage.joints if joint.kind in DRIVABLE}
    if unknown := [name for name in names if name not in known]:
        raise DatasetError(
            f"{linkage.path}: --locked {unknown[0]} is neither a revolute nor a prismatic joint; "
            f"expected some of {', '.join(known)}"
        )
    return replace(
        linkage,
        joints=tuple(locked(joint) if joint.name in names else joint for joint in linkage.joints),
    )


def locked_value(joint: LinkageJoint) -> float:
    """Return the value (rad or m) that a joint keeps if it does not move.

    A spring that would rest beyond a limit of its joint presses the joint against it.
    """
    if joint.rest is None:
        return (joint.home or (0.0,))[0]
    low, high = (limit + joint.zero for limit in joint.limits)
    return float(min(max(joint.rest, low), high))


def locked(joint: LinkageJoint) -> LinkageJoint:
    """Return a joint that does not move: at rest of its spring, or home."""
    value = locked_value(joint)
    shift = motion_of("P", joint.anchor, 1.0)
    moved = motion_of("R" if joint.kind == "revolute" else "P", joint.axes[0], value)
    return replace(
        joint, kind=FIXED, origin=joint.origin @ shift @ moved @ np.linalg.inv(shift), refusal=""
    )


def add_mass(masses: dict[str, tuple[float, Array]], body: str, mass: float, point: Array) -> None:
    """Add a mass (kg) at a point (3,) m of a body to the mass and the centre of the body."""
    before, centre = masses.get(body, (0.0, np.zeros(3)))
    whole = before + mass
    masses[body] = whole, (before * centre + mass * point) / (whole or 1.0)


def joined_bodies(linkage: Linkage, base: str) -> dict[str, Place]:
    """Return for every body the joined body that it belongs to, and its frame there."""
    at = {name: Place(name, np.eye(4)) for name in list_bodies(linkage)}
    rigid = [(j.parent, j.child, j.origin) for j in linkage.joints if j.kind == FIXED]
    for loop in linkage.loops:
        if loop.kind == "pose":  # of a link and an empty frame, the link gives the name
            ends = sorted((loop.a, loop.b), key=lambda end: -linkage.masses.get(end.body, [0])[0])
            a, b = ends
            rigid.append((a.body, b.body, a.frame @ np.linalg.inv(b.frame)))
    for parent, child, frame in rigid:
        a, b = at[parent], at[child]
        into = a.frame @ frame @ np.linalg.inv(b.frame)
        joined = [name for name in at if at[name].body == b.body and a.body != b.body]
        for name in joined:
            at[name] = Place(a.body, into @ at[name].frame)
    own = linkage.frames[base]
    root = Place(at[own.body].body, at[own.body].frame @ own.frame)
    for name in [name for name in at if at[name].body == root.body]:
        at[name] = Place(base, np.linalg.solve(root.frame, at[name].frame))
    return at


def moved_joint(joint: LinkageJoint, a: Place, b: Place) -> dict[str, Any]:
    """Return what changes of a joint whose bodies are joined to others."""
    turn, shift = b.frame[:3, :3], b.frame[:3, 3]
    return {
        "parent": a.body,
        "child": b.body,
        "origin": a.frame @ joint.origin @ np.linalg.inv(b.frame),
        "anchor": turn @ joint.anchor + shift,
        "axes": tuple(turn @ axis for axis in joint.axes),
    }


def select(linkage: Linkage, base: str, platform: str) -> Linkage:
    """Return the joints and loops on the paths from one body to another.

    An edge of the graph of bodies is on such a path if an additional edge between both ends would
    close a cycle through it: if it is in the same biconnected component.
    """
    edges = [
        *[(joint.parent, joint.child) for joint in linkage.joints],
        *[(loop.a.body, loop.b.body) for loop in linkage.loops],
        (base, platform),
    ]
    among = next(block for block in biconnected_blocks(edges) if len(edges) - 1 in block)
    n = len(linkage.joints)
    if len(among) == 1:
        raise DatasetError(
            f"{linkage.path}: no joints lead from '{base}' to '{platform}'; choose other bodies "
            "with --base and --platform"
        )
    joints = tuple(joint for k, joint in enumerate(linkage.joints) if k in among)
    loops = tuple(loop for k, loop in enumerate(linkage.loops) if n + k in among)
    between = replace(linkage, joints=joints, loops=loops)
    for one in between.parts:
        if one.refusal:
            raise DatasetError(f"{one.where or linkage.path}: {one.refusal}")
    bodies = {
        *(end for joint in joints for end in (joint.parent, joint.child)),
        *(end.body for loop in loops for end in (loop.a, loop.b)),
    }
    masses = {name: mass for name, mass in linkage.masses.items() if name in bodies}
    return replace(between, masses=masses)


def plain_name(name: str) -> str:
    """Return a name with which parameters can begin: without dots, blanks and brackets."""
    return re.sub(r"[.*?\[\]\s]", "_", name)


def with_plain_names(linkage: Linkage) -> Linkage:
    """Return the linkage with names of joints and loops as parameters can have them."""
    return replace(
        linkage,
        joints=tuple(replace(joint, name=plain_name(joint.name)) for joint in linkage.joints),
        loops=tuple(replace(loop, name=plain_name(loop.name)) for loop in linkage.loops),
    )


def list_bodies(linkage: Linkage) -> list[str]:
    ends = [
        *linkage.roots,
        *(end for joint in linkage.joints for end in (joint.parent, joint.child)),
        *(end.body for loop in linkage.loops for end in (loop.a, loop.b)),
        *(place.body for place in linkage.frames.values()),
    ]
    return list(dict.fromkeys(ends))


def biconnected_blocks(edges: Sequence[tuple[str, str]]) -> list[set[int]]:
    """Return the biconnected components of a graph as sets of edge numbers (Hopcroft, Tarjan)."""
    near: dict[str, list[tuple[int, str]]] = {}
    for k, (a, b) in enumerate(edges):
        if a != b:
            near.setdefault(a, []).append((k, b))
            near.setdefault(b, []).append((k, a))
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    blocks, stack, used = list[set[int]](), list[int](), set[int]()

    def visit(node: str) -> None:
        order[node] = low[node] = len(order)
        for k, other in near[node]:
            if k in used:
                continue
            used.add(k)
            stack.append(k)
            if other in order:
                low[node] = min(low[node], order[other])
                continue
            visit(other)
            low[node] = min(low[node], low[other])
            if low[other] >= order[node]:
                block = set[int]()
                while k not in block:
                    block.add(stack.pop())
                blocks.append(block)

    for node in near:
        if node not in order:
            visit(node)
    return blocks
