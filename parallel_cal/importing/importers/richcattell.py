"""RichCattell's Marlin: a log of M503 or commands M666 of a linear Delta.

M666 has D R H, X Y Z of the end-stops, A B C of the towers' angles and I J K of their radii, which
M503 calls E F G. Source: importing/tower_words.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.tower_words import RICHCATTELL, settings, state_all_by_m666
from parallel_cal.model.machine_class import MachineClass

CONFIGURATION = (".log", ".txt", ".gcode")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
ASSUMED = (
    "A, B and C of M666 are read as the towers' angles in degrees, I, J and K as their radii in "
    "mm, as in RichCattell's Marlin. If the printer runs MK4duo, add U0 V0 W0 to M666"
)


def recognizes(path: Path) -> bool:
    """Whether M666 states the rods, and not the radii of MK4duo."""
    return state_all_by_m666(path) is RICHCATTELL


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured."""
    stated = settings(paths)
    corrections = RICHCATTELL.fields("ABCIJK")
    corrected = any(stated.number(field, "a number", 0.0) for field in corrections)
    named = any(field in stated for field in RICHCATTELL.fields(RICHCATTELL.reported))
    return RICHCATTELL.configured(paths, (ASSUMED,) if corrected and not named else ())
