"""Frames of a URDF's joints on the identified axes of an arm, as near as possible to the file's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.importing.chain import MAX_PARALLEL_SINE
from parallel_cal.importing.mimic import Joint

Array = np.ndarray
MAX_ITERATIONS = 20
CONVERGED = 1e-14  # rad or m, of a step
ARM_M = 0.1  # m, by which errors of directions count beside those of points
QUARTER_TURNS = (0.0, np.pi / 2, -np.pi / 2, np.pi)  # a model may count from another zero
DIGITS = 9  # of an error, m: of equal ones, the first start counts


def place_frames(chain: Sequence[Joint], identified: Sequence[Array], tip: Array) -> list[Array]:
    """Return the frame (4, 4) in the base of every moving joint of a file, where the positions of
    all joints are zero. z of the `identified` frames is the axis, `tip` is the frame of {P}.

    Each frame is where the file has it relative to the one before, but for the motion that brings
    it to its identified axis. A turn about this axis and a shift along it are free. They are such
    that the next axis is where the file has it: an error of an encoder's zero thus stays in the
    origin of its own joint, and turns or shifts the link behind it as a whole.
    """
    at, placed = np.eye(4), list[Array]()
    for k, joint in enumerate(chain):
        at = at @ joint.origin
        if joint.kind:
            at = _bring_to_axis(at, joint, identified[len(placed)])
            target = _find_target(at, chain[k:], identified[len(placed) :], tip)
            at = target.turn_and_shift(at, joint)
            placed.append(at)
    return placed


def _find_target(
    frame: Array, chain: Sequence[Joint], identified: Sequence[Array], tip: Array
) -> Target:
    """Return where the link behind the first joint of a chain has to lead: to the next axis, or to
    the platform. A slide leads to the first axis that shows how far it is out."""
    ahead, following = np.eye(4), iter(identified[1:])
    for joint in chain[1:]:
        ahead = ahead @ joint.origin
        if joint.kind:
            target = Target.axis(ahead, joint, next(following))
            shown = target.counted @ frame[:3, :3] @ chain[0].axis
            if chain[0].kind == "R" or np.linalg.norm(shown) > MAX_PARALLEL_SINE:
                return target
    return Target.frame(ahead, tip)


@dataclass(frozen=True)
class Target:
    """Where a link has to lead: directions (3, n) and a point in the frame of its joint, where they
    belong in the base, and in which directions the point counts."""

    directions: Array
    point: Array
    wanted_directions: Array
    wanted_point: Array
    counted: Array

    @classmethod
    def axis(cls, ahead: Array, joint: Joint, identified: Array) -> Target:
        """Lead to the axis of a joint: to any point of one that turns, of a slide's to none."""
        u = identified[:3, 2]
        counted = np.eye(3) - np.outer(u, u) if joint.kind == "R" else np.zeros((3, 3))
        direction = (ahead[:3, :3] @ joint.axis)[:, None]
        return cls(direction, ahead[:3, 3], u[:, None], identified[:3, 3], counted)

    @classmethod
    def frame(cls, ahead: Array, tip: Array) -> Target:
        """Lead to the frame of the platform."""
        return cls(ahead[:3, :3], ahead[:3, 3], tip[:3, :3], tip[:3, 3], np.eye(3))

    def turn_and_shift(self, frame: Array, joint: Joint) -> Array:
        """Return the frame of a turning joint turned about its axis, and of any joint shifted along
        it, so that the link leads to the target as well as possible."""
        axis = frame[:3, :3] @ joint.axis
        found = list[tuple[float, Array]]()
        for start in QUARTER_TURNS if joint.kind == "R" else (0.0,):
            at = _screwed(frame, axis, start, 0.0)
            for _ in range(MAX_ITERATIONS):  # Gauss and Newton's method
                R = at[:3, :3]
                turned = np.append(
                    ARM_M * np.cross(axis, (R @ self.directions).T).ravel(),
                    self.counted @ np.cross(axis, R @ self.point),
                )
                shifted = np.append(np.zeros(self.directions.size), self.counted @ axis)
                # Nearly parallel axes do not show a shift, and nearly equal ones no turn either.
                turned *= joint.kind == "R" and np.linalg.norm(turned) > MAX_PARALLEL_SINE * ARM_M
                shifted *= np.linalg.norm(shifted) > MAX_PARALLEL_SINE
                J = np.column_stack([turned, shifted])
                turn, shift = -np.linalg.lstsq(J, self._error(at))[0]
                at = _screwed(at, axis, turn, shift)
                if max(abs(turn), abs(shift)) < CONVERGED:
                    break
            found.append((float(np.linalg.norm(self._error(at))), at))
        return min(found, key=lambda one: round(one[0], DIGITS))[1]

    def _error(self, frame: Array) -> Array:
        R, p = frame[:3, :3], frame[:3, 3]
        away = (R @ self.directions - self.wanted_directions).T.ravel()
        return np.append(ARM_M * away, self.counted @ (R @ self.point + p - self.wanted_point))


def _screwed(frame: Array, axis: Array, turn: float, shift: float) -> Array:
    """Return a frame turned about an axis through its origin and shifted along it."""
    found = frame.copy()
    found[:3, :3] = rotation_matrix(turn * axis) @ frame[:3, :3]
    found[:3, 3] += shift * axis
    return found


def _bring_to_axis(frame: Array, joint: Joint, identified: Array) -> Array:
    """Return the frame of a joint after the shortest motion to its identified axis."""
    axis, point = identified[:3, 2], identified[:3, 3]
    before, found = frame[:3, :3] @ joint.axis, frame.copy()
    normal, cosine = np.cross(before, axis), float(before @ axis)
    sine = float(np.linalg.norm(normal))
    if sine == 0 and cosine < 0:  # any normal
        normal = np.cross(before, np.eye(3)[np.argmin(np.abs(before))])
    length = float(np.linalg.norm(normal)) or 1.0
    found[:3, :3] = rotation_matrix(np.arctan2(sine, cosine) * normal / length) @ frame[:3, :3]
    if joint.kind == "R":
        found[:3, 3] = point + axis * (axis @ (frame[:3, 3] - point))
    return found
