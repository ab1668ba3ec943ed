"""The header and the first rows of a table that a session may import, and what its columns seem to
mean."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import (
    OTHER_NAMES,
    POSITION,
    QUATERNION,
    TOUCH_IMPORTS,
    find_conditions,
    find_names,
    find_position,
    find_quaternion,
    find_readings,
)
from parallel_cal.recordings.joint_names import match_numbered_names, rename_conditions
from parallel_cal.recordings.loading import MAP_SUFFIX, load_sessions
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.samplefile import holds_samples
from parallel_cal.recordings.table import Table, read_table, split_condition, split_unit
from parallel_cal.session.history import History
from parallel_cal.session.known_columns import KnownColumns, recall_columns

MAX_SHOWN_ROWS = 4
# Usual names of the columns of three angles, in small letters.
ANGLES = (("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("a", "b", "c"))
# Conditions that people often record, with other usual names; all count in small letters, too.
USUAL_CONDITIONS = OTHER_NAMES | {
    "temperature": ("temp",),
    "payload": ("load", "mass"),
}


def preview_table(file: Path, folder: Path) -> dict[str, Any]:
    """Read a table for the session in `folder`; `error` says why it cannot be read, empty if it
    can. `joints` are the units (rad or m) of the model's joints by name. `columns`, `conditions`
    and `readings` (those of the model's sensors) name the column of a quantity, `angles` those of
    three angles, `name` that of a name of each row. `with_unit` lists the columns that state
    their unit. `about_touches` says how touches of a bed are imported. `remembered` is the
    column map of the last table whose columns this one has, too, and `remembered_from` says
    which table that was, and when."""
    try:
        session = History(folder)
        model = read_model(folder / session.state.model)
        mechanism = model.mechanism
        table = read_table(file).drop_empty_rows()
        joints = _find_joints(table, mechanism.joints)
        names = {split_unit(word)[0]: joint for joint, word in joints.items() if word}
        conditions = rename_conditions(find_conditions(table, [*mechanism.joints, *names]), names)
    except ParallelCalError as error:
        return {"error": str(error)}
    place = find_position(table, [*names]) or ()
    turned = find_quaternion(table, [*names]) or ()
    pose = zip(
        (*POSITION[: len(place)], *QUATERNION[: len(turned)]), (*place, *turned), strict=True
    )
    usual = {name: _find(table, name, *more) for name, more in USUAL_CONDITIONS.items()}
    known = recall_columns(folder, mechanism, table.header)
    angles = [[_find(table, name) for name in names] for names in ANGLES]
    return {
        "error": "",
        "header": table.header,
        "rows": table.rows[:MAX_SHOWN_ROWS],
        "count": len(table.rows),
        "columns": joints
        | dict.fromkeys((*POSITION, *QUATERNION))
        | {name: table.find(column) for name, column in pose},
        "angles": next((names for names in angles if all(names)), [None] * 3),
        "conditions": usual | conditions,
        "name": find_names(table),
        "readings": {
            channel: _find(table, channel, channel.rpartition(".")[2])
            for channel in model.structure.channels
        }
        | {name: table.find(one.column) for name, one in find_readings(table).items()},
        "joints": dict(zip(mechanism.joints, mechanism.joint_units, strict=True)),
        "assumed_unit": table.assumed_unit,
        "about_touches": TOUCH_IMPORTS.format(table=file.name),
        "with_unit": [word for word in table.header if split_unit(word)[1]],
        "remembered": known and known[0].columns,
        "remembered_from": known and _describe_import(*known),
    }


def read_samples(file: Path, folder: Path, columns: Mapping[str, Any]) -> tuple[Model, Dataset]:
    """Read a table as an import into the session in `folder` would; ParallelCalError says why it
    cannot be read."""
    session = History(folder)
    model = read_model(folder / session.state.model)
    write_atomically(file.with_suffix(MAP_SUFFIX), json.dumps(columns))  # JSON is YAML
    reading = ReadOptions(**session.record.reading)
    return model, load_sessions([file], reading, mechanism=model.mechanism)


def preview_file(file: Path, folder: Path) -> dict[str, Any]:
    """Preview a table as `preview_table` does; of a file of samples only the `error` of its import
    into the session in `folder`, empty if there is none, and `words` about its samples."""
    if not holds_samples(file):
        return preview_table(file, folder)
    try:
        session = History(folder)
        mechanism = read_model(folder / session.state.model).mechanism
        found = load_sessions([file], ReadOptions(**session.record.reading), mechanism=mechanism)
    except ParallelCalError as error:
        return {"error": str(error)}
    poses = len(set(found.pose_id.tolist()))
    return {"error": "", "words": f"{len(found)} samples of {poses} poses: {found.source}"}


def _describe_import(known: KnownColumns, seconds: float) -> str:
    return f"{known.table}, imported on {datetime.fromtimestamp(seconds):%Y-%m-%d at %H:%M}"


def _find_joints(table: Table, joints: Sequence[str]) -> dict[str, str | None]:
    """Find the columns of the joints: by their names, or all by their numbers, such as A1 to A6."""
    found = {joint: _find(table, joint) for joint in joints}
    if all(found.values()):
        return found
    words = {split_unit(word)[0]: word for word in table.header}
    alike = match_numbered_names(joints, [*words])
    return {joint: words[name] for joint, name in alike.items()} or found


def _find(table: Table, *names: str) -> str | None:
    """Find the column of a quantity by one of its names, in small letters if need be."""
    for name in names:
        if (word := table.find(name)) is not None:
            return word
        splits = (split_condition, split_unit)
        small = {split(word)[0].lower(): word for split in splits for word in table.header}
        if (word := small.get(name.lower())) is not None:
            return word
    return None
