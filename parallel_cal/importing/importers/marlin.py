"""Marlin: a captured log of a linear Delta, with M503 and the touches of G29, G30 or G33.

Its settings may also be in a file of commands (.gcode), or in Configuration.h.

Touches are the lines `Bed X: Y: Z:` (G29 V4, G30), and the report of `G33 P2 V3` or `P3`, whose
numbers are single touches (except for a mean near the centre). With P4 and more they are means over
the bed and are not used. A touch belongs to the settings before it. Joints count from the
end-stops, so the settings may change within a log; the last ones are the machine's. M501 returns to
those that M500 stored, M502 to those of Configuration.h. A setting of a log counts before the same
one of Configuration.h, as the stored one does in the firmware. Sources: Marlin documentation,
"M665", "M666", "M851", "G29", "G30", "G33 - Delta Auto Calibration"; src/module/settings.cpp.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Towers
from parallel_cal.importing.gcode import (
    HOST_PREFIX,
    STEPS_FIELDS,
    parse_settings_line,
    read_scale,
)
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.importing.touch_samples import make_joint_samples, make_printed_ends
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array

CONFIGURATION = (".log", ".txt", ".gcode", ".h")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
CODES = ("M92", "M665", "M666", "M851")
BED = re.compile(r"Bed X:\s*(\S+)\s+Y:\s*(\S+)\s+Z:\s*(\S+)")
REPORT = re.compile(r"(?<!\w)(c|x|y|z|yz|zx|xy):\s*([-+.\w]+)")
SETTING = re.compile(r"(Height|E[xyz]|Radius|T[xyz]):\s*([-+.\w]+)")
# Names in Configuration.h and the commands that set the same.
DEFINITIONS = {
    "DELTA_DIAGONAL_ROD": ("M665 L",),
    "DELTA_RADIUS": ("M665 R",),
    "DELTA_HEIGHT": ("M665 H",),
    "DELTA_TOWER_ANGLE_TRIM": ("M665 X", "M665 Y", "M665 Z"),
    "DELTA_DIAGONAL_ROD_TRIM_TOWER": ("M665 A", "M665 B", "M665 C"),
    "DELTA_ENDSTOP_ADJ": ("M666 X", "M666 Y", "M666 Z"),
    "NOZZLE_TO_PROBE_OFFSET": ("M851 X", "M851 Y", "M851 Z"),
}
# Its values are those of M92 X Y Z, and of the extruders, if they are plain numbers.
STEPS_DEFINED = "DEFAULT_AXIS_STEPS_PER_UNIT"
DEFINED, RADIUS_TRIM = "DELTA_RADIUS", "DELTA_RADIUS_TRIM_TOWER"  # no command sets the latter
DEFINITION = re.compile(r"\s*#define\s+(\w+)\s+(\{[^}]*\}|[^/]*[^/\s])")
FIELDS = {"Height": "M665 H", "Radius": "M665 R"}
FIELDS |= {f"E{a}": f"M666 {a.upper()}" for a in "xyz"}
FIELDS |= {f"T{a}": f"M665 {a.upper()}" for a in "xyz"}
# The points of G33.
POINT_ANGLES_DEG = {"x": 210, "xy": 270, "y": 330, "yz": 30, "z": 90, "zx": 150}
KEPT = ", which M665 without it does not change: capture M503, which lists what the printer has"
Z_ONLY = np.array([0.0, 0.0, 1.0])  # G33 moves the nozzle over its points, with O the probe
STEPS = 80.0  # per mm, if M92 is not in the log
STORE, RESTORE, RESET = "M500", "M501", "M502"
MEANS = "G33's numbers are means of several touches, except for P2 and P3: not used"


def samples(
    paths: Sequence[Path], printed_x: Sequence[float] = (), printed_y: Sequence[float] = ()
) -> Dataset:
    """Read the touches of a log; G33 with more than P3, or without its command, is not used."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    remarks = list[str]()
    stated, skipped = Settings(texts, paths, remarks=remarks), False
    found, visits, configurations = list[Array](), list[Array](), dict[str, int]()

    def touch_at(nozzle: Array) -> None:
        found.append(_reading(stated, nozzle))
        # The same x and y by other settings are another place.
        words = repr(sorted((field, text) for field, (text, _) in texts.items()))
        number = configurations.setdefault(words, len(configurations))
        visits.append(np.array([*nozzle[:2], number]))

    radius, single, shift = None, False, Z_ONLY
    for place, line in _iterate_lines(paths, texts, remarks):
        if asked := re.search(r"(?<!\w)G33\b(.*)", line):
            points = re.search(r"P(\d+)", asked[1])
            if "Calibrate" not in line:
                single = points is not None and int(points[1]) in (1, 2, 3)
                shift = np.ones(3) if re.search(r"\bO", asked[1]) else Z_ONLY
        elif at := re.search(r"at radius:\s*(\S+)", line):
            radius = place.number("at radius", at[1], "mm above 0", low=1.0)
        elif touch := BED.search(line):
            bed = [
                place.number(f"Bed {a}", t, "mm", -1e3, 1e3)
                for a, t in zip("XYZ", touch.groups(), strict=True)
            ]
            touch_at(np.array(bed) * MM - tip(stated))
        elif line.startswith(".") and (report := REPORT.findall(line)):
            skipped |= not single
            for name, text in report if single else ():
                z = place.number(f"G33 {name}", text, "mm within 20 of the bed", -20.0, 20.0)
                out = 0.0
                if name != "c":  # older versions state the circle by M665 B
                    out = radius or stated.number("M665 B", "'at radius:' of G33, in mm", low=1.0)
                turn = POINT_ANGLES_DEG.get(name, 0) * DEGREE
                nozzle = np.array([out * np.cos(turn), out * np.sin(turn), z])
                touch_at(nozzle * MM - tip(stated) * shift)
    if not found:
        expected = "'Bed X: Y: Z:' lines (G29 V4, G30) or the report of G33 P2 V3 or P3 V3"
        why = f"; {MEANS}" if skipped else ""
        raise DatasetError(f"{', '.join(map(str, paths))}: no touches, expected {expected}{why}")
    step = [MM / stated.number(f"M92 {a}", "steps per mm", STEPS, low=1e-3) for a in "XYZ"]
    delta = towers(stated)
    q, printed = np.array(found) + delta.end_stops, make_printed_ends(delta, printed_x, printed_y)
    means = [MEANS] if skipped else []
    touched = make_joint_samples(
        delta, q, np.zeros(len(q)), paths, step, np.array(visits), warnings=means, printed=printed
    )
    return replace(touched, configuration=deltas.end_stops(delta))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer that the last settings in a log, or a Configuration.h, describe."""
    stated = settings(paths)
    remarks = stated.remarks if "M665 R" in stated else ()  # not of M502, if Configuration.h counts
    printer, probe = towers(stated), tip(stated)
    remarks = [*remarks, *stated.describe_misspelt()]
    return deltas.make_configured_robot(printer, probe, remarks=remarks)


def settings(paths: Sequence[Path]) -> Settings:
    """Read the last value of each word of the commands, or the definitions of Configuration.h."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    headers, remarks = [path for path in paths if path.suffix == ".h"], list[str]()
    for _ in _iterate_lines([path for path in paths if path not in headers], texts, remarks):
        pass
    for path in headers:
        for place, line in read_lines(path):
            found = DEFINITION.match(line)
            if not found:
                continue
            used = found[1] in (*DEFINITIONS, RADIUS_TRIM, STEPS_DEFINED)
            if used and found[1] in texts and found[1].startswith(("DELTA_", "DEFAULT_")):
                raise place.error(
                    found[1], found[2], "one definition of it; delete those that #if excludes"
                )
            texts[found[1]] = (found[2], place)
    return Settings(texts, paths, remarks=remarks)


