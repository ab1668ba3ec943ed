"""Joints that files write as several hinges in a row: ball joints, and rods between two of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from parallel_cal.importing.linkage import (
    Linkage,
    LinkageJoint,
    LinkageLoop,
    Place,
    Rod,
    add_mass,
)

TURNING = {"revolute": 1, "universal": 2, "spherical": 3}
MAX_DISTANCE_M = 1e-9  # of axes that meet in a point; files have their numbers to 1e-12 m or better
MIN_SINE = 1e-3  # between axes; of less, a hinge does not add a freedom
Array = np.ndarray

BALLS = (
    ["point", "point"],
    ["point", "spherical"],
    ["point", "universal"],
    ["spherical", "spherical"],
    ["spherical", "universal"],  # a rod may turn about itself, so one ball may be a universal joint
)


def simplify(linkage: Linkage, ends: Collection[str], driven: Collection[str]) -> Linkage:
    """Return the linkage with ball joints in place of hinges that meet, and rods in place of bodies
    between two balls.

    `ends` are bodies that stay, `driven` joints that stay. Two hinges that meet stay as they are if
    they are not the end of a rod: each may have an encoder.
    """
    # First hinges with a common point: a hinge along a rod also meets the one at its other end.
    merged = _merge(_merge(linkage, ends, driven, False), ends, driven, True)
    merged = with_rods(with_struts(merged, ends, driven), ends)
    joints = [
        part
        for joint in merged.joints
        for part in (joint.parts if _is_two_hinges(joint) else (joint,))
    ]
    return replace(merged, joints=tuple(joints))


def _is_two_hinges(joint: LinkageJoint) -> bool:
    """Whether a joint is universal by its hinges: a ball without spin has one more."""
    turns = sum(TURNING[part.kind] for part in joint.parts)
    return joint.kind == "universal" and turns == TURNING["universal"]


def _merge(
    linkage: Linkage, ends: Collection[str], driven: Collection[str], on_line: bool
) -> Linkage:
    """Join two passive joints about one point if nothing else holds the body between them; with
    `on_line`, also two hinges on one line."""
    joints, masses = [*linkage.joints], {**linkage.masses}
    held = {end.body for loop in linkage.loops for end in (loop.a, loop.b)} | {*ends}
    between = [b for joint in joints for b in (joint.parent, joint.child)]
    for body in dict.fromkeys(between):
        at = [joint for joint in joints if body in (joint.parent, joint.child)]
        if body in held or len(at) != 2 or any(one.name in driven for one in at):
            continue
        first, second = sorted(at, key=lambda joint: joint.child != body)
        into = first if first.child == body else _reversed(first)
        out = second if second.parent == body else _reversed(second)
        if joint := product_of_joints(into, out, on_line):
            joints[joints.index(first)] = joint
            joints.remove(second)
            if body in masses:  # a cross, whose centre is at the common point
                mass, _ = masses.pop(body)
                add_mass(masses, joint.parent, mass, (joint.origin @ [*joint.anchor, 1.0])[:3])
    return replace(linkage, joints=tuple(joints), masses=masses)


def _reversed(joint: LinkageJoint) -> LinkageJoint:
    """Return a joint as seen from its child, with values of the other sign."""
    turn = joint.origin[:3, :3]
    return replace(
        joint,
        parent=joint.child,
        child=joint.parent,
        origin=np.linalg.inv(joint.origin),
        anchor=turn @ joint.anchor + joint.origin[:3, 3],
        axes=tuple(turn @ axis for axis in reversed(joint.axes)),
    )


def product_of_joints(
    first: LinkageJoint, second: LinkageJoint, on_line: bool
) -> LinkageJoint | None:
    """Return the joint of two in a row, if both turn about one point."""
    if not {first.kind, second.kind} <= {*TURNING} or first.parent == second.child:
        return None
    back = np.linalg.inv(second.origin)  # from the body between both to the last one, at value 0
    turned = [back[:3, :3] @ axis for axis in first.axes]
    at = back[:3, :3] @ first.anchor + back[:3, 3]
    axes = [*turned, *second.axes]
    rank = int(np.linalg.matrix_rank(np.array(axes or np.eye(3)), tol=MIN_SINE))
    apart = second.anchor - at
    if rank == 1 and on_line:
        apart = apart - axes[0] * (axes[0] @ apart)
    if np.linalg.norm(apart) > MAX_DISTANCE_M:
        return None
    if "spherical" in (first.kind, second.kind):
        rank = 3
    if rank < len(axes) and rank == 2:  # three hinges in a plane: their order matters
        return None
    kind = {1: "revolute", 2: "universal", 3: "spherical"}[rank]
    parts = (*(first.parts or (first,)), *(second.parts or (second,)))
    return replace(
        first,
        kind=kind,
        child=second.child,
        origin=first.origin @ second.origin,
        # A hinge may be anywhere on its line through a ball; the ball turns about its centre.
        anchor=second.anchor if second.kind == "spherical" else at,
        axes=tuple(axes[:rank]) if rank < 3 else (),
        limits=(-np.inf, np.inf),
        home=(),
        parts=parts,
    )


def with_struts(linkage: Linkage, ends: Collection[str], driven: Collection[str]) -> Linkage:
    """Replace every driven slide on the line between two balls by the distance between these."""
    joints, loops = [*linkage.joints], [*linkage.loops]
    for slide in linkage.joints:
        bodies = slide.parent, slide.child
        parts: list[LinkageJoint | LinkageLoop] = [*joints, *loops]
        at = [
            [
                one
                for one in parts
                if one is not slide and body in _bodies_of(one) and body not in ends
            ]
            for body in bodies
        ]
        if slide.kind != "prismatic" or slide.name not in driven or [*map(len, at)] != [1, 1]:
            continue
        balls = [one[0] for one in at]
        if balls[0] is balls[1] or any(one.kind not in ("spherical", "point") for one in balls):
            continue
        (p, far), (r, far2) = (_half(one, body) for one, body in zip(balls, bodies, strict=True))
        span = slide.origin[:3, :3] @ r.frame[:3, 3] + slide.origin[:3, 3] - p.frame[:3, 3]
        length = float(slide.origin[:3, :3] @ slide.axes[0] @ span)
        if np.linalg.norm(span) - abs(length) > MAX_DISTANCE_M:
            continue
        if length < 0:  # its reading falls as it grows: it stays a slide, which must not spin
            joints = [without_spin(one, slide) if one in balls else one for one in joints]
            continue
        points = p.frame[:3, 3], r.frame[:3, 3]
        strut = LinkageLoop(
            slide.name,
            "distance",
            far,
            far2,
            length + slide.zero,
            slide.limits,
            slide.where,
            rod=Rod(
                slide.name,
                points,
                (balls[0], balls[1]),
                slide,
                masses_on_strut(linkage, slide, *points),
            ),
        )
        joints = [joint for joint in joints if joint is not slide and joint not in balls]
        loops = [loop for loop in loops if loop not in balls] + [strut]
    return replace(linkage, joints=tuple(joints), loops=tuple(loops))


def masses_on_strut(
    linkage: Linkage, slide: LinkageJoint, first: Array, second: Array
) -> tuple[tuple[str, float, str, float], ...]:
    """Return name and mass (kg) of both halves of a strut, its end (a or b) and the distance (m) of
    the centre from there towards the other end.

    `first` and `second` (3,) m are the ends in the frames of the halves. What a half has beside the
    line between both ends may turn about it, and counts as on the line.
    """
    along = slide.axes[0]  # in the frame of the second half, at value 0
    halves = (
        (slide.parent, "a", first, slide.origin[:3, :3] @ along),
        (slide.child, "b", second, -along),
    )
    return tuple(
        (body, linkage.masses[body][0], end, float((linkage.masses[body][1] - point) @ inward))
        for body, end, point, inward in halves
        if body in linkage.masses
    )


def without_spin(ball: LinkageJoint, slide: LinkageJoint) -> LinkageJoint:
    """Return a ball joint at one end of a strut without the turn about the strut.

    The other end stays a ball: of both turns about the strut, only the sum does anything.
    """
    if slide.parent not in (ball.parent, ball.child):
        return ball
    along = slide.origin[:3, :3] @ slide.axes[0]  # in the frame of the body at this end
    if ball.parent == slide.parent:
        along = ball.origin[:3, :3].T @ along
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    first = first / np.linalg.norm(first)
    return replace(ball, kind="universal", axes=(first, np.cross(along, first)))


def _bodies_of(one: LinkageJoint | LinkageLoop) -> tuple[str, str]:
    if isinstance(one, LinkageJoint):
        return one.parent, one.child
    return one.a.body, one.b.body


def _half(one: LinkageJoint | LinkageLoop, body: str) -> tuple[Place, Place]:
    """Return the point of a ball on one of its bodies, and on the other one."""
    if isinstance(one, LinkageLoop):
        return (one.a, one.b) if one.a.body == body else (one.b, one.a)
    shift = np.eye(4)
    shift[:3, 3] = one.anchor
    child, parent = Place(one.child, shift), Place(one.parent, one.origin @ shift)
    return (child, parent) if one.child == body else (parent, child)


def with_rods(linkage: Linkage, ends: Collection[str]) -> Linkage:
    """Replace every body that hangs on two balls alone by a rod of fixed length between them. Its
    mass is shared by the bodies at its ends, so that it has the same weight and the same centre on
    the line between both balls."""
    joints, loops, masses = [*linkage.joints], [*linkage.loops], {**linkage.masses}
    bodies = [body for one in linkage.parts for body in _bodies_of(one)]
    for body in dict.fromkeys(bodies):
        parts: list[LinkageJoint | LinkageLoop] = [*joints, *loops]
        balls = [one for one in parts if body in _bodies_of(one)]
        if body in ends or sorted(one.kind for one in balls) not in BALLS:
            continue
        (p, far), (r, far2) = (_half(one, body) for one in balls)
        if far.body == far2.body:
            continue
        points = p.frame[:3, 3], r.frame[:3, 3]
        mass, centre = masses.pop(body, (0.0, np.zeros(3)))
        span = points[1] - points[0]
        share = float((centre - points[0]) @ span / max(span @ span, 1e-300))
        for end, part in ((far, 1 - share), (far2, share)):
            add_mass(masses, end.body, part * mass, end.frame[:3, 3])
        joints = [joint for joint in joints if joint not in balls]
        rod = LinkageLoop(
            f"{body}_rod" if body in [joint.name for joint in joints] else body,
            "distance",
            far,
            far2,
            float(np.linalg.norm(points[0] - points[1])),
            where=balls[0].where,
            rod=Rod(body, points, (balls[0], balls[1])),
        )
        loops = [loop for loop in loops if loop not in balls] + [rod]
    return replace(linkage, joints=tuple(joints), loops=tuple(loops), masses=masses)
