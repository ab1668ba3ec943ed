"""A scale error: a spindle, belt or scale with a wrong pitch; the error grows with travel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from parallel_cal.effects._joints import SMOOTH, explain_how_to_state_spool, shift_joints
from parallel_cal.effects._lines import needs_lines
from parallel_cal.effects._struts import needs_struts
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# Tolerance and upper bound of real drives. A spool's radius is rarely known to better than 1 %.
SIZE = {"rad": (0.5e-3, 5e-3), "m": (0.1e-3, 1e-3)}
SPOOL_SIZE = (5e-3, 50e-3)


class EncoderGain(Effect):
    """q_ideal = q + gain * q for every joint; a zero reading stays zero."""

    family = SMOOTH
    mistaken = 100.0
    physics = (
        "If the lead of a spindle or the pitch of a belt is wrong by k, the joint travels "
        "(1 + k) times as far."
    )
    remedy = "enter the identified lead or pitch, or keep the correction in the model"
    source = "ball screw of class C5: 20 um on 300 mm is 0.07e-3; belts reach 1e-3, spools 5e-2"
    lookalikes = ("encoder_eccentricity", "encoder_second_harmonic", "device_axes")
    separated_by = "poses over the whole range of every joint, checked with a second device"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        drives = mechanism.drives or (None,) * len(mechanism.joints)
        joints = zip(mechanism.joints, mechanism.joint_units, drives, strict=True)
        sizes = [
            (joint, *(SPOOL_SIZE if drive and drive.kind == "spool" else SIZE[unit]))
            for joint, unit, drive in joints
        ]
        return [
            Parameter(f"{joint}.gain", "1", 0.0, tolerance, low=-most, high=most)
            for joint, tolerance, most in sizes
        ]

    def other_kinds(self, mechanism: Mechanism) -> Mapping[str, float]:
        how = explain_how_to_state_spool(mechanism)
        # A spool pulls at a line or at a strut of a platform, not at a carriage on a rail.
        if not how or (needs_lines(mechanism) and needs_struts(mechanism)):
            return {}
        tolerance, most = SPOOL_SIZE
        words = f"{how}. A gain of up to {most} is usual then, and spool_buildup can be tested"
        return {words: tolerance / SIZE["m"][0]}

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return e[joint].gain * q

        return shift_joints(seen, mechanism, mechanism.joints, error)
