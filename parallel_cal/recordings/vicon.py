"""The tables that Vicon's Tracker and Nexus export: five lines of header, no column of the time.

The lines hold the kind of the table (`Objects`, `Segments` or `Trajectories`), the rate in Hz, the
names of the bodies or markers, `Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ` or `Frame,Sub Frame,X,Y,Z`, and
the units (Konstanz's wiki on Vicon shows such a file; readers on GitHub assume the same lines). A
file may hold several such tables, with an empty line between them. The first one that holds poses
is read: Nexus writes those of force plates (`Devices`, at another rate) in front.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

KINDS = ("Objects", "Segments", "Trajectories")
OTHER_KINDS = ("Devices", "Joints", "Model Outputs")  # tables without poses, in front or behind
HEADER_LINES = 5
FRAME = ["Frame", "Sub Frame"]


def is_vicon(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether a table is an export of Vicon's Tracker or Nexus."""
    return (
        len(rows) > HEADER_LINES
        and rows[0][:1] != []
        and rows[0][0].strip() in KINDS
        and [cell.strip() for cell in rows[3][:2]] == FRAME
        and _read_rate(rows[1]) > 0
    )


def find_first_table(lines: Sequence[str], begin: int) -> int:
    """Return the line at which the first table with poses begins; `begin` if there is none."""
    kinds = (re.split(r"[,;\t]", line)[0].strip('" \r\n') for line in lines[begin:])
    return next((k for k, kind in enumerate(kinds, start=begin) if kind in KINDS), begin)


def convert_rows(rows: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]]]:
    """Return one name per column, and the rows of the first table with the time (s) in front.

    A coordinate of the body `platform:base` is named `platform:base.TX [mm]`, with the unit of the
    export. The time is the number of the frame over the rate: 0 in frame 0.

    Examples
    --------
    >>> rows = [
    ...     ["Objects"],
    ...     ["100"],
    ...     ["", "", "platform:base", "", ""],
    ...     ["Frame", "Sub Frame", "TX", "TY", "TZ"],
    ...     ["", "", "mm", "mm", "mm"],
    ...     ["1", "0", "12.5", "0.0", "300.0"],
    ... ]
    >>> convert_rows(rows)[0]
    ['time', 'Frame', 'Sub Frame', 'platform:base.TX [mm]', 'platform:base.TY [mm]', 'platform:base.TZ [mm]']
    >>> convert_rows(rows)[1]
    [['0.010000', '1', '0', '12.5', '0.0', '300.0']]
    """  # noqa: E501
    rate, width = _read_rate(rows[1]), len(rows[3])
    bodies, axes, units = ([*row, *[""] * width][:width] for row in rows[2:HEADER_LINES])
    names, body = ["time"], ""
    for name, axis, unit in zip(bodies, axes, units, strict=True):
        body = name.strip() or body  # a name stands over the first of its columns
        prefix = f"{body}." if body and axis.strip() not in FRAME else ""
        suffix = f" [{unit.strip()}]" if unit.strip() else ""
        names.append(f"{prefix}{axis.strip()}{suffix}")
    found = []
    for row in rows[HEADER_LINES:]:
        if not re.fullmatch(r"\s*\d+\s*", row[0]):
            break  # the next table
        cells = [*row, *[""] * width][:width]
        found.append([f"{int(row[0]) / rate:.6f}", *cells])
    return names, found


def _read_rate(row: Sequence[str]) -> float:
    """Read the rate (Hz) of a table; zero if the row holds none."""
    text = row[0].strip() if row else ""
    return float(text) if re.fullmatch(r"\d+(\.\d+)?", text) else 0.0
