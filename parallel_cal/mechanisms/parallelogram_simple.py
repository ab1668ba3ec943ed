"""Plane parallelogram as its controller sees it: a bar (Savoure et al. 2006, eqs 34-38)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.mechanisms.parallelogram import NOMINAL, Parallelogram
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BODIES = {"rods": ("l",), "platform": ("h",)}


class ParallelogramSimple(Mechanism):
    """Ideal planar parallelogram: the platform does not tilt.

    A bar of length l carries the tool, which is h below its end.
    """

    joints = Parallelogram.joints
    moves = ("x", "y")
    controls = ("x",)
    parameters = ParameterTable(
        Parameter(name, *NOMINAL[key]) for name, key in (("q0", "q0"), ("l", "l1"), ("h", "h"))
    )
    fixed = ("h",)
    home = Parallelogram.home
    workspace = Parallelogram.workspace
    joint_limits = Parallelogram.joint_limits
    closed_forms = ("direct",)
    length = Parallelogram.length
    gravity = Parallelogram.gravity
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the errors of x = l sin(q + q0) (eq. 34) and of the height, in metres."""
        return r[:2] - self._tool(q, p)

    @staticmethod
    def _tool(q: Any, p: Named) -> Any:
        angle = q + p.q0
        return ca.vertcat(p.l * ca.sin(angle), -p.l * ca.cos(angle) - p.h)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the bar and the tool below its end."""
        end = r + ca.vertcat(0, p.h, 0)
        return [
            Line("driven", (ca.DM.zeros(3), end), ("q0", "l")),
            Line("platform", (end, r), ("h",)),
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        return [(ca.vertcat(self._tool(q, p), 0), ca.DM.eye(3))]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Solve eq. 35; the second solution has the bar on the other side of the pivot."""
        angle = ca.asin(ca.fmin(ca.fmax(r[0] / p.l, -1), 1))
        return [(angle - p.q0, ca.pi - angle - p.q0)]

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Widen to the complete mechanism with two equal rods."""
        equal = {"l1": values["l"], "l2": values["l"]}
        return "parallelogram", {"q0": values["q0"], "h": values["h"], **equal}
