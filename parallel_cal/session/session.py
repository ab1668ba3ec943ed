"""A calibration as it goes on: its steps as a tree in a folder, with undo, redo and branches.

The folder holds `session.json`, replaced whole at every change, and each state's model file; a
state is never altered. Whoever opens the folder later, after a crash, too, finds the last state.
"""

from __future__ import annotations

import dataclasses
import fcntl
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from parallel_cal.base.documents import plain
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import read_text, write_atomically
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.identification.acceptance import UNITS
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import Model
from parallel_cal.planning.plan import plan
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_sessions
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.signals import Signals, signals
from parallel_cal.recordings.simulate import with_noise
from parallel_cal.session.steps import Step, added, fitted, removed

VERSION = 1
FILE, LOCK = "session.json", ".lock"
Progress = Callable[[str, float], None]


class SessionError(ParallelCalError):
    """A session cannot be opened, or a step cannot be taken in it."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class State(_Part):
    """A model and the samples it is judged by; `errors` are those at poses left out, `before` those
    of the step's start, `noise` what a perfect model would show: summaries, empty where unknown.

    `taken` is a file of samples taken since the session began, `fitting` what is identified
    otherwise than at its beginning; both hold until changed, as `excluded` does.
    """

    number: int
    parent: int | None
    step: str
    model: str
    excluded: Mapping[int, str] = {}
    taken: str = ""
    fitting: Mapping[str, Any] = {}
    before: Mapping[str, float | None] = {}
    errors: Mapping[str, float | None] = {}
    noise: Mapping[str, float | None] = {}
    against: str = ""
    verdict: str = ""

    @property
    def position_rms(self) -> float | None:
        return self.errors.get("position_rms")

    def shown(self, errors: Mapping[str, float | None]) -> str:
        """Errors in words, of the first kind that is known: `30 um`, `0.43 arcmin`."""
        for kind, factor, unit in UNITS:
            if (value := errors.get(f"{kind}_rms")) is not None:
                return f"{value * factor:.3g} {unit}"
        return "-"


class Record(_Part):
    """What session.json holds. `forward` are the states that were undone, the last one last."""

    parallel_cal_session: int = VERSION
    recordings: Sequence[str]
    reading: Mapping[str, Any] = {}
    fitting: Mapping[str, Any] = {}
    states: Sequence[State]
    branches: Mapping[str, int]
    forward: Mapping[str, Sequence[int]] = Field(default_factory=dict)
    branch: str = "main"

    @property
    def state(self) -> State:
        return self.states[self.branches[self.branch]]


class Session:
    """A folder with a calibration in it. Every change is on disk before its method returns."""

    def __init__(self, folder: str | Path):
        """Open a session; SessionError where the folder holds none, or one that cannot be read."""
        self.folder = Path(folder)
        self.record = self._read()
        self._samples: dict[tuple[str, ...], Dataset] = {}

    @classmethod
    def new(
        cls,
        folder: str | Path,
        model: Model,
        recordings: Sequence[str | Path],
        *,
        reading: ReadOptions | None = None,
        fitting: FitOptions | None = None,
    ) -> Session:
        """Begin one with a model and recordings; SessionError where the folder has one already.

        Options are those of every step that follows. Without a recording, samples are to be
        `take`n.
        """
        target = Path(folder)
        if (target / FILE).exists():
            raise SessionError(f"{target}: holds a session already; open it or name another folder")
        paths = [str(Path(path).resolve()) for path in recordings]
        if paths:  # better said now than at the first step
            load_sessions(paths, reading, joints=model.joints)
        (target / "models").mkdir(parents=True, exist_ok=True)
        first = State(number=0, parent=None, step="begin", model="models/0.yaml")
        write_model(model, target / first.model)
        record = Record(
            recordings=paths,
            reading=_changed(reading or ReadOptions(), ReadOptions()),
            fitting=_changed(fitting or FitOptions(), FitOptions()),
            states=[first],
            branches={"main": 0},
        )
        write_atomically(target / FILE, record.model_dump_json(indent=1) + "\n")
        return cls(target)

    # ------------------------------------------------------------------ what there is

    @property
    def state(self) -> State:
        return self.record.state

    @property
    def model(self) -> Model:
        return read_model(self.folder / self.state.model)

    @property
    def recordings(self) -> list[str]:
        """Those that the session began with, and the file of what was taken since."""
        taken = [str(self.folder / self.state.taken)] if self.state.taken else []
        return [*self.record.recordings, *taken]

    @property
    def samples(self) -> Dataset:
        """All samples, those that are excluded here, too; SessionError where there are none yet."""
        if not (paths := tuple(self.recordings)):
            raise SessionError(f"{self.folder}: no samples yet; take some first")
        if paths not in self._samples:
            joints = read_model(self.folder / self.record.states[0].model).joints
            options = ReadOptions(**self.record.reading)
            self._samples[paths] = load_sessions(paths, options, joints=joints)
        return self._samples[paths]

    @property
    def dataset(self) -> Dataset:
        """The samples that count here."""
        return self._counted(self.state.excluded)

    def _counted(self, excluded: Collection[int]) -> Dataset:
        return self.samples.excluding(sorted(excluded), "in this session")

    @property
    def options(self) -> FitOptions:
        return FitOptions(**{**self.record.fitting, **self.state.fitting})

    def history(self, branch: str | None = None) -> list[State]:
        """The states from the beginning to a branch's last one."""
        state: State | None = self.record.states[self._head(branch or self.record.branch)]
        found: list[State] = []
        while state is not None:
            found.append(state)
            state = None if state.parent is None else self.record.states[state.parent]
        return found[::-1]

    def compared(self, branches: Sequence[str] = ()) -> dict[str, State]:
        """The last state of several branches (all where none is named)."""
        names = branches or list(self.record.branches)
        return {name: self.record.states[self._head(name)] for name in names}

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal session`."""
        return {
            "folder": str(self.folder),
            "branch": self.record.branch,
            "branches": dict(self.record.branches),
            "recordings": list(self.record.recordings),
            "history": [plain(state.model_dump()) for state in self.history()],
            "can_undo": self.state.parent is not None,
            "can_redo": bool(self.record.forward.get(self.record.branch)),
        }

    # ------------------------------------------------------------------ steps

    def fit(self, progress: Progress | None = None) -> State:
        """Identify the model's free parameters; what speaks against the result is in the state."""
        step = fitted(self.model, self.dataset, True, options=self.options, progress=progress)
        return self._committed("fit", step)

    def add(self, effect: str, progress: Progress | None = None, force: bool = False) -> State:
        """Add an effect and identify anew; FitError where the errors at poses left out do not fall,
        and nobody insists."""
        how = {"options": self.options, "progress": progress}
        return self._committed(
            f"add {effect}", added(self.model, effect, self.dataset, force, **how)
        )

    def remove(self, effect: str, progress: Progress | None = None, force: bool = False) -> State:
        """Remove an effect and identify anew; FitError where that costs accuracy."""
        how = {"options": self.options, "progress": progress}
        step = removed(self.model, effect, self.dataset, force, **how)
        return self._committed(f"remove {effect}", step)

    def exclude(self, samples: Mapping[int, str], progress: Progress | None = None) -> State:
        """Leave samples out, each with a reason, and identify anew."""
        known = {int(n) for n in self.samples.numbers}
        if unknown := sorted(set(samples) - known):
            raise SessionError(f"no sample {unknown[0]}; there are {len(known)}")
        excluded = {**self.state.excluded, **samples}
        return self._refitted(f"exclude {_listed(samples)}", progress, excluded=excluded)

    def include(self, samples: Sequence[int], progress: Progress | None = None) -> State:
        """Take samples back that were excluded, and identify anew."""
        if missing := [n for n in samples if n not in self.state.excluded]:
            raise SessionError(f"sample {missing[0]} is not excluded")
        kept = {n: why for n, why in self.state.excluded.items() if n not in samples}
        return self._refitted(f"include {_listed(samples)}", progress, excluded=kept)

    def choose(self, progress: Progress | None = None, **options: Any) -> State:
        """Identify anew, from here on with other options of a fit: free, fix, prior, loss, ..."""
        fitting = {**self.state.fitting, **{key: plain(v) for key, v in options.items()}}
        words = ", ".join(f"{key} {_said(value)}" for key, value in options.items())
        return self._refitted(words, progress, fitting=fitting)

    def _refitted(self, words: str, progress: Progress | None, **changes: Any) -> State:
        data = self._counted(changes.get("excluded", self.state.excluded))
        options = FitOptions(
            **{**self.record.fitting, **changes.get("fitting", self.state.fitting)}
        )
        step = fitted(self.model, data, True, options=options, progress=progress)
        if (start := self.state).errors:
            # The model that it starts from knew these samples: its error at them proves nothing,
            # and other samples or parameters are no reason to doubt it.
            changes |= {"before": start.errors, "against": start.against}
        return self._committed(words, step, **changes)

    def take(self, write: Callable[[Path], None]) -> State:
        """Samples measured since the session began, in a file of its own that `write` makes: those
        that were taken before, and what came since. The model stays as it is."""
        file = self.folder / "samples" / f"{uuid4().hex}.json"
        file.parent.mkdir(exist_ok=True)
        write(file)
        reading = ReadOptions(**self.record.reading)
        paths = [*self.record.recordings, str(file)]
        data = load_sessions(paths, reading, joints=self.model.joints)
        before = self.samples if self.recordings else data
        kept = {n: why for n, why in self.state.excluded.items() if _same(before, data, n)}
        changes = {"taken": str(file.relative_to(self.folder)), "excluded": kept}
        return self._advanced(f"take {len(data)} samples", None, **changes)

    def diagnose(self, progress: Progress | None = None, **options: Any) -> Diagnosis:
        """What is missing in the model of this state; its verdict is kept with the state."""
        at = self.state
        how = {"options": self.options, "progress": progress} | options
        found = diagnose(self.model, self.dataset, **how)
        self.judged(at, f"{found.verdict.word}: {found.verdict.summary}")
        return found

    def signals(self, sample: int) -> Signals:
        """The readings that a sample was made of; DatasetError where they were not kept."""
        reading = ReadOptions(**self.record.reading)
        return signals(self.samples, sample, self.recordings, reading)

    def plan(self, poses: int, progress: Progress | None = None) -> Path:
        """Poses to measure next for what is free here: a CSV of m, quaternions and joints."""
        asked = self.options
        found = plan(
            with_noise(self.model), poses, progress=progress, free=asked.free, fix=asked.fix
        )
        file = self.folder / "plans" / f"{self.state.number}.csv"
        file.parent.mkdir(exist_ok=True)
        write_atomically(file, found.csv())
        return file

    def judged(self, at: State, verdict: str) -> None:
        """Keep a verdict with the state it was found for."""
        with self._changing() as record:
            states = list(record.states)
            states[at.number] = states[at.number].model_copy(update={"verdict": verdict})
            self._write(record.model_copy(update={"states": states}))

    # ------------------------------------------------------------------ back, forth and beside

    def undo(self) -> State:
        """One step back; SessionError at the beginning."""
        with self._changing() as record:
            if record.state.parent is None:
                raise SessionError("nothing to undo: this is where the session began")
            ahead = [*record.forward.get(record.branch, ()), record.state.number]
            self._move(record, record.state.parent, ahead)
        return self.state

    def redo(self) -> State:
        """Once more what was undone last; SessionError where nothing was."""
        with self._changing() as record:
            undone = record.forward.get(record.branch)
            if not undone:
                raise SessionError("nothing to redo")
            self._move(record, undone[-1], undone[:-1])
        return self.state

    def start_branch(self, name: str) -> State:
        """A new branch that begins at this state, to try something beside."""
        if not name.strip():
            raise SessionError("a branch needs a name")
        with self._changing() as record:
            if name in record.branches:
                raise SessionError(f"there is a branch '{name}' already; switch to it")
            branches = {**record.branches, name: record.state.number}
            self._write(record.model_copy(update={"branches": branches, "branch": name}))
        return self.state

    def switch(self, branch: str) -> State:
        """Go on with another branch."""
        with self._changing() as record:
            self._head(branch)
            self._write(record.model_copy(update={"branch": branch}))
        return self.state

    def _head(self, branch: str) -> int:
        if branch not in self.record.branches:
            known = ", ".join(self.record.branches)
            raise SessionError(f"no branch '{branch}'; there are {known}")
        return self.record.branches[branch]

    # ------------------------------------------------------------------ on disk

    def _committed(self, words: str, step: Step, **changes: Any) -> State:
        """A step as the branch's last state, with its errors."""
        judged = {
            "before": plain(step.before.document()),
            "errors": plain(step.result.held_out.summary.document()),
            "noise": plain(step.result.noise.document()),
            "against": step.acceptance.against,
        }
        return self._advanced(words, step.model, **{**judged, **changes})

    def _advanced(self, words: str, model: Model | None, **changes: Any) -> State:
        """A new last state of the branch, written with its model (None: the one there is); what
        holds until changed stays as it was, unless `changes` names it."""
        start = self.state
        with self._changing() as record:
            if record.state != start:
                raise SessionError("the session was changed meanwhile: look at it and try again")
            number = len(record.states)
            kept = {"excluded": start.excluded, "taken": start.taken, "fitting": start.fitting}
            file = start.model if model is None else f"models/{number}.yaml"
            state = State(
                number=number, parent=start.number, step=words, model=file, **{**kept, **changes}
            )
            if model is not None:
                write_model(model, self.folder / file)
            self._move(record, number, [], states=[*record.states, state])
        return self.state

    def _move(self, record: Record, number: int, ahead: Sequence[int], **changes: Any) -> None:
        branches = {**record.branches, record.branch: number}
        forward = {**record.forward, record.branch: list(ahead)}
        changes |= {"branches": branches, "forward": forward}
        self._write(record.model_copy(update=changes))

    @contextmanager
    def _changing(self) -> Iterator[Record]:
        """The record as it is on disk now; nobody else changes it meanwhile."""
        with (self.folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            self.record = self._read()
            yield self.record

    def refresh(self) -> bool:
        """Take up what others have changed; whether they have."""
        record = self._read()
        changed, self.record = record != self.record, record
        return changed

    def _read(self) -> Record:
        file = self.folder / FILE
        try:
            record = Record.model_validate_json(read_text(file))
        except OSError as error:
            raise SessionError(
                f"{self.folder}: no session here ({error.strerror}); begin one with "
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


def _changed(options: Any, usual: Any) -> dict[str, Any]:
    """What differs from the usual, as JSON has it."""
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    return {key: plain(v) for key, v in given.items() if v != getattr(usual, key)}


def _said(value: Any) -> str:
    return ", ".join(value) or "none" if isinstance(value, (list, tuple)) else str(value)


def _same(one: Dataset, other: Dataset, number: int) -> bool:
    """Whether two datasets mean the same sample by a number."""
    q = [d.q[d.numbers == number] for d in (one, other)]
    return bool(len(q[0]) and np.array_equal(*q))


def _listed(samples: Any) -> str:
    return ", ".join(map(str, sorted(samples)))
