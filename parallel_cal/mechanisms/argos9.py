"""Argos as a perfectly spherical robot, 9 parameters (section 3.5.4, table 3.16)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.mechanisms._argos import Argos, pantographs
from parallel_cal.mechanisms.argos27 import angle_parameters, widen_spherical
from parallel_cal.model.drawing import Line
from parallel_cal.model.parameters import Named, ParameterTable


class Argos9(Argos):
    """Argos as an ideal spherical robot, whose platform only rotates about a fixed centre.

    Each motor turns a plane through this centre. One ball of the platform lies in each plane:
    `u . R b = 0`. A parameter that a chain lacks is zero.

    - `u = Rx(Omega) Rz(Phi) Rx(q + alpha0) (0, 1, 0)` is the normal of the plane, in {B}.
    - `b = Rx(omega) (cos phi, sin phi, 0)` is the direction of the ball, in {P}.

    The option `radius` (m) only multiplies the closure equations, so that their residuals are in
    metres. It does not change any pose. The conversion to `argos27` uses it.
    """

    parameters = ParameterTable(p for i in range(3) for p in angle_parameters(i))
    closed_forms = ("inverse",)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute each ball's distance from its circle's plane (eq. 3.26 times radius), in m."""
        u, v = self.normals(q, p), self.balls(p)
        return self.length * ca.vertcat(*[ca.dot(u[i], R @ v[i]) for i in range(3)])

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the great circles, the balls on them and the platform."""
        both = zip(self.normals(q, p), self.balls(p), strict=True)
        circles = [(ca.DM.zeros(3), u, self.length, self.length * v) for u, v in both]
        return pantographs(circles, r, R)

    def normals(self, q: Any, p: Named) -> list[Any]:
        """Return u_i, the normals of the three pantograph planes in {b}."""
        one, two, three = (p[f"chain{i + 1}"] for i in range(3))
        S = (ca.DM.eye(3), rot_z(two.Phi), rot_x(three.Omega) @ rot_z(three.Phi))
        return [S[i] @ rot_x(q[i] + c.alpha0)[:, 1] for i, c in enumerate((one, two, three))]

    def balls(self, p: Named) -> list[Any]:
        """Return v_i, the directions to the three balls in {p}."""
        two, three = p["chain2"], p["chain3"]
        v3 = rot_x(three.omega) @ rot_z(three.phi)[:, 0]
        return [ca.DM([1, 0, 0]), rot_z(two.phi)[:, 0], v3]

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Widen to model 27 with all three circles on one sphere (eqs 3.24-3.25)."""
        return "argos27", widen_spherical(values, self.length)
