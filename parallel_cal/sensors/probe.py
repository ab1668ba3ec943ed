"""A touch probe on the platform: its height above a flat plate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import cayley
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, point_on_platform, point_parameters


@dataclass(frozen=True)
class Probe(Sensor):
    """Height (m) of `tip` in {P} above the plate z = `height` of {B}, whose pose is unknown.

    The height is along the normal of the plate, or along z of {P} if the gauge is `mounted` on the
    platform. `sigma` (m) is the standard deviation of a reading; None if not stated.
    """

    height: float
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float | None = 2e-6
    mounted: bool = False
    fixed: tuple[str, ...] = ("tip.*",)

    physics = "a length gauge along the plate's normal"
    source = "thesis 4.3.2 (TESA GT130); Hornick 91"
    channels = ("probe",)

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("plate.z", "m", self.height, 1e-3),
            *[Parameter(f"plate.{a}", "rad", 0.0, 0.01) for a in ("rx", "ry")],
            *point_parameters("tip", self.tip, 1e-3),
        ]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        turn = cayley(ca.vertcat(s["plate.rx"], s["plate.ry"], 0))
        away = point_on_platform(r, R, s) - ca.vertcat(0, 0, s["plate.z"])
        upright = ca.dot(turn[:, 2], R[:, 2]) if self.mounted else 1
        return ca.dot(turn[:, 2], away) / upright
