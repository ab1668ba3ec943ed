"""Lines that stretch under the tension that holds the platform, most where they are long."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._lines import (
    LINES,
    find_strands,
    find_tensions,
    hangs,
    has_redundant_lines,
    needs_tension,
    shift_lines,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class LineFlex(Effect):
    """q_ideal = q + (d - d_home) / k, d = s l / (1 + s), s = t / EA, for every line of length l.

    k is the line (m) that a reading of 1 lets out. W t = weight: with redundant lines t is the
    tension nearest to a pretension that all lines have in common, as controllers of tension choose
    it. `strain` is pretension / EA and `load` the weight of the platform / EA, both without unit.
    Motors that hold their angles under a payload that changes are `line_stretch`.
    """

    physics = (
        "The tension that holds the unloaded platform makes a line longer than the length that its "
        "spool let out, in proportion to this length and to the tension."
    )
    remedy = "measure the tension of the lines and correct their lengths, or take stiffer lines"
    source = "Hooke's law; 1 mm of braided line has an EA of 10-50 kN: 20 N give 0.4e-3 to 2e-3"
    lookalikes = ("encoder_gain", "pulley_radius", "spool_buildup", "line_sag", "device_axes")
    separated_by = "the same poses under another pretension or another weight of the platform"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        names = ("strain",) * has_redundant_lines(mechanism) + ("load",) * hangs(mechanism)
        return [Parameter(name, "1", 0.0, 1e-3, low=0.0, high=20e-3) for name in names]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_tension(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, LINES)

        def excess(placed: Seen) -> list[Any]:
            strains = find_tensions(placed, mechanism, e.get("strain", 0), e.get("load", 0))
            lengths = [ca.norm_2(strand) for strand in find_strands(placed, mechanism)]
            return [-s * l / (1 + s) for s, l in zip(strains, lengths, strict=True)]

        return shift_lines(seen, mechanism, excess)
