"""Layers of line on a spool: its radius grows with the line that it holds."""

from __future__ import annotations

from typing import cast

import casadi as ca

from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class SpoolBuildup(Effect):
    """q_ideal = q - Q q^2 / (4 gear R) for every motor (rad), positive letting line out.

    A metre of line on the spool adds Q to its radius squared, so a spool turned by s = q / gear
    has the radius R - Q s / 2 and has let out R s - Q s^2 / 4: the constant spool needs the
    angle q_ideal for that. Q (m) is the line's cross-section over pi times the spool's width, one
    number because every spool holds the same line on the same width.
    """

    physics = "Every layer of line makes the spool larger, so the same turn moves more line."
    remedy = "enter the spool's build-up in the firmware, or keep the correction in the model"
    source = "the Hangprinter's maker; round line has Q = d^2 / (4 width), 1 mm in 3: 0.08 mm"
    lookalikes = ("encoder_gain", "line_stretch")
    separated_by = "poses over the whole range of every line, near and far from its anchor"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter("Q", "m", 0.0, 0.1e-3, low=0.0, high=0.5e-3, label="build-up")]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if isinstance(mechanism, Cable) else "it has no line on a spool"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        rows = []
        for i, spool in enumerate(cast(Cable, mechanism).spools):
            gear, R = seen.p[f"line{i + 1}"].gear, seen.p[f"spool{spool}"].R
            rows.append(seen.q[i] - e.Q * seen.q[i] ** 2 / (4 * gear * R))
        return seen.with_q(ca.vertcat(*rows))
