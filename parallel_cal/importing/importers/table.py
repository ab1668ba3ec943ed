"""Positions or poses of a laser tracker or a measuring machine, and a log of joints.

One table contains points with the columns x, y and z, and another one joint readings. Columns Q0 to
Q3 beside x, y and z (scalar first, as a Leica T-Mac or T-Probe) or qx to qw are the orientation.
Columns with the name of a condition (`temperature [degC]`) and times are conditions. Any lines may
precede the header. Commas, semicolons, tabs or spaces separate the cells. A column that both have
joins their rows: a point's name or number, or the time. Tables of equal length without such a
column are matched row by row. The unit is in the header (`X [mm]`), in a
line before it (`Units: Millimeters`), or an option.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import UNIT_ALIASES, UNITS
from parallel_cal.importing.settings import SourceLine, read_lines
from parallel_cal.model.file.schema import NoisePart
from parallel_cal.recordings.columns import (
    ColumnMap,
    Join,
    JointColumn,
    PositionColumns,
)
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import find_conditions, find_quaternion
from parallel_cal.recordings.table import Table, read_table, split_unit
from parallel_cal.recordings.table_samples import make_dataset

XYZ = ("x", "y", "z")
ROW = "row"  # joins tables line by line
TIMES = ("t", "time", "timestamp", "stamp", "datetime")
NO_JOINTS = (
    "{}: no column is a joint reading: expected a second table with them, or columns beside the "
    "position. Touches of a printer's bed have none: `import touches TABLE.csv CONFIGURATION`"
)
TIME = "time since the first point [s]"  # the name of a converted column
EPOCH = date(1970, 1, 1)
CLOCK = re.compile(
    r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d{1,2}):(\d\d):(\d\d(?:\.\d*)?)(Z|[+-]\d\d:?\d\d)?"
)  # any number of decimals of the seconds, which fromisoformat of Python 3.10 does not accept
UNIT_STATEMENT = re.compile(r"\bunits?\b\W*(\w+)", re.IGNORECASE)


def samples(
    paths: Sequence[Path],
    by: str = "",
    within: float | None = None,
    position: Sequence[str] = XYZ,
    joints: Sequence[str] = (),
    unit: str = "",
    joint_unit: str = "",
    sigma: float | None = None,
    joint_sigma: float | None = None,
    offset: float | None = None,
) -> Dataset:
    """Read points and joints whose rows agree in the column `by`, or differ by `within` s there.

    `position` and `joints` are names of columns. The sigmas are in m and rad. `by` may be `row`:
    rows with equal numbers belong together. `offset` is the time of the points' clock minus that of
    the joints' clock, s; it is estimated from the motion if it is not stated.
    """
    for name, given in (("unit", unit), ("joint_unit", joint_unit)):
        if given and given not in UNITS:
            raise DatasetError(f"{name}={given}: expected one of {', '.join(UNITS)}")
    for name, names in (("position", position), ("joints", joints)):
        if isinstance(names, (str, Mapping)):
            raise DatasetError(f"{name}={names}: expected names of columns, such as [J1, J2, J3]")
    read = [_read_table(path) for path in paths]
    points = _points([table for table, _ in read], position)
    logs = [table for table, _ in read if table is not points] or [points]
    where = [_find_column(points, name) or "" for name in position]
    key = _find_common_column(points, logs, where) if not by else "" if by == ROW else by
    if not by and within is None and key.lower() in TIMES:
        raise DatasetError(
            f"{paths[0]}: joined by {key}: state the largest time difference "
            "(--option within=SECONDS)"
        )
    columns: list[str] = []
    turned = find_quaternion(points, joints)
    conditions = _find_conditions(points, logs, key)
    others = (*where, key, *(turned or ()), *conditions.values())
    taken = {*(name.lower() for name in others), *TIMES}
    for log in logs:
        if joints:
            columns += [word for name in joints if (word := _find_column(log, name)) is not None]
        else:  # every column that is neither the position, the key, nor a time
            words = [word for word in log.header if word]
            columns += [w for w in words if not {w.lower(), split_unit(w)[0].lower()} & taken]
    if not columns:
        raise DatasetError(NO_JOINTS.format(", ".join(map(str, paths))))
    units = dict.fromkeys(where, unit) | dict.fromkeys(columns, joint_unit)
    if clock := conditions.pop("time", ""):
        timed = _convert_times(points, str(clock))
        read = [(timed if table is points else table, said) for table, said in read]
        conditions |= {"time": TIME} if timed is not points else {}
    tables = [_add_units(table, said, units, key, within) for table, said in read]
    wanted = ColumnMap(
        joints={split_unit(word)[0]: JointColumn(column=split_unit(word)[0]) for word in columns},
        position=PositionColumns(columns=[split_unit(word)[0] for word in where]),
        orientation=turned,
        conditions=conditions,
        join=Join(by=key, within=within, offset=offset) if len(tables) > 1 and key else None,
        noise=NoisePart(position=sigma, joint=joint_sigma),
    )
    return make_dataset(tables, wanted, "import table")


def _read_table(path: Path) -> tuple[Table, str]:
    """Read a table, and the unit stated before its header; skip remarks."""
    said = ""
    for _, line in read_lines(path):
        if found := UNIT_STATEMENT.search(line):
            word = found[1].lower()
            said = said or (word if word in UNITS else UNIT_ALIASES.get(word, ""))
    return read_table(path), said


def _points(tables: Sequence[Table], position: Sequence[str]) -> Table:
    """Return the only table with the position's columns."""
    found = [t for t in tables if all(_find_column(t, name) is not None for name in position)]
    if len(found) == 1:
        return found[0]
    files = ", ".join(str(table.path) for table in tables)
    names = ", ".join(position)
    if found:
        problem = (
            f"{len(found)} of the tables have the columns {names}; give those of the position "
            "other names"
        )
    else:
        problem = f"none of the tables has the columns {names}; state which columns they are"
    raise DatasetError(f"{files}: {problem} (--option position=[X1, Y1, Z1])")