def _read_defined(stated: Settings) -> Settings:
    """Return the definitions of Configuration.h as words of commands, and those of commands."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for name, fields in DEFINITIONS.items():
        if name in stated:
            _, place = stated.text(name, "")
            words = _split(stated, name, len(fields))
            for word in words:
                place.number(name, word, "a number, or numbers in braces, without a formula")
            texts |= {field: (word, place) for field, word in zip(fields, words, strict=True)}
    if steps := read_steps(stated):
        place = stated.text(STEPS_DEFINED, "")[1]
        texts |= {f: (word, place) for f, word in zip(STEPS_FIELDS, steps, strict=False)}
    texts |= {field: value for field, value in stated.texts.items() if field.startswith("M")}
    return Settings(texts, stated.paths)


def read_steps(stated: Settings) -> list[str]:
    """Return the texts of DEFAULT_AXIS_STEPS_PER_UNIT; none if the first three are no numbers."""
    text = stated.texts[STEPS_DEFINED][0] if STEPS_DEFINED in stated else ""
    words = [word.strip() for word in text.strip("{} ").split(",")]
    plain = [re.fullmatch(r"\d+(\.\d*)?", word) for word in words[: len(STEPS_FIELDS)]]
    return words if all(plain) and len(plain) == len(STEPS_FIELDS) else []


def _split(stated: Settings, name: str, n: int) -> list[str]:
    """Return the texts of n values `{ a, b, c }`, or of a single one."""
    text, _ = stated.text(name, "")
    words = [word.strip() for word in text.strip("{} ").split(",")]
    if len(words) != n or (n > 1) != text.startswith("{"):
        raise stated.error(name, f"{n} numbers in braces" if n > 1 else "a number in mm")
    return words


def tip(stated: Settings) -> Array:
    """Return the probe's tip in {P} (m): M851, from the nozzle to the probe."""
    stated = _read_defined(stated) if DEFINED in stated else stated
    return np.array([stated.number(f"M851 {a}", "mm", 0.0, -200, 200) for a in "XYZ"]) * MM


