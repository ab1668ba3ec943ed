"""Linear Deltas of Marlin's relatives, which state everything by M666.

Tower i is at R + its radius correction, turned by its angle from 210, 330 and 90 degrees; its rod
has the length D + a correction. A carriage that touched its end-stop goes down by the distance of
M666 X, Y or Z (0 or less), and the nozzle is then H above the bed.

The words of the corrections differ. Sources: MagoKimbra/MK4duo 0d8ee93b, MK4duo/src/core/mechanics/
delta_mechanics.cpp (recalc_delta_settings, homeaxis, print_M666) and commands/gcode/delta/m666.h;
RichCattell/Marlin c3bffc2f, Marlin_main.cpp (set_delta_constants, homeaxis, M666) and
ConfigurationStore.cpp, whose report calls the radius corrections E, F and G.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.gcode import HOME_OFFSETS, HOST_PREFIX, parse_settings_line, read_scale
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.recordings.recording import Array

CODES = ("M92", "M206", "M666")
CODE, RADIUS, ROD, HEIGHT = "M666", "M666 R", "M666 D", "M666 H"
STOPS = tuple(f"{CODE} {axis}" for axis in "XYZ")


@dataclass(frozen=True)
class TowerWords:
    """The letters of M666 for corrections of towers A, B, C; empty where there are none.

    `reported` are the letters by which a report calls the radius corrections, if they differ.
    With `offsets`, M206 counts: the homed height is H + Z.
    """

    angles: str
    radii: str
    rods: str = ""
    reported: str = ""
    offsets: bool = False

    def fields(self, letters: str) -> list[str]:
        return [f"{CODE} {letter}" for letter in letters]

    def radius_fields(self, stated: Settings) -> list[str]:
        """Return the fields of the radius corrections that count."""
        words = self.fields(self.radii)
        return words if any(word in stated for word in words) else self.fields(self.reported)

    def read_radii(self, stated: Settings) -> Array:
        """Return the radius corrections (3,) in m."""
        return _three(stated, self.radius_fields(stated), "mm") * MM

    def read_rods(self, stated: Settings) -> Array:
        """Return the corrections (3,) in m of the rods."""
        return _three(stated, self.fields(self.rods), "mm") * MM

    def towers(self, stated: Settings) -> Towers:
        radius = stated.number(RADIUS, "the delta radius in mm", low=1.0)
        rod = stated.number(ROD, "the rods' length in mm, more than the radius", low=radius)
        above = "the homed height in mm, more than 0"
        height = stated.number(HEIGHT, above, low=0.0)
        if self.offsets:
            for field in HOME_OFFSETS[:2]:
                if stated.number(field, "mm", 0.0):
                    raise stated.error(field, "0: a Delta is homed on its axis")
            height += stated.number(HOME_OFFSETS[2], "mm", 0.0)
        if height <= 0:
            lowered = self.offsets and stated.number(HEIGHT, above) > 0
            raise stated.error(HOME_OFFSETS[2] if lowered else HEIGHT, above)
        stops = [stated.number(field, "mm, 0 or less", 0.0, high=0.0) for field in STOPS]
        return Towers.of(
            radius + self.read_radii(stated) / MM,
            rod + self.read_rods(stated) / MM,
            _three(stated, self.fields(self.angles), "degrees"),
            height - np.array(stops),
            **deltas.count_steps(read_scale(stated)),
        )

    def configured(self, paths: Sequence[Path], remarks: Sequence[str] = ()) -> ConfiguredRobot:
        return deltas.make_configured_robot(
            self.towers(settings(paths)), np.zeros(3), remarks=remarks
        )


MK4DUO = TowerWords(angles="IJK", radii="UVW", rods="ABC")
RICHCATTELL = TowerWords(angles="ABC", radii="IJK", reported="EFG", offsets=True)


def settings(paths: Sequence[Path]) -> Settings:
    """Read the last value of each word of a report (M503) or of commands."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            parse_settings_line(texts, place, HOST_PREFIX.sub("", line).strip(), CODES)
    return Settings(texts, paths)


def state_all_by_m666(path: Path) -> TowerWords | None:
    """Return the words of a file whose M666 has the radius or the rods; None if it is another
    firmware's."""
    stated = settings([path])
    if ROD not in stated and RADIUS not in stated:
        return None
    return MK4DUO if any(field in stated for field in MK4DUO.fields("UVW")) else RICHCATTELL


def _three(stated: Settings, fields: Sequence[str], expected: str) -> Array:
    """Return corrections (3,), 0 where none is stated."""
    if not fields:
        return np.zeros(3)
    return np.array([stated.number(field, expected, 0.0, -50, 50) for field in fields])
