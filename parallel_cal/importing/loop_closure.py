"""Close the loops of a linkage: the values of its joints near those of the file."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.importing.linkage import COORDINATES, Linkage, LinkageJoint

Array = np.ndarray

CLOSED = 1e-13  # m or rad
MAX_STEPS = 100
MAX_STEP = 0.1  # rad or m
STEP = 1e-6  # m or rad, of numerical derivatives
MIN_SHARE = 1e-7  # of the largest singular value; smaller ones are errors of the derivatives


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
            if loop.kind == "distance":
                gap = np.atleast_1d(np.linalg.norm(gap) - (loop.length or 0.0))
            rows.append(gap)
        return np.concatenate(rows)

    n = sum(counts) + (6 if floats else 0)
    if not n:
        return configuration(np.zeros(0))

    def jacobian(x: Array) -> Array:
        steps = STEP * np.eye(n)
        return np.array([(residual(x + d) - residual(x - d)) / (2 * STEP) for d in steps]).T

    U, size, _ = np.linalg.svd(jacobian(np.zeros(n)), full_matrices=False)
    reachable = U[:, size > MIN_SHARE * size.max(initial=0.0)]
    x = np.zeros(n)
    for _ in range(MAX_STEPS):  # the shortest steps, so that it ends near the file's values
        step = np.linalg.lstsq(jacobian(x), residual(x), rcond=MIN_SHARE)[0]
        x = x - step * min(1.0, MAX_STEP / max(np.abs(step).max(), CLOSED))
        if np.abs(step).max() < CLOSED:
            break
    left = residual(x)
    # What leaves the plane of a plane mechanism cannot be closed, and need not be.
    allowed = max(0.1 * float(np.linalg.norm(left)), 1e3 * CLOSED)
    closes = np.linalg.norm(reachable.T @ left) < allowed
    return configuration(x) if closes else None
