"""The command that follows a calibrated robot through its recordings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.base.errors import DatasetError, ParallelCalError
from parallel_cal.cli.arguments import Data, Details, JointSigma, Json, ModelFile
from parallel_cal.cli.calibration import list_options
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.recordings.dataset import Dataset
    from parallel_cal.watch.confirmation import Confirmation
    from parallel_cal.watch.watch import Watch

Times = Annotated[
    list[str] | None,
    typer.Option(
        "--time",
        metavar="YYYY-MM-DDTHH:MM",
        help="time of a recording that states none, such as a table (repeat for each recording; "
        "UTC if no zone is given)",
    ),
]
STATE_SUFFIX = ".watch.json"
MAX_CLOCK_ERROR_S = 86400.0  # of a stated time: zones, and clocks that a battery keeps

NewRecordings = Annotated[
    list[Path] | None,
    typer.Argument(
        help="recordings of ordinary motion since the last call, in order of time; without "
        "one, the state is shown"
    ),
]
StateFile = Annotated[
    Path | None,
    typer.Option(
        help=f"file in which the watch continues [default: MODEL{STATE_SUFFIX}, beside the model]"
    ),
]
FalseAlarmDays = Annotated[
    float, typer.Option(help="mean time between false alarms, days", min=1e-6)
]
Undo = Annotated[
    bool,
    typer.Option("--undo", help="take back the last recording first, such as one of another robot"),
]
TrendPage = Annotated[
    Path | None, typer.Option("-o", "--output", help="page to write (.html), with the trend")
]
ConfirmationFile = Annotated[
    Path | None,
    typer.Option(help="file for the poses (.csv) that would confirm an alarm"),
]


def watch(
    model: ModelFile,
    recordings: NewRecordings = None,
    state: StateFile = None,
    time: Times = None,
    false_alarm_days: FalseAlarmDays = 30.0,
    joint_sigma: JointSigma = None,
    undo: Undo = False,
    output: TrendPage = None,
    confirm: ConfirmationFile = None,
    data: Data = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Find which part of a calibrated robot has changed. Ordinary recordings are enough, if they
    hold more readings than the robot has degrees of freedom. The answer says since when, by how
    much, and what else it could be."""
    from parallel_cal.base.files import write_atomically
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.reporting.watching import describe_watch, document_watch
    from parallel_cal.watch.state import continue_watch, write_state

    robot, paths = read_model(model), recordings or []
    if output is not None and output.suffix != ".html":
        raise ParallelCalError(
            f"-o {output}: the page is HTML, expected a name that ends with .html"
        )
    if robot.covariance is None:
        console.note(f"{model} was never fitted: its errors may hide a change; calibrate it first")
    file = state or model.with_name(model.stem + STATE_SUFFIX)
    times = match_times(time, paths)
    with hold(file):
        found, anew = continue_watch(file, robot, false_alarm_days)
        if anew:
            console.note(f"{file} is of another model: the watch of {model} starts anew")
        if undo:
            console.note(f"taken back: {found.visits[-1].name if found.visits else 'nothing'}")
            found = found.without_last()
        for k, path in enumerate(paths):
            console.progress(f"reading {path.name}", k / len(paths))
            found = _add_recording(found, path, times[k], data, joint_sigma, details)
        console.progress("", 1.0)
        if not (found.visits or undo):
            raise ParallelCalError(f"{file} has no recordings yet: give at least one")
        if (anew or paths or undo) and (kept := write_state(found, file)):
            console.note(f"the watch of the other model is kept in {kept}")
    if not found.visits:
        return console.say(f"{file} has no recordings now")
    confirmation = _plan_confirmation(found) if found.alarm else None
    if output is not None:
        from parallel_cal.reporting.watch_page import watch_page

        write_atomically(output, watch_page(found, confirmation, model.stem))
    if confirm is not None and confirmation is not None:
        write_atomically(confirm, confirmation.plan.csv())
    if as_json:
        return console.emit(document_watch(found, confirmation) | {"state": str(file)})
    console.show(describe_watch(found, confirmation), list_options(details))
    for written in (output, confirm if confirmation is not None else None):
        if written is not None:
            console.say(f"written: {written}")


def _add_recording(
    found: Watch,
    path: Path,
    time: str | None,
    data: list[str] | None,
    joint_sigma: float | None,
    details: bool,
) -> Watch:
    """Add a recording to a watch, unless it has the same content as one that was added before."""
    from parallel_cal.recordings.bag import data_hash
    from parallel_cal.recordings.loading import load_stamped

    content = data_hash(path)
    if content in {visit.sha256 for visit in found.visits}:
        console.note(f"{path} was taken before; it counts once")
        return found
    mechanism = found.model.mechanism
    dataset, stamp = load_stamped(path, data_options(data), console.progress, mechanism=mechanism)
    console.warn(dataset.warnings, brief=not details)
    when = read_time(path, dataset, stamp, time)
    return found.add(replace(dataset, sha256=content), when, joint_sigma, str(path))


def _plan_confirmation(found: Watch) -> Confirmation | None:
    """Return the measurement that would confirm an alarm; None, with a note, if there is none."""
    from parallel_cal.watch.confirmation import plan_confirmation

    try:
        return plan_confirmation(found)
    except ParallelCalError as error:
        console.note(f"no measurement was planned that would confirm it: {error}")
        return None


@contextmanager
def hold(state: Path) -> Iterator[None]:
    """Hold a state file, so that no other watch writes it; ParallelCalError if another one does."""
    from parallel_cal.base.files import open_locked

    lock = open_locked(state.with_name(f".{state.name}.lock"))
    if lock is None:
        raise ParallelCalError(f"another watch uses {state} now: wait for its end")
    try:
        yield
    finally:
        os.close(lock)


def match_times(given: list[str] | None, paths: Sequence[Path]) -> Sequence[str | None]:
    """Return the stated time of each recording, None where none is stated."""
    if given and len(given) != len(paths):
        raise ParallelCalError(
            f"--time: {len(given)} given, {len(paths)} expected, one for each recording"
        )
    return given or [None] * len(paths)


def read_time(path: Path, dataset: Dataset, stamp: int, given: str | None) -> float:
    """Return when a recording was made (s since 1970), as `given` or by the recording itself.

    DatasetError if neither states it, or if they differ by more than a day."""
    from parallel_cal.recordings.loading import find_start_time
    from parallel_cal.reporting.watching import iso

    stated = find_start_time(dataset, stamp)
    when = parse_time(given) if given is not None else stated
    if when and stated and abs(when - stated) > MAX_CLOCK_ERROR_S:
        raise DatasetError(
            f"{path} states that it was recorded on {iso(stated)}, and --time says {iso(when)}: "
            "correct it, or leave it out"
        )
    if when is None:
        raise DatasetError(
            f"{path} does not state when it was recorded: give --time for each recording"
        )
    return when


def parse_time(text: str) -> float:
    """Return the s since 1970 of an ISO 8601 date or time, UTC if it names no zone."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ParallelCalError(f"--time {text}: expected a time such as 2026-05-31T14:00") from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
