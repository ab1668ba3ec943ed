"""Maslow (up to version 3): GroundControl's groundcontrol.ini, or the settings that `$$` lists, and
a table of places to which the bit was sent and where it was measured.

GroundControl compares what `$$` lists with its own settings when it connects, and sends those that
differ: its file counts. It keeps the tooth count and the options in words beside the numbers that
it sends ([Computed Settings]); what was computed counts. The firmware stops at the edge of the
sheet. It reads `$13`, from which the radius of the sprockets follows, when it is sent, but not when
it starts: then the radius is 10.1 mm. The formulas are in importing/sled_chains.py. Sources:
MaslowCNC/Firmware fad6ad31 (Settings.cpp, Report.cpp, Kinematics.h) and MaslowCNC/GroundControl
baf5d831 (main.py, Settings/maslowSettings.py).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import LENGTHS, MM
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.drives import make_drive
from parallel_cal.importing.settings import Settings, SourceLine, read_lines, sha256
from parallel_cal.importing.sled_chains import SAG_UNIT, Quadrilateral, Triangular
from parallel_cal.importing.unit_doubts import doubt_unit
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.table import read_table, split_unit

CONFIGURATION = (".ini", ".txt", ".settings")
MACHINE_CLASS: MachineClass = "hobby"  # a frame of timber, chains, no switches
SECTION, PAIR = re.compile(r"\[([^\]]+)\]"), re.compile(r"([^=:]+?)\s*[=:]\s*(.*)")
SETTING = re.compile(r"\s*(\$\d+)\s*=\s*([^\s;(]*)")
GENERAL, ADVANCED, COMPUTED = (f"[{name} Settings] " for name in ("Maslow", "Advanced", "Computed"))
SENT, MEASURED = ("x", "y"), ("measured_x", "measured_y")
TABLE = (
    "expected tables (.csv) with the columns x and y (where the bit was sent), measured_x and "
    "measured_y in mm, and groundcontrol.ini or the list of the settings that $$ prints"
)
READINGS = (
    "the model's readings are lengths of chain in m, from 12 o'clock of each sprocket to the {}, "
    "as the firmware counts them"
)
DOUBLE_SINE = (
    "the firmware takes the sine twice where a chain leaves its sprocket: its chains are up to "
    "1.4 mm wrong at the corners of a full sheet. `import maslow` and the export compute as it does"
)
FIRMWARE_RADIUS = 10.1 * MM
RESTARTED = (
    "the sprockets have a radius of {:.4g} mm, but a controller that was switched on again takes "
    "10.1 mm until $13 is sent: send it after each start"
)


@dataclass(frozen=True)
class Field:
    """Where a number is stated: in GroundControl's file and in the firmware's list, with its
    default there."""

    ini: str
    setting: str
    default: float


FIELDS = {
    "sheet width": Field(f"{GENERAL}bedwidth", "$0", 2438.4),
    "sheet": Field(f"{GENERAL}bedheight", "$1", 1219.2),
    "spacing": Field(f"{GENERAL}motorspacingx", "$2", 2978.4),
    "height": Field(f"{GENERAL}motoroffsety", "$3", 463.0),
    "width": Field(f"{GENERAL}sledwidth", "$4", 310.0),
    "above": Field(f"{GENERAL}sledheight", "$5", 139.0),
    "below": Field(f"{GENERAL}sledcg", "$6", 79.0),
    "kind": Field(f"{COMPUTED}kinematicstypecomputed", "$7", 1.0),
    "rotation": Field(f"{ADVANCED}rotationradius", "$8", 100.0),
    "steps": Field(f"{ADVANCED}encodersteps", "$12", 8113.73),
    "turn": Field(f"{COMPUTED}distperrot", "$13", 63.5),
    "sag": Field(f"{ADVANCED}chainsagcorrection", "$37", 0.0),
    "over": Field(f"{COMPUTED}chainoversprocketcomputed", "$38", 1.0),
    "left": Field(f"{ADVANCED}leftchaintolerance", "$40", 0.0),
    "right": Field(f"{ADVANCED}rightchaintolerance", "$41", 0.0),
}
SPACING = ("the sizes of the machine, by the distance of its motors,", "the usual sizes")
SPACINGS = (0.5, 2.0)  # from that of a Maslow
RING_SIZES, MOUNT_SIZES = ("rotation",), ("width", "above", "below")
FIRMWARE_ROTATION = 250.0  # mm, the firmware's own default
WORDS = {  # that GroundControl keeps beside the number which it computed from them
    "kind": (f"{ADVANCED}kinematicstype", ("Quadrilateral", "Triangular")),
    "over": (f"{ADVANCED}chainoversprocket", ("Top", "Bottom")),
}
TEETH, PITCH = f"{ADVANCED}gearteeth", f"{ADVANCED}chainpitch"


def recognizes(path: Path) -> bool:
    """Whether a file is GroundControl's, or lists the settings of a Maslow: LinuxCNC's files, and
    lists of grblHAL and uCNC, have the same endings."""
    lines = [line for _, line in read_lines(path)]
    if path.suffix == ".ini":
        return any(re.match(r"\s*\[maslow settings\]", line, re.IGNORECASE) for line in lines)
    found = {match[1] for line in lines if (match := SETTING.match(line))}
    return is_listed(found)


def is_listed(settings: set[str]) -> bool:
    """Whether the names of settings are those of a Maslow: those of Grbl include `$100`."""
    return {"$2", "$7", "$8", "$13"} <= settings and "$100" not in settings


def settings(paths: Sequence[Path]) -> Settings:
    """Read `[section] key`, with the key in lower case as GroundControl writes it, and `$2=...`."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        section = ""
        for place, line in read_lines(path):
            plain = line.strip()
            if path.suffix != ".ini":
                if found := SETTING.match(line):
                    texts[found[1]] = (found[2], place)
            elif header := SECTION.fullmatch(plain):
                section = header[1]
            elif (pair := PAIR.fullmatch(plain)) and section and plain[0] not in "#;":
                field = f"[{section}] {pair[1].lower()}"
                if field in texts:
                    raise place.error(field, pair[2], "one value; GroundControl refuses a second")
                texts[field] = (pair[2].strip(), place)
    return Settings(texts, paths)


