"""Writes samples to disk as soon as they are taken; independent of ROS.

One line of JSON for each sample; of several lines with the same number the last one counts. However
the node ends, every sample that was taken is in the file. The next start resumes it after a crash.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from errno import EEXIST
from pathlib import Path
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import MEGABYTE, append_lines, json_lines, open_locked
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets

SUFFIX = ".journal"
MAX_JOURNAL_BYTES = 512 * MEGABYTE  # largest journal that is read


@dataclass(frozen=True)
class Entry:
    """Sample i of a dataset whose times count from `start_ns`."""

    dataset: Dataset
    i: int
    start_ns: int

    def key(self) -> bytes:
        """Return bytes that change if the measurement changes."""
        d, i = self.dataset, self.i
        columns = (d.q, d.r, d.R, d.pose_cov, d.time, d.duration, *d.conditions.values())
        return b"".join(column[i].tobytes() for column in columns)

    @property
    def alone(self) -> Dataset:
        """The sample as a dataset without drops and warnings about other samples."""
        one = self.dataset.select([self.i])
        return dataclasses.replace(one, dropped=(), warnings=(), sha256="")

    def line(self, number: int) -> str:
        document = {"id": number, "start_ns": self.start_ns, "sample": to_json_value(self.alone)}
        return json.dumps(document, allow_nan=False)


@dataclass(frozen=True)
class Part:
    """Samples of one clock with their numbers."""

    dataset: Dataset
    ids: list[int]
    start_ns: int


class Journal:
    """Appends changed samples to a file and returns when they are safely on disk.

    A node locks its file against other nodes. A journal that was closed, because its samples were
    saved, is not resumed. Nor is one whose node ended in order: the next session may be about
    something else.

    After `resume`, `left` is the newest journal if its node ended in order and it has samples, and
    `busy` lists the journals that other nodes use.
    """

    def __init__(self, folder: Path, name: str):
        self._folder, self._name = folder, name
        self._file: int | None = None
        self._known: dict[int, bytes] = {}
        self.path = self.left = ""
        self.busy: list[str] = []

    def describe_obstacle(self) -> str:
        """Say why no journal can be written; empty if one can."""
        place = next(path for path in (self._folder, *self._folder.parents) if path.exists())
        if not place.is_dir():
            return f"{place} is not a folder"
        return "" if os.access(place, os.W_OK | os.X_OK) else f"{place} is not writable"

    def resume(self) -> list[Part]:
        """Continue the newest journal if its node did not end in order; return its samples, [] if
        there is none.

        DatasetError if it cannot be read.
        """
        for path in sorted(self._folder.glob(f"{self._name}-*{SUFFIX}"), reverse=True):
            try:
                file = open_locked(path)
                lines = list(json_lines(path, MAX_JOURNAL_BYTES))
            except (OSError, ValueError) as error:
                raise DatasetError(f"{path}: not a journal: {error}") from None
            if file is None:
                self.busy.append(str(path))
                continue
            if any("closed" in line for line in lines):
                os.close(file)
                continue
            if any("ended" in line for line in lines):
                os.close(file)
                self.left = str(path) if _latest_samples(lines) else ""
                return []
            self._file, self.path = file, str(path)
            parts = _read_parts(lines, path)
            for part in parts:
                entries = (Entry(part.dataset, i, part.start_ns) for i in range(len(part.ids)))
                self._known |= {k: e.key() for k, e in zip(part.ids, entries, strict=True)}
            return parts
        return []

    def keep(self, entries: Mapping[int, Entry]) -> None:
        """Make the journal contain exactly these samples; OSError if it cannot be written."""
        now = {number: entry.key() for number, entry in entries.items()}
        if now == self._known:
            return
        if self._file is None:
            self._file, self._known = self._open_file(), {}
        changed = [entries[k].line(k) for k, key in now.items() if self._known.get(k) != key]
        gone = [json.dumps({"id": k}) for k in self._known if k not in now]
        append_lines(self._file, changed + gone)
        self._known = now

    def abandon(self) -> None:
        """Leave the file as it is, locked; the next change begins another one."""
        self._file, self._known, self.path = None, {}, ""

    def close(self, why: str) -> None:
        """Mark the journal as complete; the next change begins another one."""
        self._finish({"closed": why})

    def end(self, why: str) -> None:
        """Mark the journal as that of a node that ended in order, with samples not saved."""
        self._finish({"ended": why})

    def _finish(self, line: Mapping[str, str]) -> None:
        if self._file is None:
            return
        append_lines(self._file, [json.dumps(line)])
        os.close(self._file)
        self._file, self.path = None, ""

    def _open_file(self) -> int:
        """Create and lock a new file; set its path."""
        self._folder.mkdir(parents=True, exist_ok=True)
        moment = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
        for n in range(1000):
            path = self._folder / f"{self._name}-{moment}-{n:03d}{SUFFIX}"
            with suppress(FileExistsError):
                flags = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_APPEND | os.O_CLOEXEC
                file, self.path = os.open(path, flags, 0o644), str(path)
                fcntl.flock(file, fcntl.LOCK_EX)
                return file
        raise FileExistsError(EEXIST, "a thousand journals of this second", str(self._folder))


def read_journal(path: str | Path) -> list[Part]:
    """Return the samples of a journal, whether or not it was closed; DatasetError if it cannot be
    read."""
    try:
        lines = list(json_lines(path, MAX_JOURNAL_BYTES))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a journal: {error}") from None
    if parts := _read_parts(lines, Path(path)):
        return parts
    raise DatasetError(f"{path}: a journal without samples")


def _latest_samples(lines: Iterable[Mapping[str, Any]]) -> dict[int, Any]:
    """Return the last line of each sample that was not removed, by its number."""
    latest = {line["id"]: line for line in lines if "id" in line}
    # The last line of a removed sample contains its number only.
    return {number: line for number, line in latest.items() if "sample" in line}


def _read_parts(lines: Iterable[Mapping[str, Any]], path: Path) -> list[Part]:
    """Join the samples of each clock, in the order of time."""
    kept, parts = _latest_samples(lines), []
    for start in dict.fromkeys(line["start_ns"] for line in kept.values()):
        ids = [k for k, line in kept.items() if line["start_ns"] == start]
        ones = [Dataset.from_document(kept[k]["sample"], str(path)) for k in ids]
        order = sorted(range(len(ids)), key=lambda i: ones[i].time[0])
        dataset = join_datasets([ones[i] for i in order], [1] * len(ids))
        parts.append(Part(dataset, [ids[i] for i in order], start))
    return parts
