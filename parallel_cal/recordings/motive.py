"""The tables that OptiTrack's Motive exports: six lines of header, one column per coordinate.

The first line holds pairs of a property and its value. Then lines state the type, name and ID of
the asset of each column, `Position` or `Rotation`, and the axis (OptiTrack, Motive documentation,
"Data Export: CSV").
"""

from __future__ import annotations

from collections.abc import Sequence

FIRST_CELL = "Format Version"
LENGTH_UNITS = "Length Units"  # a property in the first line; older versions state none
LENGTHS = {
    "meters": "m",
    "centimeters": "cm",
    "millimeters": "mm",
    "inches": "in",
    "feet": "ft",
}
TIMES = ("Time (Seconds)", "Time")
SOLVED = "Rigid Body Marker"  # the model's marker, beside the measured one of the same name


def is_motive(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether a table is an export of Motive."""
    return bool(rows) and rows[0][:1] == [FIRST_CELL] and _axis_row(rows) is not None


def merge_header(rows: Sequence[Sequence[str]]) -> tuple[int, list[str], str]:
    """Return the row of the last header line, one name per column, and the assumed unit of lengths.

    Older versions of Motive state no unit and write metres.

    A coordinate of a rigid body is named `platform.Position.X [mm]`, with the unit of the export;
    the time (s) is named `time`.

    Examples
    --------
    >>> rows = [
    ...     ["Format Version", "1.23", "Length Units", "Millimeters"],
    ...     ["", "", "Rigid Body"],
    ...     ["", "", "platform"],
    ...     ["", "", "4F2A"],
    ...     ["", "", "Position"],
    ...     ["Frame", "Time (Seconds)", "X"],
    ... ]
    >>> merge_header(rows)
    (5, ['Frame', 'time', 'platform.Position.X [mm]'], '')
    """
    last = _axis_row(rows)
    assert last is not None
    stated = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    unit = LENGTHS.get(stated.get(LENGTH_UNITS, "").strip().lower(), "")
    width = len(rows[last])
    lines = [[*row, *[""] * width][:width] for row in rows[1:last]]
    type = next((line for line in lines if any("Body" in c or "Marker" in c for c in line)), None)
    named = lines.index(type) + 1 if type is not None else 0
    names = []
    for k, axis in enumerate(rows[last]):
        quantity = lines[-1][k].strip() if lines else ""
        name = lines[named][k].strip() if type is not None and quantity else ""
        if type is not None and type[k].strip() == SOLVED and name:
            name += " (solved)"
        axis = "time" if axis.strip() in TIMES else axis.strip()
        parts = [part for part in (name, quantity, axis) if part]
        suffix = f" [{unit}]" if unit and quantity == "Position" else ""
        names.append(".".join(parts) + suffix)
    return last, names, "" if LENGTH_UNITS in stated else "m"


def _axis_row(rows: Sequence[Sequence[str]]) -> int | None:
    """Return the row that begins with `Frame`; None if there is none."""
    return next((k for k, row in enumerate(rows[:12]) if row[:1] == ["Frame"]), None)
