"""RepRapFirmware (Duet): `heightmap.csv` and `config.g` of linear and rotary Deltas.

A cell of the map is the height of the nozzle by the firmware, minus the probe's trigger height,
when the probe triggered over this point of the bed. Sources: Duet documentation, "Mesh bed
compensation", "Configuring RepRapFirmware for a delta printer", G-code dictionary (G31, M92, M665,
M666, M669).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Delta, Shoulders, Towers
from parallel_cal.importing.fivebar import TURNS, FiveBars
from parallel_cal.importing.gcode import STEPS_FIELDS, read_scale, settings
from parallel_cal.importing.hangprinter import Hangprinter
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.importing.touch_samples import (
    MAX_HEIGHT_MM,
    make_printed_ends,
    make_touch_samples,
    read_touch_table,
)
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array, Dropped

CONFIGURATION = (".g",)
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
CODES = ("G31", "M92", "M665", "M666", "M669")
KINDS = "3 (linear Delta), 10 (rotary Delta) or, for `new`, 6 (Hangprinter) or 9 (five-bar)"
HEAD = "RepRapFirmware height map file v2"
LABELS = (
    "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1",
    "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum",
    "xmin,xmax,ymin,ymax,radius,spacing,xnum,ynum",
)
UNEQUAL_ARMS = (
    "RepRapFirmware (read up to 3.5.3) computes the heights of all three arms with the length of "
    "arm A when it computes the position from the motors, as after homing"
)
STEPS = 80.0  # per mm or degree, if M92 is missing
ANCHORS = "ABCDI"  # letters of M669 that are anchors
# What the firmware (read 3.5.3) assumes for words that a machine may do without, by M669 K.
DEFAULTS = {
    3: {"M665 H": "240"},
    6: {"M666 Q": "0.007", "M666 R": "75", "M666 L": "20", "M666 H": "255"},
    9: {"M669 C": "10:170:10:170"},
}
ABOVE = "M669 D"  # the anchor above the others
OLD_ANCHOR = (
    f"{ABOVE} is one number: the height of the anchor above the origin, as firmware before May "
    "2021 reads it. An export writes x:y:z, which needs newer firmware"
)
SWITCHES = {1: "20:10", 2: "110:20", 4: "110:100"}  # of a five-bar by its work mode: M669 B
ADVANTAGES = (2, 2, 2, 2, 4)  # of a Hangprinter's lines: M666 U


def samples(
    paths: Sequence[Path], printed_x: Sequence[float] = (), printed_y: Sequence[float] = ()
) -> Dataset:
    """Read the touches of height maps; G31 is the offset of the probe's tip from the nozzle."""
    maps = [path for path in paths if path.suffix.lower() == ".csv"]
    if not maps or len(maps) == len(paths):
        raise DatasetError(
            f"{', '.join(map(str, paths))}: expected height maps (.csv) and the "
            "configuration that was active when they were probed (config.g, "
            "config-override.g, in the order in which they are read)"
        )
    stated = settings([path for path in paths if path not in maps], CODES)
    delta, assumed = read_delta(stated), describe_defaults(stated)
    unit = DEGREE if kind(stated) == 10 else MM  # in which M92 counts the steps
    read = [read_map(path) for path in maps]
    points = np.concatenate([each[0] for each in read])
    found = make_touch_samples(
        delta,
        points - tip(stated),
        [place for each in read for place in each[1]],
        paths,
        [unit / stated.number(f, "steps per unit", STEPS, low=1e-3) for f in STEPS_FIELDS],
        visits=points[:, :2],
        dropped=[gap for each in read for gap in each[2]],
        warnings=stated.describe_unused(),
        printed=make_printed_ends(delta, printed_x, printed_y),
    )
    return replace(found, warnings=(*found.warnings, *assumed))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured; M666 A and B are the slopes of the bed."""
    stated = settings(paths, CODES)
    assumed = [*describe_defaults(stated), *stated.describe_unused()]
    if kind(stated) == 6:
        remarks = [*assumed, "lines on spools of one radius and advantage share it"]
        if ":" not in stated.text(ABOVE, "x:y:z")[0]:
            remarks.append(OLD_ANCHOR)
        if stated.number("M666 W", "kg", 0.0) > 0:
            remarks.append("M666 W: the firmware's correction of the lines' stretch is not used")
        lines = read_hangprinter(stated)
        try:
            return ConfiguredRobot(lines.model(), tuple(remarks))
        except ModelError as error:
            raise stated.error("M669 A", f"other anchors: {error}") from None
    if kind(stated) == 9:
        return ConfiguredRobot(new_model(read_five_bars(stated).mechanism()), tuple(assumed))
    delta = read_delta(stated)
    remarks = assumed
    if isinstance(delta, Shoulders):
        deltas.check_reach(delta, stated, "M669 H")
        if np.ptp(delta.arms):
            remarks.append(f"M669 U has different arms, but {UNEQUAL_ARMS}")
    plate = delta.tilt if isinstance(delta, Towers) else (0.0, 0.0)
    return deltas.make_configured_robot(delta, tip(stated), plate, remarks)


def tip(stated: Settings) -> Array:
    """Return the probe's tip in {P} (m): G31 X and Y beside the nozzle, Z below it."""
    x, y, z = (stated.number(f"G31 {axis}", "the probe's offset in mm", 0.0) for axis in "XYZ")
    return np.array([x, y, -z]) * MM


