"""RichCattell's Marlin: M666 of its linear Delta, with a radius and an angle for each tower.

Source: importing/tower_words.py.
"""

from __future__ import annotations

from parallel_cal.exporting.deltas import LINEAR
from parallel_cal.exporting.tower_words import WrittenWords
from parallel_cal.importing.gcode import HOME_OFFSETS
from parallel_cal.importing.tower_words import RICHCATTELL

HOLDS = LINEAR
CLEARED = HOME_OFFSETS  # they are added to the homed position
WORDS = WrittenWords(RICHCATTELL, "richcattell.gcode")
settings, firmware, complete = WORDS.settings, WORDS.firmware, WORDS.complete
project, adapt = WORDS.project, WORDS.adapt
