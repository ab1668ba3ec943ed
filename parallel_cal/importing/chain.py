"""The chain of a URDF's joints as DH and Hayati links.

Frames with z along the joints' axes follow table 3.5 along the chain, so that the parameters are
the same as those of an arm that was described by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, Protocol

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.model.mechanism import POSE, Mechanism
from parallel_cal.model.parameters import Named
from parallel_cal.recordings.recording import Array

MAX_PARALLEL_SINE = 0.1  # sine of the angle between axes below which they count as parallel
MAX_COINCIDENT_DISTANCE_M = 1e-3  # m between parallel axes below which they count as one
ROUNDING_TOLERANCE = 1e-13  # m or 1; smaller values are rounding errors
MIN_INDEPENDENT_MOTION = 1e-9  # m; below it, coordinates of the tool cannot be moved separately
N_CONFIGURATIONS = 50


class Step(Protocol):
    """A joint of the chain: its frame (4, 4) in the previous one, and its axis in its own."""

    @property
    def kind(self) -> str | None:
        """R, P, or None for a joint that does not move."""

    @property
    def origin(self) -> Array:
        """The frame at reading zero."""

    @property
    def axis(self) -> Array:
        """The direction of the axis, of length 1."""


def chain_links(joints: Sequence[Step]) -> list[dict[str, Any]]:
    """Return the numbers of every link of the mechanism `serial`.

    The first link has no joint and leads to the first axis; the last one leads to {P}.
    """
    at, links, kind = np.eye(4), list[dict[str, Any]](), None
    frame = np.eye(4)  # of the current joint, at reading zero
    for joint in joints:
        frame = frame @ joint.origin
        if joint.kind:
            step, at = _to_axis(at, frame[:3, 3], frame[:3, :3] @ joint.axis, joint.kind)
            links.append({"joint": kind, **step})
            kind = joint.kind
    return [*links, *_to_frame(at, frame, kind)]


def _to_axis(F: Array, p: Array, u: Array, kind: str) -> tuple[dict[str, Any], Array]:
    """Return the link from frame F to the axis through p along u, and the frame there."""
    offset, toward = F[:3, :3].T @ (p - F[:3, 3]), F[:3, :3].T @ u
    normal = np.array([-toward[1], toward[0], 0.0])  # z x u
    if np.linalg.norm(normal) > MAX_PARALLEL_SINE:
        return _perpendicular(F, offset, toward, normal / np.linalg.norm(normal), kind)
    foot = offset - toward * offset[2] / toward[2] if kind == "R" else np.zeros(3)
    a = float(np.hypot(*foot[:2]))
    polar = a > MAX_COINCIDENT_DISTANCE_M
    theta = float(np.arctan2(foot[1], foot[0])) if polar else 0.0
    x, y = np.cos(theta) * toward[:2] + np.sin(theta) * np.array([toward[1], -toward[0]])
    beta, alpha = float(np.arcsin(np.clip(x, -1, 1))), float(np.arctan2(-y, toward[2]))
    step: dict[str, Any] = {
        "axes": "parallel",
        "theta": theta,
        "a": a,
        "alpha": alpha,
        "beta": beta,
    }
    if kind == "R" and not polar:
        step |= {"axes": "coincident", "a": float(foot[0]), "b": float(foot[1])}
    return _remove_rounding(step), F @ _matrix(_remove_rounding(step))


def _perpendicular(
    F: Array, offset: Array, toward: Array, normal: Array, kind: str
) -> tuple[dict[str, Any], Array]:
    """Return the DH link: x is along the common normal, from this axis to the next one."""
    a = float(offset @ normal)
    if a < 0:
        normal, a = -normal, -a
    alpha = float(np.arctan2(np.cross([0.0, 0.0, 1.0], toward) @ normal, toward[2]))
    # d is the height at which the next axis is nearest to z.
    across = np.array([-normal[1], normal[0], 0.0])
    d = float(offset[2] - toward[2] * (offset @ across) / (toward @ across))
    step = {
        "axes": "perpendicular",
        "theta": float(np.arctan2(normal[1], normal[0])),
        "alpha": alpha,
    }
    if kind == "R":
        step |= {"d": d, "a": a}  # for a sliding joint only the direction counts
    return _remove_rounding(step), F @ _matrix(_remove_rounding(step))


def _to_frame(F: Array, P: Array, kind: str | None) -> list[dict[str, Any]]:
    """Return the last link; if {P}'s y-axis is nearly along z, a quarter turn comes before it."""
    first: list[dict[str, Any]] = []
    left = np.linalg.solve(F, P)
    if abs(left[2, 1]) > 0.9:
        quarter: dict[str, Any] = {"joint": kind, "free": [], "alpha": np.pi / 2}
        first, left, kind = [quarter], np.linalg.solve(_matrix(quarter), left), None
    alpha = float(np.arcsin(np.clip(left[2, 1], -1, 1)))
    theta = float(np.arctan2(-left[0, 1], left[1, 1]))
    beta = float(np.arctan2(-left[2, 0], left[2, 2]))
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    a, b = (turn @ left[:2, 3]).tolist()
    step = {"theta": theta, "d": float(left[2, 3]), "a": a, "b": b, "alpha": alpha, "beta": beta}
    return [*first, {"joint": kind, **_remove_rounding(step)}]


