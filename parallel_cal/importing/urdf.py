"""A serial arm from a URDF: the chain between two of its links.

Source: ROS wiki, "urdf/XML/joint".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import read_foreign_text
from parallel_cal.importing.chain import (
    chain_links,
    choose_controls,
    choose_home,
    rotation_from_rpy,
)
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.mimic import (
    Joint,
    Mimic,
    describe_limits,
    describe_mimics,
    enter_drives,
    resolve_mimic,
)
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": None}
ASSUMED_TRAVEL_M = 0.5  # of a slide without limits, as the mechanism `serial` has it
MAX_AXIS_LENGTH_ERROR = 1e-3  # of 1; 0.707 0.707 0 is a direction with rounded numbers


def arm(path: Path, start: str = "", end: str = "", **options: Any) -> ConfiguredRobot:
    """Return the model of the chain from link `start` (the root) to `end`.

    Without `end`, it is the only leaf that a joint moves. If several leaves are fixed to the same
    last joint, it is the one after the most fixed joints; a remark names the others. `options` are
    the options of the mechanism `serial` except its links. A joint with `<mimic>` follows its
    master, on the chain or off it, and has no reading of its own.
    """
    every, remarks = _joints(path), list[str]()
    if not end:
        end, remark = _find_tip(path, every, start)
        remarks += [remark] if remark else []
    joints = [resolve_mimic(path, joint, every) for joint in _chain(path, every, start, end)]
    moving = [joint for joint in joints if joint.kind]
    if not moving:
        raise DatasetError(f"{path}: no joint moves between '{start}' and '{end}'")
    links = chain_links(joints)
    driven = enter_drives(
        [link for link in links if link["joint"]], moving, {joint.name: joint for joint in every}
    )
    mechanism = load_mechanism("serial", links=links, **options)
    masters = [*driven.values()]
    limits = tuple(  # an endless joint is endless, if no follower limits it
        master.limits if np.array_equal(found, master.finite_limits) else found
        for master, found in zip(masters, mechanism.joint_limits, strict=True)
    )
    states_home = "home" in options
    if not states_home:
        finite = np.nan_to_num(limits, posinf=2 * np.pi, neginf=-2 * np.pi).tolist()
        options["home"] = [0.0 if low < 0 < high else (low + high) / 2 for low, high in finite]
        mechanism = load_mechanism("serial", links=links, **options)
    if "controls" not in options and (able := choose_controls(mechanism)) != mechanism.controls:
        mechanism = load_mechanism("serial", links=links, **options, controls=list(able))
        remarks.append(f"the arm controls {', '.join(able)}: other coordinates follow from them")
    about_home = list[str]()
    assumed = mechanism.home.joints
    if not states_home and (regular := choose_home(mechanism)) != assumed:
        options |= {"controls": list(mechanism.controls), "home": list(regular)}
        mechanism = load_mechanism("serial", links=links, **options)
        there, singular = (", ".join(f"{q:g}" for q in home) for home in (regular, assumed))
        about_home.append(
            f"home is at {there}, because the arm is singular at {singular}: state another one "
            "with --option home=[...] if this is not in the robot's usual working range"
        )
    mechanism.joints = tuple(master.name for master in masters)
    mechanism.joint_limits = limits
    following = [(joint, joint.mimic) for joint in moving if joint.mimic]
    slowest = [
        min(
            [
                one.velocity,
                *(j.velocity / abs(m.factor) for j, m in following if m.joint == one.name),
            ]
        )
        for one in masters
    ]
    mechanism.joint_rates = tuple((velocity, np.inf) for velocity in slowest)
    remarks += describe_mimics(moving, driven)
    remarks += describe_limits(masters, limits)
    remarks += _describe_axis_lengths(moving)
    frames = {"base": joints[0].parent, "platform": joints[-1].child}
    model = replace(new_model(mechanism), frames=frames)
    return ConfiguredRobot(model, (*remarks, *about_home))


def _describe_axis_lengths(moving: Sequence[Joint]) -> list[str]:
    """Warn of axes that are not of length 1: programs read them in different ways."""
    odd = [one for one in moving if abs(one.axis_length - 1) > MAX_AXIS_LENGTH_ERROR]
    remarks = [
        f"the axis of {joint.name} has the length {joint.axis_length:.6g}. It was read as a "
        "direction, so that the joint moves by its reading; some programs (yourdfpy, ikpy) "
        f"multiply the motion by {joint.axis_length:.6g}: write an axis of length 1"
        for joint in odd
        if joint.kind == "P"
    ]
    if hinges := ", ".join(joint.name for joint in odd if joint.kind != "P"):
        remarks.append(
            f"the axes of {hinges} are not of length 1. They were read as directions; some "
            "programs (ikpy) do not rotate about such an axis: write axes of length 1"
        )
    return remarks


def read_chain(path: Path, start: str, end: str) -> list[Joint]:
    """Return the joints of a file from link `start` to `end`, fixed ones included; mimics name the
    joint that does not follow another one itself."""
    every = _joints(path)
    return [resolve_mimic(path, joint, every) for joint in _chain(path, every, start, end)]


def read_links(path: Path) -> list[str]:
    """Return the names of the links that the joints of a file connect, sorted."""
    return sorted({link for joint in _joints(path) for link in (joint.parent, joint.child)})


# ------------------------------------------------------------------ the file


def _joints(path: Path) -> list[Joint]:
    try:
        text = read_foreign_text(path)
        # XML allows nothing before its declaration, but files have blank lines and comments there.
        root = ElementTree.fromstring(text[max(text.find("<?xml"), 0) :])
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not a URDF: {error}") from None
    if any("xacro" in part.tag.partition("}")[0] for part in root.iter()):
        raise DatasetError(
            f"{path}: a xacro, expected a URDF: expand it first (xacro {path.name} > robot.urdf) "
            "and give the expanded file"
        )
    if root.tag != "robot" or not root.findall("joint"):
        raise DatasetError(
            f"{path}: not a URDF: expected <robot> with <joint>s, found <{root.tag}>"
        )
    return [_joint(path, part) for part in root.findall("joint")]


def _joint(path: Path, part: ElementTree.Element) -> Joint:
    name, kind = part.get("name", ""), part.get("type", "")
    where = f"{path}: joint '{name}'"
    ends = [getattr(part.find(end), "attrib", {}).get("link") for end in ("parent", "child")]
    if not all(ends):
        raise DatasetError(f"{where}: no parent or child link")
    origin = np.eye(4)
    origin[:3, 3] = _read_three(where, part.find("origin"), "xyz", "0 0 0")
    origin[:3, :3] = rotation_from_rpy(_read_three(where, part.find("origin"), "rpy", "0 0 0"))
    axis = _read_three(where, part.find("axis"), "xyz", "1 0 0")
    if kind in KINDS and KINDS[kind] and not np.linalg.norm(axis) > 0:
        raise DatasetError(f"{where}: axis xyz is '0 0 0', expected a direction")
    limit, moves = part.find("limit"), kind in ("revolute", "prismatic")
    low, high = (_read_one(where, limit, k, None if moves else 0.0) for k in ("lower", "upper"))
    velocity = _read_one(where, limit, "velocity", 0.0) or np.inf
    copied, mimic = part.find("mimic"), None
    if copied is not None:
        factor = _read_one(where, copied, "multiplier", 1.0)
        mimic = Mimic(copied.get("joint", ""), factor, _read_one(where, copied, "offset", 0.0))
    zero = moves and low == high == 0
    if zero:  # what generators write for joints without limits
        low, high = (
            (-ASSUMED_TRAVEL_M, ASSUMED_TRAVEL_M) if kind == "prismatic" else (-np.inf, np.inf)
        )
    return Joint(
        name,
        KINDS.get(kind, kind),
        ends[0] or "",
        ends[1] or "",
        origin,
        axis,
        (low, high) if moves else (-np.inf, np.inf),
        velocity,
        zero,
        mimic,
    )


def _read_three(where: str, part: ElementTree.Element | None, key: str, default: str) -> Array:
    text = default if part is None else part.get(key, default)
    try:
        found = np.array(text.split(), float)
    except ValueError:
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise DatasetError(f"{where}: {key} is '{text}', expected three numbers")
    return found


def _read_one(
    where: str, part: ElementTree.Element | None, key: str, default: float | None
) -> float:
    text = None if part is None else part.get(key)
    if text is None and default is not None:
        return default
    try:
        return float(text or "")
    except ValueError:
        tag = "limit" if part is None else part.tag
        raise DatasetError(f"{where}: {tag} {key} is '{text or ''}', expected a number") from None


def _find_tip(path: Path, joints: Sequence[Joint], start: str) -> tuple[str, str]:
    """Return the leaf in which the chain ends, and a remark if there were others to choose from.

    DatasetError if several leaves are moved by different joints, or equally far along.
    """
    parents = {joint.child: joint for joint in joints}
    used = {joint.parent for joint in joints}
    last: dict[str, str] = {}  # leaf -> the last joint that moves it
    fixed: dict[str, int] = {}  # leaf -> number of fixed joints after that one
    for leaf in (joint.child for joint in joints if joint.child not in used):
        at, n = leaf, 0
        while at != start and at in parents and n <= len(joints):
            if parents[at].kind:
                last[leaf], fixed[leaf] = parents[at].name, n
                break
            at, n = parents[at].parent, n + 1
    moved = sorted(last)
    if not moved:
        whole = sorted({*parents, *used} - used)
        return (whole or [joints[-1].child])[0], ""
    most = max(fixed.values())
    furthest = [leaf for leaf in moved if fixed[leaf] == most]
    if len({*last.values()}) > 1 or len(furthest) > 1:
        raise DatasetError(
            f"{path}: the chain may end in {', '.join(moved)}: choose one with --to-link"
        )
    others = [leaf for leaf in moved if leaf != furthest[0]]
    remark = (
        f"the chain ends in {furthest[0]}; {', '.join(others)} can be chosen with --to-link"
        if others
        else ""
    )
    return furthest[0], remark


def _chain(path: Path, joints: Sequence[Joint], start: str, end: str) -> list[Joint]:
    """Return the joints from one link to another; DatasetError if the chain is not unique."""
    children = {joint.child: joint for joint in joints}
    links = {*children, *(joint.parent for joint in joints)}
    for link in (start, end):
        if link and link not in links:
            raise DatasetError(
                f"{path}: no link '{link}', expected one of {', '.join(sorted(links))}"
            )
    chain, at = list[Joint](), end
    while at != start and at in children and len(chain) <= len(joints):
        chain.append(children[at])
        at = children[at].parent
    if start and at != start:
        raise DatasetError(f"{path}: link '{end}' does not descend from link '{start}'")
    for joint in chain:
        if joint.kind not in (*KINDS.values(), "R", "P"):
            kinds = "revolute, continuous, prismatic or fixed"
            raise DatasetError(
                f"{path}: joint '{joint.name}': type '{joint.kind}', expected {kinds}"
            )
    if not chain:
        raise DatasetError(f"{path}: '{start}' and '{end}' are the same link")
    return chain[::-1]
