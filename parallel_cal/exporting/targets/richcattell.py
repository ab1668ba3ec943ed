"""RichCattell's Marlin: M666 of its linear Delta, with a radius and an angle for each tower.

Source: importing/tower_words.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parallel_cal.exporting.deltas import LINEAR
from parallel_cal.exporting.projection import Projection, Refinement
from parallel_cal.exporting.tower_words import WrittenWords
from parallel_cal.importing import tower_words
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.tower_words import HOME_OFFSETS, RICHCATTELL
from parallel_cal.model.model import Model

HOLDS = LINEAR
WORDS = WrittenWords(RICHCATTELL, "richcattell.gcode")
CLEARED = HOME_OFFSETS  # they are added to the homed position
firmware, complete, adapt = WORDS.firmware, WORDS.complete, WORDS.adapt


def settings(paths: Sequence[Path]) -> Settings:
    return tower_words.settings(paths)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    return WORDS.project(model, present, stated)