def _matrix(step: dict[str, Any]) -> Array:
    """Return Rz(theta) Tz(d) Tx(a) Ty(b) Rx(alpha) Ry(beta), (4, 4)."""
    theta, d, a, b, alpha, beta = (
        step.get(k, 0.0) for k in ("theta", "d", "a", "b", "alpha", "beta")
    )
    T = np.eye(4)
    T[:3, 3] = [a * np.cos(theta) - b * np.sin(theta), a * np.sin(theta) + b * np.cos(theta), d]
    about_y = rotation_from_rpy(np.array([0.0, beta, 0.0]))
    T[:3, :3] = (
        rotation_from_rpy(np.array([0, 0, theta]))
        @ rotation_from_rpy(np.array([alpha, 0, 0]))
        @ about_y
    )
    return T


def _remove_rounding(step: dict[str, Any]) -> dict[str, Any]:
    """Set values that are only rounding errors to zero."""
    return {
        k: 0.0 if isinstance(v, float) and abs(v) < ROUNDING_TOLERANCE else v
        for k, v in step.items()
    }


def rotation_from_rpy(rpy: Array) -> Array:
    """Return the rotation about the fixed x, then y, then z."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def motion_of(kind: str | None, axis: Array, position: float) -> Array:
    """Return the motion (4, 4) of a joint, R or P, from zero to a position."""
    T = np.eye(4)
    if kind == "P":
        T[:3, 3] = axis * position
    else:
        T[:3, :3] = rotation_matrix(axis * position)
    return T


def choose_controls(arm: Mechanism) -> tuple[str, ...]:
    """Return the coordinates that an arm can move independently.

    x, y and z come first if the arm can move all of them. The others are those that it moves best:
    a SCARA cannot turn about x, and a palletizer hardly.
    """
    drawn, J = _draw_motions(arm)
    joints, position = drawn.shape[1], (0, 1, 2)

    def least_motions(which: Sequence[int]) -> Array:
        """Return at each configuration how far the least movable combination moves, m."""
        return np.asarray(np.linalg.svd(J[:, which], compute_uv=False)[:, -1])

    moves_freely = joints >= 3 and np.median(least_motions(position)) > MIN_INDEPENDENT_MOTION
    first = position if moves_freely else ()
    for n in range(min(joints, 6), 0, -1):
        every = [which for which in combinations(range(6), n) if set(first) <= set(which)]
        least = {which: least_motions(which) for which in every}
        able = [which for which in every if np.median(least[which]) > MIN_INDEPENDENT_MOTION]
        if able:  # at home, and at unfavourable configurations
            best = max(able, key=lambda w: round(least[w][0] + np.quantile(least[w], 0.05), 9))
            return tuple(POSE[i] for i in best)
    return arm.controls


def choose_home(arm: Mechanism) -> tuple[float, ...]:
    """Return home, or if the arm is singular there, the nearest of many configurations within its
    limits that are far from singular.

    At a singular home, such as a stretched wrist, no joints follow from a small motion of the tool.
    """
    drawn, J = _draw_motions(arm)
    least = np.linalg.svd(J[:, list(arm.controlled)], compute_uv=False)[:, -1]
    if least[0] > MIN_INDEPENDENT_MOTION:
        return tuple(arm.home.joints)
    regular = drawn[least[1:] >= least[1:].max() / 2]
    away = np.linalg.norm(regular - np.array(arm.home.joints), axis=1)
    return tuple(round(float(value), 3) for value in regular[int(np.argmin(away))])


def _draw_motions(arm: Mechanism) -> tuple[Array, Array]:
    """Draw configurations (N, nq) within the limits, and the motions (1 + N, 6, nq)
    of the tool per motion of the joints at home and at these; angles times `length`, m."""
    q = ca.SX.sym("q", len(arm.joints))
    p = Named(arm.parameters.names, ca.DM(arm.parameters.nominal))
    r, R = arm.candidates(q, p)[0]  # an arm has one pose
    by_q = [ca.reshape(ca.jacobian(R, q[i]), 3, 3) @ R.T for i in range(q.numel())]
    turns = ca.horzcat(*[ca.vertcat(W[2, 1], W[0, 2], W[1, 0]) for W in by_q])
    motion = ca.Function("motion", [q], [ca.vertcat(ca.jacobian(r, q), arm.length * turns)])
    low, high = np.clip(np.array(arm.joint_limits, float).T, -np.pi, np.pi)
    drawn = np.random.default_rng(0).uniform(low, high, (N_CONFIGURATIONS, q.numel()))
    return drawn, np.array([np.array(motion(row)) for row in (arm.home.joints, *drawn)])
