"""Measured distances between pairs of positions on the bed, as on a printed test object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor


@dataclass(frozen=True)
class Distances(Sensor):
    """Position of {P} along each of some `directions` (rad about z of {B}), at both ends (m).

    Each channel is one distance, with a reading at either end: the expected middle of both ends
    along the direction, minus or plus half the measured distance. How far the true middle is from
    the expected one is identified, so only the difference of the two readings measures anything.
    `sigma` is that of one end: 1/sqrt(2) of the standard deviation of a distance. A distance whose
    ends are turned by an angle a against its direction is taken too long by a^2/2 of itself: 1 um
    of 70 mm at 5 mrad.
    """

    directions: tuple[float, ...]
    sigma: float = 20e-6

    relative = True
    physics = "distances between walls of one printed object, measured with a caliper"
    source = "calipers 20-30 um over 150 mm (ISO 13385-1)"

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(f"distance{k}" for k in range(len(self.directions)))

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter(f"middle{k}", "m", 0.0, 1e-3) for k in range(len(self.directions))]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        along = [ca.cos(a) * r[0] + ca.sin(a) * r[1] for a in self.directions]
        return ca.vertcat(*(x - s[f"middle{k}"] for k, x in enumerate(along)))
