"""MK4duo: M666 of its linear Delta, with a radius, an angle and a rod for each tower.

Source: importing/tower_words.py.
"""

from __future__ import annotations

from parallel_cal.exporting.deltas import LINEAR
from parallel_cal.exporting.tower_words import WrittenWords
from parallel_cal.importing.tower_words import MK4DUO

HOLDS = LINEAR
WORDS = WrittenWords(MK4DUO, "mk4duo.gcode")
settings, firmware, complete = WORDS.settings, WORDS.firmware, WORDS.complete
project, adapt = WORDS.project, WORDS.adapt
