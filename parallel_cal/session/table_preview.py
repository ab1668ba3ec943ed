"""The header and the first rows of a table that a session may import, and what its columns seem to
mean."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.columns import find_conditions, find_names, find_readings
from parallel_cal.recordings.table import Table, read_table, split_condition, split_unit
from parallel_cal.session.history import History

MAX_SHOWN_ROWS = 4
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# Usual names of the columns of three angles, in small letters.
ANGLES = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("a", "b", "c"))
# Conditions that people often record; their names count in small letters, too.
USUAL_CONDITIONS = ("time", "temperature", "payload")


def preview_table(file: Path, folder: Path) -> dict[str, Any]:
    """Read a table for the session in `folder`; `error` says why it cannot be read, empty if it
    can. `joints` are the units (rad or m) of the model's joints by name. `columns`, `conditions`
    and `readings` (those of the model's sensors) name the column of a quantity, `angles` those of
    three angles, `name` that of a name of each row."""
    try:
        session = History(folder)
        model = read_model(folder / session.state.model)
        mechanism = model.mechanism
        table = read_table(file).drop_empty_rows()
        conditions = find_conditions(table, mechanism.joints)
    except ParallelCalError as error:
        return {"error": str(error)}
    usual = {name: _find(table, name) for name in USUAL_CONDITIONS}
    angles = [[_find(table, name) for name in names] for names in ANGLES]
    return {
        "error": "",
        "header": table.header,
        "rows": table.rows[:MAX_SHOWN_ROWS],
        "count": len(table.rows),
        "columns": {
            name: _find(table, name) for name in (*mechanism.joints, *POSITION, *QUATERNION)
        },
        "angles": next((names for names in angles if all(names)), [None] * 3),
        "conditions": usual | conditions,
        "name": find_names(table),
        "readings": dict.fromkeys(model.structure.channels)
        | {name: one.column for name, one in find_readings(table).items()},
        "joints": dict(zip(mechanism.joints, mechanism.joint_units, strict=True)),
    }


def _find(table: Table, name: str) -> str | None:
    """Find the column of a quantity by its name, in small letters if need be."""
    if (word := table.find(name)) is not None:
        return word
    split = split_condition if name in USUAL_CONDITIONS else split_unit
    small = {split(word)[0].lower(): word for word in table.header}
    return small.get(name.lower())
