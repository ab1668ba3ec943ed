"""RSSR loop of the short-cut set-up, 9 parameters (sections 4.2.7 and 5.4.5).

Two arms of a Delta, joined by one of its rods, make a loop with one degree of freedom. Encoder 1 is
the joint; encoder 2 is the measured pose: the loop's platform is the second arm, and {P} is {B}
turned about z by that encoder's reading. A short-cut recording therefore needs no measuring device.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Chains 1 and 2 of table 5.12: axes tangent to a circle of 76 + 24 mm, 120 degrees apart; they
# meet 173.2 mm from the arms, whose inner balls are 20 mm nearer. Encoder zero: arm horizontal.
CENTRE, BAR, ARM, ROD = 100 * MM, 20 * MM, 120 * MM, 240 * MM
BALL_SHIFT = CENTRE * np.tan(60 * DEGREE) - BAR
_reach = (ROD / 2 + BAR * np.cos(60 * DEGREE)) / np.sin(60 * DEGREE)  # both balls at home
ANGLE = float(np.arccos((_reach - CENTRE) / ARM))
BODIES = {"arms": ("*.r",), "rod": ("L",), "base": ("a", "*.s")}


class Rssr(Mechanism):
    """Spatial four-bar (revolute, spherical, spherical, revolute) for `parallel-cal short-cut`.

    It consists of two arms of a Delta that one rod connects. The z axis of {B} is the output axis,
    and x is the common normal, towards the input axis.

    `a` and `alpha` are the distance and the angle between the two axes. Each crank has an arm r, a
    shift s of its ball along the axis, and an encoder offset q0. L is the length of the rod. Angles
    alone do not determine the size: one length must be known, and a second one if the axes meet
    (a = 0), as in a Delta.
    """

    joints = ("input",)
    moves = ("rz",)
    controls = ("rz",)
    parameters = ParameterTable(
        [
            Parameter("a", "m", 0.0, 1 * MM, "axes", label="distance of the axes"),
            Parameter(
                "alpha", "rad", -120 * DEGREE, 0.5 * DEGREE, "axes", label="angle between the axes"
            ),
            Parameter("input.r", "m", ARM, 0.5 * MM, "arms", label="arm length"),
            Parameter(
                "input.s", "m", BALL_SHIFT, 1 * MM, "arms", label="arm's shift along its axis"
            ),
            Parameter("input.q0", "rad", -90 * DEGREE, 1 * DEGREE, "arms", label="encoder offset"),
            Parameter("output.r", "m", ARM, 0.5 * MM, "arms", label="arm length"),
            Parameter(
                "output.s", "m", -BALL_SHIFT, 1 * MM, "arms", label="arm's shift along its axis"
            ),
            Parameter("output.q0", "rad", -90 * DEGREE, 1 * DEGREE, "arms", label="encoder offset"),
            Parameter("L", "m", ROD, 0.5 * MM, "rod", label="rod length"),
        ]
    )
    fixed: tuple[str, ...] = ("L", "input.r")
    home = Home(joints=(ANGLE,), quaternion=(0.0, 0.0, np.sin(ANGLE / 2), np.cos(ANGLE / 2)))
    workspace = Workspace(low=(ANGLE - 55 * DEGREE,), high=(ANGLE + 55 * DEGREE,))
    joint_limits = ((-30 * DEGREE, 135 * DEGREE),)
    closed_forms = ("direct", "inverse")
    length = ARM
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute (|BC|^2 - L^2) / 2 L: length error of the rod, in metres."""
        C = ca.vertcat(p.a, 0, 0) + rot_x(p.alpha) @ rot_z(q[0]) @ self.ball(p.input)
        CB = R @ self.ball(p.output) - C
        return (ca.dot(CB, CB) - p.L**2) / (2 * p.L)

    @staticmethod
    def ball(crank: Named) -> Any:
        """Compute a crank's ball at reading zero; its axis is z."""
        return rot_z(crank.q0)[:, 0] * crank.r + ca.vertcat(0, 0, crank.s)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw both axes, their cranks and the rod between the cranks' balls."""
        to_input = rot_x(p.alpha)
        foot, along = ca.vertcat(p.a, 0, 0), to_input[:, 2]
        hub, own = foot + along * p.input.s, ca.vertcat(0, 0, p.output.s)
        C, B = foot + to_input @ rot_z(q[0]) @ self.ball(p.input), R @ self.ball(p.output)
        up = ca.DM([0, 0, 1])
        return [
            Line("base", (own, ca.DM.zeros(3), foot, hub), ("a", "alpha", "*.s")),
            axis(hub, along, BAR),
            axis(own, up, BAR),
            Line("driven", (hub, C), ("input.r", "input.q0")),
            Line("platform", (own, B), ("output.r", "output.q0")),
            Line("rod", (C, B), ("L",)),
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both output angles: the rod's ball meets the output circle twice (cf. eq. 6.24)."""
        turned = _OutputAsJoint(q)
        return [(ca.DM.zeros(3), rot_z(w)) for w in joint_angles(turned, None, None, p)[0]]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both input angles (eq. 6.24)."""
        return joint_angles(self, r, R, p)


def compute_parameters(input: Circle, output: Circle, rod: Any) -> Any:
    """Compute the nine parameters (9, 1) of a rod between balls on two circles, in table order.

    The common normal is directed so that alpha is between -pi and 0; the axes must not be parallel.
    """
    normal = ca.cross(input.axis, output.axis)
    x = normal / ca.norm_2(normal)
    alpha = ca.atan2(-ca.norm_2(normal), ca.dot(input.axis, output.axis))
    between = input.centre - output.centre
    # Position of each centre along its axis, from the foot of the common normal
    c, s2 = ca.cos(alpha), ca.sin(alpha) ** 2
    along_in, along_out = ca.dot(between, input.axis), ca.dot(between, output.axis)
    s_in, s_out = (along_in - c * along_out) / s2, (c * along_in - along_out) / s2
    cranks = [ca.vertcat(k.radius, s, k.angle_from(x)) for k, s in ((input, s_in), (output, s_out))]
    return ca.vertcat(ca.dot(between, x), alpha, *cranks, rod)


class Circle:
    """The circle of a ball on a crank, from the ball's position (3, 1) at 0, 90 and 180 degrees."""

    def __init__(self, start: Any, quarter: Any, half: Any):
        self.centre, self.arm = (start + half) / 2, (start - half) / 2
        self.radius = ca.norm_2(self.arm)
        self.axis = ca.cross(self.arm, quarter - self.centre) / self.radius**2

    def angle_from(self, x: Any) -> Any:
        """Angle (rad) about the axis from direction x, perpendicular to it, to the ball at zero."""
        return ca.atan2(ca.dot(self.arm, ca.cross(self.axis, x)), ca.dot(self.arm, x))


class _OutputAsJoint(Rssr):
    """The loop with the output angle as its joint: the direct problem becomes an inverse one."""

    def __init__(self, q: Any):
        self._q = q

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        return Rssr.closure(self, self._q, ca.DM.zeros(3), rot_z(q[0]), p)
