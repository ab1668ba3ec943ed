"""A plate that is not flat: touched points are above or below its mean plane."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._touches import Touch
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import point_on_platform

# Powers of x and y, of second and third order. Height and tilt of the plate belong to the sensor.
POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
SIZE = {2: ("1/m", 10e-3, 0.1), 3: ("1/m^2", 0.1, 1.0)}  # tolerance and upper bound of plates


class BedShape(Touch):
    """r_ideal = r - z * sum of h_ij x^i y^j over 2 <= i + j <= 3, (x, y) of the tip in {B}.

    h_xx (1/m) to h_yyy (1/m^2): where this plate is higher than a flat plate, the tip is nearer to
    it. Wrong radii or rods of a Delta curve its measured plane as well.
    """

    physics = (
        "A bed of glass or sheet metal that is clamped at its rim and heated becomes domed "
        "or saddle-shaped."
    )
    remedy = "level or replace the bed; a mesh of its heights corrects the bed, not the robot"
    source = "printers' beds 0.1-0.3 mm over 200 mm; ground plates 5 um (ISO 8512)"
    lookalikes = ("probe_offset", "encoder_gain", "encoder_eccentricity")
    separated_by = "the plate rotated by 90 degrees, or a second plate"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        sizes = [(i, j, *SIZE[i + j]) for i, j in POWERS]
        return [
            Parameter(f"h_{'x' * i}{'y' * j}", unit, 0.0, tolerance, low=-most, high=most)
            for i, j, unit, tolerance, most in sizes
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if {"x", "y"} <= {*mechanism.moves} else "the platform does not move over a plate"

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        tip = point_on_platform(r, R, s)
        height = sum(e[f"h_{'x' * i}{'y' * j}"] * tip[0] ** i * tip[1] ** j for i, j in POWERS)
        return r - ca.vertcat(0, 0, height), R