def read_map(path: Path) -> tuple[Array, list[SourceLine], list[Dropped]]:
    """Read points (N, 3) in m of a height map or of a table with columns x, y and z, the line of
    each, and cells without a touch."""
    rows = read_lines(path)
    if not rows or not rows[0][1].startswith(HEAD):
        first = rows[0][1][:40] if rows else ""
        is_map = first.startswith(HEAD.rpartition(" ")[0])  # of another version
        if rows and not is_map and (found := read_touch_table(path)):
            return *found, []
        expected = f"'{HEAD} ...', or a table with the columns x, y and z of touches in mm"
        raise SourceLine(path, 1).error("the first line", first, expected)
    if len(rows) < 3:
        raise SourceLine(path, len(rows) + 1).error(
            "the file's end", "", f"'{LABELS[0]}' and a grid"
        )
    label = rows[1][1].replace(" ", "")
    if label not in LABELS:
        raise rows[1][0].error("the names line", rows[1][1], f"'{LABELS[0]}'")
    axes = _grid(*rows[2], label.split(","))
    points, places, dropped = [], [], []
    body = [(place, line) for place, line in rows[3:] if line.strip()]
    if len(body) != len(axes[1]):
        end = SourceLine(path, body[-1][0].line if body else 3)
        raise end.error("the last row", f"{len(body)}", f"row {len(axes[1])} of the grid")
    for y, (place, line) in zip(axes[1], body, strict=True):
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != len(axes[0]):
            raise place.error("the row's length", str(len(cells)), f"{len(axes[0])} heights")
        for k, (x, cell) in enumerate(zip(axes[0], cells, strict=True), start=1):
            if cell == "0" or cell.lower() == "nan":
                where = f"{path}:{place.line}: column {k}, x {x:g} y {y:g} mm"
                dropped.append(Dropped(0.0, "not probed", where))
                continue
            within = f"a height in mm within {MAX_HEIGHT_MM:g} of the bed, or 0 if none was probed"
            height = place.number(f"column {k}", cell, within, -MAX_HEIGHT_MM, MAX_HEIGHT_MM)
            points.append((x, y, height))
            places.append(place)
    return np.array(points).reshape(-1, 3) * MM, places, dropped


def _grid(place: SourceLine, line: str, names: Sequence[str]) -> tuple[list[float], list[float]]:
    """Return the grid's x and y (mm)."""
    cells = [cell.strip() for cell in line.split(",")]
    if len(cells) != len(names):
        raise place.error(
            "the grid's line", line.strip(), f"{len(names)} values: {','.join(names)}"
        )
    found = dict(zip(names, cells, strict=True))
    for name, axis in (("axis0", "X"), ("axis1", "Y")):
        if found.get(name, axis) != axis:
            raise place.error(name, found[name], axis)
    axes = []
    for i, axis in enumerate("xy"):
        field = {"low": f"{axis}min", "high": f"{axis}max", "n": f"{axis}num"}
        field["step"] = "spacing" if "spacing" in found else f"{axis}spacing"
        if "axis0" in found:
            field = {"low": f"min{i}", "high": f"max{i}", "step": f"spacing{i}", "n": f"num{i}"}
        low, high = (place.number(field[k], found[field[k]], "mm") for k in ("low", "high"))
        step = place.number(field["step"], found[field["step"]], "mm above 0", low=1e-6)
        text = found[field["n"]]
        most = math.floor((high - low) / step + 1.5)
        if not text.isdigit() or not 2 <= int(text) <= most:
            raise place.error(field["n"], text, f"2 to {most} points from {low:g} to {high:g} mm")
        axes.append([low + step * k for k in range(int(text))])
    return axes[0], axes[1]


