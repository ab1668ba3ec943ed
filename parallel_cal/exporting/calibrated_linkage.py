"""The numbers of a file that describes a linkage, as a calibration of its chain found them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.importing.chain import motion_of
from parallel_cal.importing.closed_chain import cut_out, read_linkage
from parallel_cal.importing.linkage import (
    FIXED,
    Linkage,
    LinkageJoint,
    LinkageLoop,
    Place,
    Rod,
    joined_bodies,
    locked_value,
    plain_name,
    with_locked,
)
from parallel_cal.model.model import Model

Array = np.ndarray
ROUNDING_TOLERANCE = 1e-13  # m or 1; a number that changes by less stays as it is


@dataclass
class Changes:
    """New places in a file: frames of joints (child in parent) and anchors of balls by joint, and
    ends of loops.

    `halves` are the shifts of halves of rods, by body. In a file of which a body has the frame of
    its joint, `shifts` has how far a ball moved in its second body, by body. `target` is the frame
    of {P} in the body of the file that carries it, if it moved.
    """

    origins: dict[str, Array] = field(default_factory=dict)
    anchors: dict[str, Array] = field(default_factory=dict)
    ends: dict[tuple[str, str], Array] = field(default_factory=dict)
    halves: dict[str, Array] = field(default_factory=dict)
    shifts: dict[str, Array] = field(default_factory=dict)
    target: Array | None = None


@dataclass
class Calibrated:
    """The linkage of a file, and what its calibration changes.

    `between` is the linkage between base and platform with the identified numbers, `at` has the
    joined body of every body. `at_joints` says whether each body of the file has the frame of its
    joint.
    """

    linkage: Linkage
    between: Linkage
    at: dict[str, Place]
    base: str
    platform: Place
    at_joints: bool = False
    changes: Changes = field(default_factory=Changes)
    remarks: list[str] = field(default_factory=list)

    def joint(self, name: str) -> LinkageJoint:
        """Return a joint of the file, by its name in the model."""
        return next(one for one in self.linkage.joints if plain_name(one.name) == name)

    def loop(self, name: str) -> LinkageLoop:
        """Return a loop of the file, by its name in the model."""
        return next(one for one in self.linkage.loops if plain_name(one.name) == name)


def calibrated_linkage(model: Model, files: Sequence[Path], at_joints: bool = False) -> Calibrated:
    """Return the identified numbers for the file from which a chain was made.

    `at_joints`: the file draws a body in the frame of its joint, as a URDF does.
    ModelError if the file describes another linkage, or has no place for a number.
    """
    if model.mechanism.name != "chain":
        raise ModelError(
            f"{model.mechanism.name} was not made from such a file: expected a model of the "
            "mechanism chain (new --from)"
        )
    base, end = (model.frames[name] for name in ("base", "platform"))
    linkage, between, place = match_model(read_linkage(files), model)
    found = Calibrated(linkage, between, joined_bodies(linkage, base), base, place, at_joints)
    joints = [identified_joint(model, joint) for joint in between.joints]
    loops = [identified_loop(model, loop) for loop in between.loops]
    found.between = replace(between, joints=tuple(joints), loops=tuple(loops))
    for old, new in zip(between.joints, joints, strict=True):
        if closes_loop(model, old):
            in_parent = (new.origin @ _point(new.anchor) - old.origin @ _point(old.anchor))[:3]
            _move_ball(found, old, in_parent, new.anchor - old.anchor)
        else:
            _set_joint(found, old, new.origin @ np.linalg.inv(old.origin))
    for was, loop in zip(between.loops, loops, strict=True):
        if was.rod is None:
            for side, one in (("a", loop.a), ("b", loop.b)):
                _set_end(found, loop.name, side, one.frame)
        else:
            set_rod(found, was, loop)
    target = identified_target(model, place.frame)
    if np.abs(target - place.frame).max() > ROUNDING_TOLERANCE:
        own = linkage.frames[end]
        found.changes.target = np.linalg.solve(found.at[own.body].frame, target)
    return found


def match_model(linkage: Linkage, model: Model) -> tuple[Linkage, Linkage, Place]:
    """Return the linkage of the file with the joints locked that the model has locked, the part of
    it that the model describes, and where the platform is."""
    base, platform = (model.frames[name] for name in ("base", "platform"))
    options = model.mechanism.options
    names = {part["name"] for key in ("joints", "loops") for part in options.get(key, ())}
    between, place = cut_out(linkage, base, platform, model.joints)
    found = {one.name for one in between.parts}
    more, less = sorted(found - names), sorted(names - found)
    if not more and not less:
        return linkage, between, place
    held = [joint.name for joint in linkage.joints if plain_name(joint.name) in more]
    if more and len(held) == len(more):
        for joint in linkage.joints:
            if joint.name in held and abs(value := locked_value(joint)) > ROUNDING_TOLERANCE:
                raise ModelError(
                    f"{linkage.path}: joint {joint.name} is locked at {value:.6g} "
                    f"{'rad' if joint.kind == 'revolute' else 'm'}, but the file is drawn with it "
                    "at 0, so the places of its loops cannot be written; set its spring reference "
                    "(or home) in the file to 0 and turn its child body instead, and make the "
                    "model anew"
                )
        still = with_locked(linkage, held)
        between, place = cut_out(still, base, platform, model.joints)
        if {one.name for one in between.parts} == names:
            return still, between, place
    words = [f"it has {', '.join(more)}"] if more else []
    words += [f"it lacks {', '.join(less)}"] if less else []
    raise ModelError(
        f"{linkage.path}: between '{base}' and '{platform}' {' and '.join(words)}, other than the "
        "model: expected the file from which the model was made (new --from)"
    )


def identified_joint(model: Model, joint: LinkageJoint) -> LinkageJoint:
    """Return a joint with the identified place and direction; its encoder's zero is in them."""
    if closes_loop(model, joint):
        a, b = (
            np.array([model.value(f"{joint.name}.{side}_{axis}") for axis in "xyz"])
            for side in "ab"
        )
        origin = joint.origin.copy()
        origin[:3, 3] = a - origin[:3, :3] @ b
        return replace(joint, origin=origin, anchor=b)
    values = {key: model.value(f"{joint.name}.{key}") for key in ("x", "y", "z", "rx", "ry", "rz")}
    shift, turn, placed = motion_of("P", joint.anchor, 1.0), np.eye(4), joint.origin.copy()
    turn[:3, :3] = rotation_matrix(np.array([values[key] for key in ("rx", "ry", "rz")]))
    placed[:3, 3] = [values[key] for key in "xyz"]
    origin = placed @ shift @ turn @ np.linalg.inv(shift)
    if joint.name in model.joints:
        change = model.value(f"{joint.name}.zero") - joint.zero
        zero = motion_of("R" if joint.kind == "revolute" else "P", joint.axes[0], change)
        origin = origin @ shift @ zero @ np.linalg.inv(shift)
    return replace(joint, origin=origin)