def _iterate_lines(
    paths: Sequence[Path], texts: dict[str, tuple[str, SourceLine]], remarks: list[str]
) -> Iterator[tuple[SourceLine, str]]:
    """Yield every line without the host's prefix, and keep `texts` at the settings in memory."""
    stored: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            plain = HOST_PREFIX.sub("", line).strip()
            code = parse_settings_line(texts, place, plain, (*CODES, STORE, RESTORE, RESET))
            if code == STORE:
                stored = dict(texts)
            elif code == RESTORE and stored:
                texts.clear()
                texts.update(stored)
                remarks.clear()
            elif code == RESTORE:
                remarks[:] = [
                    f"{place.path}:{place.line}: M501 returns to values that M500 stored before "
                    "this log. Send M503 after it"
                ]
            elif code == "M665":
                remarks.clear()
            elif code == RESET:
                texts.clear()
                remarks[:] = [
                    f"{place.path}:{place.line}: M502 returns to the values of Configuration.h. "
                    "Send M503 after it, or give Configuration.h as well"
                ]
            if code is None and plain.startswith("."):
                for name, text in SETTING.findall(plain):
                    texts[FIELDS[name]] = (text, place)
            yield place, plain


def _reading(stated: Settings, nozzle: Array) -> Array:
    """Return the carriages (3,) in m from their end-stops."""
    delta = towers(stated)
    q = delta.joints(nozzle[None])[0] - delta.end_stops
    if np.isfinite(q).all():
        return np.asarray(q)
    raise stated.error("M665 L", f"rods that reach {np.round(nozzle / MM, 2).tolist()} mm")


def towers(stated: Settings) -> Towers:
    """Return the Delta of M665 L R H X Y Z, with A B C added to the rods, and of M666 X Y Z.

    M666 is the distance by which the nozzle is lowered from its end-stop to the height H.
    """
    out = np.zeros(3)
    if DEFINED in stated:
        if RADIUS_TRIM in stated:
            words = _split(stated, RADIUS_TRIM, 3)
            place = stated.text(RADIUS_TRIM, "")[1]
            out = np.array([place.number(RADIUS_TRIM, w, "mm", -50, 50) for w in words])
        stated = _read_defined(stated)
    radius = stated.number("M665 R", "the delta radius in mm", low=1.0)
    more = [0.0, 0.0, 0.0]
    if "M665 A" in stated or "M665 C" in stated:  # otherwise B is a radius
        more = [stated.number(f"M665 {t}", "mm", 0.0, -10, 10) for t in "ABC"]
    rod = stated.number("M665 L", "the rods' length in mm, more than the radius", low=radius)
    stops = [stated.number(f"M666 {t}", "mm, 0 or less", 0.0, high=0.0) for t in "XYZ"]
    homed = stated.number("M665 H", f"the homed height in mm{KEPT}", low=0.0)
    trim = [stated.number(f"M665 {t}", "degrees", 0.0, -30, 30) for t in "XYZ"]
    heights = homed - np.array(stops)
    return Towers.of(
        radius + out, rod + np.array(more), trim, heights, **deltas.count_steps(read_scale(stated))
    )
