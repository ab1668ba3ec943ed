"""Plane/spheres set-up: a tip slides on a plane or turns about holes in it (4.2.6, 5.4.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import cayley
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, point_on_platform, point_parameters


@dataclass(frozen=True)
class PlaneSpheres(Sensor):
    """No device: the closure is redundant because the tip stays on a plane or a sphere.

    The plane is z = `height` (m) of a frame that the parameters tilt and shift against {B};
    `holes` (m, in that plane) are the spheres' centres, `bars` the ball-bars' lengths (m).
    Its pose is fixed by default: the interface plane *defines* {B} (5.4.4). Free it with priors
    to keep another {B}. Without holes this is Hornick's plane alone.
    """

    height: float
    holes: tuple[tuple[float, float], ...] = ()
    bars: tuple[float, ...] = ()
    sigma: float = 15e-6
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fixed: tuple[str, ...] = ("*",)

    physics = (
        "a ball-ended tip slides on a flat plate, or a ball-bar ties the tip to a hole of the plate"
    )
    source = "thesis 4.2.6, 5.4.4; Hornick 91 (plane), Driels 91 (ball-bar)"

    def __post_init__(self) -> None:
        lengths = (self.sigma, *self.bars)
        if len(self.holes) != len(self.bars) or min(lengths) <= 0:
            raise ModelError(
                f"plane_spheres: {len(self.holes)} holes and {len(self.bars)} bars, sigma "
                f"{self.sigma} m, bars {self.bars} m; expected one bar for each hole and "
                "positive lengths"
            )

    @property
    def channels(self) -> tuple[str, ...]:
        return ("plane", *(f"sphere{i + 1}" for i in range(len(self.holes))))

    @property
    def contacts(self) -> Mapping[str, tuple[str, ...]]:
        return {channel: (channel,) for channel in self.channels}

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        plane = [
            Parameter("plane.z", "m", self.height, 1 * MM),
            *[Parameter(f"plane.{a}", "rad", 0.0, 0.5 * DEGREE) for a in ("rx", "ry")],
        ]
        spheres = [
            p
            for i, (hole, bar) in enumerate(zip(self.holes, self.bars, strict=True), 1)
            for p in (
                *point_parameters(f"hole{i}", (*hole, 0.0), 1 * MM),
                Parameter(f"bar{i}.length", "m", bar, 1 * MM),
            )
        ]
        return [*plane, *spheres, *point_parameters("tip", self.tip, 1 * MM)]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        """Return the distance of the tip from the plane and each sphere (m); 0 if constrained."""
        turn = cayley(ca.vertcat(s["plane.rx"], s["plane.ry"], 0))
        local = turn.T @ (point_on_platform(r, R, s) - ca.vertcat(0, 0, s["plane.z"]))
        spheres = [
            (ca.sumsqr(local - s.vector(*[f"hole{i}.{a}" for a in "xyz"])) - L**2) / (2 * L)
            for i in range(1, len(self.holes) + 1)
            for L in [s[f"bar{i}.length"]]
        ]
        return ca.vertcat(local[2], *spheres)
