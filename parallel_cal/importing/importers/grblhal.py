"""grblHAL: the settings $641 to $646 of its rotary Delta, as `$$` lists them.

All chains are alike, z = 0 is the plane of the motors' axes, and angles count down from the
horizontal. The settings called radii are sides of triangles: an axis is tan(30)/2 times the side
from the centre. Source: grblHAL core, kinematics/delta.c and its settings' descriptions.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Shoulders
from parallel_cal.importing.importers.maslow import is_listed
from parallel_cal.importing.settings import Settings, read_fields
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model

CONFIGURATION = (".txt", ".settings")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
SETTING = re.compile(r"\s*(\$\d+)\s*=\s*([^\s;(]*)")
ROD, UCNC = "$641", "$106"
REVERSED = deltas.ANGLES_UP.format("grblHAL")


def recognizes(path: Path) -> bool:
    """Whether a file lists settings, and not those of uCNC or of a Maslow; logs of Marlin have the
    same ending."""
    stated = settings([path])
    others = UCNC in stated or is_listed({*stated.texts})
    return bool(stated.texts) and not (others and ROD not in stated)


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the robot as configured."""
    machine = shoulders(settings(paths))
    return ConfiguredRobot(new_model(machine.mechanism()), (deltas.NOT_STATED, REVERSED), machine)


def settings(paths: Sequence[Path]) -> Settings:
    """Read settings such as `$641=250.000`; the last value of each counts."""
    return read_fields(paths, SETTING)


def shoulders(stated: Settings) -> Shoulders:
    rod, arm = (stated.number(f, "a length in mm", low=1.0) * MM for f in (ROD, "$642"))
    sides = [stated.number(f, "a triangle's side in mm", low=0.0) for f in ("$643", "$644")]
    top = stated.number("$646", "the homing angle in degrees", low=-90.0, high=90.0)
    short = stated.error(ROD, "a length in mm that reaches the middle of the workspace")
    radius, homed = deltas.SIDE * (sides[0] - sides[1]) * MM, np.full(3, -top * DEGREE)
    return deltas.hang_shoulders(radius, arm, rod, homed, short)
