"""Planar Stewart platform, 18 parameters (figure 3.2, eq. 3.4)."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rot_z
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms.stewart42 import one_leg, ring
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BASE_RADIUS, PLATFORM_RADIUS, RETRACTED = 0.3, 0.08, 0.15  # m
BASE_ANGLES, PLATFORM_ANGLES = (0, 120, 240), (30, 150, 270)  # turned: no leg points at the centre

PLATFORM = ring(PLATFORM_RADIUS, PLATFORM_ANGLES)[:, :2]
BASE = ring(BASE_RADIUS, BASE_ANGLES)[:, :2]
TURNS = np.radians(np.arange(0, 360, 10))  # close enough to find all six poses
LENGTH = float(np.linalg.norm(PLATFORM[0] - BASE[0]))  # of all legs, at home


BODIES = {"base": ("*.C_?",), "platform": ("*.B_?",), "legs": ("*.L0",)}


class PlanarStewart(Mechanism):
    """Planar platform with three legs; the joint readings are the extensions of the legs.

    L0 is the length of a leg at reading zero. delta is the angle between the leg and its sliding
    axis. The length depends on the square of delta, so no measurement determines a delta near zero:
    it is fixed by default.
    """

    joints = ("leg1", "leg2", "leg3")
    joint_unit = "m"
    moves = ("x", "y", "rz")
    controls = ("x", "y", "rz")
    parameters = ParameterTable(
        parameter
        for i, leg in enumerate(joints)
        for parameter in (
            *one_leg(leg, PLATFORM[i], BASE[i], RETRACTED),
            Parameter(
                f"{leg}.delta",
                "rad",
                0.0,
                0.5 * DEGREE,
                "misalignment",
                label="actuator's misalignment",
            ),
        )
    )
    fixed = ("*.delta",)
    home = Home(joints=(LENGTH - RETRACTED,) * 3)
    workspace = Workspace(low=(-0.05, -0.05, -20 * DEGREE), high=(0.05, 0.05, 20 * DEGREE))
    joint_limits = ((0.0, 0.2),) * 3
    length = PLATFORM_RADIUS
    bodies = BODIES

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the distance of each leg's joint centres minus its length, in metres."""
        legs = [p[f"leg{i + 1}"] for i in range(3)]
        return ca.vertcat(
            *[self.span(r, R, c) - self.leg_length(q[i], c) for i, c in enumerate(legs)]
        )

    @staticmethod
    def span(r: Any, R: Any, c: Named) -> Any:
        """Distance between the joint centres of one leg (the plane's part of eq. 3.8)."""
        B, C = ca.vertcat(c.B_x, c.B_y, 0), ca.vertcat(c.C_x, c.C_y, 0)
        return ca.norm_2((r + R @ B - C)[:2])

    @staticmethod
    def leg_length(q: Any, c: Named) -> Any:
        """|L0 + q exp(i delta)|: the slide is misaligned with the leg by delta."""
        return ca.sqrt(c.L0**2 + q**2 + 2 * c.L0 * q * ca.cos(c.delta))

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw both triangles and the legs between them."""
        legs = [p[f"leg{i + 1}"] for i in range(3)]
        C = [ca.vertcat(c.C_x, c.C_y, 0) for c in legs]
        tops = [r + R @ ca.vertcat(c.B_x, c.B_y, 0) for c in legs]
        between = enumerate(zip(C, tops, strict=True), start=1)
        return [
            closed("base", C, "*.C_?"),
            *[Line("driven", ends, (f"leg{i}.L0", f"leg{i}.delta")) for i, ends in between],
            closed("platform", tops, "*.B_?"),
        ]

    def start(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Return home."""
        return super().candidates(q, p)[0]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find the position of the platform for orientations in steps of 10 degrees.

        With m_i = R B_i - C_i, |r + m_i|^2 = l_i^2; the difference of two legs is linear in r.
        """
        legs = [p[f"leg{i + 1}"] for i in range(3)]
        lengths = ca.vertcat(*[self.leg_length(q[i], c) for i, c in enumerate(legs)])
        return [(self._position(rot_z(turn), lengths, legs), rot_z(turn)) for turn in TURNS]

    @staticmethod
    def _position(R: Any, lengths: Any, legs: list[Named]) -> Any:
        turned = [R[:2, :2] @ ca.vertcat(c.B_x, c.B_y) for c in legs]
        m = [B - ca.vertcat(c.C_x, c.C_y) for B, c in zip(turned, legs, strict=True)]
        (a, b), (c, d) = ((2 * (m[i] - m[0])).elements() for i in (1, 2))
        g, h = (
            lengths[i] ** 2 - lengths[0] ** 2 - ca.sumsqr(m[i]) + ca.sumsqr(m[0]) for i in (1, 2)
        )
        return ca.vertcat(d * g - b * h, a * h - c * g, 0) / (a * d - b * c)

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the longer of the two extensions at which a leg has its length."""
        legs = [p[f"leg{i + 1}"] for i in range(3)]
        return [(self._reading(self.span(r, R, c), c),) for c in legs]

    @staticmethod
    def _reading(span: Any, c: Named) -> Any:
        aside = c.L0 * ca.sin(c.delta)
        return ca.sqrt(span**2 - aside**2) - c.L0 * ca.cos(c.delta)
