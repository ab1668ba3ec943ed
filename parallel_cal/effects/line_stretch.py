"""Lines that stretch under load: the platform is lower than with inextensible lines."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._lines import compute_sag, needs_hanging_lines
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class LineStretch(Effect):
    """r_ideal = r - compliance * K^-1 (mass + payload) g, K = sum of advantage u u^T / L.

    u points from {P} to the line's anchor, L (m) away; of a tackle's `advantage` strands each
    carries its share. A line under the tension T is longer by T L / (EA), compliance = 1 / (EA)
    (1/N). Where lines are redundant statics alone leaves T open, but the weight sags motors that
    hold still by the displacement whose stretch balances it: K times that is the weight. `mass` is
    the platform's own. A tension that is constant in every line acts like the spools' radii.
    """

    needs = ("payload",)
    fixed = ("mass",)
    physics = "A payload makes each line longer, in proportion to its length: the platform sags."
    remedy = "enter the payload in the model; a stiffer line reduces the error"
    source = "Hooke's law; braided line of 1 mm, EA of 10-50 kN: 2 m under 1 kg give 2-0.4 mm"
    lookalikes = ("payload_sag", "joint_compliance", "device_axes", "spool_buildup")
    separated_by = "the same poses with another payload, at high and low positions"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("compliance", "1/N", 0.0, 0.1e-3, low=0.0),
            Parameter("mass", "kg", 0.0, 5.0, low=0.0),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_hanging_lines(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, Cable)
        weight = (e.mass + at["payload"]) * mechanism.place(ca.DM(mechanism.gravity))
        sag = e.compliance * compute_sag(seen, mechanism, weight)
        return seen.with_pose(seen.r - mechanism.in_base(sag), seen.R)
