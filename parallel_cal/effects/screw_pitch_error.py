"""Screws that advance unevenly: an error once per lead, and a pitch that changes along them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._joints import WAVE, shift_joints, wave
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

LEADS = (1e-3, 25e-3)  # m; spindles of robots


class ScrewPitchError(Effect):
    """q_ideal = q + sin * sin(2 pi q / lead) + cos * cos(2 pi q / lead) + bend * q^2 (m).

    For every prismatic joint, with one `lead` (m) for all: known from the screw's data sheet, or
    found by `scan`. A line has the effect only if the model file states a screw as its drive. A
    pitch that is wrong by a constant factor is `encoder_gain`.
    """

    fixed = ("lead",)
    alone = ("*.bend",)
    physics = "A screw that wobbles or is bent advances unevenly within each of its turns."
    remedy = "keep the correction in the model; a ground screw reduces the error"
    source = "ISO 3408-3: v_2pi of 4-8 um for ball screws of class C1-C5, tens for rolled ones"
    lookalikes = ("encoder_gain",)
    separated_by = "poses over the whole stroke whose distances are not multiples of the lead"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        sizes = {part: ("m", 10e-6, 0.1e-3, label) for part, label in WAVE.items()}
        sizes["bend"] = ("1/m", 1e-3, 10e-3, "change of pitch")
        return [
            Parameter("lead", "m", 5e-3, 3e-3, low=0.1e-3, high=0.1),
            *[
                Parameter(f"{joint}.{part}", unit, 0.0, size, low=-most, high=most, label=label)
                for joint in _find_prismatic_joints(mechanism)
                for part, (unit, size, most, label) in sizes.items()
            ],
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            own, turned = e[joint], 2 * ca.pi * q / e.lead
            return wave(own, "", turned) + own.bend * q**2

        return shift_joints(seen, mechanism, _find_prismatic_joints(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        if _find_prismatic_joints(mechanism):
            return ""
        if isinstance(mechanism, Cable) and not any(mechanism.drives):
            return "its lines wind onto spools, unless the model file states a screw as their drive"
        if "m" in mechanism.joint_units:
            return "no screw moves its joints: the model file states other drives"
        return "it has no prismatic joint"

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return leads 1 / (2 travel) apart in turns per metre: half a peak's width, as for a gear.

        The travel is the longest that was recorded. A lead that the model file states is the only
        one.
        """
        stated = {drive.lead for drive in mechanism.drives if drive and drive.kind == "screw"}
        if len(stated) == 1:
            yield {"lead": stated.pop()}
            return
        travel = max(np.ptp(recorded[joint]) for joint in _find_prismatic_joints(mechanism))
        short, long = LEADS
        low, high = 1 / long, 1 / short
        for turns in np.arange(low, high, 1 / (2 * max(travel, 0.5 / (high - low)))):
            yield {"lead": float(1 / turns)}

    def period(self, setting: Mapping[str, float]) -> float:
        """Return the lead: one turn of the screw."""
        return setting["lead"]


def _find_prismatic_joints(mechanism: Mechanism) -> list[str]:
    """Return the prismatic joints that a screw moves: those with a screw as their stated drive, and
    those without a stated drive unless they are lines."""
    drives = mechanism.drives or (None,) * len(mechanism.joints)
    joints = zip(mechanism.joints, mechanism.joint_units, drives, strict=True)
    by_default = not isinstance(mechanism, Cable)
    return [
        joint
        for joint, unit, drive in joints
        if unit == "m" and (drive.kind == "screw" if drive else by_default)
    ]
