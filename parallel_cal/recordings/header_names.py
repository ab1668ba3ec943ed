"""The meaning of a table's columns by their names, where no column map states it."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import CONDITION_UNITS
from parallel_cal.model.effect import CONDITIONS, parse_part
from parallel_cal.recordings.columns import (
    ColumnMap,
    JointColumn,
    PositionColumns,
    ReadingColumn,
)
from parallel_cal.recordings.joint_names import match_numbered_names, rename_conditions
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import Table, split_condition, split_unit

SAMPLE_NAMES = ("shot", "id", "name", "label", "point")  # usual names of the column of a row's name
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# Names of the columns of a position, in capitals or not; the first ones that a table has count.
POSITIONS = (
    POSITION,
    *(
        tuple(form.format(axis) for axis in POSITION)
        for form in ("p{}", "t{}", "pos_{}", "position_{}", "position.{}")
    ),
)
OTHER_NAMES = {"time": ("timestamp",)}  # of conditions, whose meaning is clear
# Units that people use, by their SI unit: the first one if no number is larger than the limit.
USUAL_UNITS = {"rad": ("rad", 7.0, "deg"), "m": ("m", 5.0, "mm")}
# Quaternions as trackers export them (x y z w): Leica's T-Mac and T-Probe have the scalar first.
EXPORTED_QUATERNIONS = (
    QUATERNION,
    ("q1", "q2", "q3", "q0"),
    ("quaternion1", "quaternion2", "quaternion3", "quaternion0"),
    ("dquaternion1", "dquaternion2", "dquaternion3", "dquaternion0"),
)
MAX_NORM_ERROR = 0.01  # of a quaternion; four other columns q0 to q3 are none
# What reads the touches of each firmware.
TOUCH_IMPORTS = (
    "A table of touches of a bed (x, y and the height z) has no joint readings: import it with the "
    "configuration of the machine, from which its joints follow: parallel-cal import rrf {table} "
    "config.g -o touches.json (RepRapFirmware), or import klipper, marlin or linuxcnc with the "
    "files in which these store their touches (docs/delta_printer_details.md)"
)
MAX_SHOWN_HEADER = 400  # characters of a table's header in a message


def map_by_names(
    table: Table, joints: Sequence[str], beside: Path, controls: Sequence[str] = POSITION
) -> ColumnMap:
    """Return the column map of a table whose columns have the names of the joints, of a position
    and a quaternion, of readings (`reading.CHANNEL`) and of conditions. Of x, y and z it needs
    those that the robot `controls`. DatasetError with the columns that are missing; the map can be
    stated in the file `beside`."""
    missing = [joint for joint in joints if table.find(joint) is None]
    columns = {joint: joint for joint in joints}
    words = [split_unit(word)[0] for word in table.header]
    needed = [name for name in POSITION if name in controls] or POSITION
    position = find_position(table, joints, needed)
    if missing and (alike := match_numbered_names(joints, words)):
        columns, missing = alike, []
    names = {column: joint for joint, column in columns.items()}
    exact = all(name in words and name not in joints for name in QUATERNION)
    orientation = [*QUATERNION] if exact else find_quaternion(table, joints)
    readings = find_readings(table)
    if missing or not joints or not (position or orientation or readings):
        raise DatasetError(_explain_missing(table, joints, missing, needed, beside))
    return ColumnMap(
        joints={joint: JointColumn(column=columns[joint]) for joint in joints},
        position=PositionColumns(columns=position) if position else None,
        orientation=orientation or None,
        readings=readings,
        conditions=rename_conditions(find_conditions(table, [*names]), names),
        name=find_names(table),
    )


def find_position(
    table: Table, joints: Sequence[str], needed: Sequence[str] = POSITION
) -> list[str | None] | None:
    """Return the columns x, y and z of a position by their usual names, None for one that is not
    `needed` and not there; None if there are none, or if they are joints."""
    words = [name for word in table.header if (name := split_unit(word)[0]) not in joints]
    names = index_names(words)
    for group in POSITIONS:
        columns = [names.get(name) for name in group]
        if all(columns[POSITION.index(axis)] for axis in needed):
            return columns
    return None


def index_names(names: Collection[str]) -> dict[str, str]:
    """Index the names of columns by themselves, and in small letters; x comes before X."""
    return {name.lower(): name for name in names} | {name: name for name in names}


def check_units(
    table: Table, wanted: ColumnMap, beside: Path, joint_units: Mapping[str, str]
) -> None:
    """DatasetError if columns of joints, of the position or of readings state no unit: with a
    column map for the file `beside`, whose units follow from the size of the numbers.

    `joint_units` are the SI units of joints, as far as they are known.
    """
    joints = {joint: str(one.column) for joint, one in wanted.joints.items()}
    readings = {name: one.column for name, one in wanted.readings.items()}
    place = list(wanted.position.names) if wanted.position else []
    named = [*joints.values(), *readings.values(), *([] if table.assumed_unit else place)]
    unitless = [name for name in named if split_unit(table.find(name) or "")[1] is None]
    if not unitless:
        return

    def state(si_unit: str, columns: Sequence[str]) -> dict[str, str]:
        """The likely unit of columns that state none."""
        lacking = [table.find(name) or name for name in columns if name in unitless]
        small, limit, large = USUAL_UNITS[si_unit]
        numbers = [np.nanmax(np.abs(table.column(word)), initial=0.0) for word in lacking]
        return {"unit": large if max(numbers) > limit else small} if lacking else {}

    def alike(joint: str) -> list[str]:
        """The columns of the joints that move as this one: they have one unit."""
        own = joint_units.get(joint, "rad")
        return [column for name, column in joints.items() if joint_units.get(name, "rad") == own]

    found: dict[str, Any] = {
        "joints": {
            joint: {"column": column}
            | (state(joint_units.get(joint, "rad"), alike(joint)) if column in unitless else {})
            for joint, column in joints.items()
        },
        "position": wanted.position and {"columns": wanted.position.columns} | state("m", place),
        "orientation": wanted.orientation and list(wanted.orientation),
        "readings": {name: {"column": c} | state("m", [c]) for name, c in readings.items()},
        "conditions": dict(wanted.conditions),
    }
    found = {key: part for key, part in found.items() if part}
    text = yaml.safe_dump(found, default_flow_style=True, width=float("inf"), sort_keys=False)
    what = "columns {} have" if len(unitless) > 1 else "column {} has"
    raise DatasetError(
        f"{table.path}:1: {what.format(', '.join(unitless))} no unit. Write it into the header "
        f"({unitless[0]} [deg] or {unitless[0]} [mm]), or write this into the file {beside}, with "
        f"the units of your table: {text.strip()}"
    )


def find_quaternion(table: Table, joints: Sequence[str]) -> list[str] | None:
    """Return the columns x y z w of a quaternion by the names that trackers export, in capitals or
    not; None if there are none, if they are joints, or if their norm is not 1."""
    words = {split_unit(word)[0].lower(): word for word in table.header if word}
    for names in EXPORTED_QUATERNIONS:
        if not all(name in words and words[name] not in joints for name in names):
            continue
        columns = [words[name] for name in names]
        norm = np.linalg.norm([table.column(name) for name in columns], axis=0)
        norm = norm[np.isfinite(norm)]
        if len(norm) and (np.abs(norm - 1) < MAX_NORM_ERROR).all():
            return columns
    return None


def find_names(table: Table) -> str | None:
    """Return the column of a table that has a name of each row; None if no column has its usual
    names."""
    small = {word.lower(): word for word in table.header}
    return next((small[name] for name in SAMPLE_NAMES if name in small), None)


def _explain_missing(
    table: Table,
    joints: Sequence[str],
    missing: Sequence[str],
    needed: Sequence[str],
    beside: Path,
) -> str:
    """Say which columns a table without a column map lacks, of the joints or of the `needed`
    coordinates, and where to state others."""
    problem = f"no columns {', '.join(missing or needed)}"
    stated = f"the columns in the file {beside}, or --data columns=MAP.yaml"
    expected = (
        "Expected the joints of the model, and x, y and z or qx, qy, qz and qw, each length and "
        f"angle with its unit ({joints[0] if joints else 'joint1'} [mm]). Otherwise state {stated}"
    )
    shared = [name for name in POSITION if name in joints]
    if not joints:
        problem = "nothing states which columns are joints, because no model file was given"
    elif shared and not missing:
        problem = f"the model has joints {', '.join(shared)}, so no column contains the position"
        example = ", ".join(f"{name}: {{column: {name}}}" for name in shared)
        expected = (
            "Give the columns of the position other names, such as tool_x [mm], and state all of "
            f"{stated}: joints: {{{example}}}, position: {{columns: [tool_x, tool_y, tool_z]}}"
        )
    elif missing == [*joints] and find_position(table, joints):
        expected += f". {TOUCH_IMPORTS.format(table=table.path)}"
    header = textwrap.shorten(", ".join(table.header), MAX_SHOWN_HEADER, placeholder=" ...")
    return f"{table.path}:1: {problem}; the table has {header}. {expected} (see docs/import_csv.md)"


def find_readings(table: Table) -> dict[str, ReadingColumn]:
    """Return the columns of a table that are named `reading.CHANNEL`."""
    named = [split_unit(word)[0] for word in table.header]
    return {
        name.removeprefix(READING): ReadingColumn(column=name)
        for name in named
        if name.startswith(READING)
    }


def find_conditions(table: Table, joints: Sequence[str]) -> dict[str, str | float]:
    """Return the columns of a table that have the name of a condition, with its unit or without;
    DatasetError for a unit that is none of this quantity."""
    found: dict[str, str | float] = {}
    alike: dict[str, str | float] = {}
    for word in table.header:
        name, unit = split_condition(word)
        bracketed = re.fullmatch(r"(.+?)\s*[\[(](.+)[\])]", word)
        name = bracketed[1] if bracketed else name
        kind, dot, part = name.partition(".")
        kind = kind.lower()  # devices write Temperature
        other = next((known for known, others in OTHER_NAMES.items() if kind in others), None)
        if other and not np.isfinite(table.column(word)).all():
            continue  # a date, for example
        kind = other or kind
        name = f"{kind}{dot}{part}"
        if kind not in CONDITIONS:
            continue
        per_joint = CONDITIONS[kind][2]
        if not (part in joints if per_joint else not part or parse_part(name)):
            continue
        if bracketed and unit is None and split_unit(word)[1] is None:
            own = CONDITIONS[kind][0]
            known = ", ".join(CONDITION_UNITS.get(own, (own,)))
            raise DatasetError(
                f"{table.path}:1: column {word}: '{bracketed[2]}' is no unit of {kind}; expected "
                f"{known}"
            )
        (alike if other else found)[name] = word
    return alike | found
