"""The folder of a session: its states as a tree, with undo, redo and branches.

The folder contains `session.json`, replaced as a whole at every change, and the model file of each
state. A model and its samples never change in a state. The last state survives a crash.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from parallel_cal.base.arguments import require
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import read_text, write_atomically
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.identification.options import FitOptions

VERSION = 2
FILE, LOCK = "session.json", ".lock"


class SessionError(ParallelCalError):
    """A session cannot be opened, or a step cannot be taken in it."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class State(_Part):
    """A model and the samples that judge it.

    `errors` are the errors at held-out poses of the `samples` that the step used, `before` those of
    the step's start at the same samples, `noise` the noise floor: summaries, empty if unknown.
    `weights` is the noise (a `Noise`) with which the step weighted the samples.
    `imported` are tables that were added since the session began, `taken` is a file of samples
    recorded since then, `fitting` the options that differ from those of the session; all persist
    until changed, as `excluded` does. `verdict` is the word
    of the diagnosis (empty: not diagnosed), `summary` its sentence. `sigmas` is by kind the
    standard deviation of the rms in `errors`, `sigmas_before` that of the rms in `before`. `reason`
    is the owner's reason for a forced step.
    `knocked` are the samples that the diagnosis excluded because they are far from all others; None
    if these samples were not diagnosed, or only a part of them.
    `drift` says whether the robot has drifted since its last calibration, in a session that updates
    one; `recheck` is the document of the `Recheck` that decided it.
    """

    number: int
    parent: int | None
    step: str
    model: str
    excluded: Mapping[int, str] = {}
    imported: Sequence[str] = ()
    taken: str = ""
    fitting: Mapping[str, Any] = {}
    before: Mapping[str, float | None] = {}
    errors: Mapping[str, float | None] = {}
    noise: Mapping[str, float | None] = {}
    weights: Mapping[str, Any] = {}
    against: str = ""
    verdict: str = ""
    summary: str = ""
    samples: int | None = None
    sigmas: Mapping[str, float] = {}
    sigmas_before: Mapping[str, float] = {}
    reason: str = ""
    knocked: Sequence[int] | None = None
    drift: str = ""
    recheck: Mapping[str, Any] = {}

    @property
    def verdict_text(self) -> str:
        """The verdict and its sentence: `explained: backlash ...`; empty if not diagnosed."""
        return f"{self.verdict}: {self.summary}" if self.verdict else ""

    @property
    def position_rms(self) -> float | None:
        return self.errors.get("position_rms")


class Record(_Part):
    """Contents of session.json. `forward` are the undone states, the last one last."""

    parallel_cal_session: int = VERSION
    recordings: Sequence[str]
    reading: Mapping[str, Any] = {}
    fitting: Mapping[str, Any] = {}
    states: Sequence[State]
    branches: Mapping[str, int]
    forward: Mapping[str, Sequence[int]] = Field(default_factory=dict)
    branch: str = "main"

    @model_validator(mode="before")
    @classmethod
    def _convert_version_1(cls, document: Any) -> Any:
        """Split the verdicts of version 1, which stored `word: summary` as one text."""
        if not isinstance(document, dict) or document.get("parallel_cal_session") != 1:
            return document
        states = document.get("states")
        for state in states if isinstance(states, list) else ():
            if isinstance(state, dict) and isinstance(state.get("verdict"), str):
                state["verdict"], _, state["summary"] = state["verdict"].partition(": ")
        return document | {"parallel_cal_session": VERSION}

    @property
    def state(self) -> State:
        return self.states[self.branches[self.branch]]


