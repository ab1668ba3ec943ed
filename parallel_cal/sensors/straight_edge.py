"""A straight edge or a plumb line: the tip touches it at many points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import cayley
from parallel_cal.base.units import DEGREE
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, point_on_platform, point_parameters
from parallel_cal.sensors._places import check_axes, check_touch, spread_places, workspace_radius


@dataclass(frozen=True)
class StraightEdge(Sensor):
    """Distances (m) of the point `tip` of {P} from a straight line, across it: zero on the line.

    `direction` is the rough direction of the line in {B}, and `place` (m) a point near it, by
    default the middle of the workspace. The line is identified: two shifts across it and two turns.
    If it is a `plumb` line, `direction` is exact, and only the shifts are identified. `axes` are xy
    for a robot that moves in this plane: there is one shift, and at most one turn.
    """

    direction: tuple[float, float, float] = (1.0, 0.0, 0.0)
    place: tuple[float, float, float] | None = None
    plumb: bool = False
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: str = "xyz"
    sigma: float | None = 20e-6
    name: str = "edge"
    fixed: tuple[str, ...] = ("tip.*",)

    physics = "the tip touches one straight edge, or a stretched or hanging line, at many points"
    source = "straight edges of grade 1: 4-10 um over 0.5 m (DIN 874-1)"
    guessed_sigma = 20e-6

    def __post_init__(self) -> None:
        check_touch(self, self.axes)
        if not np.linalg.norm(self.direction) > 0 or self.axes not in ("xyz", "xy"):
            raise ModelError(
                f"{self.name}: direction {self.direction}, axes {self.axes}: expected a direction "
                "that is not zero, and axes xyz or xy"
            )
        if self.axes == "xy" and self.direction[2] != 0:
            raise ModelError(f"{self.name}: direction {self.direction} leaves the plane x-y")

    @property
    def _across(self) -> np.ndarray:
        """Unit vectors (k, 3) across the line."""
        d = np.array(self.direction) / np.linalg.norm(self.direction)
        helper = np.eye(3)[2 if abs(d[2]) < 0.9 else 0]
        first = np.cross(helper, d) / np.linalg.norm(np.cross(helper, d))
        return np.stack([first, np.cross(d, first)])[: 1 if self.axes == "xy" else 2]

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}.across{k + 1}" for k in range(len(self._across)))

    @property
    def contacts(self) -> Mapping[str, tuple[str, ...]]:
        return {self.name: self.channels}

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        check_axes(self, self.axes, mechanism)
        [place] = [self.place] if self.place else spread_places(mechanism, 1, self.tip)
        radius, n = workspace_radius(mechanism), len(self._across)
        return [
            *[
                Parameter(f"shift{k + 1}", "m", float(np.dot(a, place)), radius)
                for k, a in enumerate(self._across)
            ],
            *[
                Parameter(f"turn{k + 1}", "rad", 0.0, 5 * DEGREE)
                for k in range(0 if self.plumb else n)
            ],
            *point_parameters("tip", self.tip, 1e-3),
        ]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        """Turn k inclines the line towards its direction across k."""
        across = self._across
        ball = point_on_platform(r, R, s)
        d = np.array(self.direction) / np.linalg.norm(self.direction)
        away = [ca.dot(ca.DM(a), ball) - s[f"shift{k + 1}"] for k, a in enumerate(across)]
        if self.plumb:
            return ca.vertcat(*away)
        # A point of the line is at the shifts where it passes the middle of the workspace's plane.
        w = sum(s[f"turn{k + 1}"] * ca.DM(np.cross(d, a)) for k, a in enumerate(across))
        back = cayley(w).T
        off = sum(x * ca.DM(a) for x, a in zip(away, across, strict=True))
        local = back @ (off + ca.dot(ca.DM(d), ball) * ca.DM(d))
        return ca.vertcat(*(ca.dot(ca.DM(a), local) for a in across))