def closes_loop(model: Model, joint: LinkageJoint) -> bool:
    """Return whether a joint is a ball that closes a loop: a point in each of its bodies."""
    return f"{joint.name}.a_x" in model.table.names


def identified_loop(model: Model, loop: LinkageLoop) -> LinkageLoop:
    ends = []
    for side, end in (("a", loop.a), ("b", loop.b)):
        frame = end.frame.copy()
        frame[:3, 3] = [model.value(f"{loop.name}.{side}_{axis}") for axis in "xyz"]
        ends.append(Place(end.body, frame))
    length = model.value(f"{loop.name}.length") if loop.kind == "distance" else None
    return replace(loop, a=ends[0], b=ends[1], length=length)


def identified_target(model: Model, nominal: Array) -> Array:
    """Return the identified frame of {P} in the body that carries it."""
    turn = np.eye(4)
    turn[:3, :3] = rotation_matrix(np.array([model.value(f"target.r{axis}") for axis in "xyz"]))
    placed = nominal.copy()
    placed[:3, 3] = [model.value(f"target.{axis}") for axis in "xyz"]
    return placed @ turn


# ------------------------------------------------------------------ into the file's frames


def _set_joint(found: Calibrated, joint: LinkageJoint, moved: Array) -> None:
    """Move a joint in the joined body of its parent; of several in a row, the first."""
    if np.abs(moved - np.eye(4)).max() < ROUNDING_TOLERANCE:
        return
    first = (joint.parts or (joint,))[0]
    if first.parent != joint.parent:
        raise ModelError(
            f"{first.where}: the joints {', '.join(part.name for part in joint.parts)} act as one "
            "ball whose place cannot be written, because the file has them in the other direction"
        )
    own = found.joint(first.name)
    a, b = found.at[own.parent].frame, found.at[own.child].frame
    found.changes.origins[own.name] = np.linalg.solve(a, moved @ first.origin @ b)