class History:
    """The folder of a calibration without computations: cheap to open and to poll."""

    def __init__(self, folder: str | Path):
        """Open a session; SessionError if the folder has none, or an unreadable one."""
        require("folder", folder, "str | Path", SessionError)
        self.folder = Path(folder)
        self.record = self._read()

    # ------------------------------------------------------------------ contents

    @property
    def state(self) -> State:
        return self.record.state

    @property
    def recordings(self) -> list[str]:
        """The recordings of the session, and the files of samples added since it began."""
        return self._list_recordings(self.state.imported, self.state.taken)

    def _list_recordings(self, imported: Sequence[str], taken: str) -> list[str]:
        added = [*imported, *([taken] if taken else [])]
        return [*self.record.recordings, *(str(self.folder / file) for file in added)]

    @property
    def options(self) -> FitOptions:
        return FitOptions(**{**self.record.fitting, **self.state.fitting})

    def history(self, branch: str | None = None) -> list[State]:
        """Return the states of a branch, from the first to the last one."""
        state: State | None = self.record.states[self._head(branch or self.record.branch)]
        found: list[State] = []
        while state is not None:
            found.append(state)
            state = None if state.parent is None else self.record.states[state.parent]
        return found[::-1]

    def compared(self, branches: Sequence[str] = ()) -> dict[str, State]:
        """Return the last state of each branch, or of the named ones."""
        names = branches or list(self.record.branches)
        return {name: self.record.states[self._head(name)] for name in names}

    def document(self) -> dict[str, Any]:
        """Return the JSON document of `parallel-cal session`."""
        return {
            "folder": str(self.folder),
            "branch": self.record.branch,
            "branches": dict(self.record.branches),
            "recordings": list(self.record.recordings),
            "history": [to_json_value(state.model_dump()) for state in self.history()],
            "can_undo": self.state.parent is not None,
            "can_redo": bool(self.record.forward.get(self.record.branch)),
        }

    # ------------------------------------------------------------------ undo, redo and branches

    def undo(self) -> State:
        """Go one step back; SessionError at the first state."""
        with self._lock_record() as record:
            if record.state.parent is None:
                raise SessionError("nothing to undo: this is the first state of the session")
            ahead = [*record.forward.get(record.branch, ()), record.state.number]
            self._move(record, record.state.parent, ahead)
        return self.state

    def redo(self) -> State:
        """Repeat the step that was undone last; SessionError if there is none."""
        with self._lock_record() as record:
            undone = record.forward.get(record.branch)
            if not undone:
                raise SessionError("nothing to redo")
            self._move(record, undone[-1], undone[:-1])
        return self.state

    def start_branch(self, name: str) -> State:
        """Start a new branch at this state."""
        if not name.strip():
            raise SessionError("a branch needs a name")
        with self._lock_record() as record:
            if name in record.branches:
                raise SessionError(f"branch '{name}' already exists; switch to it")
            branches = {**record.branches, name: record.state.number}
            self._write(record.model_copy(update={"branches": branches, "branch": name}))
        return self.state

    def switch(self, branch: str) -> State:
        """Continue with another branch."""
        with self._lock_record() as record:
            self._head(branch)
            self._write(record.model_copy(update={"branch": branch}))
        return self.state

    def _head(self, branch: str) -> int:
        if branch not in self.record.branches:
            known = ", ".join(self.record.branches)
            raise SessionError(f"no branch '{branch}'; there are {known}")
        return self.record.branches[branch]

    # ------------------------------------------------------------------ on disk

    def record_verdict(
        self, at: State, verdict: str, summary: str, knocked: Sequence[int] | None = None
    ) -> None:
        """Store the word of a verdict, its sentence and the samples that it excluded with the state
        `at`."""
        with self._lock_record() as record:
            states = list(record.states)
            states[at.number] = states[at.number].model_copy(
                update={"verdict": verdict, "summary": summary, "knocked": knocked}
            )
            self._write(record.model_copy(update={"states": states}))

    def _move(self, record: Record, number: int, ahead: Sequence[int], **changes: Any) -> None:
        branches = {**record.branches, record.branch: number}
        forward = {**record.forward, record.branch: list(ahead)}
        changes |= {"branches": branches, "forward": forward}
        self._write(record.model_copy(update=changes))

    @contextmanager
    def _lock_record(self) -> Iterator[Record]:
        """Lock and read the record on disk; SessionError if the folder cannot be written."""
        try:
            file = (self.folder / LOCK).open("w")
        except OSError as error:
            raise SessionError(
                f"{self.folder}: this session cannot be changed ({error.strerror}); make its "
                "folder writable, or copy it to one that is"
            ) from None
        with file as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self.record = self._read()
            yield self.record

    def refresh(self) -> bool:
        """Read changes by others; return whether there were any."""
        record = self._read()
        changed, self.record = record != self.record, record
        return changed

    def _read(self) -> Record:
        file = self.folder / FILE
        try:
            record = Record.model_validate_json(read_text(file))
        except OSError as error:
            raise SessionError(
                f"{self.folder}: no session here ({error.strerror}); create one with "
                "parallel-cal session new"
            ) from None
        except ValidationError as error:
            one = error.errors(include_url=False)[0]
            key = ".".join(str(part) for part in one["loc"])
            raise SessionError(f"{file}: {key or 'document'}: {one['msg']}") from None
        if record.parallel_cal_session != VERSION:
            raise SessionError(
                f"{file}: parallel_cal_session is {record.parallel_cal_session}, expected {VERSION}"
            )
        return record

    def _write(self, record: Record) -> None:
        write_atomically(self.folder / FILE, record.model_dump_json(indent=1) + "\n")
        self.record = record


def format_first_error(errors: Mapping[str, float | None], missing: str = "-") -> str:
    """Format the first known kind of error: `30 um`, `1820 um`, `0.43 arcmin`; `missing` if none
    is known."""
    for kind, (unit, factor) in ERROR_UNITS.items():
        if (value := errors.get(f"{kind}_rms")) is not None:
            shown = value * factor
            return f"{shown:.3g} {unit}" if shown < 1000 else f"{shown:.0f} {unit}"
    return missing
