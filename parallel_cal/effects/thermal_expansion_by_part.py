"""Bodies that expand, each with its own temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.effects.thermal_expansion import ThermalExpansion
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named


class ThermalExpansionByPart(ThermalExpansion):
    """L_ideal = L (1 + alpha (T_body - T0)) for every length of a body, with one alpha (1/K) each.

    T_body is the condition `temperature.BODY`, such as `temperature.arms`. A body without a sensor
    of its own has the general temperature. `scales` are what measures the prismatic joints, as in
    `thermal_expansion`: `temperature.scales` is the temperature of the screws, belts or scales.
    If it is not recorded, it is that of the legs; without legs, it is the general temperature, or
    that of the base.
    """

    physics = "Parts have different temperatures: motors and the sun warm some more than others."
    remedy = "warm up before work, or give the model the temperature of each part"
    lookalikes = ("thermal_expansion", "base_drift", "zero_shift")
    told_from: ClassVar[Mapping[str, str]] = {}
    separated_by = "temperatures of the parts that do not rise and fall together"

    def applies(self, mechanism: Mechanism) -> str:
        if why := super().applies(mechanism):
            return why
        if len(mechanism.expanding_bodies) > 1:
            return ""
        return "its lengths belong to one body: thermal_expansion describes it"

    def conditions(self, mechanism: Mechanism) -> list[str]:
        return [f"temperature.{body}" for body in mechanism.expanding_bodies]

    def temperature(self, at: Named, body: str) -> Any:
        """Return the temperature (degC) of a body by its own sensor."""
        return at[f"temperature.{body}"]
