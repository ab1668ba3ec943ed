"""A URDF for RViz: the drawing's links, driven joints, and passive joints that close the loops.

kinematics_node publishes the passive joints on `~/passive_joint_states`.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from parallel_cal.exporting.tree import Joint, Segment, Tree, tree_of
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
    tree = tree_of(model)
    root = ElementTree.Element("robot", name=name)
    for kind, colour in COLOURS.items():
        material = ElementTree.SubElement(root, "material", name=kind)
        ElementTree.SubElement(material, "color", rgba=colour)
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
    return {f"{name}.urdf": f'<?xml version="1.0"?>\n{text}\n'}


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
