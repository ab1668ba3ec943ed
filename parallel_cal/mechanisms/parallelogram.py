"""Plane parallelogram with every dimension free (Savoure et al. 2006, section III, eqs 39-69)."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

NOMINAL = {  # the paper's table 2: unit, nominal value, tolerance
    "q0": ("rad", 0.0, 0.5 * DEGREE),
    "a1_x": ("m", 125 * MM, 1 * MM),
    "a2_x": ("m", 125 * MM, 1 * MM),
    "a2_y": ("m", 0.0, 1 * MM),
    "b1_x": ("m", 125 * MM, 1 * MM),
    "b2_x": ("m", 125 * MM, 1 * MM),
    "b2_y": ("m", 0.0, 1 * MM),
    "l1": ("m", 950 * MM, 1 * MM),
    "l2": ("m", 950 * MM, 1 * MM),
    "h": ("m", 100 * MM, 1 * MM),
}
BODIES = {"base": ("a?_?",), "platform": ("b?_?", "h"), "rods": ("l?",)}


class Parallelogram(Mechanism):
    """Planar parallelogram with general dimensions.

    The joint drives the crank A1 B1. The other parts are the rod A2 B2, and the platform B1 B2 with
    the tool C below it.

    The x axis of {B} is along O A1, and y points up. The origin of {P} is C. q + q0 is the angle of
    the crank from the vertical; the platform hangs below. h belongs to the tool and is not
    identified.
    """

    joints = ("joint1",)
    moves = ("x", "y", "rz")
    controls = ("x",)
    parameters = ParameterTable(Parameter(name, *entry) for name, entry in NOMINAL.items())
    fixed = ("h", "a1_x", "b2_x", "b2_y")  # eqs 70-73: six of nine errors are identifiable
    home = Home(joints=(0.0,), position=(0.0, -1050 * MM, 0.0))
    workspace = Workspace(low=(-0.65,), high=(0.65,))
    joint_limits = ((-60 * DEGREE, 60 * DEGREE),)
    closed_forms = ("direct",)
    length = 125 * MM
    gravity = (0.0, -9.81, 0.0)  # y is up
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the errors of A1 B1 = l1 u (eqs 55, 61) and of |A2 B2| = l2, in metres."""
        A1, A2, B1, B2 = self._points(r[:2], R[:2, :2], p)
        angle = q + p.q0
        u = ca.vertcat(ca.sin(angle), -ca.cos(angle))
        rod = B2 - A2
        return ca.vertcat(B1 - A1 - p.l1 * u, (ca.dot(rod, rod) - p.l2**2) / (2 * p.l2))

    @staticmethod
    def _points(C: Any, R: Any, p: Named) -> tuple[Any, Any, Any, Any]:
        """A1, A2 on the base, B1, B2 on the platform, from the tool point C."""
        A1, A2 = ca.vertcat(-p.a1_x, 0), ca.vertcat(p.a2_x, p.a2_y)
        B1, B2 = ca.vertcat(-p.b1_x, p.h), ca.vertcat(p.b2_x, p.h + p.b2_y)
        return A1, A2, C + R @ B1, C + R @ B2

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw base, crank, rod, and the platform with its tool."""
        A1, A2, B1, B2 = (ca.vertcat(point, 0) for point in self._points(r[:2], R[:2, :2], p))
        return [
            Line("base", (A1, ca.DM.zeros(3), A2), ("a?_?",)),
            Line("driven", (A1, B1), ("q0", "l1")),
            Line("rod", (A2, B2), ("l2",)),
            Line("platform", (B1, B2, r, B1), ("b?_?", "h")),
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both assembly modes: parallelogram and antiparallelogram (eqs 42-52)."""
        return [self._assemble(q, p, sign) for sign in (1, -1)]

    def start(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Start at the parallelogram: B2 on the right of the line from B1 to A2, where sin > 0."""
        return self._assemble(q, p, 1)

    def _assemble(self, q: Any, p: Named, sign: int) -> tuple[Any, Any]:
        """Tool point and tilt at which B2 closes the loop on one side.

        w + R c is A2 B2, so 2 w . R c = l2^2 - w.w - c.c, a cosine of the tilt (eq. 50).
        (The printed G of eq. 48 has a superfluous h, as C is common to both sides of the loop;
        eq. 52 must end in gamma_p.)
        """
        angle = q + p.q0
        B1 = ca.vertcat(p.l1 * ca.sin(angle) - p.a1_x, -p.l1 * ca.cos(angle))
        w, c = B1 - ca.vertcat(p.a2_x, p.a2_y), ca.vertcat(p.b1_x + p.b2_x, p.b2_y)
        along = (p.l2**2 - ca.dot(w, w) - ca.dot(c, c)) / 2
        across = ca.sqrt(ca.dot(w, w) * ca.dot(c, c) - along**2)
        tilt = ca.atan2(w[1], w[0]) - ca.atan2(c[1], c[0]) + ca.atan2(sign * across, along)
        R = rot_z(tilt)
        C = B1 - R[:2, :2] @ ca.vertcat(-p.b1_x, p.h)
        return ca.vertcat(C, 0), R

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the simple mechanism's two angles (eq. 35)."""
        angle = ca.asin(ca.fmin(ca.fmax(r[0] / p.l1, -1), 1))
        return [(angle - p.q0, ca.pi - angle - p.q0)]

    def start_inverse(self, r: Any, R: Any, p: Named) -> Any:
        return self.joint_candidates(r, R, p)[0][0]
