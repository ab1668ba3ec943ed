"""Write linear Deltas of Marlin's relatives, which state everything by M666."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import TOWERS, complete_towers, express_gain, towers
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import Array, Firmware, Projection, Refinement
from parallel_cal.importing import tower_words
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.gcode import STEPS_FIELDS, read_scale
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.tower_words import HEIGHT, RADIUS, ROD, STOPS, TowerWords
from parallel_cal.model.model import Model

DECIMALS = 4  # of mm and degrees
STEPS_DECIMALS = 5  # of steps per mm
MIN_RETRACT_M = 0.1e-3  # m; six steps, which Marlin ignores, are up to 0.1 mm
STORE = "send M500 after these commands, or they are lost when the printer is switched off"


def split_heights(delta: Towers) -> tuple[float, Array]:
    """Return the homed height (m), and how far (3,) m carriages go down from their end-stops.

    A carriage does not go down by less than MIN_RETRACT_M, except by nothing.
    """
    homed = float(delta.heights.min())
    retract = delta.heights - homed
    if ((retract > 0) & (retract < MIN_RETRACT_M)).any():
        retract, homed = retract + MIN_RETRACT_M, homed - MIN_RETRACT_M
    return homed, retract


@dataclass(frozen=True)
class WrittenWords:
    """An export target whose firmware has the `words` of M666, in the file `name`."""

    words: TowerWords
    name: str

    def settings(self, paths: Sequence[Path]) -> Settings:
        return tower_words.settings(paths)

    def firmware(self, stated: Settings) -> Firmware:
        return self.words.towers(stated)

    def complete(self, read: Firmware, model: Model) -> Firmware:
        return complete_towers(read, model, TOWERS)

    def project(
        self, model: Model, present: Refinement | None = None, stated: Settings | None = None
    ) -> Projection:
        w = self.words
        delta, c = towers(
            model,
            TOWERS,
            tilted=False,
            present=present,
            equal_rods=not w.rods,
            has_scale=stated is not None and read_scale(stated) is not None,
            equal_radii=False,
        )
        # Of all ways to state the same, the one with the file's own mean corrections.
        own_radii, own_rods = np.zeros(3), np.zeros(3)
        if stated is not None:
            own_radii, own_rods = w.read_radii(stated), w.read_rods(stated)
        radius, rod = delta.radius.mean() - own_radii.mean(), delta.rods.mean() - own_rods.mean()
        homed, retract = split_heights(delta)
        found = {RADIUS: radius / MM, ROD: rod / MM, HEIGHT: homed / MM}
        groups = (
            (w.fields(w.angles), delta.trim / DEGREE),
            (w.fields(w.radii), (delta.radius - radius) / MM),
            (w.fields(w.rods), (delta.rods - rod) / MM if w.rods else ()),
            (STOPS, -retract / MM),
        )
        for fields, values in groups:
            found |= dict(zip(fields, values, strict=True))
        written = {field: format_number(v, DECIMALS) for field, v in found.items()}
        if delta.scale is not None:
            steps = zip(STEPS_FIELDS, delta.scale * MM, strict=True)
            written |= {field: f"{value:.{STEPS_DECIMALS}f}" for field, value in steps}
        made = Projection({self.name: written}, c.frame, c.stops, (STORE,))
        return express_gain(model, made, delta.scale, "M92")

    def adapt(self, stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
        """Return the words to write into files: also those of a report, where they stand."""
        w, found = self.words, dict(numbers)
        for field, shown in zip(w.fields(w.radii), w.fields(w.reported), strict=False):
            if shown in stated:
                found[shown] = numbers[field]
        return found
