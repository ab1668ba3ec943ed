"""Planar slider-crank, 3 parameters (section 5.3.2): the thesis' example for every method."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

A, B, X = 80 * MM, 50 * MM, 100 * MM  # eq. 5.8; the slider at home
BODIES = {"crank": ("a",), "rod": ("b",)}


class SliderCrank(Mechanism):
    """Slider-crank: a crank a with an encoder, a rod b, and a slider.

    The slider moves on the x axis, which passes through the axis of the crank.
    """

    joints = ("crank",)
    moves = ("x",)
    controls = ("x",)
    parameters = ParameterTable(
        [
            Parameter("a", "m", A, 0.2 * MM, label="crank length"),
            Parameter("b", "m", B, 0.2 * MM, label="rod length"),
            Parameter("q0", "rad", 0.0, 1 * DEGREE, label="encoder offset"),
        ]
    )
    home = Home(joints=(float(np.arccos((A**2 + X**2 - B**2) / (2 * A * X))),), position=(X, 0, 0))
    workspace = Workspace(low=(75 * MM,), high=(125 * MM,))
    joint_limits = ((0.0, 60 * DEGREE),)
    closed_forms = ("direct", "inverse")
    length = A
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute eq. 5.10 divided by 2 b: length error of the rod, in metres."""
        x = r[0]
        return (p.a**2 + x**2 - p.b**2 - 2 * p.a * x * ca.cos(q[0] + p.q0)) / (2 * p.b)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw crank, rod and the slider's axis."""
        origin, slide = ca.DM.zeros(3), ca.DM([2 * A, 0, 0])
        pin = p.a * ca.vertcat(ca.cos(q[0] + p.q0), ca.sin(q[0] + p.q0), 0)
        return [
            Line("base", (origin, slide)),
            Line("driven", (origin, pin), ("a", "q0")),
            Line("rod", (pin, r), ("b",)),
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both solutions of eq. 5.11."""
        foot, height = p.a * ca.cos(q[0] + p.q0), p.a * ca.sin(q[0] + p.q0)
        away = ca.sqrt(p.b**2 - height**2)
        return [(ca.vertcat(x, 0, 0), ca.DM.eye(3)) for x in (foot + away, foot - away)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both solutions of eq. 5.12."""
        x = r[0]
        angle = ca.acos((p.a**2 + x**2 - p.b**2) / (2 * p.a * x))
        return [(angle - p.q0, -angle - p.q0)]
