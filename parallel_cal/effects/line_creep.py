"""Polymer lines that go on stretching for hours under the tension that holds the platform."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._lines import LINES, find_strands, needs_lines, shift_lines
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

STEP = 4.0  # between the time constants that the scan tries; the best one is refined
RATIOS = (3.0, 10.0, 30.0)  # of the time constants of the two elements, tried and refined, too
MIN_TIME_CONSTANT = 1.0  # s
SHORTEST = 1 / 64  # of the session's length; what creeps faster has crept before the second pose


class LineCreep(Effect):
    """q_ideal = q + l c / (1 + c) / k for every line of length l.

    c = fast (1 - exp(-ratio t / tau)) + slow (1 - exp(-t / tau)): the line is a spring and two
    Voigt elements in series, under a tension that stays.
    `fast` and `slow` are the strains to which these creep. t is the time since the first recording
    began, and k is the line (m) that a reading of 1 lets out. The time constant `tau` (s) of the
    slow element is known from a creep test, or found by `scan`, and so is the `ratio`: the time
    constant of the fast element is tau / `ratio`.
    """

    needs = ("time",)
    fixed = ("tau", "ratio")
    depends_on_class = False
    physics = "A polymer line under tension goes on stretching, fast at first and then ever slower."
    remedy = "pretension new lines for a day, warm up under tension, or home more often"
    source = "Miyasaka et al. 2016 (10.1177/1687814017737199); braided lines creep by 0.1-1 % a day"
    lookalikes = ("base_drift", "zero_shift", "thermal_expansion")
    separated_by = "some poses again and again over several hours, with long and with short lines"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("fast", "1", 0.0, 1e-3, low=0.0, high=20e-3, label="fast creep"),
            Parameter("slow", "1", 0.0, 1e-3, low=0.0, high=20e-3, label="slow creep"),
            Parameter("tau", "s", 3600.0, 2000.0, low=MIN_TIME_CONSTANT, label="time constant"),
            Parameter("ratio", "1", 10.0, 5.0, low=1.0, label="of the time constants"),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_lines(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        assert isinstance(mechanism, LINES)
        t = at["time"] / ca.fmax(e.tau, MIN_TIME_CONSTANT)  # a search may try less
        crept = e.fast * (1 - ca.exp(-e.ratio * t)) + e.slow * (1 - ca.exp(-t))

        def excess(placed: Seen) -> list[Any]:
            strands = find_strands(placed, mechanism)
            return [-crept * ca.norm_2(strand) / (1 + crept) for strand in strands]

        return shift_lines(seen, mechanism, excess, since_home=False)

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return time constants up to twice the session, because slower creep is a line in time,
        with each of some ratios."""
        duration = float(np.ptp(recorded["time"]))
        tau = 2 * duration
        while duration and tau >= SHORTEST * duration:
            yield from ({"tau": tau, "ratio": ratio} for ratio in RATIOS)
            tau /= STEP
