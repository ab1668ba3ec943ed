"""Drives of joints in m, of which a configuration states the travel per turn."""

from __future__ import annotations

from parallel_cal.model.drive import Drive

# m. Screws of printers advance 2 to 12 mm per turn, belt pulleys (10 teeth of 2 mm) from 20 on.
MAX_LEAD_OF_SCREW = 15e-3


def make_drive(turn: float, gear: float = 1.0) -> Drive:
    """Return the drive of a carriage that moves by `turn` (m) per turn of its screw or pulley.

    `gear` is the number of turns of the motor for one of these. Configurations do not say whether
    this is a screw or a pulley, but their sizes differ.
    """
    kind = "screw" if turn < MAX_LEAD_OF_SCREW else "belt"
    return Drive(kind, per_rev=turn / gear, gear=gear)
