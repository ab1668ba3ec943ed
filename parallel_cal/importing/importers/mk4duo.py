"""MK4duo: a log of M503 or commands M666 of a linear Delta.

M666 has D R H, X Y Z of the end-stops, A B C of the rods, I J K of the towers' angles and U V W of
their radii. Source: importing/tower_words.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.tower_words import MK4DUO, state_all_by_m666
from parallel_cal.model.machine_class import MachineClass

CONFIGURATION = (".log", ".txt", ".gcode")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop


def recognizes(path: Path) -> bool:
    """Whether M666 states the rods and radii of the towers."""
    return state_all_by_m666(path) is MK4DUO


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured."""
    return MK4DUO.configured(paths)
