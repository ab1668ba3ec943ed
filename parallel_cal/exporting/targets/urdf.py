"""A URDF: the chain of a serial arm with its identified joints, or a picture of another robot.

The picture has the drawing's links, a joint for each reading, and passive joints that close loops.
kinematics_node publishes the passive joints on `~/passive_joint_states`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.arm_urdf import (
    ArmJoint,
    arm_joints,
    describe_losses,
    format_exactly,
    rpy_of,
)
from parallel_cal.exporting.linkage_urdf import edit_urdf
from parallel_cal.exporting.tree import Joint, Segment, Tree, tree_of
from parallel_cal.exporting.urdf_editing import edit_arm
from parallel_cal.mechanisms.serial import Serial
from parallel_cal.model.model import Model

COLOURS = {
    "base": "0.35 0.35 0.38 1",
    "axis": "0.85 0.65 0.13 1",
    "driven": "0.80 0.35 0.10 1",
    "rod": "0.10 0.45 0.70 1",
    "platform": "0.15 0.60 0.35 1",
}
THICKNESS = 0.008  # of a link, per extent of the drawing
UNLIMITED = 1e3  # the limit (SI) of joints without limits


def files(model: Model, name: str = "robot") -> dict[str, str]:
    """Return `name`.urdf, with lengths in m and links as cylinders."""
    tree = None if isinstance(model.mechanism, Serial) else tree_of(model)
    return {f"{name}.urdf": urdf_text(model, name, tree)}


def urdf_text(model: Model, name: str, tree: Tree | None) -> str:
    """Return the text of a URDF: of a serial arm, or of the tree of another robot."""
    root = ElementTree.Element("robot", name=name)
    for kind, colour in COLOURS.items():
        material = ElementTree.SubElement(root, "material", name=kind)
        ElementTree.SubElement(material, "color", rgba=colour)
    if tree is None:
        _add_arm(root, model)
    else:
        lengths = [np.ptp(s.ends, axis=0).max() for link in tree.links.values() for s in link]
        radius = THICKNESS * max(lengths, default=0.1)
        for link, segments in tree.links.items():
            part = ElementTree.SubElement(root, "link", name=link)
            for segment in segments:
                _draw(part, segment, radius)
        for joint in tree.joints:
            _join(root, joint, tree)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n{text}\n'


def remarks(model: Model) -> list[str]:
    """Say what a URDF cannot represent, and what the numbers of an arm's mean."""
    mechanism, s = model.mechanism, model.structure
    if not isinstance(mechanism, Serial):
        drawn = mechanism.drawing(s.q, s.r, s.R, s.geometry)
        return [] if drawn else [f"{mechanism.name} has no drawing: the URDF has its frames only"]
    return [
        *describe_losses(model),
        "positions and limits of the joints are the readings of the robot: the zeros of its "
        "encoders are in the origins",
    ]


def edit(model: Model, files: Sequence[Path]) -> tuple[dict[Path, str], list[str]]:
    """Return the text of an arm's or a chain's own URDF with identified origins, and remarks.

    ModelError if the robot is neither: the loops of others are not in their URDF.
    """
    if model.mechanism.name == "chain":
        return edit_urdf(model, files)
    if not isinstance(model.mechanism, Serial):
        raise ModelError(
            f"{model.mechanism.name} is neither a serial arm nor a chain: expected -o FOLDER "
            "in place of --into, which writes a picture of the robot"
        )
    if len(files) != 1:
        raise ModelError(f"found {len(files)} files after --into, expected one URDF")
    text, changes = edit_arm(model, files[0])
    return {files[0]: text}, [*changes, *remarks(model)]


