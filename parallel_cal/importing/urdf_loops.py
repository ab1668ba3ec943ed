"""A linkage from a URDF and what closes its loops.

The loops are in a file beside it (`closed_loop` in robot.yaml: Extended URDF, arXiv 2504.04767), or
in `<constraint>` elements (proposed in ros/urdfdom_headers#108).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from parallel_cal.base.errors import DatasetError, format_suggestion
from parallel_cal.base.files import read_text
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.importing.chain import rotation_from_rpy
from parallel_cal.importing.linkage import Linkage, LinkageJoint, LinkageLoop, Place
from parallel_cal.importing.located_xml import Element, read_xml

Array = np.ndarray

KINDS = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
    "planar": "planar",
    "floating": "",
    "spherical": "spherical",
    "ball": "spherical",
}
AXES = dict(zip("XYZ", np.eye(3), strict=True))
LOOP_KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
LOOP_TYPES = {"3d": "point", "6d": "pose"}
SPHERICAL = "spherical"
MIN_SIMILARITY = 0.9  # of a misspelt name, as difflib counts it
CONSTRAINTS = ("revolute", "prismatic", "universal", "spherical", "link")


def find_loops(path: Path) -> Path | None:
    """Return the file with the loops beside a URDF: of the same name, or robot.yaml."""
    for name in dict.fromkeys([f"{path.stem}.yaml", f"{path.stem}.yml", "robot.yaml", "robot.yml"]):
        beside = path.with_name(name)
        if beside.is_file() and "closed_loop" in read_text(beside, errors="replace"):
            return beside
    return None


def has_loops(path: Path) -> bool:
    """Return whether a URDF has loops, in a file beside it or in itself."""
    return find_loops(path) is not None or "<constraint" in read_text(path, errors="replace")


def read_urdf_loops(path: Path, loop_file: Path | None = None) -> Linkage:
    """Return the linkage of a URDF and of its loops; DatasetError names what is not understood.

    `loop_file` has the loops; without it, a file beside the URDF is looked for.
    """
    root = read_xml(path, "URDF")
    if root.tag != "robot" or not root.all("joint"):
        raise DatasetError(
            f"{path}: not a URDF: expected <robot> with <joint>s, found <{root.tag}>"
        )
    joints = {one.required("name"): read_joint(one) for one in root.all("joint")}
    links = dict.fromkeys(one.required("name") for one in root.all("link"))
    for joint in joints.values():
        links |= dict.fromkeys([joint.parent, joint.child])
    frames = {name: Place(name, np.eye(4)) for name in links}
    for joint in joints.values():  # the frame of a joint is that of its child
        frames.setdefault(joint.name, Place(joint.child, np.eye(4)))
    loops, driven, remarks = list[LinkageLoop](), read_transmissions(root), list[str]()
    if beside := loop_file or find_loops(path):
        stated, remarks = find_types(beside, read_loop_file(beside), joints)
        remarks += describe_unlisted(beside, stated, frames)
        joints = with_types(beside, stated, joints)
        loops += listed_loops(beside, stated, frames)
        driven = tuple(stated.get("name_mot") or driven)
    for one in root.all("constraint"):
        closing = read_constraint(one, frames)
        if isinstance(closing, LinkageJoint):
            joints[closing.name] = closing
        else:
            loops.append(closing)
    held = {joint.child for joint in joints.values() if joint.kind}
    tree = tuple(joint for joint in joints.values() if joint.kind)
    roots = tuple(name for name in links if name not in held)
    masses = {}
    for one in root.all("link"):
        inertial = one.find("inertial")
        mass = inertial.find("mass") if inertial else None
        if inertial and mass:
            value = float(mass.numbers("value", 1, "")[0])
            masses[one.get("name")] = value, read_origin(inertial.find("origin"))[:3, 3]
    return Linkage(
        path,
        roots,
        tree,
        tuple(loops),
        frames,
        drawn_poses(roots, tree),
        driven,
        masses=masses,
        remarks=tuple(remarks),
    )


def read_origin(element: Element | None) -> Array:
    """Return the frame (4, 4) of xyz and rpy; without the element, it is the identity."""
    T = np.eye(4)
    if element is not None:
        T[:3, 3] = element.numbers("xyz", 3, "0 0 0")
        T[:3, :3] = rotation_from_rpy(element.numbers("rpy", 3, "0 0 0"))
    return T


def drawn_poses(roots: tuple[str, ...], joints: tuple[LinkageJoint, ...]) -> dict[str, Array]:
    poses = {name: np.eye(4) for name in roots}
    n = -1
    while n < len(poses):
        n = len(poses)
        for joint in joints:
            if joint.parent in poses and joint.child not in poses:
                poses[joint.child] = poses[joint.parent] @ joint.origin
    return poses


def read_joint(element: Element) -> LinkageJoint:
    name, kind = element.required("name"), element.get("type")
    parent, child = _ends(element)
    axes = () if kind in ("fixed", "floating") else (_axis(element, element.find("axis")),)
    limit, limits, velocity = element.find("limit"), (-np.inf, np.inf), np.inf
    if limit is not None:
        low, high = (float(limit.numbers(key, 1, "0")[0]) for key in ("lower", "upper"))
        if low < high and kind != "continuous":  # 0 to 0 is what generators write for none
            limits = low, high
        velocity = float(limit.numbers("velocity", 1, "0")[0]) or np.inf
    refusal = ""
    if kind not in KINDS:
        refusal = f"type is '{kind}', expected one of {', '.join(KINDS)}"
    if mimic := element.find("mimic"):
        refusal = (
            f"joint '{name}' follows joint '{mimic.get('joint')}' (<mimic>); the mechanism `chain` "
            "has no joints that follow others. Choose --base and --platform so that it is not "
            "between them"
        )
    return LinkageJoint(
        name,
        KINDS.get(kind, kind),
        parent,
        child,
        read_origin(element.find("origin")),
        axes=axes,
        limits=limits,
        velocity=velocity,
        where=element.where,
        refusal=refusal,
    )


def _ends(element: Element) -> tuple[str, str]:
    ends = []
    for tag in ("parent", "child"):
        part = element.find(tag)
        if part is None or not part.get("link"):
            raise DatasetError(f"{element.where}: no {tag} link")
        ends.append(part.get("link"))
    return ends[0], ends[1]


def _axis(owner: Element, element: Element | None) -> Array:
    axis = np.array([1.0, 0.0, 0.0]) if element is None else element.numbers("xyz", 3, "1 0 0")
    if not np.linalg.norm(axis) > 0:
        raise DatasetError(f"{owner.where}: axis xyz is '0 0 0', expected a direction")
    return axis / np.linalg.norm(axis)


def read_transmissions(root: Element) -> tuple[str, ...]:
    """Return the joints of `<transmission>`, and those with a command of `<ros2_control>`."""
    named = [
        joint.get("name")
        for part in root.all("transmission", "ros2_control")
        for joint in part.all("joint")
        if part.tag == "transmission" or joint.find("command_interface")
    ]
    return tuple(dict.fromkeys(filter(None, named)))


# ------------------------------------------------------------------ the file beside it


def read_loop_file(path: Path) -> dict[str, Any]:
    try:
        stated = yaml.safe_load(read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DatasetError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    if not isinstance(stated, dict):
        raise DatasetError(f"{path}: expected keys such as closed_loop: [[frame_A, frame_B]]")
    for key in LOOP_KEYS:
        if not isinstance(stated.get(key) or [], list):
            raise DatasetError(f"{path}: {key} is {stated[key]!r}, expected a list")
    for one, other in (("type", "closed_loop"), ("joint_type", "joint_name")):
        n, m = (len(stated.get(key) or []) for key in (one, other))
        if n and n != m:
            raise DatasetError(f"{path}: {one} has {n} entries, expected {m}, as {other} has")
    return stated


def find_types(
    path: Path, stated: Mapping[str, Any], joints: Mapping[str, LinkageJoint]
) -> tuple[dict[str, Any], list[str]]:
    """Return the content of the file with names of joints that the URDF has, and remarks.

    A misspelt name is read as the one joint that is similar. A file without `joint_name` means what
    the tool that writes these files would add: hinges with `spherical` in their names are balls.
    """
    if "joint_name" not in stated:
        balls = [n for n, one in joints.items() if SPHERICAL in n and one.kind == "revolute"]
        remark = (
            f"{path}: no joint_name is stated, so hinges named {SPHERICAL} are read as ball "
            f"joints, as is usual in such files: {', '.join(balls)}. If they are hinges, state "
            "joint_name: []"
        )
        types = {"joint_name": balls, "joint_type": ["SPHERICAL"] * len(balls)}
        return {**stated, **types}, [remark] if balls else []
    names, kinds = (stated.get(key) or [] for key in ("joint_name", "joint_type"))
    free = [name for name in joints if name not in names]
    found, remarks = dict[str, str](), list[str]()
    for name, kind in zip(names, kinds, strict=True):
        meant = [name] if name in joints else get_close_matches(name, free, 2, MIN_SIMILARITY)
        if len(meant) == 1:
            found[meant[0]] = kind
        if meant != [name]:
            read = f"read as '{meant[0]}', the similar one" if len(meant) == 1 else "not read"
            remarks.append(f"{path}: the URDF has no joint '{name}' of joint_name: {read}")
    return {**stated, "joint_name": [*found], "joint_type": [*found.values()]}, remarks


def describe_unlisted(
    path: Path, stated: Mapping[str, Any], frames: Mapping[str, Place]
) -> list[str]:
    """Say which frames are named as the ends of loops are, but close none."""
    pairs = stated.get("closed_loop") or []
    listed = {name for pair in pairs if isinstance(pair, list) for name in pair}
    names = {re.sub(r"\d+", "#", str(name)) for name in listed}
    others = [n for n in frames if n not in listed and re.sub(r"\d+", "#", n) in names]
    return others and [
        f"{path}: closed_loop does not list {', '.join(others)}, which are named as the ends of "
        "its loops: if they close a loop, add the pair"
    ]


def with_types(
    path: Path, stated: Mapping[str, Any], joints: Mapping[str, LinkageJoint]
) -> dict[str, LinkageJoint]:
    """Return the joints with the types that the file states in place of the URDF's."""
    found = dict(joints)
    names, kinds = (stated.get(key) or [] for key in ("joint_name", "joint_type"))
    for name, kind in zip(names, kinds, strict=True):
        word = str(kind).upper()
        axes = word.removeprefix("UJOINT_")
        if word in ("SPHERICAL", "FIXED"):
            found[name] = replace(found[name], kind=word.lower(), axes=())
        elif len(axes) == 2 and set(axes) <= set(AXES):
            its = tuple(AXES[letter] for letter in axes)
            found[name] = replace(found[name], kind="universal", axes=its)
        else:
            raise DatasetError(
                f"{path}: joint_type of '{name}' is '{kind}', expected SPHERICAL, FIXED or "
                "UJOINT_XY, with the axes of the joint"
            )
    return found


