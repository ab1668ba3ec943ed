"""Argos as its controller sees it: everything at right angles, 3 encoder offsets (table 3.18)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.mechanism import Mechanism
from parallel_cal.mechanisms.argos9 import Argos9
from parallel_cal.mechanisms.argos27 import RADIUS, angle_parameters
from parallel_cal.parameters import Named, ParameterTable
from parallel_cal.rotation import rot_x, rot_y
from parallel_cal.solvers.closed_form import joint_angles


class ArgosNominal(Mechanism):
    """Motor axes and directions to the balls are perpendicular (eq. 3.27)."""

    joints = Argos9.joints
    moves = Argos9.moves
    controls = Argos9.controls
    parameters = ParameterTable(p for p in Argos9.parameters if p.name.endswith(".alpha0"))
    home = Argos9.home
    workspace = Argos9.workspace
    joint_limits = Argos9.joint_limits

    def __init__(self, radius: float = RADIUS):
        self.length = float(radius)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Model 9's closure (eq. 3.26) with the angles of eq. 3.27."""
        return Argos9(self.length).closure(q, r, R, self._wide(p))

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """All four regular solutions (eqs 6.43-6.49), the centre at rest.

        With one solution R, R diag(+-1) of determinant 1 are the others: the balls change to
        the opposite points of their circles. The factor sin(theta2) = 0 of eq. 6.47 gives four
        more poses with a ball on its motor axis, all singular; they are left out.
        """
        a1, a2, a3 = (q[i] + p[f"chain{i + 1}"].alpha0 for i in range(3))  # eq. 6.41
        R = rot_x(a1) @ _platform_angles(a1, a2, a3)
        signs = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
        return [(ca.DM.zeros(3), R @ ca.diag(ca.DM(s))) for s in signs]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Both angles of every motor (eqs 6.50-6.52); home decides as eq. 6.53 does."""
        return joint_angles(self, r, R, p)

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 9 with right angles."""
        return "argos9", {**Argos9.parameters.mapping(Argos9.parameters.nominal), **values}

    @staticmethod
    def _wide(p: Named) -> Named:
        """Model 9's parameters: the encoder offsets as given, the rest by eq. 3.27."""
        right = {q.name: q.nominal for i in range(3) for q in angle_parameters(i)}
        offsets = {f"chain{i + 1}.alpha0": p[f"chain{i + 1}"].alpha0 for i in range(3)}
        return Named(tuple(right), [offsets.get(name, right[name]) for name in right])


def _platform_angles(a1: Any, a2: Any, a3: Any) -> Any:
    """Rot(y, theta2) Rot(x, theta3) from eqs 6.44-6.49.

    theta3 solves two equations that agree; where a1 vanishes both factors of the first one do,
    so the one with the larger factors is taken.
    """
    s, c = ca.sin, ca.cos
    C1 = -(c(a1) * s(a2) * c(a3) + s(a1) * c(a2) * s(a3))
    C2 = c(a2) * c(a3) - c(a1) * s(a1) * s(a2) * s(a3)
    t2 = ca.atan2(C1, -C2)
    m = (s(a1) * s(a2), c(t2) * c(a1) * s(a2) - s(t2) * c(a2))
    k = (s(t2) * c(a3) - c(t2) * s(a1) * s(a3), -c(a1) * s(a3))
    larger = m[0] ** 2 + m[1] ** 2 > k[0] ** 2 + k[1] ** 2
    t3 = ca.if_else(larger, ca.atan2(m[0], -m[1]), ca.atan2(k[0], -k[1]))
    return rot_y(t2) @ rot_x(t3)
