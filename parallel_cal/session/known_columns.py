"""The column maps of the tables that a user imported, for the next table in any session.

Each set of columns has a file of its own, so that two sessions that import at the same time lose
nothing, and a damaged file costs no other map.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from parallel_cal.base.files import read_text, state_folder, write_atomically
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.recordings.columns import ColumnMap
from parallel_cal.recordings.loading import MAP_SUFFIX

FOLDER = "column_maps"
# The keys of a map that the form of the page states.
FORM_KEYS = {"joints", "conditions", "visits", "noise"}


class KnownColumns(BaseModel):
    """The columns of an imported table: the units of its joints by name, and the column map."""

    table: str
    joints: dict[str, str]
    columns: dict[str, Any]

    @property
    def names(self) -> set[str]:
        """The columns that the map names."""
        return set(ColumnMap.model_validate(self.columns).columns)


def remember_columns(mechanism: Mechanism, table: Path, columns: Mapping[str, Any]) -> str:
    """Remember the column map of a table for this user, in place of an earlier one of the same
    columns; return why this is impossible, or an empty text."""
    joints = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
    known = KnownColumns(table=table.name, joints=joints, columns=dict(columns))
    key = json.dumps([known.joints, sorted(known.names)])
    try:
        folder = state_folder() / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"
        write_atomically(file, known.model_dump_json(indent=1) + "\n")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        return f"the columns are not remembered for the next table: {error}"
    return ""


def recall_columns(
    session: Path, mechanism: Mechanism, header: list[str]
) -> tuple[KnownColumns, float] | None:
    """Find the columns of the last table that this table has, too: of the session in this folder,
    or else of any session of this user. Return them with the time of that import (s since 1970)."""
    joints = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
    for file, known in (*_read_session(session, joints), *_read_user()):
        if known.joints == joints and _fits_form(known, header):
            return known, file.stat().st_mtime
    return None


def _read_session(session: Path, joints: dict[str, str]) -> Iterator[tuple[Path, KnownColumns]]:
    for file in _sort_by_age((session / "imports").glob(f"*/*{MAP_SUFFIX}")):
        try:
            columns = json.loads(read_text(file))
            table = next(other for other in file.parent.iterdir() if other != file)
            yield file, KnownColumns(table=table.name, joints=joints, columns=columns)
        except (OSError, ValueError, StopIteration):
            continue  # damaged, or written by hand as YAML


def _read_user() -> Iterator[tuple[Path, KnownColumns]]:
    try:
        files = _sort_by_age((state_folder() / FOLDER).glob("*.json"))
    except (OSError, RuntimeError):
        return
    for file in files:
        try:
            yield file, KnownColumns.model_validate_json(read_text(file))
        except (OSError, ValueError):
            continue  # damaged: the next import of these columns replaces it


def _sort_by_age(files: Iterator[Path]) -> list[Path]:
    """Sort files from the newest to the oldest."""
    return sorted(files, key=lambda file: file.stat().st_mtime_ns, reverse=True)


def _fits_form(known: KnownColumns, header: list[str]) -> bool:
    """Whether the table has all columns of a map, and the form of the page can state it."""
    columns = known.columns
    try:
        return (
            known.names <= set(header)
            and columns.keys() >= FORM_KEYS
            and columns["joints"].keys() == known.joints.keys()
            and all(isinstance(one.get("column"), str) for one in columns["joints"].values())
            and all(isinstance(one, str) for one in columns["conditions"].values())
        )
    except (ValidationError, AttributeError):
        return False