def _set_end(found: Calibrated, name: str, side: str, frame: Array) -> None:
    """Move an end of a loop in its joined body."""
    loop = found.loop(name)
    end = getattr(loop, side)
    new = np.linalg.solve(found.at[end.body].frame, frame)
    if np.abs(new - end.frame).max() > ROUNDING_TOLERANCE:
        found.changes.ends[loop.name, side] = new


def set_rod(found: Calibrated, old: LinkageLoop, new: LinkageLoop) -> None:
    """Move both balls of a rod, and lengthen its body or shift its slide."""
    rod = old.rod
    assert rod is not None
    assert old.length is not None
    assert new.length is not None
    growth, span = new.length - old.length, rod.points[1] - rod.points[0]
    longer = np.zeros(3) if rod.slide else span / (np.linalg.norm(span) or 1.0) * growth
    if rod.slide:
        along = rod.slide.origin[:3, :3] @ rod.slide.axes[0] * growth
        _set_joint(found, rod.slide, motion_of("P", along, 1.0))
    shifts = [now.frame[:3, 3] - was.frame[:3, 3] for was, now in ((old.a, new.a), (old.b, new.b))]
    # The length goes to a point of its own, or to where the rod is joined, or to the second ball.
    takes = 0 if isinstance(rod.balls[0], LinkageLoop) else 1
    if not any(isinstance(ball, LinkageLoop) for ball in rod.balls) and stretch_rod(
        found, rod, longer
    ):
        takes = -1
    for k, (ball, shift) in enumerate(zip(rod.balls, shifts, strict=True)):
        own = longer * (1 if k else -1) if k == takes else np.zeros(3)
        body = (old.a, old.b)[k].body
        if isinstance(ball, LinkageLoop):
            for side, end in (("a", ball.a), ("b", ball.b)):
                moved = shift if end.body == body else own
                _set_end(found, ball.name, side, motion_of("P", moved, 1.0) @ end.frame)
        elif ball.parent == body:
            _move_ball(found, ball, shift, own)
        else:
            _move_ball(found, ball, own, shift)


def stretch_rod(found: Calibrated, rod: Rod, longer: Array) -> bool:
    """Move apart two halves of a rod that a pose or a fixed joint of the file joins, if there are.

    The half with the second ball moves by `longer`, in the frame of the rod.
    """
    if np.abs(longer).max() < ROUNDING_TOLERANCE:
        return True
    first, second = (body_at(found, ball, rod.body) for ball in rod.balls)
    loops = [loop for loop in found.linkage.loops if loop.kind == "pose"]
    edges: list[tuple[LinkageJoint | LinkageLoop, str, str]] = [
        *[(loop, loop.a.body, loop.b.body) for loop in loops],
        *[(one, one.parent, one.child) for one in found.linkage.joints if one.kind == FIXED],
    ]
    edges = [edge for edge in edges if found.at[edge[1]].body == rod.body]
    shift = motion_of("P", longer, 1.0)
    for edge in edges:
        one, a, b = edge
        side, n = {first}, 0
        while n < len(side):
            n = len(side)
            for other in edges:
                if other is not edge and side & {*other[1:]}:
                    side |= {*other[1:]}
        if second in side or not side & {a, b}:
            continue
        frame, bodies = found.at[a].frame, {body for other in edges for body in other[1:]}
        found.changes.halves |= dict.fromkeys(bodies - side, longer)
        if isinstance(one, LinkageLoop):
            key, end = ("a", one.a) if a in side else ("b", one.b)
            _set_end(found, one.name, key, shift @ found.at[end.body].frame @ end.frame)
        else:
            moved = shift if a in side else np.linalg.inv(shift)
            found.changes.origins[one.name] = np.linalg.solve(frame, moved @ frame @ one.origin)
        return True
    return False


