"""Screws, drums and pulleys that advance unevenly: an error once per turn, and a screw's pitch that
changes along it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._joints import (
    WAVE,
    constant_of,
    find_drives,
    make_own_constants,
    scan_periods,
    shift_joints,
    wave,
)
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# m; of spindles, and of the pulleys of belts: 16 to 30 teeth of 2 mm
LEADS = (1e-3, 60e-3)
WIDEST = 0.1  # m; of a lead that nothing states
SCREW = (10e-6, 0.1e-3)  # m: tolerance and upper bound of the wave of screws
# Tolerance and upper bound of the wave of drums and pulleys, as shares of their radius: 0.1 and 2
# mm of a printed drum of 40 mm, 13 and 250 um of a belt pulley of 5 mm.
ROUND = (2.5e-3, 50e-3)
TURNING = {"screw": "screw", "spool": "drum", "belt": "pulley"}  # what turns in each kind of drive


class ScrewPitchError(Effect):
    """q_ideal = q + sin * sin(2 pi q / lead) + cos * cos(2 pi q / lead) + bend * q^2 (m).

    For every prismatic joint: a screw that wobbles, a drum or belt pulley that is eccentric, or
    what turns with the motor of a stated gear. `lead` (m) is the travel per turn, one for all but
    those with a `joint.lead` of their own that is not 0: the model file states it with the drive,
    or it is known from the data sheet, or found by `scan`. If stated drives have different leads,
    each has its own. Only screws bend. A line has the effect only if the model file states its
    drive. A pitch or radius that is wrong by a constant factor is `encoder_gain`.
    """

    fixed = ("*lead",)
    each = "lead"
    added_later = ("*.lead",)
    alone = ("*.bend",)
    physics = (
        "A screw that wobbles or is bent, or a drum or pulley that is eccentric, advances unevenly "
        "within each of its turns."
    )
    remedy = (
        "keep the correction in the model; a ground screw, or a drum or pulley that runs true on "
        "its shaft, reduces the error"
    )
    source = (
        "ISO 3408-3: v_2pi of 4-8 um for ball screws of class C1-C5, tens for rolled ones; a drum "
        "or pulley: its eccentricity, 10-50 um if turned, to 5 % of the radius if printed"
    )
    lookalikes = ("encoder_gain",)
    separated_by = "poses over the whole stroke whose distances are not multiples of the lead"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        turning, stated = _find_turning_joints(mechanism), _state_leads(mechanism)
        leads = [
            Parameter(name, "m", lead, 6e-3, low=0.1e-3, high=max(WIDEST, lead), label="lead")
            for name, lead in (stated or {"lead": 5e-3}).items()
        ]
        if [one.name for one in leads] == [self.each]:
            leads = make_own_constants(turning, *leads)
        return [
            *leads,
            *[
                Parameter(f"{joint}.{part}", unit, 0.0, size, low=-most, high=most, label=label)
                for joint, drive in turning.items()
                for part, unit, size, most, label in _list_sizes(drive)
            ],
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        turning = _find_turning_joints(mechanism)

        def error(joint: str, q: Any) -> Any:
            own, turned = e[joint], 2 * ca.pi * q / constant_of(e, joint, "lead")
            return wave(own, "", turned) + own.get("bend", 0.0) * q**2

        return shift_joints(seen, mechanism, turning, error)

    def applies(self, mechanism: Mechanism) -> str:
        if _find_turning_joints(mechanism):
            return ""
        if "m" in mechanism.joint_units:
            return (
                "its lines wind onto spools, whose size the model file does not state: state it "
                "with the joints (drive: {kind: spool, radius: 0.05})"
            )
        return "it has no prismatic joint"

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return the `scan_periods` of the longest travel that was recorded, or the leads that the
        model file states, and behind gears the travels per turn of the motors."""
        if stated := _state_leads(mechanism):
            yield stated
            motors = _state_leads(mechanism, of_motors=True)
            if motors != stated:
                yield motors
            return
        travel = max(np.ptp(recorded[joint]) for joint in _find_turning_joints(mechanism))
        for lead in scan_periods(travel, *LEADS):
            yield {"lead": lead}

    def period(self, setting: Mapping[str, float]) -> float:
        """Return the lead: one turn of the screw, drum, pulley or motor; the least of several."""
        return min(setting.values())


def _find_turning_joints(mechanism: Mechanism) -> dict[str, Drive | None]:
    """Return the prismatic joints that a screw, drum or pulley moves, with their drives. If stated
    drives have different leads, none is known for a joint without a drive, which has no error."""
    drives = find_drives(mechanism)
    differ = len({drive.lead for drive in drives.values() if drive}) > 1
    return {joint: drive for joint, drive in drives.items() if drive or not differ}


def _state_leads(mechanism: Mechanism, of_motors: bool = False) -> dict[str, float]:
    """Return the stated leads, or the travels per turn of the motors, by the name of their
    parameter; empty if none is stated. The shortest motor stands for others with one lead."""
    stated = {joint: one for joint, one in _find_turning_joints(mechanism).items() if one}
    each = {joint: one.lead / (one.gear if of_motors else 1.0) for joint, one in stated.items()}
    if len({one.lead for one in stated.values()}) == 1:
        return {"lead": min(each.values())}
    return {f"{joint}.lead": lead for joint, lead in each.items()}


def _list_sizes(drive: Drive | None) -> Iterator[tuple[str, str, float, float, str]]:
    """Yield name, unit, tolerance, upper bound and label of the numbers of one joint."""
    is_round = drive is not None and drive.kind != "screw"
    turning = TURNING[drive.kind] if drive is not None else "screw or pulley"
    if drive is not None and drive.gear != 1:
        turning += " or motor"
    radius = drive.lead / (2 * np.pi) if drive is not None else 0.0
    size, most = (share * radius for share in ROUND) if is_round else SCREW
    for part, label in WAVE.items():
        yield part, "m", size, most, f"{label}, once per turn of the {turning}"
    if not is_round:
        yield "bend", "1/m", 1e-3, 10e-3, "change of pitch"
