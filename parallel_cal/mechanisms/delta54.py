"""Delta robot, complete calibration model with 54 parameters (table 3.10, eqs 3.9-3.12)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._delta import (
    POSITION,
    SizedDelta,
    chain_parameters,
    pair_errors,
    pair_lengths,
    rod_pairs,
)
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.model.drawing import Line, axis, ring
from parallel_cal.model.parameters import Named

PARALLELOGRAM = {  # set P1 (eq. 3.14): errors of the spatial parallelogram
    "dalpha": ("rad", 0.0, 0.5 * DEGREE, "arm bar's twist against the platform bar, about x"),
    "dbeta": ("rad", 0.0, 0.5 * DEGREE, "arm bar's twist against the platform bar, about y"),
    "dC_x": ("m", 0.0, 0.1 * MM, "difference of the arm's ball positions along the arm"),
    "dC_y": ("m", 0.0, 0.1 * MM, "difference of the arm's ball positions across the arm"),
    "dC_z": ("m", 0.0, 0.1 * MM, "difference of arm's and platform's bar length"),
    "dLb": ("m", 0.0, 0.1 * MM, "difference of the two rods' lengths"),
}
PLATFORM = {  # set P2 (eq. 3.15): size of the platform, nearly unobservable, fixed by default
    "d_z": ("m", 20 * MM, 0.2 * MM, "half length of the platform bar"),
    "b_x": ("m", 24 * MM, 0.2 * MM, "platform balls' distance from the centre"),
    "b_y": ("m", 0.0, 0.2 * MM, "platform balls' height"),
    "b_z": ("m", 0.0, 0.2 * MM, "platform balls' shift along the bar"),
}
GROUPS = {"position": POSITION, "P1": PARALLELOGRAM, "P2": PLATFORM}
# The chains depend on the difference D of base and platform, so these are one body of one material.
BODIES = {"arms": ("*.La_?",), "rods": ("*.Lb", "*.dLb"), "base": ("*.D_?", "*.b_?")}


def rotation_as_matrix(v: Any) -> Any:
    """Write Rot(z, q) v as a matrix times (cos q, sin q, 1): eqs 6.28 and 6.29."""
    x, y, z = v[0], v[1], v[2]
    return ca.vertcat(ca.horzcat(x, -y, 0), ca.horzcat(y, x, 0), ca.horzcat(0, 0, z))


class Delta54(SizedDelta):
    """Delta robot with three arms and six rods, each with its own length and end points.

    Position and orientation of the platform vary.

    A chain has two rods, s = 1 and s = -1. Each gives one equation, `|r + R B - C| = Lb + s dLb`,
    with its end B on the platform (in {P}) and C on the arm (in {B}).

    - `B = T (b + s d)` and `C = T (b + D) + M s d + M Rz(q) (La + s dC)`.
    - `T = Rz(theta) Rx(alpha)` and `M = T Rx(dalpha) Ry(dbeta)`: x of the chain points outwards,
      and z is parallel to the motor axis.
    - b, D and dC are the vectors of the parameters `b_x, b_y, b_z` and so on.
      `La = (La_x, La_y, 0)` and `d = (0, 0, d_z)`.

    Options: `base`, `platform`, `arm`, `rod`, `direction`, `home`, `below` and `limits`, the size
    of the robot in m and rad. `base` and `platform` are the distances of the motor axes and of the
    rods' joints on the platform from the centre (0.1 and 0.024), `arm` and `rod` the lengths (0.12
    and 0.24). `direction` is that of the first motor about z, measured from x (0); the others
    follow at 120 and 240 degrees. `home` is the angle of all arms at home, positive towards +z
    (0.535). With `below: true` the platform is on the -z side of the arms: a hanging robot with z
    up (then `home` is -0.535). `limits` are those of the angles (-0.52 to 2.36, or -2.36 to 0.52
    with `below`). With any of them, the motors lie in the plane z = 0, and home and workspace
    follow from the size. Without options, the robot is that of table 5.12.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    parameters = chain_parameters(GROUPS)
    fixed = tuple(f"*.{name}" for name in PLATFORM)
    bodies = BODIES
    parts = ("arm", "rod")

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute mean and half difference of each pair's two rods (eq. 3.12), in metres."""
        return pair_errors(self.rods(q, p), r, R, p)

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the rods' ends C in {B} and B in {P}, (3, 1) each, and lengths (eq. 3.9)."""
        chains = [self.rod_pair(q[i], p[f"chain{i + 1}"]) for i in range(3)]
        C, B, L = zip(*[rod for pair in chains for rod in pair], strict=True)
        return list(C), list(B), list(L)

    @staticmethod
    def rod_pair(angle: Any, c: Named) -> list[tuple[Any, Any, Any]]:
        """Compute both rods of one chain: C on the arm, B on the platform, length (table 3.10)."""
        T = rot_z(c.theta) @ rot_x(c.alpha)
        motor = T @ (rot_x(c.dalpha) @ rot_y(c.dbeta))
        b, D = c.vector("b_x", "b_y", "b_z"), c.vector("D_x", "D_y", "D_z")
        La, dC = ca.vertcat(c.La_x, c.La_y, 0), c.vector("dC_x", "dC_y", "dC_z")
        d, turn = ca.vertcat(0, 0, c.d_z), ca.vertcat(ca.cos(angle), ca.sin(angle), 1)

        def rod(side: int) -> tuple[Any, Any, Any]:
            # The factors of `turn` depend on the parameters alone: computed once per model.
            C = T @ (b + D) + side * motor @ d + motor @ rotation_as_matrix(La + side * dC) @ turn
            return C, T @ (b + side * d), c.Lb + side * c.dLb

        return [rod(1), rod(-1)]

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw motor axes, arms, bars, six rods and the platform."""
        rods, chains = self.rods(q, p), [p[f"chain{i + 1}"] for i in range(3)]
        hubs, lines = [self._hub(c) for c in chains], []
        for i, (hub, c) in enumerate(zip(hubs, chains, strict=True), start=1):
            bar = rods[0][2 * i - 2 : 2 * i]
            along, own = (rot_z(c.theta) @ rot_x(c.alpha))[:, 2], f"chain{i}."
            lines += [
                axis(hub, along, self.length, f"{own}theta", f"{own}alpha"),
                Line("driven", (hub, (bar[0] + bar[1]) / 2), (f"{own}La_x", f"{own}La_y")),
            ]
        return [ring("base", hubs, "*.D_?"), *lines, *rod_pairs(rods, r, R)]

    def rod_lengths(self, p: Named) -> list[Any]:
        return pair_lengths(p)

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of arms and rods."""
        C, B, _ = self.rods(q, p)
        rods = [(c + r + R @ b) / 2 for c, b in zip(C, B, strict=True)]
        balls = [(one + other) / 2 for one, other in zip(C[::2], C[1::2], strict=True)]
        arms = [(self._hub(p[f"chain{i + 1}"]) + ball) / 2 for i, ball in enumerate(balls)]
        return {"arm": arms, "rod": rods}

    @staticmethod
    def _hub(c: Named) -> Any:
        b, D = c.vector("b_x", "b_y", "b_z"), c.vector("D_x", "D_y", "D_z")
        return rot_z(c.theta) @ rot_x(c.alpha) @ (b + D)

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find model 24's two positions, with a parallel platform (section 6.4.1)."""
        return Delta24().candidates(q, p)

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find model 24's two angles of each joint (section 6.4.1)."""
        return Delta24().joint_candidates(r, R, p)
