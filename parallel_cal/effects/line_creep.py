"""Polymer lines that go on stretching for hours under the tension that holds the platform."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._lines import find_strands, needs_lines, shift_lines
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

FASTEST = 60.0  # s; what creeps within a minute has crept before the first pose
RATIO = 5.0  # of the time constants that the scan tries: nearer ones look alike


class LineCreep(Effect):
    """q_ideal = q + l c / (1 + c) / k, c = sum over i = 1, 2 of strain_i (1 - exp(-t / tau_i)).

    The line of length l is two Voigt elements and a spring in series under a tension that stays. t
    is the time since the first recording began. `tau1` and `tau2` (s) are known from a creep test,
    or found by `scan`. k is the line (m) that a reading of 1 lets out.
    """

    needs = ("time",)
    fixed = ("tau1", "tau2")
    depends_on_class = False
    physics = "A polymer line under tension goes on stretching, fast at first and then ever slower."
    remedy = "pretension new lines for a day, warm up under tension, or home more often"
    source = "Miyasaka et al. 2016 (10.1177/1687814017737199); braided lines creep by 0.1-1 % a day"
    lookalikes = ("base_drift", "zero_shift", "thermal_expansion")
    separated_by = "some poses again and again over several hours, with long and with short lines"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            *[
                Parameter(f"strain{i}", "1", 0.0, 1e-3, low=0.0, high=20e-3, label=f"{word} creep")
                for i, word in ((1, "fast"), (2, "slow"))
            ],
            Parameter("tau1", "s", 300.0, 200.0, low=1.0, label="time constant"),
            Parameter("tau2", "s", 3600.0, 2000.0, low=1.0, label="time constant"),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_lines(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, Cable)
        crept = sum(e[f"strain{i}"] * (1 - ca.exp(-at["time"] / e[f"tau{i}"])) for i in (1, 2))

        def excess(placed: Seen) -> list[Any]:
            strands = find_strands(placed, mechanism)
            return [-crept * ca.norm_2(strand) / (1 + crept) for strand in strands]

        return shift_lines(seen, mechanism, excess, since_home=False)

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return pairs of time constants up to the length of the session: slower creep is a line
        in time, as that of the session's length nearly is."""
        duration = float(np.ptp(recorded["time"]))
        count = max(1, round(np.log(max(duration / FASTEST, 1.0)) / np.log(RATIO)))
        slow = [max(duration, FASTEST) / RATIO**k for k in range(count)]
        for tau2 in slow:
            yield {"tau1": tau2 / RATIO, "tau2": tau2}
