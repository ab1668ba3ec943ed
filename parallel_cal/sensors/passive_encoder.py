"""Encoders on passive joints of a closed chain: their readings, besides those of the motors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import ARCMIN, DEGREE
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor

ZERO_TOLERANCE = {"rad": 0.5 * DEGREE, "m": 0.5e-3}  # as `chain` assumes for its joints


@dataclass(frozen=True)
class PassiveEncoder(Sensor):
    """Value of each of some passive `joints`, minus the encoder's `zero`.

    Its channels have the names of the joints, which are passive coordinates of the mechanism. All
    have one `unit`, rad or m; encoders of the other unit are a second entry, with another `name`.
    """

    joints: tuple[str, ...]
    sigma: float | None = ARCMIN
    unit: str = "rad"  # type: ignore[misc]  # a constant of other sensors
    name: str = "passive_encoder"

    physics = "an encoder reads a joint that no motor drives"
    source = "magnetic encoders of 12 to 14 bits: 1 to 5 arcmin"
    guessed_sigma = ARCMIN
    reads_always = True

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.joints)

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        if self.unit not in ZERO_TOLERANCE:
            raise ModelError(f"{self.name}: unit is '{self.unit}', expected rad or m")
        units = dict(zip(mechanism.passive, mechanism.passive_units, strict=True))
        for joint in self.joints:
            if joint not in units:
                raise ModelError(
                    f"{self.name}: '{joint}' is no passive coordinate of {mechanism.name}, "
                    f"expected some of {', '.join(units) or 'none, as it has none'}"
                )
            if units[joint] != self.unit:
                raise ModelError(
                    f"{self.name}: joint '{joint}' has the unit {units[joint]}, not {self.unit}; "
                    "write an entry of its own for it, with unit and name"
                )
        tolerance = ZERO_TOLERANCE[self.unit]
        return [Parameter(f"{joint}.zero", self.unit, 0.0, tolerance) for joint in self.joints]

    def readings_with_passive(self, r: Any, R: Any, u: Mapping[str, Any], s: Named) -> Any:
        return ca.vertcat(*(u[joint] - s[f"{joint}.zero"] for joint in self.joints))