def _find_column(table: Table, name: str) -> str | None:
    """Return the header's word for a column; upper and lower case are equal."""
    same = (w for w in table.header if name.lower() in (w.lower(), split_unit(w)[0].lower()))
    return next(same, None)


def _find_common_column(points: Table, logs: Sequence[Table], where: Sequence[str]) -> str:
    """Return the column that all tables have, besides the position; the time is the last choice.

    If there is none and the tables have equally many rows, it is "": they are matched row by row.
    """
    if logs == [points]:
        return ""
    shared = [
        split_unit(word)[0]
        for word in points.header
        if word not in where and all(_find_column(log, split_unit(word)[0]) for log in logs)
    ]
    chosen = [name for name in shared if name.lower() not in TIMES] or shared
    if len(chosen) == 1:
        return chosen[0]
    tables = (points, *logs)
    files = ", ".join(str(table.path) for table in tables)
    if not chosen:
        counts = [sum(any(row) for row in table.rows) for table in tables]
        if len({*counts}) == 1:
            return ""
        raise DatasetError(
            f"{files}: no column that all tables have, and "
            f"{' and '.join(map(str, counts))} rows: expected equally many rows, or a column that "
            "joins them (--option by=...)"
        )
    has = ", ".join(chosen)
    raise DatasetError(
        f"{files}: columns that all tables have: {has}; state which one joins "
        "them (--option by=...)"
    )


def _find_conditions(points: Table, logs: Sequence[Table], key: str) -> dict[str, str | float]:
    """Return the columns of conditions: of the first table that has one, the time of the points
    alone. The column that joins the tables is none."""
    found: dict[str, str | float] = {}
    for table in (points, *logs):
        own = {name: word for name, word in find_conditions(table, ()).items() if name != "time"}
        found = own | found
    word = next((w for name in TIMES if (w := _find_column(points, name))), None)
    if word and key.lower() not in TIMES:
        found["time"] = word
    return {name: word for name, word in found.items() if word != key}


def _convert_times(table: Table, column: str) -> Table:
    """Return the table with the times of a column as s since the first one, in the column TIME; the
    table itself if some are no times."""
    at = table.header.index(column)
    rows = [[*row] for row in table.rows]
    filled = [i for i, row in enumerate(rows) if len(row) > at and row[at].strip()]
    try:
        seconds = [
            float(
                _seconds(rows[i][at].strip(), SourceLine(table.path, 0), column).replace(",", ".")
            )
            for i in filled
        ]
    except DatasetError:
        return table
    for i, value in zip(filled, seconds, strict=True):
        rows[i][at] = repr(value - min(seconds)).replace(".", table.decimal)
    header = [TIME if k == at else word for k, word in enumerate(table.header)]
    return replace(table, header=header, rows=rows)


def _add_units(
    table: Table, said: str, units: dict[str, str], key: str, within: float | None
) -> Table:
    """Return the table with a unit in every word that needs one, and times in seconds."""
    header = [
        f"{word} [{units[word] or said}]"
        if word in units and split_unit(word)[1] is None and (units[word] or said)
        else word
        for word in table.header
    ]
    word = _find_column(table, key) if key else None
    if word is None:
        return replace(table, header=header).drop_empty_rows()
    column = table.header.index(word)
    header[column] = key
    rows = [[*row] for row in table.rows]
    for row, line in zip(rows, table.lines, strict=True) if within is not None else ():
        if len(row) > column:
            row[column] = _seconds(row[column].strip(), SourceLine(table.path, line), key)
    return replace(table, header=header, rows=rows).drop_empty_rows()


def _seconds(text: str, place: SourceLine, key: str) -> str:
    """Convert a number of seconds, a time of day, or a date and time to seconds."""
    if _is_number(text.replace(",", ".")):
        return text
    found = CLOCK.fullmatch(text)
    try:
        day = date.fromisoformat(found[1] or EPOCH.isoformat()) if found else EPOCH
    except ValueError:
        found = None
    if not found:
        raise place.error(key, text, "seconds, 14:03:05.2 or 2026-11-22T14:03:05.2")
    east = found[5].replace("Z", "+0000").replace(":", "") if found[5] else "+0000"
    ahead = float(f"{east[0]}1") * (60 * int(east[1:3]) + int(east[3:]))
    minutes = 1440 * (day - EPOCH).days + 60 * int(found[2]) + int(found[3]) - ahead
    return repr(60 * minutes + float(found[4]))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
