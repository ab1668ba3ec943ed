"""A serial arm from a URDF: the chain between two of its links as DH and Hayati links.

Frames with z along the joints' axes follow table 3.5 along the chain, so that the parameters are
the same as those of an arm that was described by hand. Source: ROS wiki, "urdf/XML/joint".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import read_foreign_text
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

KINDS = {"revolute": "R", "continuous": "R", "prismatic": "P", "fixed": None}
MAX_PARALLEL_SINE = 0.1  # sine of the angle between axes below which they count as parallel
MAX_COINCIDENT_DISTANCE_M = 1e-3  # m between parallel axes below which they count as one
ASSUMED_TRAVEL_M = 0.5  # of a slide without limits, as the mechanism `serial` has it
ROUNDING_TOLERANCE = 1e-13  # m or 1; smaller values are rounding errors


@dataclass(frozen=True)
class Joint:
    """One joint of a chain: its frame (4, 4) in its parent's frame, and its axis in its own."""

    name: str
    kind: str | None
    parent: str
    child: str
    origin: Array
    axis: Array
    limits: tuple[float, float]
    velocity: float
    is_limit_zero: bool = False  # stated as 0 to 0


def arm(path: Path, start: str = "", end: str = "", **options: Any) -> ConfiguredRobot:
    """Return the model of the chain from link `start` (the root) to `end`.

    Without `end`, it is the only leaf that a joint moves. If several leaves are fixed to the same
    last joint, it is the one after the most fixed joints; a remark names the others. `options` are
    the options of the mechanism `serial` except its links.
    """
    every, remarks = _joints(path), list[str]()
    if not end:
        end, remark = _find_tip(path, every, start)
        remarks += [remark] if remark else []
    joints = _chain(path, every, start, end)
    driven = [joint for joint in joints if joint.kind]
    if not driven:
        raise DatasetError(f"{path}: no joint moves between '{start}' and '{end}'")
    finite = [
        tuple(np.clip(j.limits, -2 * np.pi, 2 * np.pi).tolist()) if j.kind == "R" else j.limits
        for j in driven
    ]
    links = _links(joints)
    for link, limits in zip([k for k in links if k["joint"]], finite, strict=True):
        link |= {"low": limits[0], "high": limits[1]}
    middle = [0.0 if low <= 0 <= high else (low + high) / 2 for low, high in finite]
    mechanism = load_mechanism("serial", links=links, **{"home": middle, **options})
    mechanism.joints = tuple(joint.name for joint in driven)
    mechanism.joint_limits = tuple(joint.limits for joint in driven)
    mechanism.joint_rates = tuple((joint.velocity, np.inf) for joint in driven)
    frames = {"base": joints[0].parent, "platform": joints[-1].child}
    if unlimited := [joint.name for joint in driven if joint.is_limit_zero]:
        remarks.append(
            f"the limits of {', '.join(unlimited)} are 0 to 0, which does not state how far they "
            "move: set them in the model file (joint_limits)"
        )
    return ConfiguredRobot(replace(new_model(mechanism), frames=frames), tuple(remarks))


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
    origin[:3, :3] = _rotation_from_rpy(_read_three(where, part.find("origin"), "rpy", "0 0 0"))
    axis = _read_three(where, part.find("axis"), "xyz", "1 0 0")
    if kind in KINDS and KINDS[kind] and not np.linalg.norm(axis) > 0:
        raise DatasetError(f"{where}: axis xyz is '0 0 0', expected a direction")
    limit, moves = part.find("limit"), kind in ("revolute", "prismatic")
    low, high = (_read_one(where, limit, k, None if moves else 0.0) for k in ("lower", "upper"))
    velocity = _read_one(where, limit, "velocity", 0.0) or np.inf
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
        axis / (np.linalg.norm(axis) or 1.0),
        (low, high) if moves else (-np.inf, np.inf),
        velocity,
        zero,
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
        raise DatasetError(f"{where}: limit {key} is '{text or ''}', expected a number") from None


