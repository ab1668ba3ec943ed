"""A telescoping ball-bar: one distance between a point of the base and one of the platform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, point_on_platform, point_parameters


@dataclass(frozen=True)
class BallBar(Sensor):
    """Distance (m) from `centre` in {B} to `tip` in {P}.

    The centre is identified. The zero error of the bar is identified if `offset` is free.
    """

    centre: tuple[float, float, float]
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float = 1e-6
    fixed: tuple[str, ...] = ("tip.*", "offset")

    physics = "a rod with a length gauge and a ball at either end ties the platform to the base"
    source = "Driels 91, in thesis 4.1"
    channels = ("ball_bar",)

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            *point_parameters("centre", self.centre, 1e-3),
            *point_parameters("tip", self.tip, 1e-3),
            Parameter("offset", "m", 0.0, 1e-4),
        ]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        away = point_on_platform(r, R, s) - s.vector("centre.x", "centre.y", "centre.z")
        return ca.norm_2(away) + s.offset
