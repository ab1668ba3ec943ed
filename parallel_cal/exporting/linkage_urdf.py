"""Write the identified numbers of a chain into its own URDF.

Origins of joints and of `<constraint>` elements change, and the fixed joints that place the frames
of loops. Everything else stays, byte for byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.arm_urdf import format_exactly, rpy_of
from parallel_cal.exporting.calibrated_linkage import (
    ROUNDING_TOLERANCE,
    calibrated_linkage,
    describe_changes,
    describe_target,
)
from parallel_cal.exporting.editing import read_verbatim
from parallel_cal.importing.chain import motion_of
from parallel_cal.importing.linkage import Linkage
from parallel_cal.importing.located_xml import Element, XmlEdit, parse_xml
from parallel_cal.importing.urdf_loops import read_origin
from parallel_cal.model.model import Model

Array = np.ndarray


def edit_urdf(model: Model, files: Sequence[Path]) -> tuple[dict[Path, str], list[str]]:
    """Return the text of a URDF with the identified numbers of a chain, and what changed."""
    path, found = files[0], calibrated_linkage(model, files, at_joints=True)
    text = read_verbatim(path)
    root = parse_xml(path, text, "URDF")
    elements = {one.get("name"): one for one in root.all("joint", "constraint")}
    if found.changes.anchors:
        name = next(iter(found.changes.anchors))
        raise ModelError(
            f"{elements[name].where}: the point of this joint moved in its child link, for which a "
            "URDF has no number: the frame of the child is that of the joint"
        )
    placed, edit, remarks = dict(found.changes.origins), XmlEdit(), describe_changes(found)
    frames: dict[str, Array] = {}  # link -> its frame in the one that the file states
    for (name, side), frame in found.changes.ends.items():
        if name in elements:
            tag = "parent_origin" if side == "a" else "child_origin"
            set_origin(edit, elements[name], tag, frame)
            continue
        link = getattr(next(loop for loop in found.linkage.loops if loop.name == name), side).body
        if np.abs(frames.setdefault(link, frame) - frame).max() > ROUNDING_TOLERANCE:
            raise ModelError(f"{path}: '{link}' is the end of two loops, which have moved apart")
    end = found.linkage.frames[model.frames["platform"]].body
    target = np.eye(4) if found.changes.target is None else found.changes.target
    loops = [loop for loop in found.linkage.loops if loop.name not in elements]
    is_end = any(end in (loop.a.body, loop.b.body) for loop in loops)
    at_end = frames.get(end, np.eye(4) if is_end else target)
    if np.abs(at_end - target).max() > ROUNDING_TOLERANCE:
        apart = 1e3 * np.linalg.norm((at_end - target)[:3, 3])
        raise ModelError(
            f"{path}: '{end}' is the platform and the end of a loop, which are {apart:.3g} mm "
            "apart now: give the platform a link of its own with a fixed joint"
        )
    if end in found.changes.shifts:
        found.changes.target = motion_of("P", -found.changes.shifts[end], 1.0) @ target
    if found.changes.target is not None:
        frames[end] = found.changes.target
    for link, frame in frames.items():
        holder = _fixed_joint(root, link)
        if holder is None and link == end:
            remarks.append(describe_target(found, link, "a link with a fixed joint"))
        elif holder is None:
            raise ModelError(
                f"{path}: the end '{link}' of a loop moved, and no fixed joint places it: put a "
                "link for the end of the loop there, with a fixed joint"
            )
        else:
            joint = holder.get("name")
            placed[joint] = placed.get(joint, read_origin(holder.find("origin"))) @ frame
    for link, shift in found.changes.shifts.items():
        place_around(found.linkage, link, shift, placed)
    for name, origin in placed.items():
        element = elements[name]
        if element.tag == "constraint":  # its child's side stays: the parent's takes the change
            old = next(joint for joint in found.linkage.joints if joint.name == name)
            first = read_origin(element.find("parent_origin"))
            set_origin(edit, element, "parent_origin", origin @ np.linalg.inv(old.origin) @ first)
        else:
            set_origin(edit, element, "origin", origin)
    return {path: edit.apply(text)}, remarks


def place_around(linkage: Linkage, link: str, shift: Array, placed: dict[str, Array]) -> None:
    """Place the ball by which a link hangs elsewhere in it: a link has the frame of its joint, so
    that all other joints on it, and the ends of loops, move the other way."""
    ends = {loop.name: {loop.a.body, loop.b.body} for loop in linkage.loops}
    ends |= {one.name: {one.child} for one in linkage.joints if "constraint" in one.where}
    for name, links in ends.items():
        if link in links:
            raise ModelError(
                f"{linkage.path}: the ball of '{link}' moved in it, which is an end of the loop "
                f"{name}: give this end a link of its own with a fixed joint"
            )
    for joint in linkage.joints:
        if joint.parent == link:
            placed[joint.name] = motion_of("P", -shift, 1.0) @ placed.get(joint.name, joint.origin)


def set_origin(edit: XmlEdit, owner: Element, tag: str, frame: Array) -> None:
    """State a frame in `xyz` and `rpy` of a part of an element; what does not change stays."""
    part = owner.find(tag)
    old = read_origin(part)
    words = {}
    if np.abs(frame[:3, 3] - old[:3, 3]).max() > ROUNDING_TOLERANCE:
        words["xyz"] = format_exactly(frame[:3, 3])
    if np.abs(frame[:3, :3] - old[:3, :3]).max() > ROUNDING_TOLERANCE:
        words["rpy"] = format_exactly(rpy_of(frame[:3, :3]))
    if part is not None:
        for key, value in words.items():
            edit.set(part, key, value)
    elif words:
        attributes = " ".join(f'{key}="{value}"' for key, value in words.items())
        edit.insert(owner, f"<{tag} {attributes}/>")


def _fixed_joint(root: Element, link: str) -> Element | None:
    """Return the fixed joint that places a link."""
    for one in root.all("joint"):
        child = one.find("child")
        if child is not None and child.get("link") == link:
            return one if one.get("type") == "fixed" else None
    return None