def _add_arm(root: ElementTree.Element, model: Model) -> None:
    """Add the chain of an arm, each link with a cylinder to the next joint."""
    joints = arm_joints(model)
    lengths = [float(np.linalg.norm(joint.origin[:3, 3])) for joint in joints]
    radius = THICKNESS * max(sum(lengths), 0.1)
    for link in dict.fromkeys([model.frames["base"], *(joint.child for joint in joints)]):
        part = ElementTree.SubElement(root, "link", name=link)
        for joint, length in zip(joints, lengths, strict=True):
            if joint.parent == link and length > radius:
                kind = "base" if link == model.frames["base"] else "driven"
                _draw(part, Segment(kind, (np.zeros(3), joint.origin[:3, 3])), radius)
    for joint in joints:
        _add_arm_joint(root, joint)


def _add_arm_joint(root: ElementTree.Element, joint: ArmJoint) -> None:
    (low, high), speed = joint.limits, min(joint.velocity, UNLIMITED)
    kind = "fixed"
    if joint.kind == "P":
        kind, (low, high) = "prismatic", np.clip(joint.limits, -UNLIMITED, UNLIMITED)
    elif joint.kind == "R":
        kind = "revolute" if np.isfinite(joint.limits).all() else "continuous"
    part = ElementTree.SubElement(root, "joint", name=joint.name, type=kind)
    ElementTree.SubElement(part, "parent", link=joint.parent)
    ElementTree.SubElement(part, "child", link=joint.child)
    xyz, rpy = (format_exactly(v) for v in (joint.origin[:3, 3], rpy_of(joint.origin[:3, :3])))
    ElementTree.SubElement(part, "origin", xyz=xyz, rpy=rpy)
    if joint.kind is None:
        return
    ElementTree.SubElement(part, "axis", xyz="0 0 1")
    limits = {"lower": low, "upper": high} if kind != "continuous" else {}
    limits |= {"velocity": speed, "effort": UNLIMITED}
    ElementTree.SubElement(part, "limit", {k: format_exactly((v,)) for k, v in limits.items()})
    if joint.follows:
        law = {"multiplier": joint.follows.factor, "offset": joint.follows.offset}
        words = {k: format_exactly((v,)) for k, v in law.items()}
        ElementTree.SubElement(part, "mimic", {"joint": joint.follows.reading} | words)


def _draw(link: ElementTree.Element, segment: Segment, radius: float) -> None:
    """Draw a segment as a cylinder; URDF draws it along z about its middle."""
    a, b = segment.ends
    x, y, z = b - a
    turned = _numbers([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=_numbers((a + b) / 2), rpy=turned)
    shape = ElementTree.SubElement(visual, "geometry")
    length = _numbers([np.linalg.norm(b - a)])
    ElementTree.SubElement(shape, "cylinder", radius=_numbers([radius]), length=length)
    ElementTree.SubElement(visual, "material", name=segment.kind)


def _join(root: ElementTree.Element, joint: Joint, tree: Tree) -> None:
    none = np.inf if joint.turns else UNLIMITED
    low, high, speed = -none, none, UNLIMITED
    if joint.value is None:  # a driven joint
        i = tree.model.joints.index(joint.name)
        low, high = np.clip(tree.model.mechanism.joint_limits[i], -none, none)
        if rates := tree.model.mechanism.joint_rates:
            speed = min(rates[i][0], UNLIMITED)
    endless = joint.turns and not np.isfinite([low, high]).all()
    kind = "continuous" if endless else "revolute" if joint.turns else "prismatic"
    part = ElementTree.SubElement(root, "joint", name=joint.name, type=kind)
    ElementTree.SubElement(part, "parent", link=joint.parent)
    ElementTree.SubElement(part, "child", link=joint.child)
    ElementTree.SubElement(part, "origin", xyz=_numbers(joint.origin), rpy="0 0 0")
    ElementTree.SubElement(part, "axis", xyz=_numbers(joint.axis))
    limits = {"lower": low, "upper": high, "velocity": speed, "effort": UNLIMITED}
    if endless:
        limits = {"velocity": speed, "effort": UNLIMITED}
    ElementTree.SubElement(part, "limit", {k: _numbers([v]) for k, v in limits.items()})


def _numbers(values: object) -> str:
    return " ".join(f"{float(v) + 0.0:.12g}" for v in np.ravel(np.asarray(values)))
