"""Repetier-Firmware: a report of its EEPROM (M205), commands M206, or Configuration.h of a Delta.

A report has lines `EPR:type position value text`, and `M206 T3 P881 X217` sets the number at the
position 881. Values of the EEPROM count before those of Configuration.h. Tower i is at the
horizontal radius + its correction, in the direction Alpha; its rod has the diagonal length + a
correction. The firmware computes in whole steps: it rounds the places of the towers, and cuts off
the rods. All motors have the steps per mm of Z. A carriage that touched its end-stop goes down by
its offset in steps, and the nozzle is then at Z max length less the coating. Source:
repetier/Repetier-Firmware 7cb37413 (1.0.4), src/ArduinoAVR/Repetier: Eeprom.h and .cpp
(writeSettings, update), Printer.cpp (updateDerivedParameter, homeZAxis), Repetier.h (ROD_RADIUS).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.drives import make_drive
from parallel_cal.importing.gcode import HOST_PREFIX
from parallel_cal.importing.importers.marlin import DEFINITION
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.recordings.recording import Array

CONFIGURATION = (".log", ".txt", ".gcode", ".h")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
REPORT = re.compile(r"EPR:([0-3])\s+(\d+)\s+(\S+)\s*(.*)")
COMMAND = re.compile(r"M206\s+T([0-3])\s+P(\d+)\s+[XS](\S+)", re.IGNORECASE)
FLOAT = 3  # type of a number that is not whole; M206 states it by X, and others by S


def place_in_eeprom(position: int, kind: int = FLOAT) -> str:
    """Return the field of a number of the EEPROM, which begins as the command that sets it."""
    return f"M206 T{kind} P{position} {'X' if kind == FLOAT else 'S'}"


STEPS, HEIGHT, COATING = (place_in_eeprom(p) for p in (11, 153, 1024))
ROD, RADIUS = (place_in_eeprom(p) for p in (881, 885))
STOPS = tuple(place_in_eeprom(p, kind=1) for p in (893, 895, 897))
ALPHAS = tuple(place_in_eeprom(p) for p in (901, 905, 909))
RADII = tuple(place_in_eeprom(p) for p in (913, 917, 921))
RODS = tuple(place_in_eeprom(p) for p in (933, 937, 941))
DIRECTIONS = (210.0, 330.0, 90.0)  # degrees, the defaults of Alpha
# Names in Configuration.h.
PARTS_OF_RADIUS = (
    "PRINTER_RADIUS",
    "END_EFFECTOR_HORIZONTAL_OFFSET",
    "CARRIAGE_HORIZONTAL_OFFSET",
)
STEPS_OF_TURN = ("MICRO_STEPS", "STEPS_PER_ROTATION")
PARTS_OF_STEPS = (*STEPS_OF_TURN, "BELT_PITCH", "PULLEY_TEETH")
ABOVE_ZERO = "a plain number above 0"
DEFINED = {
    "ZAXIS_STEPS_PER_MM": STEPS,
    "Z_MAX_LENGTH": HEIGHT,
    "Z_PROBE_Z_OFFSET": COATING,
    "DELTA_DIAGONAL_ROD": ROD,
    "ROD_RADIUS": RADIUS,
}
for letters, name, group in (
    ("XYZ", "DELTA_{}_ENDSTOP_OFFSET_STEPS", STOPS),
    ("ABC", "DELTA_ALPHA_{}", ALPHAS),
    ("ABC", "DELTA_RADIUS_CORRECTION_{}", RADII),
    ("ABC", "DELTA_DIAGONAL_CORRECTION_{}", RODS),
):
    DEFINED |= {name.format(letter): field for letter, field in zip(letters, group, strict=True)}
DELTA = {"3", "DELTA"}  # of DRIVE_SYSTEM
OTHER_VERSION = (
    "the diagonal rod length: at this position Repetier-Firmware 0.9 to 1.0 store it; version 2 "
    "stores it elsewhere, and is not read"
)


def recognizes(path: Path) -> bool:
    """Whether a file states the rods in the EEPROM, or is Repetier's Configuration.h of a Delta."""
    stated = settings([path])
    if path.suffix == ".h":
        return "DRIVE_SYSTEM" in stated and any(
            n in stated for n in ("ROD_RADIUS", "PRINTER_RADIUS")
        )
    return any(field in stated for field in (ROD, RADIUS))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured. A pulley sits on its motor: Configuration.h states how far
    a carriage moves per turn by the steps of a turn."""
    stated = settings(paths)
    printer = towers(stated)
    remarks = stated.describe_unused()
    found = deltas.make_configured_robot(printer, np.zeros(3), remarks=remarks)
    if printer.scale is not None and all(name in stated for name in STEPS_OF_TURN):
        micro, turn = (stated.number(name, ABOVE_ZERO, low=1e-6) for name in STEPS_OF_TURN)
        drives = [make_drive(float(micro * turn / scale)) for scale in printer.scale]
        found.model.mechanism.drives = tuple(drives)
    return found


def settings(paths: Sequence[Path]) -> Settings:
    """Read the last value at each position of the EEPROM, by the command that sets it, and the
    definitions of Configuration.h."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            if path.suffix == ".h":
                if found := DEFINITION.match(line):
                    texts[found[1]] = (found[2], place)
                continue
            plain = HOST_PREFIX.sub("", line).strip()
            if found := REPORT.match(plain):
                kind, position, text, what = found.groups()
                field = place_in_eeprom(int(position), int(kind))
                if field == ROD and what and "rod" not in what.lower():
                    raise place.error(f"EPR:3 {position}", f"{text} {what}", OTHER_VERSION)
            elif found := COMMAND.match(plain):
                kind, position, text = found.groups()
                field = place_in_eeprom(int(position), int(kind))
            else:
                continue
            texts[field] = (text, place)
    return Settings(texts, paths)


