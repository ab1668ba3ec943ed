"""Store a fleet's results: one file per recording as soon as it is judged, then a table."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from parallel_cal.base.files import open_locked, read_text, write_atomically
from parallel_cal.fleet.jobs import TABLE, FleetError
from parallel_cal.fleet.judging import Row

WORDS = ("robot", "recording", "inputs", "mechanism", "verdict", "reason")
# Errors of the model as given, after a fit of its parameters, and with the effects found.
ERRORS = ("before", "identified", "after")
KINDS = {"position": "m", "orientation": "rad", "reading": "m"}


class Rows:
    """A fleet's folder: `recordings/` holds the rows, each named by the hash of its inputs."""

    def __init__(self, folder: Path):
        self.folder = folder
        if folder.is_file():
            raise FleetError(f"{folder} is a file, expected a folder")
        for part in (folder, folder / "recordings", folder / "reports"):
            part.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the folder; raise FleetError if another process has locked it."""
        file = open_locked(self.folder / ".lock")
        if file is None:
            raise FleetError(f"{self.folder}: another run is writing fleet results there")
        try:
            yield
        finally:
            os.close(file)

    def load(self, inputs: str) -> Row | None:
        """Return the stored row of a recording; None if there is none, or if it failed."""
        try:
            row: Row = json.loads(read_text(self._file(inputs)))
        except (OSError, ValueError):
            return None
        return None if row["reason"] else row

    def keep(self, row: Row, page: str = "") -> None:
        """Store a row and, if given, the page of its robot."""
        if page:
            write_atomically(self.page_of(row["robot"]), page)
        write_atomically(self._file(row["inputs"]), json.dumps(row, allow_nan=False))

    def page_of(self, robot: str) -> Path:
        return self.folder / "reports" / f"{quote(robot, safe='')}.html"

    def _file(self, inputs: str) -> Path:
        return self.folder / "recordings" / f"{inputs}.json"

    def gather(self, rows: Sequence[Row]) -> None:
        """Write `rows.parquet`, one row per recording, and the computing times to
        `seconds.parquet`: without them the rows are the same to the last bit on every machine."""
        import pyarrow as pa

        units = {n: one["unit"] for row in rows for n, one in row.get("parameters", {}).items()}
        errors = {f"{when}.{kind}_rms": (when, kind) for when in ERRORS for kind in KINDS}
        columns: list[tuple[pa.Field, list[Any]]] = [
            (pa.field(name, pa.string()), [row.get(name) for row in rows]) for name in WORDS
        ]
        columns += [
            (pa.field("effects", pa.list_(pa.string())), [row.get("effects") for row in rows]),
            (_number("time", "s"), [row.get("time") for row in rows]),
            (pa.field("samples", pa.int64()), [row.get("samples") for row in rows]),
            (_number("chi2_per_dof", "1"), [row.get("chi2_per_dof") for row in rows]),
        ]
        for name, (when, kind) in errors.items():
            values = [row.get(when, {}).get(f"{kind}_rms") for row in rows]
            columns.append((_number(name, KINDS[kind]), values))
        for name, unit in units.items():
            for column, key in ((name, "value"), (f"{name}.sigma", "sigma")):
                values = [row.get("parameters", {}).get(name, {}).get(key) for row in rows]
                columns.append((_number(column, unit), values))
        _write(columns, self.folder / TABLE)
        seconds = (_number("seconds", "s"), [row.get("seconds") for row in rows])
        _write([*columns[:2], seconds], self.folder / "seconds.parquet")

    def forget_others(self, inputs: Iterable[str]) -> None:
        """Remove the rows of all other inputs: of recordings that changed or are gone."""
        current = set(inputs)
        for file in (self.folder / "recordings").glob("*.json"):
            if file.stem not in current:
                file.unlink()


def _number(name: str, unit: str) -> Any:
    import pyarrow as pa

    return pa.field(name, pa.float64(), metadata={"unit": unit})


def _write(columns: Sequence[tuple[Any, list[Any]]], path: Path) -> None:
    """Write a table atomically."""
    import pyarrow as pa
    from pyarrow import parquet

    arrays = [pa.array(values, field.type) for field, values in columns]
    part = path.with_suffix(".part")
    parquet.write_table(pa.table(arrays, pa.schema([field for field, _ in columns])), part)
    os.replace(part, path)
