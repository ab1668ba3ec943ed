"""The short-cut set-up (4.2.7): two arms of a virtual Delta tied by one of its rods, no platform.

A ball is named as in figure 3.9: 12 is the second ball of arm 1, and 12 is also the rod that
belongs to it. A loop is wherever the tied balls are a rod's length apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.virtual import robot as vr

ORDER = ("11", "21", "31", "12", "22", "32")  # of Delta.joint_points and Delta.lengths
STOPS = np.radians([-30.0, 135.0])  # section 2.3.2

# Every ball and every rod is in the first six; all pairs of balls are in the twelve.
THREE = ("12:21:11", "22:31:21", "32:11:31")
SIX = (*THREE, "11:22:12", "21:32:22", "31:12:32")
TWELVE = (*SIX, "11:21:12", "21:31:22", "31:11:32", "12:22:11", "22:32:21", "32:12:31")

# 1 sigma of a real robot (mm, degrees), as a workshop would state it.
SPREAD = {
    **{"D_x": 1, "D_y": 1, "D_z": 1, "theta": 0.5, "alpha": 0.5, "La_x": 0.5, "La_y": 1},
    **{"Lb": 0.5, "dalpha": 0.5, "dbeta": 0.5, "dC_x": 0.1, "dC_y": 0.1, "dC_z": 0.1, "dLb": 0.1},
}


def random_delta(seed: int) -> vr.Delta:
    """A Delta each of whose 42 dimensions is off by its spread."""
    rng = np.random.default_rng([seed, 54])
    parameters = dict(vr.TABLE_5_12)
    for i in (1, 2, 3):
        for name, sigma in SPREAD.items():
            unit = np.pi / 180 if name in vr.ANGLES else 1e-3
            parameters[f"chain{i}.{name}"] += rng.normal() * sigma * unit
    return vr.Delta(parameters)


@dataclass(frozen=True)
class Tied:
    """Balls `one` and `other` of a Delta, held a rod's length apart."""

    robot: vr.Delta
    one: str
    other: str
    rod: str

    def joints(self, q: vr.Array, w: vr.Array) -> vr.Array:
        """All three arms (..., 3): the tied ones at q and w (...,), the third parked at zero."""
        joints = np.zeros((*np.broadcast_shapes(np.shape(q), np.shape(w)), 3))
        joints[..., int(self.one[0]) - 1] = q
        joints[..., int(self.other[0]) - 1] = w
        return joints

    def gap(self, q: vr.Array, w: vr.Array) -> vr.Array:
        """How far the rod is too short, metres."""
        balls = self.robot.joint_points(self.joints(q, w))
        apart = balls[..., ORDER.index(self.one), :] - balls[..., ORDER.index(self.other), :]
        return np.linalg.norm(apart, axis=-1) - self.robot.rods[ORDER.index(self.rod)]

    def places(self, n: int) -> vr.Array:
        """n places (n, 3) all over what the stops allow: where the gap changes sign on a grid,
        then by root finding."""
        q, w = np.linspace(*STOPS, 120), np.linspace(*STOPS, 120)
        closed = self.gap(q[:, None], w[None, :]) > 0
        i, j = np.nonzero(closed[:, 1:] != closed[:, :-1])
        some = np.round(np.linspace(0, len(i) - 1, n)).astype(int)
        first, start = q[i[some]], (w[j[some]] + w[j[some] + 1]) / 2
        found = vr.solve(lambda u: self.gap(first, u[:, 0])[:, None], start[:, None])
        return self.joints(first, found[:, 0])


def tied(robot: vr.Delta, loop: str) -> Tied:
    """`12:21:11`: ball 12 tied to ball 21 by rod 11."""
    return Tied(robot, *loop.split(":"))


def workspace(robot: vr.Delta, n: int = 100) -> tuple[vr.Array, vr.Array]:
    """Joints and positions of the whole robot all over its workspace."""
    low, high = (-0.06, -0.06, 0.14), (0.06, 0.06, 0.26)
    r = np.random.default_rng(1).uniform(low, high, (n, 3))
    return robot.inverse(r)[0], r


def moved_onto(r: vr.Array, truth: vr.Array) -> vr.Array:
    """Points (n, 3) moved as one body, so that they fit the truth best: {B} set aside (Kabsch)."""
    U, _, Vt = np.linalg.svd((r - r.mean(0)).T @ (truth - truth.mean(0)))
    turn = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return (r - r.mean(0)) @ turn + truth.mean(0)
