"""SDF: the identified numbers of a chain, written into the file from which it was made.

Poses of links, joints and frames change. Everything else stays, byte for byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.base.units import DEGREE
from parallel_cal.exporting.arm_urdf import format_exactly, rpy_of
from parallel_cal.exporting.calibrated_linkage import (
    ROUNDING_TOLERANCE,
    calibrated_linkage,
    describe_changes,
    describe_target,
)
from parallel_cal.exporting.drawn_linkage import drawn_poses
from parallel_cal.exporting.editing import read_verbatim
from parallel_cal.importing.located_xml import Element, XmlEdit
from parallel_cal.importing.sdf import MODEL, WORLD, SdfModel, axis_frame, read_model, read_pose
from parallel_cal.model.model import Model

Array = np.ndarray


def edit(model: Model, files: Sequence[Path]) -> tuple[dict[Path, str], list[str]]:
    """Return the text of the file with the identified numbers, and what changed."""
    if len(files) != 1:
        raise ModelError(f"found {len(files)} files after --into, expected one SDF")
    found, sdf = calibrated_linkage(model, files), read_model(files[0])
    world = sdf.world
    new = {
        name: np.linalg.solve(world, pose)
        for name, pose in drawn_poses(model, found).items()
        if name != WORLD
    }
    # What is attached to a link moves with it; the frames of loops and of the target are stated.
    attached = {
        name: np.linalg.solve(sdf.pose(body), sdf.pose(name)) for name, body in sdf.bodies.items()
    }
    for name, anchor in found.changes.anchors.items():
        attached[name][:3, 3] = anchor
    target, remarks = model.frames["platform"], describe_changes(found)
    if found.changes.target is not None:
        if target in sdf.frames and sdf.frames[target][0].tag == "frame":
            attached[target] = found.changes.target
        else:
            remarks.append(describe_target(found, target, "a <frame>"))
    poses = {
        name: (new[body] if body in new else sdf.pose(body)) @ attached[name]
        for name, body in sdf.bodies.items()
    }
    change = XmlEdit()
    for name, (element, reference) in sdf.frames.items():
        if name in poses:
            base = poses.get(reference, np.eye(4) if reference == MODEL else sdf.pose(reference))
            _set_pose(change, element, np.linalg.solve(base, poses[name]))
    if sdf.placement in poses:  # it may have moved, and the model must stay where it is
        _set_pose(change, sdf.element, world @ poses[sdf.placement])
    for joint in sdf.element.all("joint"):
        for part in joint.all("axis", "axis2"):
            _set_axis(change, sdf, joint, part, poses)
    return {files[0]: change.apply(read_verbatim(files[0]))}, remarks


def _set_pose(change: XmlEdit, element: Element, pose: Array) -> None:
    """State a pose as the element has it: six numbers, in degrees or not, or a quaternion."""
    old, part = read_pose(element), element.find("pose")
    if np.abs(pose - old).max() < ROUNDING_TOLERANCE:
        return
    if part is not None and part.get("rotation_format") == "quat_xyzw":
        turn = matrix_to_quaternion(pose[:3, :3])
    else:
        unit = DEGREE if part is not None and part.get("degrees") == "true" else 1.0
        turn = np.array(rpy_of(pose[:3, :3])) / unit
    words = format_exactly(np.concatenate([pose[:3, 3], turn]))
    if part is None:
        change.insert(element, f"<pose>{words}</pose>")
    else:
        change.set_text(part, words)


def _set_axis(
    change: XmlEdit, sdf: SdfModel, joint: Element, part: Element, poses: dict[str, Array]
) -> None:
    """State an axis again if it is expressed in a frame that does not move with its link."""
    frame, xyz = axis_frame(sdf, part), part.find("xyz")
    body = sdf.bodies.get(joint.get("name"), "")
    if not frame or not body or xyz is None or sdf.bodies.get(frame) == body:
        return
    old = np.array(xyz.text.split(), float)
    turned = sdf.pose(body)[:3, :3].T @ sdf.pose(frame)[:3, :3] @ old
    now = poses.get(frame, sdf.pose(frame))[:3, :3].T @ poses[body][:3, :3] @ turned
    if np.abs(now - old).max() > ROUNDING_TOLERANCE:
        change.set_text(xyz, format_exactly(now))
