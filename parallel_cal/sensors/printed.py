"""A measured printed part: the positions of its ends along x and y."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.base.errors import ModelError
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor


@dataclass(frozen=True)
class Printed(Sensor):
    """Position of {P} `along` x, y or both (`xy`) of {B}, from the middle of a printed part (m).

    The middle is identified: an end is half the measured length away from it.
    """

    along: str = "x"
    sigma: float = 20e-6

    relative = True
    physics = "a printed length between two faces, measured with a caliper or micrometer"
    source = "calipers 20-30 um over 150 mm (ISO 13385-1)"

    def __post_init__(self) -> None:
        if self.along not in ("x", "y", "xy"):
            raise ModelError(f"printed: along is {self.along!r}, expected x, y or xy")

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(f"printed_{axis}" for axis in self.along)

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter(f"middle.{axis}", "m", 0.0, 1e-3) for axis in self.along]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        return ca.vertcat(*(r["xy".index(axis)] - s[f"middle.{axis}"] for axis in self.along))