def read_defined(stated: Settings) -> Settings:
    """Return the values of the EEPROM, and those of Configuration.h where it has none."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    if "DRIVE_SYSTEM" in stated and stated.text("DRIVE_SYSTEM", "")[0] not in DELTA:
        raise stated.error("DRIVE_SYSTEM", "3 (DELTA)")
    for name, field in DEFINED.items():
        if name in stated:
            texts[field] = stated.texts[name]
    if "ROD_RADIUS" not in stated and PARTS_OF_RADIUS[0] in stated:
        outer, *inner = (stated.number(name, "mm, a plain number") for name in PARTS_OF_RADIUS)
        texts[RADIUS] = (repr(outer - sum(inner)), stated.texts[PARTS_OF_RADIUS[0]][1])
    if STEPS not in texts or not re.fullmatch(r"[\d.]+", texts[STEPS][0]):
        texts.pop(STEPS, None)
        if all(name in stated for name in PARTS_OF_STEPS):
            micro, turn, pitch, teeth = (
                stated.number(name, ABOVE_ZERO, low=1e-6) for name in PARTS_OF_STEPS
            )
            place = stated.texts[PARTS_OF_STEPS[0]][1]
            texts[STEPS] = (repr(micro * turn / (pitch * teeth)), place)
    texts |= {field: value for field, value in stated.texts.items() if field.startswith("M206")}
    return Settings(texts, stated.paths)


def towers(stated: Settings) -> Towers:
    """Return the Delta as the firmware computes it, in whole steps."""
    stated = read_defined(stated)
    per_mm = stated.number(STEPS, "steps per mm (EPR:3 11, ZAXIS_STEPS_PER_MM)", low=1.0)
    radius = stated.number(RADIUS, "the horizontal rod radius in mm (EPR:3 885)", low=1.0)
    long = "the diagonal rod length in mm (EPR:3 881), more than the radius"
    rod = stated.number(ROD, long, low=radius)
    out = radius + _three(stated, RADII, "mm", 50.0)
    rods = rod + _three(stated, RODS, "mm", 50.0)
    alphas = np.array(
        [
            stated.number(field, "degrees, within 30 of the default", usual, usual - 30, usual + 30)
            for field, usual in zip(ALPHAS, DIRECTIONS, strict=True)
        ]
    )
    height = stated.number(HEIGHT, "Z max length in mm (EPR:3 153)", low=1.0)
    height -= stated.number(COATING, "mm", 0.0, -20, 20)
    stops = _three(stated, STOPS, "steps", 1e4)
    around = alphas * DEGREE
    places = out[:, None] * np.column_stack([np.cos(around), np.sin(around)])
    places = np.floor(places * per_mm + 0.5) / per_mm
    rods = np.floor(np.float32(rods) * np.float32(per_mm)).astype(float) / per_mm
    turned = np.degrees(np.arctan2(places[:, 1], places[:, 0])) - DIRECTIONS
    trim = (turned + 180) % 360 - 180
    scale = np.full(3, per_mm / MM)
    return Towers.of(
        np.hypot(*places.T), rods, trim, height + stops / per_mm, **deltas.count_steps(scale)
    )


def _three(stated: Settings, fields: Sequence[str], unit: str, most: float) -> Array:
    """Return numbers (3,), 0 where none is stated."""
    expected = f"{unit} from {-most:g} to {most:g}"
    return np.array([stated.number(field, expected, 0.0, -most, most) for field in fields])