def body_at(found: Calibrated, ball: LinkageJoint | LinkageLoop, rod: str) -> str:
    """Return the body of the file, part of a rod, at which a ball is."""
    if isinstance(ball, LinkageLoop):
        loop = found.loop(ball.name)
        return loop.a.body if ball.a.body == rod else loop.b.body
    parts = ball.parts or (ball,)
    if ball.child == rod:
        return found.joint(parts[-1].name).child
    return found.joint(parts[0].name).parent


def _move_ball(found: Calibrated, ball: LinkageJoint, in_parent: Array, in_child: Array) -> None:
    """Move the point of a ball joint in both of its bodies."""
    if np.abs(in_child).max() < ROUNDING_TOLERANCE:
        return _set_joint(found, ball, motion_of("P", in_parent, 1.0))
    last = (ball.parts or (ball,))[-1]
    own = found.joint(last.name)
    if found.at_joints and last.child == ball.child and own.child != found.base:
        found.changes.shifts[own.child] = found.at[own.child].frame[:3, :3].T @ in_child
        return _set_joint(found, ball, motion_of("P", in_parent, 1.0))
    if ball.parts:
        raise ModelError(
            f"{last.where}: the joints {', '.join(part.name for part in ball.parts)} act as one "
            "ball whose point on its second body is not a number of the file"
        )
    turn = found.at[own.child].frame[:3, :3]
    found.changes.anchors[own.name] = own.anchor + turn.T @ in_child
    moved = motion_of("P", in_parent, 1.0) @ ball.origin @ motion_of("P", -in_child, 1.0)
    _set_joint(found, ball, moved @ np.linalg.inv(ball.origin))
    return None


def _point(vector: Array) -> Array:
    return np.append(vector, 1.0)


def describe_changes(found: Calibrated) -> list[str]:
    """Say how many joints and ends of loops changed, and by how much."""
    moved = {}
    for name, origin in found.changes.origins.items():
        old = next(joint for joint in found.linkage.joints if joint.name == name).origin
        moved[name] = np.linalg.solve(old, origin)
    for (name, side), frame in found.changes.ends.items():
        end = getattr(next(loop for loop in found.linkage.loops if loop.name == name), side)
        moved[f"{name} on {end.body}"] = np.linalg.solve(end.frame, frame)
    if not moved:
        return ["no joint and no loop changed"]
    shift = {name: float(np.linalg.norm(T[:3, 3])) for name, T in moved.items()}
    turn = {name: float(np.linalg.norm(rotation_vector(T[:3, :3]))) for name, T in moved.items()}
    far, wide = max(shift, key=shift.__getitem__), max(turn, key=turn.__getitem__)
    return [
        f"joints and ends of loops changed: {len(moved)}, by up to {1e3 * shift[far]:.3g} mm "
        f"({far}) and {np.degrees(turn[wide]):.3g} deg ({wide})"
    ]


def describe_target(found: Calibrated, body: str, place: str) -> str:
    """Say where the target is if the file has no place for it."""
    assert found.changes.target is not None
    x, y, z = found.changes.target[:3, 3]
    angle = np.degrees(np.linalg.norm(rotation_vector(found.changes.target[:3, :3])))
    return (
        f"the target is at {x:.6g} {y:.6g} {z:.6g} m in the frame of {body}, turned by "
        f"{angle:.4g} deg, which was not written: name {place} with --platform to have it written"
    )
