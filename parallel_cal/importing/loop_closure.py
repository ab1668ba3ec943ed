"""Close the loops of a linkage: the values of its joints near those of the file."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from scipy.optimize import least_squares

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.importing.linkage import COORDINATES, Linkage, LinkageJoint
from parallel_cal.recordings.recording import Array

CLOSED = 1e-13  # m or rad
MAX_STEPS = 20
STEP = 1e-6  # m or rad, of numerical derivatives


def joint_motion(joint: LinkageJoint, values: Array) -> Array:
    """Return the frame (4, 4) of the child in that of the parent at some values."""
    moved = np.eye(4)
    if joint.kind == "spherical":
        for axis, value in zip(np.eye(3), values, strict=True):
            moved[:3, :3] = moved[:3, :3] @ rotation_matrix(axis * value)
    elif joint.kind == "prismatic":
        moved[:3, 3] = joint.axes[0] * values[0]
    elif joint.kind != "fixed":  # revolute or universal
        for axis, value in zip(joint.axes, values, strict=True):
            moved[:3, :3] = moved[:3, :3] @ rotation_matrix(axis * value)
    moved[:3, 3] += joint.anchor - moved[:3, :3] @ joint.anchor
    return joint.origin @ moved


def body_frames(linkage: Linkage, base: str, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return the frames (4, 4) of the bodies that joints reach from the base, nearest first."""
    frames, n = {base: np.eye(4)}, 0
    while n < len(frames):
        n = len(frames)
        for joint in linkage.joints:
            a, b = joint.parent in frames, joint.child in frames
            if a != b:
                moved = joint_motion(joint, values[joint.name])
                if a:
                    frames[joint.child] = frames[joint.parent] @ moved
                else:
                    frames[joint.parent] = frames[joint.child] @ np.linalg.inv(moved)
    return frames


def close_loops(
    linkage: Linkage, base: str, platform: str, still: Collection[str]
) -> tuple[dict[str, Array], dict[str, Array]] | None:
    """Return the values of all joints and the frames of all bodies where the loops close.

    `still` are joints whose value stays 0. None if the loops do not close near the file's values.
    """
    names = [joint.name for joint in linkage.joints if joint.name not in still]
    counts = [COORDINATES[joint.kind] for joint in linkage.joints if joint.name not in still]
    zero = {joint.name: np.zeros(COORDINATES[joint.kind]) for joint in linkage.joints}
    drawn = body_frames(linkage, base, zero)
    floats = platform not in drawn

    def configuration(x: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        parts = np.split(x, np.cumsum(counts))
        values = zero | dict(zip(names, parts[: len(names)], strict=True))
        frames = body_frames(linkage, base, values)
        if floats:
            pose = np.linalg.solve(linkage.poses[base], linkage.poses[platform])
            pose[:3, 3] += parts[-1][:3]
            pose[:3, :3] = rotation_matrix(parts[-1][3:]) @ pose[:3, :3]
            beyond = body_frames(linkage, platform, values)
            frames |= {name: pose @ frame for name, frame in beyond.items() if name not in frames}
        return values, frames

    def residual(x: Array) -> Array:
        values, frames = configuration(x)
        rows = [np.zeros(0)]
        for joint in linkage.joints:
            ahead = frames[joint.parent] @ joint_motion(joint, values[joint.name])
            rows.append(ahead[:3, 3] - frames[joint.child][:3, 3])
            rows.append(rotation_vector(ahead[:3, :3] @ frames[joint.child][:3, :3].T))
        for loop in linkage.loops:
            a, b = (frames[end.body] @ end.frame[:, 3] for end in (loop.a, loop.b))
            gap = (a - b)[:3]
            at_rest = loop.kind == "distance" and loop.length is not None
            rows.append(np.atleast_1d(np.linalg.norm(gap) - loop.length) if at_rest else gap)
        return np.concatenate(rows)

    n = sum(counts) + (6 if floats else 0)
    x = least_squares(residual, np.zeros(n), x_scale=1.0).x if n else np.zeros(0)
    for _ in range(MAX_STEPS):
        r = residual(x)
        if np.abs(r).max(initial=0.0) < CLOSED or not n:
            break
        J = np.array(
            [(residual(x + d) - residual(x - d)) / (2 * STEP) for d in STEP * np.eye(n)]
        ).T
        x = x - np.linalg.lstsq(J, r, rcond=1e-9)[0]
    return configuration(x) if np.abs(residual(x)).max(initial=0.0) < 1e3 * CLOSED else None
