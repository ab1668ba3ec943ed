"""The drawing of a chain: every body through its joints, the rods, and the axes of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.mechanisms._chain_bodies import Pose, Skeleton
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.parameters import Named


def draw(
    s: Skeleton, frames: Mapping[str, Pose], r: Any, axis_length: float, p: Named
) -> list[Line]:
    """Draw a skeleton whose bodies have these frames, with {P} at r."""
    points: dict[str, list[Any]] = {body: [] for body in frames}
    shows: dict[str, list[str]] = {body: [] for body in frames}
    points[s.base].append(ca.DM.zeros(3))
    kinds, lines = {s.base: "base", s.platform: "platform"}, list[Line]()
    for joint in s.joints:
        at, turned = frames[joint.child]
        anchor = at + turned @ ca.DM(joint.anchor)
        points[joint.parent].append(anchor)
        points[joint.child].append(anchor)
        kinds.setdefault(joint.child, "driven" if joint.driven else "rod")
        shows[joint.parent].append(f"{joint.name}.[xyz]")
        shows[joint.child] += [f"{joint.name}.zero", f"{joint.name}.r?"]
        if len(joint.axes) == 1:
            along = turned @ ca.DM(joint.axes[0])
            lines.append(axis(anchor, along, axis_length))
    for loop in s.loops:
        ends = s.rod_ends(loop, frames, p)
        for side, end, at in zip("ab", (loop.a, loop.b), ends, strict=True):
            points[end.body].append(at)
            shows[end.body].append(f"{loop.name}.{side}_?")
        if loop.type == "distance":
            kind = "driven" if loop.driven else "rod"
            lines.append(Line(kind, ends, (f"{loop.name}.length",)))
    points[s.platform].append(r)
    shows[s.platform].append("target.*")
    lines += [
        Line(kinds.get(body, "rod"), tuple(through), tuple(shows[body]))
        for body, through in points.items()
        if len(through) > 1
    ]
    return lines