def is_of_firmware(stated: Settings) -> bool:
    """Whether the settings are those that `$$` lists, not GroundControl's."""
    return any(field.startswith("$") for field in stated.texts)


def read_number(stated: Settings, name: str, expected: str = "mm", low: float = 0.0) -> float:
    """Return a number of FIELDS as it is stated; of GroundControl's, what it would compute. The
    motors may be below the upper edge of the sheet."""
    field, default = FIELDS[name], FIELDS[name].default
    low = -np.inf if name == "height" else low
    if is_of_firmware(stated):
        default = FIRMWARE_ROTATION if name == "rotation" else default
        return stated.number(field.setting, expected, default, low)
    if field.ini in stated:
        return stated.number(field.ini, expected, low=low)
    if name in WORDS and WORDS[name][0] in stated:
        key, words = WORDS[name]
        text, _ = stated.text(key, "")
        if text not in words:
            raise stated.error(key, " or ".join(words))
        return 1.0 + words.index(text)
    if name == "turn":
        return stated.number(TEETH, "teeth", 10.0, 1.0) * stated.number(PITCH, "mm", 6.35, low)
    return default


def chains(stated: Settings) -> Triangular | Quadrilateral:
    """Return the machine as configured."""

    def m(name: str) -> float:
        return read_number(stated, name) * MM

    spacing, height, radius = m("spacing"), m("height") + m("sheet") / 2, m("turn") / (2 * np.pi)
    if read_number(stated, "kind", "1 (quadrilateral) or 2 (triangular)") == 1:
        return Quadrilateral(spacing, height, radius, m("width"), m("above"), m("below"))
    left, right = (read_number(stated, side, "percent", -100.0) / 100 for side in ("left", "right"))
    return Triangular(
        spacing,
        height,
        radius,
        m("rotation"),
        read_number(stated, "over", "1 (top) or 2 (bottom)") == 1,
        read_number(stated, "sag", "a number, at least 0") * SAG_UNIT,
        left,
        right,
    )


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the machine as configured."""
    stated = settings(paths)
    machine = chains(stated)
    ring = isinstance(machine, Triangular)
    remarks = [READINGS.format("bit, less the rotation radius" if ring else "mount")]
    kind = "setting" if is_of_firmware(stated) else "ini"
    sizes = {
        getattr(FIELDS[name], kind): read_number(stated, name)
        for name in ("sheet", "spacing", "height", *(RING_SIZES if ring else MOUNT_SIZES))
    }
    if lacking := [f"{field} {size:g} mm" for field, size in sizes.items() if field not in stated]:
        remarks.append(f"not stated, so that the default counts: {', '.join(lacking)}")
    if not ring:
        remarks.append(DOUBLE_SINE)
    spacing = read_number(stated, "spacing") / FIELDS["spacing"].default
    remarks += doubt_unit(spacing, *SPACING, SPACINGS)
    if abs(machine.radius - FIRMWARE_RADIUS) > 0.02 * MM:
        remarks.append(RESTARTED.format(machine.radius / MM))
    remarks += stated.describe_unused()
    model = machine.model()
    model.mechanism.drives = (make_drive(read_number(stated, "turn") * MM),) * 2
    return ConfiguredRobot(model, tuple(remarks), None)


def samples(paths: Sequence[Path], sigma: float | None = None) -> Dataset:
    """Read tables of places, with the settings by which the firmware moved there; `sigma` (m) is
    the noise of a measured coordinate. The noise of a chain is that of a step of its encoder.

    Coordinates are expected to count from the middle of the sheet along its edges, as those that
    are sent. If they do not, a fit finds where they count from.
    """
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    setup = [path for path in paths if path not in tables]
    if not tables or not setup:
        raise DatasetError(f"{', '.join(map(str, paths))}: {TABLE}")
    stated = settings(setup)
    machine = chains(stated)
    edge = np.array([read_number(stated, name) / 2 for name in ("sheet width", "sheet")]) * MM
    sent, measured = (
        np.concatenate(each) for each in zip(*(_places(path, edge) for path in tables), strict=True)
    )
    warnings = [
        words
        for places, name in ((sent, "sent"), (measured, "measured"))
        for words in _doubt_places(places, edge, f"the {name} places")
    ]
    q = machine.joints(sent)
    step = read_number(stated, "turn") * MM / read_number(stated, "steps", "steps a turn", 1.0)
    covariance = None if sigma is None else np.diag([sigma**2] * 3 + [np.nan] * 3)
    found = Dataset.from_arrays(
        ["left", "right"],
        q,
        measured,
        measured=np.array([True, True, False, False, False, False]),
        pose_cov=covariance,
        joint_sigma=np.full(2, step / 12**0.5),
        joint_units=("m", "m"),
        frame="base",
        source=", ".join(map(str, paths)),
        sha256=sha256(paths),
    )
    return replace(found, warnings=(*found.warnings, *warnings, *stated.describe_unused()))


def _places(path: Path, edge: Array) -> tuple[Array, Array]:
    """Return where the bit was sent and where it was measured, (N, 3) m each."""
    table = read_table(path).drop_empty_rows()
    words = [table.find(name) for name in (*SENT, *MEASURED)]
    if None in words:
        raise DatasetError(f"{path}:1: the columns are {', '.join(table.header)}: {TABLE}")
    columns = [word for word in words if word]
    units = [split_unit(word)[1] or "mm" for word in columns]
    if wrong := [word for word, unit in zip(columns, units, strict=True) if unit not in LENGTHS]:
        raise DatasetError(f"{path}:1: column {wrong[0]} is no length: {', '.join(LENGTHS)}")
    numbers = table.numbers(columns) * [LENGTHS[unit] for unit in units]
    beyond = np.abs(numbers[:, :2]) > edge + 1e-9
    for k, axis in np.argwhere(beyond)[:1]:
        place = SourceLine(path, table.lines[k])
        raise place.error(
            columns[axis],
            f"{numbers[k, axis] / MM:g} mm",
            f"a place on the sheet, within {edge[axis] / MM:g} mm: the firmware stops at its edge"
            + "".join(f"; {words}" for words in _doubt_places(numbers, edge, "the sent places")),
        )
    heights = np.zeros((len(numbers), 1))
    return np.hstack([numbers[:, :2], heights]), np.hstack([numbers[:, 2:], heights])


def _doubt_places(places: Array, edge: Array, what: str) -> list[str]:
    """Name the unit with which places (N, 2 or more) m fill a sheet with edges (2,) m."""
    share = float((np.abs(places[:, :2]) / edge).max(initial=0.0))
    return doubt_unit(share, what, "the sizes of the sheet")