def _rotation_from_rpy(rpy: Array) -> Array:
    """Return the rotation about the fixed x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


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


# ------------------------------------------------------------------ the links


def _links(joints: Sequence[Joint]) -> list[dict[str, Any]]:
    """Return the numbers of every link of the mechanism `serial`.

    The first link has no joint and leads to the first axis; the last one leads to {P}.
    """
    at, links, kind = np.eye(4), list[dict[str, Any]](), None
    frame = np.eye(4)  # of the current joint, at reading zero
    for joint in joints:
        frame = frame @ joint.origin
        if joint.kind:
            step, at = _to_axis(at, frame[:3, 3], frame[:3, :3] @ joint.axis, joint.kind)
            links.append({"joint": kind, **step})
            kind = joint.kind
    return [*links, *_to_frame(at, frame, kind)]


def _to_axis(F: Array, p: Array, u: Array, kind: str) -> tuple[dict[str, Any], Array]:
    """Return the link from frame F to the axis through p along u, and the frame there."""
    offset, toward = F[:3, :3].T @ (p - F[:3, 3]), F[:3, :3].T @ u
    normal = np.array([-toward[1], toward[0], 0.0])  # z x u
    if np.linalg.norm(normal) > MAX_PARALLEL_SINE:
        return _perpendicular(F, offset, toward, normal / np.linalg.norm(normal), kind)
    foot = offset - toward * offset[2] / toward[2] if kind == "R" else np.zeros(3)
    a = float(np.hypot(*foot[:2]))
    polar = a > MAX_COINCIDENT_DISTANCE_M
    theta = float(np.arctan2(foot[1], foot[0])) if polar else 0.0
    x, y = np.cos(theta) * toward[:2] + np.sin(theta) * np.array([toward[1], -toward[0]])
    beta, alpha = float(np.arcsin(np.clip(x, -1, 1))), float(np.arctan2(-y, toward[2]))
    step: dict[str, Any] = {
        "axes": "parallel",
        "theta": theta,
        "a": a,
        "alpha": alpha,
        "beta": beta,
    }
    if kind == "R" and not polar:
        step |= {"axes": "coincident", "a": float(foot[0]), "b": float(foot[1])}
    return _remove_rounding(step), F @ _matrix(_remove_rounding(step))


def _perpendicular(
    F: Array, offset: Array, toward: Array, normal: Array, kind: str
) -> tuple[dict[str, Any], Array]:
    """Return the DH link: x is along the common normal, from this axis to the next one."""
    a = float(offset @ normal)
    if a < 0:
        normal, a = -normal, -a
    alpha = float(np.arctan2(np.cross([0.0, 0.0, 1.0], toward) @ normal, toward[2]))
    # d is the height at which the next axis is nearest to z.
    across = np.array([-normal[1], normal[0], 0.0])
    d = float(offset[2] - toward[2] * (offset @ across) / (toward @ across))
    step = {
        "axes": "perpendicular",
        "theta": float(np.arctan2(normal[1], normal[0])),
        "alpha": alpha,
    }
    if kind == "R":
        step |= {"d": d, "a": a}  # for a sliding joint only the direction counts
    return _remove_rounding(step), F @ _matrix(_remove_rounding(step))


def _to_frame(F: Array, P: Array, kind: str | None) -> list[dict[str, Any]]:
    """Return the last link; if {P}'s y-axis is nearly along z, a quarter turn comes before it."""
    first: list[dict[str, Any]] = []
    left = np.linalg.solve(F, P)
    if abs(left[2, 1]) > 0.9:
        quarter: dict[str, Any] = {"joint": kind, "free": [], "alpha": np.pi / 2}
        first, left, kind = [quarter], np.linalg.solve(_matrix(quarter), left), None
    alpha = float(np.arcsin(np.clip(left[2, 1], -1, 1)))
    theta = float(np.arctan2(-left[0, 1], left[1, 1]))
    beta = float(np.arctan2(-left[2, 0], left[2, 2]))
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    a, b = (turn @ left[:2, 3]).tolist()
    step = {"theta": theta, "d": float(left[2, 3]), "a": a, "b": b, "alpha": alpha, "beta": beta}
    return [*first, {"joint": kind, **_remove_rounding(step)}]


def _matrix(step: dict[str, Any]) -> Array:
    """Return Rz(theta) Tz(d) Tx(a) Ty(b) Rx(alpha) Ry(beta), (4, 4)."""
    theta, d, a, b, alpha, beta = (
        step.get(k, 0.0) for k in ("theta", "d", "a", "b", "alpha", "beta")
    )
    T = np.eye(4)
    T[:3, 3] = [a * np.cos(theta) - b * np.sin(theta), a * np.sin(theta) + b * np.cos(theta), d]
    about_y = _rotation_from_rpy(np.array([0.0, beta, 0.0]))
    T[:3, :3] = (
        _rotation_from_rpy(np.array([0, 0, theta]))
        @ _rotation_from_rpy(np.array([alpha, 0, 0]))
        @ about_y
    )
    return T


def _remove_rounding(step: dict[str, Any]) -> dict[str, Any]:
    """Set values that are only rounding errors to zero."""
    return {
        k: 0.0 if isinstance(v, float) and abs(v) < ROUNDING_TOLERANCE else v
        for k, v in step.items()
    }