def kind(stated: Settings) -> int:
    return int(stated.number("M669 K", KINDS, 3.0))


def find_defaults(stated: Settings) -> dict[str, str]:
    """Return the texts that the firmware assumes for words that the files do not state."""
    found = dict(DEFAULTS.get(kind(stated), {}))
    if kind(stated) == 6:
        found["M666 U"] = ":".join(map(str, ADVANTAGES[: _count_anchors(stated)]))
    if kind(stated) == 9:
        found["M669 B"] = SWITCHES[_work_mode(stated)]
    return {field: text for field, text in found.items() if field not in stated}


def describe_defaults(stated: Settings) -> list[str]:
    """Name the words that the files do not state, with what the firmware assumes for them."""
    assumed = ", ".join(f"{field} {text}" for field, text in find_defaults(stated).items())
    if not assumed:
        return []
    return [
        f"not stated, so the default of RepRapFirmware (3.5.3) is taken: {assumed}. If your "
        "machine states another value elsewhere, give that file as well"
    ]


def with_defaults(stated: Settings) -> Settings:
    """Return settings with what the firmware assumes for words that the files do not state."""
    place = SourceLine(stated.paths[0], 1)
    assumed = {field: (text, place) for field, text in find_defaults(stated).items()}
    return replace(stated, texts=assumed | stated.texts)


def read_delta(stated: Settings) -> Delta:
    stated = with_defaults(stated)
    if kind(stated) == 3:  # M665 L R H B X Y Z and M666 X Y Z A B; A and B are in per cent
        radius = stated.number("M665 R", "the delta radius in mm", low=1.0)
        least = "rod lengths in mm, longer than the delta radius"
        rods = stated.numbers("M665 L", least, 3, low=radius)
        trim = [stated.number(f"M665 {tower}", "degrees", 0.0, -30, 30) for tower in "XYZ"]
        stops = [stated.number(f"M666 {tower}", "mm", 0.0) for tower in "XYZ"]
        tilt = [stated.number(f"M666 {axis}", "per cent", 0.0, -20, 20) / 100 for axis in "AB"]
        homed = stated.number("M665 H", "the homed height in mm", low=0.0)
        heights = homed + np.array(stops)
        reach = _reach(stated, "M665 B")
        more = {"tilt": (tilt[0], tilt[1]), "reach": reach, "scale": scale(stated)}
        return Towers.of(radius, rods, trim, heights, **more)
    if kind(stated) != 10:
        raise stated.error("M669 K", KINDS)
    # M669 K10 U L H A R B X Y Z and M666 X Y Z (degrees)
    arm = "least:most degrees of an arm"
    span = stated.numbers("M669 A", arm, 2) if "M669 A" in stated else np.array([-45.0, 45.0])
    trim = [stated.number(f"M669 {tower}", "degrees", 0.0, -30, 30) for tower in "XYZ"]
    stops = [stated.number(f"M666 {tower}", "degrees", 0.0) for tower in "XYZ"]
    if span[1] + min(stops) <= span[0]:
        raise stated.error("M669 A", arm)
    return Shoulders(
        stated.number("M669 R", "the delta radius in mm", low=0.0) * MM,
        stated.numbers("M669 H", "heights of the arms' bearings in mm", 3, low=1.0) * MM,
        stated.numbers("M669 U", "arm lengths in mm", 3, low=1.0) * MM,
        stated.numbers("M669 L", "rod lengths in mm", 3, low=1.0) * MM,
        (np.array([210.0, 330.0, 90.0]) + trim) * DEGREE,
        tuple((span[0] * DEGREE, (span[1] + stop) * DEGREE) for stop in stops),
        _reach(stated, "M669 B"),
    )


