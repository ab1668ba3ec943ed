"""uCNC: the settings $106 and $107 of its linear Delta, as `$$` lists them.

All towers and rods are alike, and the towers stand at 30, 150 and 270 degrees. After homing and
pulling off ($27), the nozzle is at the height $132 if $23 inverts the direction of Z, and at 0 if
it does not. Source: Paciente8159/uCNC 140831c7, uCNC/src/hal/kinematics/kinematic_linear_delta.c
and .h (kinematics_init, kinematics_apply_inverse, kinematics_home) and src/interface/
grbl_settings.c.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.importers import grblhal
from parallel_cal.importing.settings import Settings
from parallel_cal.model.machine_class import MachineClass

CONFIGURATION = (".txt", ".settings")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
ROD, RADIUS, HEIGHT, INVERTED = "$106", "$107", "$132", "$23"
STEPS = ("$100", "$101", "$102")
BICEP = "$108"  # of the rotary Delta, whose $106 and $107 are other numbers
FIRST = 30 * DEGREE  # STEPPER0_ANGLE
INVERT_Z = 4  # in $23
ANGLES = (
    "the towers are assumed at 30, 150 and 270 degrees. If your build of uCNC defines another "
    "STEPPER0_ANGLE, turn x and y of the measured poses accordingly"
)


def recognizes(path: Path) -> bool:
    """Whether a file lists the arm's length of a Delta."""
    return ROD in grblhal.settings([path])


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured."""
    stated = settings(paths)
    return deltas.make_configured_robot(towers(stated), np.zeros(3), remarks=[ANGLES])


def settings(paths: Sequence[Path]) -> Settings:
    return grblhal.settings(paths)


def towers(stated: Settings) -> Towers:
    if BICEP in stated:
        raise stated.error(
            BICEP, "no such setting: it is of uCNC's rotary Delta, which is not read; grblHAL's is"
        )
    radius = stated.number(RADIUS, "the radius of the towers in mm", low=1.0)
    rod = stated.number(ROD, "the rods' length in mm, more than $107", low=radius)
    height = stated.number(HEIGHT, "the height of the nozzle in mm after homing", low=0.0)
    mask = stated.number(INVERTED, "a mask of axes", INVERT_Z, 0, 255)
    if not int(mask) & INVERT_Z:
        height = 0.0
    scale = None
    if all(field in stated for field in STEPS):
        scale = np.array([stated.number(f, "steps per mm", low=1e-3) / MM for f in STEPS])
    return Towers.of(
        radius,
        np.full(3, rod),
        np.zeros(3),
        np.full(3, height),
        first=FIRST,
        **deltas.count_steps(scale),
    )