def listed_loops(
    path: Path, stated: Mapping[str, Any], frames: Mapping[str, Place]
) -> list[LinkageLoop]:
    pairs = stated.get("closed_loop") or []
    kinds = stated.get("type") or ["6d"] * len(pairs)
    loops = []
    for pair, kind in zip(pairs, kinds, strict=True):
        if not isinstance(pair, list) or len(pair) != 2:
            raise DatasetError(f"{path}: closed_loop has {pair!r}, expected two frames")
        if missing := [name for name in pair if name not in frames]:
            raise DatasetError(
                f"{path}: closed_loop names '{missing[0]}', which is no link or joint of the URDF"
                f"{format_suggestion(missing[0], [*frames])}"
            )
        if str(kind).lower() not in LOOP_TYPES:
            raise DatasetError(f"{path}: type is '{kind}', expected 3d or 6d")
        a, b = (frames[name] for name in pair)
        name = f"{pair[0]}_to_{pair[1]}"
        loops.append(LinkageLoop(name, LOOP_TYPES[str(kind).lower()], a, b, where=str(path)))
    return loops


# ------------------------------------------------------------------ <constraint>


def read_constraint(element: Element, frames: Mapping[str, Place]) -> LinkageJoint | LinkageLoop:
    name = element.required("name")
    kind = element.get("type").removesuffix("_joint")
    if kind not in CONSTRAINTS:
        raise DatasetError(
            f"{element.where}: type is '{element.get('type')}', expected one of "
            f"{', '.join(CONSTRAINTS)}"
        )
    parent, child = _ends(element)
    if missing := [link for link in (parent, child) if link not in frames]:
        raise DatasetError(f"{element.where}: there is no link '{missing[0]}'")
    a, b = (read_origin(element.find(f"{end}_origin")) for end in ("parent", "child"))
    if kind in ("spherical", "link"):
        loop = "point" if kind == "spherical" else "pose"
        return LinkageLoop(name, loop, Place(parent, a), Place(child, b), where=element.where)
    first, turn = _axis(element, element.find("parent_axis")), np.eye(4)
    axes = [first]
    if kind == "universal":
        second = _axis(element, element.find("child_axis"))
        turn[:3, :3] = turn_to_perpendicular(first, second)
        axes = [turn[:3, :3].T @ first, second]
    return LinkageJoint(
        name,
        kind,
        parent,
        child,
        a @ turn @ np.linalg.inv(b),
        b[:3, 3],
        tuple(b[:3, :3] @ axis for axis in axes),
        where=element.where,
    )


def turn_to_perpendicular(first: Array, second: Array) -> Array:
    """Return the smallest rotation after which the second axis is perpendicular to the first one.

    The axes of a universal joint are, in every position; those of the file are in two frames.
    """
    normal = np.cross(first, second)
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    angle = np.arccos(np.clip(first @ second, -1, 1))
    return rotation_matrix(normal / np.linalg.norm(normal) * (np.pi / 2 - angle))
