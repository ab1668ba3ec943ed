"""Bodies that expand with temperature, and what measures prismatic joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.effects._joints import find_prismatic_joints, shift_joints
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import SCALES, Mechanism
from parallel_cal.model.parameters import Named, Parameter


class ThermalExpansion(Effect):
    """L_ideal = L (1 + alpha (T - T0)) for every length of a body, with one alpha (1/K) per body.

    Readings of prismatic joints are lengths, too: q_ideal = q (1 + alpha (T - T0)), with one alpha
    for all of them, `scales.alpha`. It is the expansion of the screw or belt if a rotary encoder
    measures the joint, and that of the linear scale if one does. The scale is taken to be fixed at
    reading 0. If it is fixed at q0, all joints also shift by -q0 alpha (T - T0). The other
    expansions include this shift (`legs.alpha` of a hexapod, `rods.alpha` and `base.alpha` of a
    linear Delta), so the poses are right, but these numbers are not those of the materials.

    T0 is `reference` (degC). Another T0 changes the lengths and the scales, and nothing else.
    """

    depends_on_class = False
    needs = ("temperature",)
    fixed = ("reference",)
    added_later = (f"{SCALES}.alpha",)
    physics = (
        "A part of length L becomes longer by alpha L for every kelvin of warming. So does the "
        "screw, belt or scale that measures a prismatic joint."
    )
    remedy = "warm up before work, or give the model the temperature"
    source = (
        "steel 11.7e-6/K, aluminium 23e-6/K, carbon fibre -1e-6..2e-6/K, polymers to 1e-4/K; "
        "scales of glass 8e-6/K, of glass ceramic 0"
    )
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
                for body in mechanism.expanding_bodies
            ],
            Parameter("reference", "degC", 20.0, 10.0, low=-50.0, high=100.0),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if mechanism.expanding_bodies else "it has no lengths that belong to a known body"

    def temperature(self, at: Named, body: str) -> Any:
        """Return the temperature (degC) of a body."""
        return at["temperature"]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        table = mechanism.parameters

        def growth(body: str) -> Any:
            return e[body].alpha * (self.temperature(at, body) - e.reference)

        changes = {
            name: seen.p[name] * (1 + growth(body))
            for body, lengths in mechanism.bodies.items()
            for name, of_body in zip(table.names, table.matching(lengths), strict=True)
            if of_body
        }
        prismatic = find_prismatic_joints(mechanism)
        if prismatic:
            seen = shift_joints(seen, mechanism, prismatic, lambda joint, q: growth(SCALES) * q)
        return seen.with_p(changes)