def scale(stated: Settings) -> Array | None:
    """Return the steps (3,) of the motors for 1 m of a carriage.

    None if they are not stated, or if several motors have them from one variable.
    """
    places = [stated.texts[field] for field in STEPS_FIELDS if field in stated]
    if any(a is b for a, b in combinations(places, 2)):
        return None
    return read_scale(stated)


def _reach(stated: Settings, field: str) -> float | None:
    if field not in stated:
        return None
    return stated.number(field, "the bed's radius in mm", low=1.0) * MM


def read_hangprinter(stated: Settings) -> Hangprinter:
    """Return the Hangprinter of M669 K6 N with one triple per anchor, and M666 Q R U O L H."""
    stated, n = with_defaults(stated), _count_anchors(stated)
    rows, expected = [], "x:y:z of the anchor in mm"
    for field in (f"M669 {letter}" for letter in ANCHORS[:n]):
        if ":" in stated.text(field, expected)[0]:
            rows.append(stated.numbers(field, expected, 3))
        elif field == ABOVE:
            rows.append(np.array([0.0, 0.0, stated.number(field, expected)]))
        else:  # a single number does not stand for all
            raise stated.error(field, expected)
    anchors = np.array(rows)

    def each(letter: str, what: str) -> Array:
        return stated.numbers(f"M666 {letter}", what, n, low=1e-6)

    radii = each("R", "spool radii in mm") * MM
    gears = each("H", "teeth of the spools' gears") / each("L", "teeth of the motors' gears")
    on_spool = stated.numbers("M666 O", "number of lines on each spool", n, 1.0, low=1.0)
    if len({*on_spool}) > 1:
        raise stated.error("M666 O", "the same number of lines on every spool")
    buildup = stated.number("M666 Q", "the build-up in mm", low=0.0) * MM * on_spool[0]
    return Hangprinter(anchors * MM, radii, gears, each("U", "mechanical advantages"), buildup)


def _count_anchors(stated: Settings) -> int:
    return int(stated.number("M669 N", "the number of anchors", 4.0, 4, len(ANCHORS)))


def _work_mode(stated: Settings) -> int:
    mode = stated.number("M669 L", "the work mode", 1.0)
    if mode not in TURNS:
        raise stated.error("M669 L", f"one of the work modes {', '.join(map(str, TURNS))}")
    return int(mode)


def read_five_bars(stated: Settings) -> FiveBars:
    """Return the five-bar of M669 K9: X, Y, P, D (cantilevers of 0), L, B and C.

    L is the work mode, B the angles at the switches, and C the limits of the cranks (degrees).
    """

    stated, mode = with_defaults(stated), _work_mode(stated)

    def both(letter: str, what: str, low: float = -np.inf) -> Array:
        return stated.numbers(f"M669 {letter}", f"{what} of left:right", 2, low=low)

    turns = "least:most degrees of left:right"
    least, most = stated.numbers("M669 C", turns, 4).reshape(2, 2).T
    if (most <= least).any():
        raise stated.error("M669 C", turns)
    homed = both("B", "degrees at the switches") * DEGREE
    axes = np.column_stack([both("X", "mm"), both("Y", "mm")]) * MM
    if (axes[0] == axes[1]).all():
        raise stated.error("M669 X", "two axes, in mm of left:right")
    whole = "lengths in mm of left:right, and cantilevers of 0"
    count = 4 if stated.text("M669 D", whole)[0].count(":") > 1 else 2
    rods = stated.numbers("M669 D", whole, count, low=0.0)
    if rods[2:].any() or not rods[:2].all():
        raise stated.error("M669 D", whole)
    limits = tuple(zip((least * DEGREE).tolist(), (most * DEGREE).tolist(), strict=True))
    cranks = both("P", "lengths in mm", 1.0) * MM
    bars = FiveBars(axes, cranks, rods[:2] * MM, TURNS[mode], homed, limits)
    if not np.isfinite(bars.mechanism().home.joints).all():
        raise stated.error("M669 P", "cranks whose rods meet in front of the axes")
    return bars
