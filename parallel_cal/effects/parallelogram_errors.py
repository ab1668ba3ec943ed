"""Imperfect parallelograms: the larger model, in which the platform may rotate."""

from __future__ import annotations

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.shelf import load_mechanism


class ParallelogramErrors(Effect):
    """The next larger model instead of this one (24 -> 54: set P1, eq. 3.14), at first equal to it.

    The effect has no parameters of its own: the larger mechanism has additional ones. To undo it,
    go back to the model file from before.
    """

    widens = True
    physics = "Unequal rods and skew bars tilt the platform; bent pantographs shift its centre."
    remedy = "replace rods in pairs of equal length, or use the larger model"
    source = "table 5.18: half bars and rods off by 0.02-0.1 mm, axes by 0.1-0.6 degrees"
    lookalikes = ("target_offset",)
    separated_by = "measured orientations, or a target at a lever arm"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return []

    def applies(self, mechanism: Mechanism) -> str:
        if type(mechanism).widen is Mechanism.widen:
            return "it is not a special case of a larger model"
        name, _ = mechanism.widen(mechanism.parameters.mapping(mechanism.parameters.nominal))
        if set(load_mechanism(name, **mechanism.options).moves) <= set(mechanism.moves):
            return f"{name}, its larger model, gives the platform no additional degree of freedom"
        return ""

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return seen
