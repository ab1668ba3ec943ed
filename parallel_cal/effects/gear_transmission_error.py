"""Unequal gear teeth: a ripple at the gear's ratio and at twice the ratio."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from parallel_cal.effects._joints import (
    SMOOTH,
    constant_of,
    find_revolute_joints,
    make_harmonics,
    make_own_constants,
    needs_turning,
    shift_joints,
    sizes,
    wave,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

SIZE = {"rad": (0.3e-3, 3e-3), "m": (0.1e-3, 1e-3)}  # tolerance and upper bound; m of line
WAVES = (", once per input turn", ", twice per input turn")
RATIOS = (3.0, 150.0)  # below: an encoder's harmonics; above: too fine for the poses


class GearTransmissionError(Effect):
    """q_ideal = q + sum over k = 1, 2 of sin_k * sin(k ratio q) + cos_k * cos(k ratio q) (rad).

    All joints have one `ratio`, except those with a `joint.ratio` of their own that is not 0. It is
    known from the gear's catalogue, or `scan` finds it. The best ratio of the scan is at most half
    a step from the true one and shows at least 90 % of the first harmonic. From there, a fit can
    refine the ratio together with the amplitudes (`--free`). If the readings are angles of motors
    that turn spools, the ratio is the angle of the spool per angle of the motor: a spool that is
    out of round errs once per turn of its own.

    The interpolation error of an encoder and the cogging of a motor have the same form, with the
    number of periods per turn of the joint as `ratio`.
    """

    fixed = ("*ratio",)
    each = "ratio"
    added_later = ("*.ratio",)
    family = SMOOTH
    physics = "Eccentric gears and wave generators advance and delay the arm once per input turn."
    remedy = "keep the correction in the model; it stays valid until the gear is taken apart"
    source = "harmonic drives: 0.3-0.45 mrad at one and two periods per turn of the input"
    lookalikes = ("strain_wave_ripple", "encoder_harmonic")
    separated_by = (
        "poses in steps of a fifth of a turn of the gear's input, over as many turns as the joint "
        "reaches"
    )

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        amplitudes = [
            amplitude
            for joint, unit, (size, most) in sizes(mechanism, SIZE)
            if unit == "rad"
            for amplitude in make_harmonics(joint, unit, size, most, WAVES)
        ]
        ratio = _find_spool_turns(mechanism)[0] if mechanism.winds else 50.0
        common = Parameter(
            "ratio", "1", ratio, 0.4 * ratio, low=1e-3, high=250.0, label="gear ratio"
        )
        return [*make_own_constants(find_revolute_joints(mechanism), common), *amplitudes]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            own, turned = e[joint], constant_of(e, joint, "ratio") * q
            return wave(own, "1", turned) + wave(own, "2", 2 * turned)

        return shift_joints(seen, mechanism, find_revolute_joints(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        return needs_turning(mechanism)

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return ratios pi / travel apart: a peak reaches 2 pi / travel to each side.

        The travel is the longest that was recorded. Spools that motors turn have known ratios.
        """
        if mechanism.winds:
            yield from ({"ratio": turn} for turn in _find_spool_turns(mechanism))
            return
        low, high = RATIOS
        travel = max(np.ptp(recorded[joint]) for joint in find_revolute_joints(mechanism))
        for ratio in np.arange(low, high, np.pi / max(travel, np.pi / (high - low))):
            yield {"ratio": float(ratio)}

    def multiples(self, setting: Mapping[str, float]) -> Iterator[Mapping[str, float]]:
        """Return twice the ratio: an error once per input turn is its second harmonic."""
        key = "ratio" if "ratio" in setting else next(iter(setting))  # that of one joint
        if 2 * setting[key] <= RATIOS[1]:
            yield {key: 2 * setting[key]}

    def period(self, setting: Mapping[str, float]) -> float:
        """Return one turn of the gear's input."""
        return 2 * np.pi / (setting.get("ratio") or max(setting.values()))


def _find_spool_turns(mechanism: Mechanism) -> list[float]:
    """Return the turns of the nominal spools per turn of their motors."""
    p = Named(mechanism.parameters.names, mechanism.parameters.nominal)
    spools = [mechanism.spool(i, p) for i in range(len(mechanism.joints))]
    return sorted({round(abs(float(spool.turn)), 12) for spool in spools if spool})
