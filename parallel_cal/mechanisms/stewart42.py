"""Stewart platform with perfect ball joints, 42 parameters (section 3.3.2, eq. 3.8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.units import DEGREE
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BASE_RADIUS, PLATFORM_RADIUS, HEIGHT, RETRACTED = 0.25, 0.15, 0.3, 0.25  # m
# Joints come in pairs 20 degrees apart; each leg leads to the nearer pair of the platform.
BASE_ANGLES = (-10, 10, 110, 130, 230, 250)
PLATFORM_ANGLES = (-50, 50, 70, 170, 190, 290)


def ring(radius: float, degrees: tuple[float, ...]) -> np.ndarray:
    """Place points (n, 3) on a circle in the plane z = 0."""
    angles = np.radians(degrees)
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])


ENDS = {"B": "platform joint", "C": "base joint"}


def one_leg(leg: str, B: np.ndarray, C: np.ndarray, retracted: float) -> list[Parameter]:
    """Make the parameters of one leg: centres B in {P} and C in {B}, (3,) or (2,) m, and the length
    at reading zero."""
    balls = [
        Parameter(
            f"{leg}.{name}_{axis}",
            "m",
            float(value),
            1e-3,
            f"{name} balls",
            label=f"{ENDS[name]}'s {axis}",
        )
        for name, point in (("B", B), ("C", C))
        for axis, value in zip("xyz", point, strict=False)
    ]
    offset = Parameter(f"{leg}.L0", "m", retracted, 1e-3, "offset", label="length at reading zero")
    return [*balls, offset]


def leg_parameters(platform: np.ndarray, base: np.ndarray, retracted: float) -> ParameterTable:
    """Make the parameters of all six legs; centres B in {P} and C in {B} are (6, 3) m each."""
    pairs = enumerate(zip(platform, base, strict=True), start=1)
    return ParameterTable(p for i, (B, C) in pairs for p in one_leg(f"leg{i}", B, C, retracted))


PLATFORM, BASE = ring(PLATFORM_RADIUS, PLATFORM_ANGLES), ring(BASE_RADIUS, BASE_ANGLES)
# Length of all legs at home, rounded: the last bit of a norm depends on the machine.
LENGTH = round(float(np.linalg.norm(PLATFORM[0] + [0, 0, HEIGHT] - BASE[0])), 13)
BODIES = {"base": ("*.C_?",), "platform": ("*.B_?",), "legs": ("*.L0",)}


class Stewart42(Mechanism):
    """Stewart platform: six legs with measured lengths (6-SPS).

    Leg i connects the point B of the platform with the point C of the base (`legI.B_x`, `legI.C_x`,
    ...).

    In the nominal robot, these points form two flat hexagons. For another robot, change the nominal
    values in the model file.
    """

    joints = tuple(f"leg{i + 1}" for i in range(6))
    joint_unit = "m"
    parameters = leg_parameters(PLATFORM, BASE, RETRACTED)
    home = Home(joints=(LENGTH - RETRACTED,) * 6, position=(0.0, 0.0, HEIGHT))
    workspace = Workspace(
        low=(-0.04, -0.04, HEIGHT - 0.03, *(-10 * DEGREE,) * 3),
        high=(0.04, 0.04, HEIGHT + 0.03, *(10 * DEGREE,) * 3),
    )
    joint_limits = ((0.0, 0.2),) * 6
    closed_forms = ("inverse",)
    length = PLATFORM_RADIUS
    bodies = BODIES
    parts = ("leg",)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each leg, eq. 3.8 without the squares, in metres."""
        legs = [p[f"leg{i + 1}"] for i in range(6)]
        return ca.vertcat(*[self.span(r, R, c) - (q[i] + c.L0) for i, c in enumerate(legs)])

    @staticmethod
    def span(r: Any, R: Any, c: Named) -> Any:
        """Distance between the ball centres of one leg."""
        B, C = c.vector("B_x", "B_y", "B_z"), c.vector("C_x", "C_y", "C_z")
        return ca.norm_2(r + R @ B - C)

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the six legs' ends C in {B} and B in {P}, (3, 1) each, and their lengths."""
        legs = [p[f"leg{i + 1}"] for i in range(6)]
        C = [c.vector("C_x", "C_y", "C_z") for c in legs]
        B = [c.vector("B_x", "B_y", "B_z") for c in legs]
        return C, B, [q[i] + c.L0 for i, c in enumerate(legs)]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the legs."""
        C, B, _ = self.rods(q, p)
        return {"leg": [(c + r + R @ b) / 2 for c, b in zip(C, B, strict=True)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw both hexagons and the legs between them."""
        C, B, _ = self.rods(q, p)
        tops = [r + R @ b for b in B]
        legs = enumerate(zip(C, tops, strict=True), start=1)
        return [
            closed("base", C, "*.C_?"),
            *[Line("driven", ends, (f"leg{i}.L0",)) for i, ends in legs],
            closed("platform", tops, "*.B_?"),
        ]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: a leg's length is positive."""
        legs = [p[f"leg{i + 1}"] for i in range(6)]
        return [(self.span(r, R, c) - c.L0,) for c in legs]
