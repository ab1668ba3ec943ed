"""Common parts of the Argos models: home, workspace, and starts of the direct problem."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rot_x, rot_y
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.drawing import Line, ring
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named

RADIUS = 110 * MM  # of the mock-up: distance of {p} from all three ball centres
# Home turns the platform by 109.5 degrees about (-1, 1, 0): ball 1 points to (1, -2, -2) / 3,
# between the motor axes 2 and 3, and the others likewise. As a rotation vector:
HOME_TURN = float(np.arccos(-1 / 3) / np.sqrt(2))
REACH = 30 * DEGREE
ARC = tuple(np.radians(np.arange(-60, 61, 10)).tolist())  # drawn part of a pantograph's circle


class Argos(Mechanism):
    """Three motors, three pantographs, one platform that turns."""

    joints = ("joint1", "joint2", "joint3")
    moves: tuple[str, ...] = ("rx", "ry", "rz")
    controls = ("rx", "ry", "rz")
    home = Home(joints=(0.0, 0.0, 0.0), quaternion=(-(3**-0.5), 3**-0.5, 0.0, 3**-0.5))
    workspace = Workspace(
        low=(-HOME_TURN - REACH, HOME_TURN - REACH, -REACH),
        high=(-HOME_TURN + REACH, HOME_TURN + REACH, REACH),
    )
    joint_limits = ((-80 * DEGREE, 80 * DEGREE),) * 3  # the pantographs move over 60 degrees

    def __init__(self, radius: float = RADIUS):
        self.length = float(radius)

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find the nominal model's four orientations, with the centre at home (section 6.7.2)."""
        return orientations(q, p)

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles of every motor, with the centre at home.

        See eqs 6.50-6.53, 6.62-6.63 and section 6.7.3.
        """
        return joint_angles(self, ca.DM(self.home.position), R, p)


def pantographs(circles: list[tuple[Any, ...]], r: Any, R: Any) -> list[Line]:
    """Draw circles (C, u, radius) with balls B in {p}: for each ball an arc of its circle and the
    pantograph to the ball; and the platform."""
    lines, balls = [], []
    for i, (C, u, radius, B) in enumerate(circles, start=1):
        ball, own = r + R @ B, f"chain{i}."
        out = (ball - C) / ca.norm_2(ball - C)
        across = ca.cross(u, out)
        arc = tuple(C + radius * (ca.cos(w) * out + ca.sin(w) * across) for w in ARC)
        lines += [
            Line("driven", arc, (f"{own}alpha0", f"{own}Omega", f"{own}Phi", f"{own}gamma")),
            Line("rod", (C, ball), tuple(own + name for name in ("R", "dR", "da", "dc"))),
        ]
        balls.append(ball)
    return [*lines, ring("platform", balls, "*.omega", "*.phi")]


def orientations(q: Any, p: Named) -> list[tuple[Any, Any]]:
    """Find all four regular solutions (eqs 6.43-6.49), with the centre at home.

    If R is one solution, the others are R diag(+-1) of determinant 1: the balls change to the
    opposite points of their circles. The factor sin(theta2) = 0 of eq. 6.47 gives four more poses
    with a ball on its motor axis. They are all singular and omitted.
    """
    a1, a2, a3 = (q[i] + p[f"chain{i + 1}"].alpha0 for i in range(3))  # eq. 6.41
    R = rot_x(a1) @ _platform_angles(a1, a2, a3)
    signs = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    return [(ca.DM.zeros(3), R @ ca.diag(ca.DM(s))) for s in signs]


def _platform_angles(a1: Any, a2: Any, a3: Any) -> Any:
    """Rot(y, theta2) Rot(x, theta3) from eqs 6.44-6.49.

    Both equations for theta3 have a factor that depends on a1 alone, sin a1 or cos a1, and are
    equal without it. Then theta3 has no jump where a factor changes its sign.
    """
    s, c = ca.sin, ca.cos
    C1 = -(c(a1) * s(a2) * c(a3) + s(a1) * c(a2) * s(a3))
    C2 = c(a2) * c(a3) - c(a1) * s(a1) * s(a2) * s(a3)
    m = ca.sqrt((s(a1) * s(a3)) ** 2 + c(a3) ** 2)
    k = ca.sqrt((c(a1) * s(a2)) ** 2 + c(a2) ** 2)
    return rot_y(ca.atan2(C1, -C2)) @ rot_x(ca.atan2(m * s(a2), -k * s(a3)))
