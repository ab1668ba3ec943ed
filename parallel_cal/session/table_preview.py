"""The header and the first rows of a table that a session may import, and which columns its joints
and coordinates seem to have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.table import Table, read_table, split_unit
from parallel_cal.session.history import History

MAX_SHOWN_ROWS = 4
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# Conditions that a person states; the others follow from the motion.
STATED_CONDITIONS = ("time", "temperature", "payload")


def preview_table(file: Path, folder: Path) -> dict[str, Any]:
    """Read a table for the session in `folder`; `error` says why it cannot be read, empty if it
    can. `joints` are the units (rad or m) of the model's joints by name."""
    try:
        session = History(folder)
        mechanism = read_model(folder / session.state.model).mechanism
        table = read_table(file).drop_empty_rows()
    except ParallelCalError as error:
        return {"error": str(error)}
    names = (*mechanism.joints, *POSITION, *QUATERNION, *STATED_CONDITIONS)
    return {
        "error": "",
        "header": table.header,
        "rows": table.rows[:MAX_SHOWN_ROWS],
        "count": len(table.rows),
        "columns": {name: _find(table, name) for name in names},
        "joints": dict(zip(mechanism.joints, mechanism.joint_units, strict=True)),
    }


def _find(table: Table, name: str) -> str | None:
    """Find the column of a quantity by its name, in small letters if need be."""
    if (word := table.find(name)) is not None:
        return word
    small = {split_unit(word)[0].lower(): word for word in table.header}
    return small.get(name.lower())
