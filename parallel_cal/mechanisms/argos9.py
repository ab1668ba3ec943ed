"""Argos as a perfectly spherical robot, 9 parameters (section 3.5.4, table 3.16)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.mechanisms._argos import orientations
from parallel_cal.mechanisms.argos27 import (
    RADIUS,
    Argos27,
    angle_parameters,
    widened,
)
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, ParameterTable


class Argos9(Mechanism):
    """Three great circles turned by the motors; a ball of the platform lies on each.

    `radius` (m) only scales the closure to metres and widens into model 27.
    """

    joints = Argos27.joints
    moves = ("rx", "ry", "rz")
    controls = ("rx", "ry", "rz")
    parameters = ParameterTable(p for i in range(3) for p in angle_parameters(i))
    home = Argos27.home
    workspace = Argos27.workspace
    joint_limits = Argos27.joint_limits
    closed_forms = ("inverse",)

    def __init__(self, radius: float = RADIUS):
        self.length = float(radius)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Eq. 3.26 times the radius: each ball's distance from its circle's plane, in metres."""
        u, v = self.normals(q, p), self.balls(p)
        return self.length * ca.vertcat(*[ca.dot(u[i], R @ v[i]) for i in range(3)])

    def normals(self, q: Any, p: Named) -> list[Any]:
        """u_i: normals of the three pantograph planes in {b}."""
        one, two, three = (p[f"chain{i + 1}"] for i in range(3))
        S = (ca.DM.eye(3), rot_z(two.Phi), rot_x(three.Omega) @ rot_z(three.Phi))
        return [S[i] @ rot_x(q[i] + c.alpha0)[:, 1] for i, c in enumerate((one, two, three))]

    def balls(self, p: Named) -> list[Any]:
        """v_i: directions to the three balls in {p}."""
        two, three = p["chain2"], p["chain3"]
        v3 = rot_x(three.omega) @ rot_z(three.phi)[:, 0]
        return [ca.DM([1, 0, 0]), rot_z(two.phi)[:, 0], v3]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """The nominal model's four orientations, which lie near four of this model's eight."""
        return orientations(q, p)

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Both angles of every motor (eqs 6.62-6.63)."""
        return joint_angles(self, r, R, p)

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 27 with all three circles on one sphere (eqs 3.24-3.25)."""
        return "argos27", widened(values, self.length)
