"""A linkage from an MJCF file (MuJoCo): bodies, joints, equality constraints and tendons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.importing.chain import motion_of
from parallel_cal.importing.linkage import (
    FIXED,
    Linkage,
    LinkageJoint,
    LinkageLoop,
    Place,
    locked,
)
from parallel_cal.importing.located_xml import Element, to_numbers
from parallel_cal.importing.mjcf_elements import Body, Document, read_document
from parallel_cal.importing.mjcf_masses import read_masses

Array = np.ndarray

WORLD = "world"
KINDS = {"hinge": "revolute", "slide": "prismatic", "ball": "spherical"}
QPOS = {"revolute": 1, "prismatic": 1, "spherical": 4}
NO_RELPOSE = "0 1 0 0 0 0 0"  # MuJoCo's default: as the bodies are in the file


def read_mjcf(path: Path) -> Linkage:
    """Return the linkage of a file and of those that it includes.

    DatasetError names the element that is not understood.
    """
    document = read_document(path)
    joints, qpos = list[LinkageJoint](), list[tuple[str, int]]()
    for body in document.bodies.values():
        if body.floats:
            qpos.append(("", 7))
        elif body.parent:
            own = joints_of_body(document, body)
            joints += own
            qpos += [(joint.name, QPOS[joint.kind]) for joint in own if joint.kind != FIXED]
    names = [joint.name for joint in joints if joint.kind != FIXED]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(f"{path}: two joints have the name '{twice[0]}'")
    frames = {name: Place(name, np.eye(4)) for name in document.bodies}
    for body in document.bodies.values():
        for element, _, frame in body.sites:
            frames.setdefault(element.get("name"), Place(body.name, frame))
    frames.pop("", None)
    joints, loops = _equalities(document, joints, frames)
    driven, rods, remarks = read_actuators(document, frames, {one.name for one in joints})
    joints, home_remarks = read_keyframe(document, joints, qpos)
    masses, mass_remarks = read_masses(document)
    floating = tuple(body.name for body in document.bodies.values() if body.floats)
    return Linkage(
        path,
        (*floating, WORLD) if len(floating) == 1 else (WORLD, *floating),
        tuple(joints),
        (*loops, *rods),
        frames,
        drawn_poses(document, joints),
        driven,
        read_gravity(document),
        masses,
        (*remarks, *home_remarks, *mass_remarks),
    )


def joints_of_body(document: Document, body: Body) -> list[LinkageJoint]:
    """Return the joints between a body and its parent, with a body between any two of them."""
    if not body.joints:
        where = body.element.where
        return [LinkageJoint(body.name, FIXED, body.parent, body.name, body.pose, where=where)]
    settings, found = document.settings, list[LinkageJoint]()
    n, parent, origin = len(body.joints), body.parent, body.pose
    for k, (element, values, frame) in enumerate(body.joints, start=1):
        kind = values.get("type", "hinge")
        if kind not in KINDS:
            expected = ", ".join(KINDS)
            raise DatasetError(f"{element.where}: type is '{kind}', expected {expected} or free")
        name = element.get("name") or f"{body.name}_joint{k if n > 1 else ''}"
        child = body.name if k == n else f"{body.name}/{k}"
        pos = to_numbers(element.where, "pos", values.get("pos", "0 0 0"), 3)
        axis = to_numbers(element.where, "axis", values.get("axis", "0 0 1"), 3)
        if not np.linalg.norm(axis) > 0:
            raise DatasetError(f"{element.where}: axis is '0 0 0', expected a direction")
        unit = 1.0 if kind == "slide" else settings.angle
        ref, spring = (
            unit * float(to_numbers(element.where, key, values.get(key, "0"), 1)[0])
            for key in ("ref", "springref")
        )
        springy = kind != "ball" and float(values.get("stiffness", "0").split()[0]) > 0
        found.append(
            LinkageJoint(
                name,
                KINDS[kind],
                parent,
                child,
                origin,
                frame[:3, :3] @ pos + frame[:3, 3],
                () if kind == "ball" else (frame[:3, :3] @ axis / np.linalg.norm(axis),),
                _range(document, element, values, unit),
                zero=0.0 if kind == "ball" else -ref,
                rest=spring - ref if springy else None,
                where=element.where,
            )
        )
        parent, origin = child, np.eye(4)
    return found


def _range(
    document: Document, element: Element, values: dict[str, str], unit: float
) -> tuple[float, float]:
    limited = values.get("limited", "auto")
    if "range" not in values or limited == "false":
        return -np.inf, np.inf
    if limited == "auto" and not document.settings.autolimits:
        return -np.inf, np.inf
    low, high = unit * to_numbers(element.where, "range", values["range"], 2)
    return float(low), float(high)


def _equalities(
    document: Document, joints: list[LinkageJoint], frames: dict[str, Place]
) -> tuple[list[LinkageJoint], list[LinkageLoop]]:
    """Return the loops, and the joints with those that are held or that follow another one."""
    loops = list[LinkageLoop]()
    for k, element in enumerate(document.section("equality"), start=1):
        values = document.with_defaults(element, "equality")
        name = values.get("name", f"{element.tag}{k}")
        if values.get("active") == "false":
            continue
        if element.tag in ("connect", "weld"):
            loops.append(read_loop(document, element, values, name, frames))
        elif element.tag == "joint":
            joints = couple_joints(element, values, joints)
        elif element.tag != "tendon":
            raise DatasetError(
                f"{element.where}: expected connect, weld, joint or tendon in <equality>"
            )
    return joints, loops


def read_loop(
    document: Document,
    element: Element,
    values: dict[str, str],
    name: str,
    frames: dict[str, Place],
) -> LinkageLoop:
    is_weld = element.tag == "weld"
    kind = "pose" if is_weld and float(values.get("torquescale", "1")) != 0 else "point"
    if "site1" in values:
        a, b = (_site(element, values.get(key, ""), frames) for key in ("site1", "site2"))
        return LinkageLoop(name, kind, a, b, where=element.where)
    one, other = values.get("body1", ""), values.get("body2", WORLD)
    for body in (one, other):
        if body not in document.bodies:
            raise DatasetError(f"{element.where}: there is no body '{body}'")
    relative = np.linalg.solve(body_pose(document, one), body_pose(document, other))
    if is_weld:
        x, y, z, w, i, j, k = to_numbers(
            element.where, "relpose", values.get("relpose", NO_RELPOSE), 7
        )
        if w or i or j or k:
            relative = np.eye(4)
            relative[:3, :3] = quaternion_to_matrix([i, j, k, w])
            relative[:3, 3] = x, y, z
        anchor = to_numbers(element.where, "anchor", values.get("anchor", "0 0 0"), 3)
        shift = motion_of("P", anchor, 1.0)  # the anchor of a weld is in the frame of body2
        ends = Place(one, relative @ shift), Place(other, shift)
        return LinkageLoop(name, kind, *ends, where=element.where, drawn=True)
    anchor = to_numbers(element.where, "anchor", values.get("anchor", ""), 3)
    point = motion_of("P", anchor, 1.0)  # that of a connect is in the frame of body1
    there = np.linalg.solve(relative, point)
    ends = Place(one, point), Place(other, there)
    return LinkageLoop(name, kind, *ends, where=element.where, drawn=True)


def body_pose(document: Document, name: str) -> Array:
    """Return the frame (4, 4) of a body in the world as the file draws it."""
    pose = np.eye(4)
    while name:
        body = document.bodies[name]
        pose, name = body.pose @ pose, body.parent
    return pose


def drawn_poses(document: Document, joints: list[LinkageJoint]) -> dict[str, Array]:
    """Return the poses of all bodies as the file draws them, those between two joints included."""
    poses = {name: body_pose(document, name) for name in document.bodies}
    for joint in joints:
        if joint.child not in poses:
            poses[joint.child] = poses[joint.parent] @ joint.origin
    return poses


def _site(element: Element, name: str, frames: dict[str, Place]) -> Place:
    if name not in frames:
        raise DatasetError(f"{element.where}: there is no site '{name}'")
    return frames[name]


def couple_joints(
    element: Element, values: dict[str, str], joints: list[LinkageJoint]
) -> list[LinkageJoint]:
    """Fix a joint that an equality holds, and mark one that follows another joint."""
    name, other = values.get("joint1", ""), values.get("joint2", "")
    if name not in {joint.name for joint in joints}:
        raise DatasetError(f"{element.where}: there is no joint '{name}'")
    first = float(values.get("polycoef", "0 1 0 0 0").split()[0])

    def change(joint: LinkageJoint) -> LinkageJoint:
        if joint.name != name:
            return joint
        if other:
            words = (
                f"joint '{name}' follows joint '{other}'; the mechanism `chain` has no joints that "
                "follow others. Choose --base and --platform so that it is not between them"
            )
            return replace(joint, refusal=words, where=element.where)
        return locked(replace(joint, rest=first))

    return [change(joint) for joint in joints]


def read_actuators(
    document: Document, frames: dict[str, Place], joints: set[str]
) -> tuple[tuple[str, ...], list[LinkageLoop], list[str]]:
    """Return the names of what is driven, the rods among the tendons, and remarks."""
    driven, remarks = list[str](), list[str]()
    for element in document.section("actuator"):
        values = document.with_defaults(element, element.tag)
        target = next((values[k] for k in ("joint", "jointinparent", "tendon") if k in values), "")
        driven.append(target)
    held = {
        values.get("tendon1", ""): float(values.get("polycoef", "0").split()[0])
        for element in document.section("equality")
        for values in (document.with_defaults(element, "equality"),)
        if element.tag == "tendon" and "tendon2" not in values and values.get("active") != "false"
    }
    rods = list[LinkageLoop]()
    for element in document.section("tendon"):
        values, name = document.with_defaults(element, "tendon"), element.get("name")
        low, high = _range(document, element, values, 1.0)
        if element.tag == "spatial" and (name in held or name in driven or low == high):
            sites = element.all("site")
            refusal = ""
            if len(sites) != 2 or len(element.children) != 2:
                refusal = "a rod or a linear actuator is a tendon between two sites; it has others"
                sites = [*sites, *sites, element, element][:2]
            a, b = (_site(one, one.get("site"), frames) for one in sites)
            poses = [body_pose(document, end.body) @ end.frame for end in (a, b)]
            length = float(np.linalg.norm(poses[0][:3, 3] - poses[1][:3, 3])) + held.get(name, 0.0)
            if name in driven:  # the reading is the whole length
                length = 0.0
            elif low == high:
                length = low
            rods.append(
                LinkageLoop(name, "distance", a, b, length, (low, high), element.where, refusal)
            )
        elif element.tag == "fixed" and name in driven:
            names = ", ".join(one.get("joint") for one in element.children)
            remarks.append(
                f"an actuator drives the tendon '{name}' of the joints {names}: state the driven "
                "ones with --driven"
            )
        elif element.tag == "spatial":
            remarks.append(f"the tendon '{name}' is no rod of fixed length: it was not read")
    known = {*joints, *(rod.name for rod in rods)}
    return tuple(dict.fromkeys(name for name in driven if name in known)), rods, remarks


def read_keyframe(
    document: Document, joints: list[LinkageJoint], qpos: list[tuple[str, int]]
) -> tuple[list[LinkageJoint], list[str]]:
    """Return the joints with the values of the keyframe `home`, or of the only one."""
    keys = [one for one in document.section("keyframe") if one.get("qpos")]
    key = next((one for one in keys if one.get("name") == "home"), None)
    if key is None and len(keys) == 1:
        key = keys[0]
    if key is None:
        return joints, []
    found = to_numbers(key.where, "qpos", key.get("qpos"), sum(n for _, n in qpos))
    ends = np.cumsum([n for _, n in qpos])[:-1]
    values = {name: at for (name, _), at in zip(qpos, np.split(found, ends), strict=True)}

    def home(joint: LinkageJoint) -> LinkageJoint:
        if joint.kind == FIXED or joint.name not in values:
            return joint
        at = values[joint.name]
        if joint.kind == "spherical":
            w, x, y, z = at
            R = quaternion_to_matrix([x, y, z, w])
            angles = (
                np.arctan2(-R[1, 2], R[2, 2]),
                np.arcsin(np.clip(R[0, 2], -1, 1)),
                np.arctan2(-R[0, 1], R[0, 0]),
            )
            return replace(joint, home=tuple(float(angle) for angle in angles))
        return replace(joint, home=(float(at[0]) + joint.zero,))

    words = (
        f"home is the keyframe '{key.get('name')}'" if key.get("name") else "home is the keyframe"
    )
    return [home(joint) for joint in joints], [words]


def read_gravity(document: Document) -> Array:
    for element in document.root.all("option"):
        if "gravity" in element.attributes:
            return element.numbers("gravity", 3, "")
    return np.array([0.0, 0.0, -9.81])
