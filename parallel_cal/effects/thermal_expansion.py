"""Bodies that expand with temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class ThermalExpansion(Effect):
    """L_ideal = L (1 + alpha (T - T0)) for every length of a body, with one alpha (1/K) per body.

    T0 is `reference` (degC). Another T0 changes the lengths, and nothing else.
    """

    depends_on_class = False
    needs = ("temperature",)
    fixed = ("reference",)
    physics = "A part of length L becomes longer by alpha L for every kelvin of warming."
    remedy = "warm up before work, or give the model the temperature"
    source = "steel 11.7e-6/K, aluminium 23e-6/K, carbon fibre -1e-6..2e-6/K, polymers to 1e-4/K"
    lookalikes = ("base_drift", "zero_shift", "thermal_expansion_by_part")
    separated_by = "a temperature that rises and falls, so that it is not proportional to time"
    told_from: ClassVar[Mapping[str, str]] = {
        "thermal_expansion_by_part": "temperatures of the parts that do not rise and fall together"
    }

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            *[
                Parameter(
                    f"{body}.alpha", "1/K", 0.0, 10e-6, low=-2e-6, high=100e-6, label="expansion"
                )
                for body in mechanism.bodies
            ],
            Parameter("reference", "degC", 20.0, 10.0, low=-50.0, high=100.0),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if mechanism.bodies else "it has no lengths that belong to a known body"

    def temperature(self, at: Named, body: str) -> Any:
        """Return the temperature (degC) of a body."""
        return at["temperature"]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        table = mechanism.parameters
        changes = {
            name: seen.p[name] * (1 + e[body].alpha * (self.temperature(at, body) - e.reference))
            for body, lengths in mechanism.bodies.items()
            for name, of_body in zip(table.names, table.matching(lengths), strict=True)
            if of_body
        }
        return seen.with_p(changes)
