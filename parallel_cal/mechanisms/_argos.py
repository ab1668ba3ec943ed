"""The direct problem of the nominal Argos, where those of all its models start (section 6.7.2)."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_y
from parallel_cal.model.parameters import Named


def orientations(q: Any, p: Named) -> list[tuple[Any, Any]]:
    """All four regular solutions (eqs 6.43-6.49), the centre at rest.

    With one solution R, R diag(+-1) of determinant 1 are the others: the balls change to
    the opposite points of their circles. The factor sin(theta2) = 0 of eq. 6.47 gives four
    more poses with a ball on its motor axis, all singular; they are left out.
    """
    a1, a2, a3 = (q[i] + p[f"chain{i + 1}"].alpha0 for i in range(3))  # eq. 6.41
    R = rot_x(a1) @ _platform_angles(a1, a2, a3)
    signs = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    return [(ca.DM.zeros(3), R @ ca.diag(ca.DM(s))) for s in signs]


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
