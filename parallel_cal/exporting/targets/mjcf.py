"""MJCF: the identified numbers of a chain, written into the file from which it was made.

Poses of bodies, points of joints, sites and anchors change. Everything else stays, byte for byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.exporting.arm_urdf import format_exactly
from parallel_cal.exporting.calibrated_linkage import (
    ROUNDING_TOLERANCE,
    Calibrated,
    calibrated_linkage,
    describe_changes,
    describe_target,
)
from parallel_cal.exporting.drawn_linkage import drawn_poses
from parallel_cal.exporting.editing import read_verbatim
from parallel_cal.importing.linkage import FIXED, LinkageLoop
from parallel_cal.importing.located_xml import Element, XmlEdit
from parallel_cal.importing.mjcf_elements import (
    ORIENTATIONS,
    Body,
    Document,
    Settings,
    read_document,
    read_pose,
)
from parallel_cal.model.model import Model

Array = np.ndarray


def edit(model: Model, files: Sequence[Path]) -> tuple[dict[Path, str], list[str]]:
    """Return the texts of the file, and of those that it includes, with the identified numbers."""
    if len(files) != 1:
        raise ModelError(f"found {len(files)} files after --into, expected one MJCF")
    found = calibrated_linkage(model, files)
    document = read_document(files[0])
    poses = drawn_poses(model, found)
    edits: dict[Path, XmlEdit] = {}
    moving = {joint.child for joint in found.linkage.joints if joint.kind != FIXED}
    for name, body in document.bodies.items():
        if name in moving and {name, body.parent} <= {*poses}:
            _set_body(edits, document, body, poses, found)
    remarks = describe_changes(found)
    places = {  # of the sites: the frames of the `<frame>` in which they stand
        element.get("name"): (
            element,
            pose @ np.linalg.inv(read_pose(element, values, document.settings)),
        )
        for body in document.bodies.values()
        for element, values, pose in body.sites
    }
    name = model.frames["platform"]
    require_one_place(document, found, files[0], name)
    for end, frame in found.changes.ends.items():
        _set_end(edits, document, found, places, end, frame)
    if found.changes.target is not None:
        if name in places:
            element, at = places[name]
            _set_pose(edits, element, document.settings, np.linalg.solve(at, found.changes.target))
        else:
            remarks.append(describe_target(found, name, "a site"))
    texts = {path: change.apply(read_verbatim(path)) for path, change in edits.items()}
    return texts or {files[0]: read_verbatim(files[0])}, remarks


def require_one_place(document: Document, found: Calibrated, path: Path, platform: str) -> None:
    """Raise ModelError if a site must be at two places: of two loops, or of a loop and {P}."""
    points: dict[str, Array] = {}
    for loop in found.linkage.loops:
        for side, end in (("a", loop.a), ("b", loop.b)):
            site = _site_of(document, loop, side)
            if site is None:
                continue
            point = found.changes.ends.get((loop.name, side), end.frame)[:3, 3]
            if np.abs(points.setdefault(site, point) - point).max() > ROUNDING_TOLERANCE:
                raise ModelError(
                    f"{path}: site '{site}' is the end of two loops, which have moved apart: give "
                    "each loop a site of its own"
                )
    if platform in points:
        target = (
            found.linkage.frames[platform].frame
            if found.changes.target is None
            else found.changes.target
        )
        apart = target[:3, 3] - points[platform]
        if np.abs(apart).max() > ROUNDING_TOLERANCE:
            raise ModelError(
                f"{path}: site '{platform}' is the platform and the end of a loop, which are "
                f"{1e3 * np.linalg.norm(apart):.3g} mm apart now: give the platform a site of its "
                "own"
            )


def _site_of(document: Document, loop: LinkageLoop, side: str) -> str | None:
    """Return the site at the end of a loop or of a rod; None if bodies state it."""
    element = _element_of(document, loop)
    if element is None or loop.drawn:
        return None
    if element.tag == "spatial":
        return element.all("site")["ab".index(side)].get("site")
    return document.with_defaults(element, "equality").get("site1" if side == "a" else "site2")


def _element_of(document: Document, loop: LinkageLoop) -> Element | None:
    parts = [*document.section("equality"), *document.section("tendon")]
    return next((one for one in parts if one.where == loop.where), None)


def _set_body(
    edits: dict[Path, XmlEdit],
    document: Document,
    body: Body,
    poses: dict[str, Array],
    found: Calibrated,
) -> None:
    """State the pose of a body, and the points and axes of its joints in it."""
    new = np.linalg.solve(poses[body.parent], poses[body.name])
    if np.abs(new - body.pose).max() > ROUNDING_TOLERANCE:
        outer = body.pose @ np.linalg.inv(
            read_pose(body.element, body.element.attributes, document.settings)
        )
        _set_pose(edits, body.element, document.settings, np.linalg.solve(outer, new))
    wheres = [element.where for element, _, _ in body.joints]
    its = [joint for joint in found.linkage.joints if joint.where in wheres]
    drawn = found.linkage.poses
    for (element, _, frame), joint in zip(body.joints, its, strict=True):
        inner = np.linalg.solve(poses[body.name], poses[joint.child])
        old = np.linalg.solve(drawn[body.name], drawn[joint.child])
        anchor = found.changes.anchors.get(joint.name, joint.anchor)
        was, now = (
            (np.linalg.inv(frame) @ place @ [*point, 1.0])[:3]
            for place, point in ((old, joint.anchor), (inner, anchor))
        )
        if np.abs(was - now).max() > ROUNDING_TOLERANCE:
            _edit(edits, element).set(element, "pos", format_exactly(now))
        for axis in joint.axes:
            was, now = (frame[:3, :3].T @ place[:3, :3] @ axis for place in (old, inner))
            if np.abs(was - now).max() > ROUNDING_TOLERANCE:
                _edit(edits, element).set(element, "axis", format_exactly(now))


def _set_end(
    edits: dict[Path, XmlEdit],
    document: Document,
    found: Calibrated,
    places: dict[str, tuple[Element, Array]],
    end: tuple[str, str],
    frame: Array,
) -> None:
    """State the point of a loop or of a rod: an anchor, or the place of a site."""
    name, side = end
    loop = next(one for one in found.linkage.loops if one.name == name)
    key = _site_of(document, loop, side)
    if key is None:
        # The other end follows from where the bodies are drawn, as a weld does.
        element = _element_of(document, loop)
        if side == "a" and element is not None and element.tag == "connect":
            _edit(edits, element).set(element, "anchor", format_exactly(frame[:3, 3]))
        return
    site, at = places[key]
    _set_pose(edits, site, document.settings, np.linalg.solve(at, frame))


def _set_pose(
    edits: dict[Path, XmlEdit], element: Element, settings: Settings, pose: Array
) -> None:
    """State a pose, with the orientation in the way that the element has it."""
    old = read_pose(element, element.attributes, settings)
    if np.abs(pose[:3, 3] - old[:3, 3]).max() > ROUNDING_TOLERANCE:
        _edit(edits, element).set(element, "pos", format_exactly(pose[:3, 3]))
    if np.abs(pose[:3, :3] - old[:3, :3]).max() > ROUNDING_TOLERANCE:
        stated = next((key for key in ORIENTATIONS if key in element.attributes), "quat")
        key = "quat" if stated == "zaxis" else stated  # a direction does not state a rotation
        words = format_exactly(_orientation(pose[:3, :3], key, settings))
        _edit(edits, element).rename(element, stated, key, words)


def _orientation(R: Array, key: str, settings: Settings) -> Array:
    """Return a rotation as the numbers of an attribute."""
    turn = Rotation.from_matrix(R)
    if key == "xyaxes":
        return np.concatenate([R[:, 0], R[:, 1]])
    if key == "euler":  # upper case turns about fixed axes, for SciPy about those of the frame
        return np.asarray(turn.as_euler(settings.sequence.swapcase()) / settings.angle)
    if key == "axisangle":
        vector = turn.as_rotvec()
        angle = float(np.linalg.norm(vector))
        return np.array([*(vector / angle if angle else np.eye(3)[2]), angle / settings.angle])
    x, y, z, w = matrix_to_quaternion(R)
    return np.array([w, x, y, z])


def _edit(edits: dict[Path, XmlEdit], element: Element) -> XmlEdit:
    return edits.setdefault(element.path, XmlEdit())
