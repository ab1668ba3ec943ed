"""Where the bodies of a calibrated linkage are drawn: at zero of its driven joints, and closed.

MJCF and SDF state the poses of bodies in one drawn configuration, and derive from it what joints
and loops have in their second body. So the loops have to be closed in it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.calibrated_linkage import Calibrated
from parallel_cal.importing.linkage import LinkageJoint, LinkageLoop
from parallel_cal.importing.loop_closure import close_loops
from parallel_cal.model.model import Model

Array = np.ndarray


def drawn_poses(model: Model, found: Calibrated) -> dict[str, Array]:
    """Return the poses (4, 4) of the bodies between base and platform in the world of the file.

    The first of these bodies in the file stays where it is.
    """
    linkage, base, platform = found.between, found.base, found.platform.body
    loops = [at_rest(found, loop) for loop in linkage.loops if is_drawn(loop)]
    drawn = replace(linkage, loops=tuple(loops))
    closed = close_loops(drawn, base, platform, model.joints)
    if closed is None:
        raise ModelError(
            f"{linkage.path}: the loops do not close with the identified numbers where the file "
            "draws the bodies (all driven joints at zero)"
        )
    frames = closed[1]
    poses = {
        body: frames[place.body] @ place.frame
        for body, place in found.at.items()
        if place.body in frames
    }
    balls = list[LinkageJoint]()
    for loop in linkage.loops:
        if loop.rod is not None:
            poses |= rod_poses(found, loop, frames)
            balls += [ball for ball in loop.rod.balls if isinstance(ball, LinkageJoint)]
    for joint in (*linkage.joints, *balls):  # bodies between hinges that act as one joint
        for part in reversed(joint.parts[1:]):
            own = found.joint(part.name)
            poses[own.parent] = poses[own.child] @ np.linalg.inv(own.origin)
    order = [body for body in found.linkage.poses if body in poses]
    world = found.linkage.poses[order[0]] @ np.linalg.inv(poses[order[0]])
    return {body: world @ pose for body, pose in poses.items()}


def is_drawn(loop: LinkageLoop) -> bool:
    if loop.rod is None:
        return loop.drawn
    return any(isinstance(b, LinkageLoop) and b.drawn for b in loop.rod.balls) or all(
        not isinstance(b, LinkageLoop) for b in loop.rod.balls
    )


def at_rest(found: Calibrated, loop: LinkageLoop) -> LinkageLoop:
    """Return a loop with its length in the drawn configuration."""
    if loop.rod is not None and loop.rod.slide is not None:
        return replace(loop, length=(loop.length or 0.0) - loop.rod.slide.zero)
    return loop


def rod_poses(found: Calibrated, loop: LinkageLoop, frames: dict[str, Array]) -> dict[str, Array]:
    """Return the poses of the bodies of a rod, or of both sides of a slide."""
    rod = loop.rod
    assert rod is not None
    start, stop = ((frames[end.body] @ end.frame)[:3, 3] for end in (loop.a, loop.b))
    slide = rod.slide
    bodies = {rod.body: np.eye(4)} if slide is None else {slide.parent: np.eye(4)}
    if slide is not None:
        own = found.joint(slide.name)
        a, b = found.at[own.parent].frame, found.at[own.child].frame
        bodies[slide.child] = a @ found.changes.origins.get(own.name, own.origin) @ np.linalg.inv(b)
    first, last = rod.points[0], (list(bodies.values())[-1] @ [*rod.points[1], 1.0])[:3]
    drawn = drawn_pose(found, next(iter(bodies)))
    base = np.linalg.solve(found.between.poses[found.base], drawn)
    along = base[:3, :3] @ (last - first)
    pose = np.eye(4)
    pose[:3, :3] = turn_between(along, stop - start) @ base[:3, :3]
    pose[:3, 3] = start - pose[:3, :3] @ first
    poses = {}
    for body, place in found.at.items():
        if place.body in bodies:
            shifted = place.frame.copy()
            shifted[:3, 3] += found.changes.halves.get(body, np.zeros(3))
            poses[body] = pose @ bodies[place.body] @ shifted
    return poses


def drawn_pose(found: Calibrated, joined: str) -> Array:
    """Return the pose of a joined body where the file draws it."""
    body = next(name for name, place in found.at.items() if place.body == joined)
    return found.linkage.poses[body] @ np.linalg.inv(found.at[body].frame)


def turn_between(one: Array, other: Array) -> Array:
    """Return the smallest rotation from one direction to another."""
    normal = np.cross(one, other)
    sine = np.linalg.norm(normal)
    if sine < 1e-12 * np.linalg.norm(one) * np.linalg.norm(other):
        return np.eye(3)
    return rotation_matrix(normal / sine * np.arctan2(sine, one @ other))
