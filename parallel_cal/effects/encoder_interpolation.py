"""Linear joints: an error with one and two periods per pitch of the scale, the linear motor, the
rack or the toothed belt."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._joints import (
    constant_of,
    find_drives,
    make_own_constants,
    make_waves,
    scan_periods,
    shift_joints,
    wave,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

PERIODS = (1e-3, 60e-3)  # m; of magnetic scales, belts, racks and linear motors
WAVES = {"1": ", once per period", "2": ", twice per period"}


class EncoderInterpolation(Effect):
    """q_ideal = q + sum over k = 1, 2 of sin_k * sin(2 pi k q / period) + cos_k * cos(2 pi k q /
    period) (m).

    For every prismatic joint that is no line on a spool. All have the same `period` (m), except
    those with a `joint.period` of their own that is not 0: state it (the pole pitch of the scale or
    of the motor, the pitch of the belt), or let `scan` find it. Offsets of an encoder's two signals
    cause an error with one period per `period`. Unequal amplitudes and a wrong phase between the
    signals cause one with two. For revolute joints, `gear_transmission_error` has the same form,
    with the period 2 pi / ratio. An error once per turn of a screw is `screw_pitch_error`.
    """

    fixed = ("*period",)
    each = "period"
    added_later = ("*.period",)
    generalizes = ("screw_pitch_error",)
    physics = (
        "The two signals of a scale are no perfect sine and cosine, and the magnets of a linear "
        "motor pull it from pole to pole."
    )
    remedy = "adjust offset, gain and phase of the signals, or keep the correction in the model"
    source = "TI TIDUA05B: 0.1-1 % of the period; magnetic scales of 1-5 mm: 5-20 um"
    lookalikes = ("screw_pitch_error", "encoder_gain")
    separated_by = "poses over the whole stroke whose distances are not multiples of the period"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        joints = _find_scales(mechanism)
        common = Parameter("period", "m", 10e-3, 6e-3, low=10e-6, high=0.5, label="pitch")
        return [
            *make_own_constants(joints, common),
            *[
                amplitude
                for joint in joints
                for amplitude in make_waves(joint, "m", 10e-6, 0.1e-3, WAVES)
            ],
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            own, turned = e[joint], 2 * ca.pi * q / constant_of(e, joint, "period")
            return wave(own, "1", turned) + wave(own, "2", 2 * turned)

        return shift_joints(seen, mechanism, _find_scales(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        if _find_scales(mechanism):
            return ""
        if "m" in mechanism.joint_units:
            return "its joints are lines on spools, which have no scale, magnets or teeth"
        return "it has no prismatic joint: gear_transmission_error describes revolute ones"

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return the `scan_periods` of the longest travel that was recorded."""
        travel = max(np.ptp(recorded[joint]) for joint in _find_scales(mechanism))
        for period in scan_periods(travel, *PERIODS):
            yield {"period": period}

    def multiples(self, setting: Mapping[str, float]) -> Iterator[Mapping[str, float]]:
        """Return half of the period: twice the true period fits as well, by its second harmonic."""
        key = "period" if "period" in setting else next(iter(setting))  # that of one joint
        if setting[key] >= 2 * PERIODS[0]:
            yield {key: setting[key] / 2}

    def period(self, setting: Mapping[str, float]) -> float:
        return setting.get("period") or min(setting.values())


def _find_scales(mechanism: Mechanism) -> list[str]:
    """Return the prismatic joints that may have a scale, magnets or teeth: those on no spool."""
    drives = find_drives(mechanism).items()
    return [joint for joint, drive in drives if drive is None or drive.kind != "spool"]
