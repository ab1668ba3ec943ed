"""A linkage from an SDF file (Gazebo): links, joints, which may close loops, and frames.

Source: sdformat.org, "Specification" and "Pose Frame Semantics".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.importing.chain import rotation_from_rpy
from parallel_cal.importing.linkage import Linkage, LinkageJoint, Place
from parallel_cal.importing.located_xml import Element, read_xml, to_numbers

Array = np.ndarray

WORLD, MODEL = "world", "__model__"
KINDS = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "ball": "spherical",
    "universal": "universal",
    "revolute2": "universal",
    "fixed": "fixed",
}
UNLIMITED = 1e16  # what SDF states for no limit
MODEL_AXES_UNTIL = (1, 4)  # up to this version, axes are in the frame of the model


@dataclass
class SdfModel:
    """The frames of a model: each with its element and the frame that its pose is relative to."""

    element: Element
    version: tuple[int, ...]
    frames: dict[str, tuple[Element, str]] = field(default_factory=dict)
    bodies: dict[str, str] = field(default_factory=dict)  # frame -> the link that carries it

    def pose(self, name: str, own: Callable[[Element], Array] | None = None) -> Array:
        """Return a frame (4, 4) in that of the model; `own` reads the pose of an element."""
        pose, passed = np.eye(4), list[str]()
        while name != MODEL:
            if name not in self.frames:
                known = ", ".join(sorted(self.frames))
                raise DatasetError(
                    f"{self.element.where}: there is no frame '{name}', expected one of {known}"
                )
            if name in passed:
                words = " is relative to ".join([*passed, name])
                raise DatasetError(f"{self.frames[name][0].where}: {words}")
            passed.append(name)
            element, name = self.frames[name]
            pose = (own or read_pose)(element) @ pose
        return pose

    @property
    def placement(self) -> str:
        """The frame that the pose of the model places in the world; empty for that of the model."""
        return self.element.get("placement_frame")

    @property
    def world(self) -> Array:
        """The frame (4, 4) of the model in the world."""
        placed = read_pose(self.element)
        return placed @ np.linalg.inv(self.pose(self.placement)) if self.placement else placed


def read_sdf(path: Path) -> Linkage:
    """Return the linkage of the model in a file; DatasetError names what is not understood."""
    model = read_model(path)
    world = model.world
    links = [one.get("name") for one in model.element.all("link")]
    poses = {WORLD: np.eye(4)} | {name: world @ model.pose(name) for name in links}
    joints = tuple(read_joint(model, one, poses) for one in model.element.all("joint"))
    frames = {name: Place(name, np.eye(4)) for name in poses}
    for name, body in model.bodies.items():
        frames.setdefault(name, Place(body, np.linalg.solve(poses[body], world @ model.pose(name))))
    held = {joint.child for joint in joints}
    free = [name for name in poses if name not in held and name != WORLD]
    fixed = WORLD in {end for joint in joints for end in (joint.parent, joint.child)}
    masses = {}
    for one in model.element.all("link"):
        inertial = one.find("inertial")
        mass = inertial.find("mass") if inertial else None
        if inertial and mass:
            value = to_numbers(mass.where, "mass", mass.text, 1)[0]
            masses[one.get("name")] = float(value), read_pose(inertial)[:3, 3]
    return Linkage(
        path,
        (WORLD, *free) if fixed else (*free, WORLD),
        joints,
        (),
        frames,
        poses,
        read_driven(model.element),
        masses=masses,
    )


def read_model(path: Path) -> SdfModel:
    """Return the model of a file that has joints; DatasetError if it has none or several."""
    root = read_xml(path, "SDF")
    if root.tag != "sdf":
        raise DatasetError(f"{path}: not an SDF: expected <sdf>, found <{root.tag}>")
    models = [one for one in root.walk() if one.tag == "model" and one.all("joint")]
    if len(models) != 1:
        names = ", ".join(one.get("name") for one in models) or "none"
        raise DatasetError(f"{path}: expected one <model> with joints, found {names}")
    (element,) = models
    for one in element.children:
        if one.tag in ("include", "model"):
            raise DatasetError(
                f"{one.where}: a model inside of a model: write the links into one model first "
                "(gz sdf -p prints the expanded file)"
            )
    try:
        version = tuple(int(part) for part in root.get("version", "1.9").split("."))
    except ValueError:
        raise DatasetError(f"{root.where}: version is '{root.get('version')}'") from None
    model = SdfModel(element, version)
    for one in element.all("link", "frame", "joint"):
        name, pose = one.required("name"), one.find("pose")
        base = {"joint": _child(one), "frame": one.get("attached_to") or MODEL}.get(one.tag, MODEL)
        stated = (pose.get("relative_to") or pose.get("frame")) if pose else ""
        if name in model.frames:
            raise DatasetError(f"{one.where}: another element has this name")
        model.frames[name] = one, stated or base
    for one in element.all("link"):
        model.bodies[one.get("name")] = one.get("name")
    for one in element.all("frame", "joint"):
        body = find_carrier(model, one)
        if body:
            model.bodies[one.get("name")] = body
    return model


def find_carrier(model: SdfModel, element: Element) -> str:
    """Return the link to which a frame or a joint is attached; empty if it is the model."""
    passed = set[str]()
    while element.tag != "link":
        name = _child(element) if element.tag == "joint" else element.get("attached_to")
        if not name or name in (MODEL, WORLD) or name in passed:
            return ""
        if name not in model.frames:
            raise DatasetError(f"{element.where}: there is no link or frame '{name}'")
        passed.add(name)
        element = model.frames[name][0]
    return element.get("name")


def read_pose(element: Element) -> Array:
    """Return the frame (4, 4) of the `<pose>` of an element; without one it is the identity."""
    T, part = np.eye(4), element.find("pose")
    if part is None or not part.text.strip():
        return T
    if part.get("rotation_format") == "quat_xyzw":
        values = to_numbers(part.where, f"pose of '{element.get('name')}'", part.text, 7)
        T[:3, :3] = quaternion_to_matrix(values[3:])
    else:
        values = to_numbers(part.where, f"pose of '{element.get('name')}'", part.text, 6)
        unit = DEGREE if part.get("degrees") == "true" else 1.0
        T[:3, :3] = rotation_from_rpy(unit * values[3:])
    T[:3, 3] = values[:3]
    return T


def _child(joint: Element) -> str:
    part = joint.find("child")
    return part.text.strip() if part else ""


def read_joint(model: SdfModel, element: Element, poses: dict[str, Array]) -> LinkageJoint:
    name, kind = element.required("name"), element.get("type")
    ends = []
    for tag in ("parent", "child"):
        part = element.find(tag)
        end = part.text.strip() if part else ""
        body = end if end in poses else model.bodies.get(end, "")
        if body not in poses:
            raise DatasetError(f"{element.where}: {tag} is '{end}', expected a link or a frame")
        ends.append(body)
    parent, child = ends
    world = poses[child] @ np.linalg.inv(model.pose(child)) if child != WORLD else np.eye(4)
    frame = np.linalg.solve(poses[child], world @ model.pose(name))  # of the joint in its child
    axes, limits, refusal = list[Array](), (-np.inf, np.inf), ""
    for part in element.all("axis", "axis2"):
        axes.append(read_axis(model, part, frame, child))
        if part.find("mimic"):
            refusal = (
                f"joint '{name}' follows another joint (<mimic>); the mechanism `chain` has no "
                "joints that follow others. Choose --base and --platform so that it is not between "
                "them"
            )
    n = {"universal": 2, "spherical": 0, "fixed": 0}.get(KINDS.get(kind, ""), 1)
    if kind not in KINDS:
        refusal = f"type is '{kind}', expected one of {', '.join(KINDS)}"
    elif len(axes) < n:
        raise DatasetError(f"{element.where}: found {len(axes)} axes, expected {n}")
    axis = element.find("axis")
    limit = axis.find("limit") if axis else None
    if limit and kind != "continuous":
        low, high = (
            float(to_numbers(part.where, tag, part.text, 1)[0]) if part else default
            for tag, default in (("lower", -np.inf), ("upper", np.inf))
            for part in (limit.find(tag),)
        )
        limits = (-np.inf if low <= -UNLIMITED else low, np.inf if high >= UNLIMITED else high)
    velocity = limit.find("velocity") if limit else None
    speed = float(to_numbers(velocity.where, "velocity", velocity.text, 1)[0]) if velocity else 0.0
    return LinkageJoint(
        name,
        KINDS.get(kind, kind),
        parent,
        child,
        np.linalg.solve(poses[parent], poses[child]),
        frame[:3, 3],
        tuple(axes[:n]),
        limits,
        speed if 0 < speed < UNLIMITED else np.inf,
        where=element.where,
        refusal=refusal,
    )


def read_axis(model: SdfModel, part: Element, joint_frame: Array, child: str) -> Array:
    """Return the direction of an axis in the frame of the child link."""
    xyz = part.find("xyz")
    values = to_numbers(part.where, "xyz", xyz.text if xyz else "0 0 1", 3)
    if not np.linalg.norm(values) > 0:
        raise DatasetError(f"{part.where}: xyz is '0 0 0', expected a direction")
    direction = values / np.linalg.norm(values)
    frame = axis_frame(model, part)
    if not frame:
        return joint_frame[:3, :3] @ direction
    turned = np.eye(4) if child == WORLD else model.pose(child)
    return turned[:3, :3].T @ model.pose(frame)[:3, :3] @ direction


def axis_frame(model: SdfModel, part: Element) -> str:
    """Return the frame in which an axis is stated; empty for that of its joint."""
    xyz, flag = part.find("xyz"), part.find("use_parent_model_frame")
    if xyz and xyz.get("expressed_in"):
        return xyz.get("expressed_in")
    if flag:
        return MODEL if flag.text.strip() in ("1", "true") else ""
    return MODEL if model.version[:2] <= MODEL_AXES_UNTIL else ""


def read_driven(element: Element) -> tuple[str, ...]:
    """Return the joints that a controller's plugin names."""
    named = [
        part.text.strip()
        for plugin in element.all("plugin")
        if "controller" in (plugin.get("filename") + plugin.get("name")).lower()
        for part in plugin.children
        if part.tag == "joint_name"
    ]
    return tuple(dict.fromkeys(named))
