"""List the jobs of a fleet: every recording of every robot, from a folder or from a list."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock

from parallel_cal import __version__
from parallel_cal.base.errors import ParallelCalError, format_suggestion
from parallel_cal.identification.options import FitOptions
from parallel_cal.recordings.bag import DATA_FILES, data_hash
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.samplefile import SAMPLES_SUFFIX
from parallel_cal.recordings.table import read_table

COLUMNS, TIME = ("robot", "model", "recording"), "time"
TABLE = "rows.parquet"  # a folder that contains it holds a fleet's results
CASADI_LOCK = Lock()  # CasADi's expressions are not thread-safe, and a worker may have threads


class FleetError(ParallelCalError):
    """A fleet cannot start or continue; the message says what to do."""


def reason(error: Exception) -> str:
    """Describe an error in one line; a user's own mechanism or effect may raise anything."""
    if isinstance(error, ParallelCalError):
        return " ".join(str(error).split())
    return f"{type(error).__name__}: {error}"


def check_version(asked: str) -> None:
    """Raise FleetError unless this worker has the requested version: results of different versions
    are not comparable."""
    if asked != __version__:
        raise FleetError(f"the worker has parallel_cal {__version__}, but {asked} is needed")


@dataclass(frozen=True)
class FleetOptions:
    """How every recording is read, fitted and diagnosed, and by which version."""

    options: FitOptions = field(default_factory=FitOptions)
    effects: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    data: ReadOptions = field(default_factory=ReadOptions)
    version: str = __version__


@dataclass(frozen=True)
class Job:
    """One recording of one robot; `last` if it is the robot's newest. `time` is in s since 1970, or
    None if unknown."""

    robot: str
    recording: str
    model: Path
    data: Path
    time: float | None = None
    last: bool = True

    @property
    def order(self) -> list[str | int]:
        """The sort key of its name, with numbers in numerical order: 9 before 10."""
        parts = re.split("([0-9]+)", self.recording)
        return [int(part) if k % 2 else part for k, part in enumerate(parts)]

    def hash_inputs(self, asked: FleetOptions) -> str:
        """Return the sha256 of everything that determines the result."""
        parts = [repr(asked), self.robot, self.recording, repr(self.time)]
        for path in (self.model, self.data):
            try:
                parts.append(data_hash(path))
            except OSError as error:  # judging the recording will report this error
                parts.append(str(error))
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def jobs_of(robots: Path) -> list[Job]:
    """List the jobs of a folder with one subfolder per robot, or of a list (.csv).

    The jobs are sorted by robot, then by time if the list gives it for all recordings of the robot,
    else by name. Raises FleetError if there are none, or if two robots, or two recordings of one
    robot, have the same name; DatasetError if a list is not a table.
    """
    jobs = list(_list_table_jobs(robots) if robots.is_file() else _list_folder_jobs(robots))
    if not jobs:
        raise FleetError(
            f"{robots}: no recordings; expected a folder for each robot with its "
            "model (.yaml) and its recordings, or a list (.csv) with the columns "
            f"{', '.join(COLUMNS)}"
        )
    models: dict[str, Path] = {}
    seen: set[tuple[str, str]] = set()
    for job in jobs:
        if models.setdefault(job.robot, job.model) != job.model:
            raise FleetError(
                f"{robots}: two robots have the name '{job.robot}', with the models "
                f"{models[job.robot]} and {job.model}: give them different names"
            )
        if (job.robot, job.recording) in seen:
            raise FleetError(f"{robots}: '{job.robot}' has the recording {job.recording} twice")
        seen.add((job.robot, job.recording))
    untimed = {job.robot for job in jobs if job.time is None}
    jobs.sort(key=lambda job: (job.robot, job.time if job.robot not in untimed else 0.0, job.order))
    last = {job.robot: job for job in jobs}
    return [replace(job, last=last[job.robot] is job) for job in jobs]


def _list_folder_jobs(robots: Path) -> Iterator[Job]:
    """List the jobs of a folder; a robot without a model file of its own has the shared one."""
    if not robots.is_dir():
        raise FleetError(f"{robots}: no such folder or list")
    shared = sorted(robots.glob("*.yaml"))
    folders = (path for path in robots.iterdir() if path.is_dir())
    for folder in sorted(path for path in folders if not (path / TABLE).exists()):
        recordings = sorted(path for path in folder.iterdir() if _is_recording(path))
        if not recordings:
            continue
        models = sorted(folder.glob("*.yaml")) or shared
        if len(models) != 1:
            names = ", ".join(path.name for path in models) or "none"
            raise FleetError(f"{folder}: expected one model file (.yaml), found {names}")
        model = models[0].resolve()
        yield from (Job(folder.name, path.name, model, path.resolve()) for path in recordings)


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return any(file.suffix in (".yaml", *DATA_FILES) for file in path.iterdir())
    return path.suffix in (*DATA_FILES, SAMPLES_SUFFIX)


def _list_table_jobs(robots: Path) -> Iterator[Job]:
    """List the jobs of a list; paths are relative to its folder, the column `time` is optional."""
    table, known, lost = read_table(robots).drop_empty_rows(), [*COLUMNS, TIME], []
    if unknown := [name for name in table.header if name and name not in known]:
        expected = f"expected {', '.join(known)}{format_suggestion(unknown[0], known)}"
        raise FleetError(f"{robots}:1: unknown column '{unknown[0]}', {expected}")
    if missing := [name for name in COLUMNS if name not in table.header]:
        raise FleetError(f"{robots}:1: no column {', '.join(missing)}")
    for line, cells in zip(table.lines, table.rows, strict=True):
        place, row = f"{robots}:{line}", dict(zip(table.header, map(str.strip, cells), strict=True))
        if empty := [name for name in COLUMNS if not row[name]]:
            raise FleetError(f"{place}: no {empty[0]}")
        model, data = paths = [(robots.parent / row[n]).resolve() for n in ("model", "recording")]
        lost += [f"{place}: no such file {path}" for path in paths if not path.exists()]
        yield Job(row["robot"], row["recording"], model, data, _parse_time(row.get(TIME), place))
    if lost:  # report all missing files at once
        raise FleetError("; ".join(lost))


def _parse_time(text: str | None, place: str) -> float | None:
    """Return the seconds since 1970 of an ISO 8601 date or time (UTC if no zone is given)."""
    if not text:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise FleetError(
            f"{place}: time is '{text}', expected a time such as 2026-05-31T14:00"
        ) from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
