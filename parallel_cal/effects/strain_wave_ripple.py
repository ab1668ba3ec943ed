"""Strain-wave gears: two ripples, each with two periods per turn of the wave generator relative to
one of the splines. Their sum beats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from parallel_cal.effects._joints import (
    SMOOTH,
    find_revolute_joints,
    make_waves,
    needs_turning,
    shift_joints,
    wave,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

RATIOS = (30.0, 50.0, 80.0, 100.0, 120.0)  # of catalogues
WAVES = {"_c": ", circular spline", "_f": ", flexspline"}


class StrainWaveRipple(Effect):
    """q_ideal = q + sum over s = c, f of sin_s * sin(2 n_s q) + cos_s * cos(2 n_s q) (rad).

    Per turn of the joint, the wave generator turns n_c = `ratio` times relative to the circular
    spline (c) and n_f = `ratio` + 1 times relative to the flexspline (f). In each of these turns,
    both ends of the generator pass every tooth of this spline once, so that an error of the spline
    has two periods. The two waves beat: their sum is largest, and smallest, twice per turn of the
    joint. If a joint moves far less than half a turn, the two waves look like one: use
    `gear_transmission_error` with twice the ratio. All joints have the same `ratio`: state it, or
    `scan` tries usual ones.
    """

    fixed = ("ratio",)
    generalizes = ("gear_transmission_error",)
    refines = False
    family = SMOOTH
    physics = "Errors of both splines of a strain-wave gear repeat at nearly one rate, and beat."
    remedy = "keep the correction in the model; it stays valid until the gear is taken apart"
    source = "Jia et al., MMT 155 (2021) 104122; Tuttle, MIT AI-TR 1365 (1992): 0.1-0.5 mrad"
    lookalikes = ("gear_transmission_error", "encoder_harmonic")
    separated_by = "poses over half a turn of every joint, or more"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("ratio", "1", 100.0, 40.0, low=10.0, high=400.0, label="gear ratio"),
            *[
                amplitude
                for joint in find_revolute_joints(mechanism)
                for amplitude in make_waves(joint, "rad", 0.2e-3, 2e-3, WAVES)
            ],
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            own, c, f = e[joint], 2 * e.ratio * q, 2 * (e.ratio + 1) * q
            return wave(own, "_c", c) + wave(own, "_f", f)

        return shift_joints(seen, mechanism, find_revolute_joints(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        if mechanism.winds:
            return "its motors turn spools: gear_transmission_error describes their gears"
        return needs_turning(mechanism)

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return the ratios of catalogues."""
        return ({"ratio": ratio} for ratio in RATIOS)

    def period(self, setting: Mapping[str, float]) -> float:
        """Return half a turn of the wave generator."""
        return np.pi / setting["ratio"]
