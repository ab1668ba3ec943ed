"""Delta robot as its controller sees it: one radius, one arm, one rod length (table 3.12)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.mechanisms._delta import DEGREE, MM
from parallel_cal.mechanisms.delta24 import Delta24
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BODIES = {"arms": ("La",), "rods": ("Lb",), "base": ("R",)}


class DeltaNominal(Mechanism):
    """Three equal chains at theta_i; R is the base radius minus the platform radius."""

    joints = ("joint1", "joint2", "joint3")
    moves = ("x", "y", "z")
    controls = ("x", "y", "z")
    parameters = ParameterTable(
        [
            *[
                Parameter(
                    f"chain{i + 1}.theta",
                    "rad",
                    i * 120 * DEGREE,
                    0.5 * DEGREE,
                    label="chain's direction about z",
                )
                for i in range(3)
            ],
            Parameter("R", "m", 76 * MM, 1 * MM, label="base radius less platform radius"),
            Parameter("La", "m", 120 * MM, 0.5 * MM, label="arm length"),
            Parameter("Lb", "m", 240 * MM, 0.5 * MM, label="rod length"),
        ]
    )
    home = Home(joints=(30.65 * DEGREE,) * 3, position=(0.0, 0.0, 0.22078))
    workspace = Workspace(low=(-0.06, -0.06, 0.155), high=(0.06, 0.06, 0.275))
    joint_limits = Delta24.joint_limits
    closed_forms = ("direct", "inverse")
    length = Delta24.length
    bodies = BODIES
    parts = Delta24.parts

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Model 24's closure (eq. 3.16) with the numbers of table 3.12."""
        return Delta24().closure(q, r, R, self._wide(p))

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        return Delta24().candidates(q, self._wide(p))

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        return Delta24().joint_candidates(r, R, self._wide(p))

    def rod_lengths(self, p: Named) -> list[Any]:
        return Delta24().rod_lengths(self._wide(p))

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        return Delta24().centres(q, r, R, self._wide(p))

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Model 24 with equal chains."""
        p = Named(list(values), list(values.values()))
        return "delta24", dict(zip(Delta24.parameters.names, self._entries(p), strict=True))

    def _wide(self, p: Named) -> Named:
        return Named(Delta24.parameters.names, ca.vertcat(*self._entries(p)))

    @staticmethod
    def _entries(p: Named) -> list[Any]:
        """Model 24's parameters, chain by chain: D_x D_y D_z theta alpha La_x La_y Lb."""
        return [
            entry
            for i in range(3)
            for entry in (p.R, 0, 0, p[f"chain{i + 1}.theta"], np.pi / 2, p.La, 0, p.Lb)
        ]
