"""LinuxCNC: a kinematics component of any model, and numbers for its own kinematics.

Its own kinematics are genhexkins for hexapods, and lineardeltakins and rotarydeltakins for Deltas
with equal chains. The numbers are pins in a .hal file and HOME_OFFSET in the .ini file, in mm and
degrees. Source: LinuxCNC documentation,
kins(9), lineardeltakins(9), "INI configuration", and src/emc/kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files as resources
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import LINEAR, ROTARY, fit_equal_shoulders, fit_equal_towers
from parallel_cal.exporting.projection import (
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.exporting.targets import c
from parallel_cal.importing.deltas import HANGING_ANGLES
from parallel_cal.importing.importers import linuxcnc
from parallel_cal.importing.importers.linuxcnc import HEXAPOD, HOMED, ROTARY_PINS
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.struts import Struts
from parallel_cal.model.model import Model

HOLDS = ("stewart42", *LINEAR, *ROTARY)
CLEARED = tuple(f"lineardeltakins.J{i}off" for i in range(3))  # the offsets of older versions
HAL, INI = "machine.hal", "machine.ini"
INCH_DECIMALS = 7  # as fine as the digits of mm
STRUTS = 6  # of genhexkins
SWITCHES = (
    "HOME_OFFSET assumes switches at the joints' upper limits in the model "
    "file: if yours are elsewhere, change these limits"
)
TOWERS = np.radians([90.0, 210.0, 330.0])


def files(model: Model, name: str = "") -> dict[str, str]:
    """Return the exported C, and a component `name`_kins around it."""
    made = c.files(model, name)
    robot = next(file for file in made if file.endswith(".h")).removesuffix(".h")
    if len(model.joints) > 9:
        raise ModelError(
            f"{model.mechanism.name} has {len(model.joints)} joints, but LinuxCNC supports 9"
        )
    m, tool = model.mechanism, resources(__package__).joinpath("_c", "kins.c")
    factors = [MM if unit == "m" else DEGREE for unit in m.joint_units]
    text = c.fill_template(
        tool.read_text(encoding="utf-8"),
        {
            "robot": robot,
            "ROBOT": robot.upper(),
            "factors": ", ".join(map(repr, factors)),
            "turns": str(int(any(i >= 3 for i in m.controlled))),
        },
    )
    return {
        f"{robot}.h": made[f"{robot}.h"],
        f"{robot}.c": made[f"{robot}.c"],
        f"{robot}_kins.c": text,
    }


def settings(paths: Sequence[Path]) -> Settings:
    return linuxcnc.settings(paths)


def firmware(stated: Settings) -> Firmware:
    """Return the kinematics whose pins are set."""
    return linuxcnc.kinematics(stated)


def adapt(stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
    """Return settings in mm in the unit of the machine's own files."""
    factor = MM / linuxcnc.length_unit(stated)
    if factor == 1.0:
        return dict(numbers)
    angular = any(field.startswith(linuxcnc.ROTARY) for field in stated.texts)
    return {
        field: text
        if angular and field.endswith("HOME_OFFSET")
        else f"{float(text) * factor:.{INCH_DECIMALS}f}"
        for field, text in numbers.items()
    }


def project(model: Model, present: Refinement | None = None) -> Projection:
    name = model.mechanism.name
    if name in LINEAR:
        tall, found = fit_equal_towers(model, TOWERS, present)
        pins = {"lineardeltakins.R": tall.radius[0], "lineardeltakins.L": tall.rods[0]}
        homed = tall.homed / MM
    elif name in ROTARY:
        turned, found = fit_equal_shoulders(model, HANGING_ANGLES, one_stop=False, present=present)
        sizes = (turned.radius, turned.arms[0], turned.rods[0], 0.0)
        pins = {f"rotarydeltakins.{p}": size for p, size in zip(ROTARY_PINS, sizes, strict=True)}
        homed = -turned.homed / DEGREE
    else:
        struts, found = _struts(model)
        pins = {
            f"{HEXAPOD}.{kind}.{k}.{axis}": float(points[k, i])
            for kind, points in (("base", struts.base), ("platform", struts.platform))
            for k in range(6)
            for i, axis in enumerate("xyz")
        }
        homed = struts.homed / MM
    written = {field: f"{float(size) / MM + 0.0:.5f}" for field, size in pins.items()}
    offsets = {HOMED.format(i): f"{value:.6f}" for i, value in enumerate(homed)}
    return Projection({HAL: written, INI: offsets}, found.frame, found.stops, (SWITCHES,))


def _struts(model: Model) -> tuple[Struts, Machine]:
    """Fit both hexagons, and the lengths at the upper limits of the legs."""
    if len(model.joints) != STRUTS:
        raise ModelError(
            f"{HEXAPOD} has {STRUTS} struts, this robot {len(model.joints)}: leave out the "
            "settings, and export writes a component of its own"
        )
    legs = [f"{leg}." for leg in model.joints]
    ends = [[[model.value(f"{leg}{end}_{a}") for a in "xyz"] for leg in legs] for end in "CB"]
    stops = np.array(model.mechanism.joint_limits, float)[:, 1]
    lengths = stops + [model.value(f"{leg}L0") for leg in legs]

    def machine(v: np.ndarray) -> Machine:
        struts = Struts(v[:18].reshape(6, 3), v[18:36].reshape(6, 3), v[36:])
        return Machine(struts, Frame(tuple(range(6)), np.ones(6)), stops)

    found = machine(fit_numbers(model, np.array([*np.ravel(ends), *lengths]), machine))
    return found.firmware, found  # type: ignore[return-value]
