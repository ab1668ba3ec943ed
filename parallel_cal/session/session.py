"""A calibration session in a folder: steps that identify, judge and store a model."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.files import write_atomically
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.patterns import explain_exclusion
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.identification.fit import Prepared
from parallel_cal.identification.noise_figures import noise_in_use
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import add_plugin_folder, load_effect
from parallel_cal.planning.options import PlanOptions
from parallel_cal.planning.plan import plan
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions
from parallel_cal.recordings.loading import MAP_SUFFIX, load_sessions
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.samplefile import SAMPLES_SUFFIX
from parallel_cal.recordings.signals import Signals, signals
from parallel_cal.recordings.simulate import with_noise
from parallel_cal.recordings.table import TABLE_SUFFIXES, is_table
from parallel_cal.session.history import FILE, History, Record, SessionError, State
from parallel_cal.session.saving import (
    Replacement,
    compare_with_model_in_use,
    write_for_robot,
)
from parallel_cal.session.steps import Step, add, fitted, remove

CHANGED = "the session changed in the meantime: look at it and try again"
# The fields of a state that the next one takes over unless it changes them.
PERSISTENT = ("excluded", "imported", "taken", "fitting")
# The fields of a state that judge its model.
JUDGED = (
    *("before", "errors", "noise", "weights", "sigmas_before", "sigmas", "samples"),
    *("against", "verdict", "summary", "drift", "recheck"),
)


class Session(History):
    """The folder of a calibration. Every change is on disk before its method returns.

    `Session.new` starts a session; a step (`fit`, `add`, `remove`) makes a new state, and `undo`
    returns to the previous one.

    Parameters
    ----------
    folder : str or Path
        Folder of the session.

    Raises
    ------
    SessionError
        If the folder holds no session, or an unreadable one.

    Examples
    --------
    >>> import tempfile
    >>> import parallel_cal as pc
    >>> model, folder = pc.new_model("delta24"), tempfile.mkdtemp()
    >>> pc.write_bag(pc.simulate(model, 12, effects=["backlash"]), f"{folder}/bag")
    >>> session = pc.Session.new(f"{folder}/session", model, [f"{folder}/bag"])
    >>> session.state.step
    'begin'
    """

    def __init__(self, folder: str | Path):
        """Open a session; SessionError if the folder has none, or an unreadable one."""
        super().__init__(folder)
        add_plugin_folder(self.effects_folder)
        self._samples: dict[tuple[str, ...], Dataset] = {}
        # By file. A model is kept because it holds its compiled functions.
        self._models: dict[str, Model] = {}

    @classmethod
    @check_arguments(SessionError)
    def new(
        cls,
        folder: str | Path,
        model: Model,
        recordings: Sequence[str | Path],
        *,
        reading: ReadOptions | None = None,
        fitting: FitOptions | None = None,
    ) -> Session:
        """Start a session with a model and recordings; SessionError if the folder has one already.

        The options apply to every step. Without recordings, `take` provides the samples.
        """
        target = Path(folder)
        if (target / FILE).exists():
            raise SessionError(
                f"{target}: already holds a session; open it, or name another folder"
            )
        paths = [str(Path(path).resolve()) for path in recordings]
        samples = {}
        if paths:  # report a bad recording now, not at the first step
            samples[tuple(paths)] = load_sessions(paths, reading, mechanism=model.mechanism)
        (target / "models").mkdir(parents=True, exist_ok=True)
        first = State(number=0, parent=None, step="begin", model="models/0.yaml")
        write_model(model, target / first.model)
        record = Record(
            recordings=paths,
            reading=_collect_changes(reading or ReadOptions(), ReadOptions()),
            fitting=_collect_changes(fitting or FitOptions(), FitOptions()),
            states=[first],
            branches={"main": 0},
        )
        write_atomically(target / FILE, record.model_dump_json(indent=1) + "\n")
        session = cls(target)
        session._samples |= samples
        return session

    # ------------------------------------------------------------------ contents

    @property
    def effects_folder(self) -> Path:
        """Effect files of this session: its models and `add` find an effect NAME.py here."""
        return self.folder / "effects"

    @property
    def model(self) -> Model:
        """The model of the present state."""
        return self._model(self.state)

    @property
    def effects_note(self) -> str:
        """Say which effect files of this session a reader of its present model needs; empty if it
        needs none."""
        names = [effect.name for effect in self.model.effects]
        if not (own := [n for n in names if (self.effects_folder / f"{n}.py").exists()]):
            return ""
        return (
            f"programs that read this model need {' and '.join(f'{name}.py' for name in own)} on "
            f"their Python path: add {self.effects_folder.resolve()} to PYTHONPATH"
        )

    def _model(self, state: State) -> Model:
        if state.model not in self._models:
            self._models[state.model] = read_model(self.folder / state.model)
        return self._models[state.model]

    @property
    def samples(self) -> Dataset:
        """All samples, including excluded ones; SessionError if there are none yet."""
        if not (paths := tuple(self.recordings)):
            raise SessionError(f"{self.folder}: no samples yet; record samples first")
        if paths not in self._samples:
            mechanism = self._model(self.record.states[0]).mechanism
            options = ReadOptions(**self.record.reading)
            self._samples[paths] = load_sessions(paths, options, mechanism=mechanism)
        return self._samples[paths]

    @property
    def dataset(self) -> Dataset:
        """The samples that are not excluded."""
        return self._select_counted(self.state.excluded)

    def dataset_of_some(self, most: int) -> Dataset | None:
        """About `most` of the samples that are not excluded, evenly spread over the recording; None
        if there are no more than that."""
        if not self.recordings:
            return None
        whole = self.dataset
        some = whole.thinned(most)
        return None if some is whole else some

    def options_for(self, dataset: Dataset) -> FitOptions:
        """Return the options of this state for a fit of these samples of the session.

        In a session that updates a calibration, what is known of the robot today is their prior: it
        follows from the last calibration, since a later state already knows the samples.
        """
        return self._with_prior(self.options, dataset)

    def _with_prior(self, options: FitOptions, dataset: Dataset) -> FitOptions:
        if not options.update:
            return options
        return Prepared.of(self._begin_of_update, dataset, options).options

    def _select_counted(self, excluded: Mapping[int, str]) -> Dataset:
        return self.samples.excluding(excluded, "in this session")

    # ------------------------------------------------------------------ steps

    @check_arguments(SessionError)
    def fit(self, progress: Progress | None = None, effects: Sequence[str] = ()) -> State:
        """Identify the free parameters.

        Parameters
        ----------
        progress : callable, optional
            Called with a stage in words and the completed share (0 to 1).
        effects : sequence of str, optional
            Effects to add to the model before the fit, as in `pc.fit`.

        Returns
        -------
        State
            The new state of the session. Its text `against` gives the reason why the new model is
            not proven better than the old one. The text is empty if the new model is proven
            better.
        """
        words = f"fit with {' and '.join(effects)}" if effects else "fit"
        return self._refit(words, progress, effects)

    @check_arguments(SessionError)
    def add(
        self,
        effect: str,
        progress: Progress | None = None,
        force: bool = False,
        reason: str = "",
    ) -> State:
        """Add an effect and fit again; FitError if the validation error does not fall, unless
        forced. The histories of the session and of the model record the `reason` of a forced
        step.

        Both fits exclude the samples that the diagnosis of this state excluded because they are far
        from all others. They stay excluded until they are included again."""
        how: dict[str, Any] = {"options": self.options_for(self.dataset), "progress": progress}
        step = add(self.model, effect, self.dataset, force, self.state.knocked, **how)
        laws = [name for name, _ in parse_effects(effect) if load_effect(name).found_in_data]
        cause = " (found in data, cause unknown)" if laws else ""
        words = f"add {effect}{cause}"
        if not step.knocked:
            return self._commit_judged(words, step, reason)
        words = f"{words} without sample {_format_numbers(step.knocked)}"
        why = explain_exclusion(self.dataset, step.knocked)
        excluded = {**self.state.excluded, **dict.fromkeys(step.knocked, why)}
        return self._commit_judged(words, step, reason, excluded=excluded)

    @check_arguments(SessionError)
    def remove(
        self,
        effect: str,
        progress: Progress | None = None,
        force: bool = False,
        reason: str = "",
    ) -> State:
        """Remove an effect and fit again; FitError if that costs accuracy, unless forced. The
        `reason` is as in `add`."""
        data = self.dataset
        how: dict[str, Any] = {"options": self.options_for(data), "progress": progress}
        step = remove(self.model, effect, data, force, **how)
        return self._commit_judged(f"remove {effect}", step, reason)

    @property
    def _begin_of_update(self) -> Model:
        """The last calibration: a later state already knows the samples of this session."""
        return self._model(self.record.states[0])

    def _commit_judged(self, words: str, step: Step, reason: str, **changes: Any) -> State:
        """Append a step that was accepted, or forced for a `reason`."""
        if not step.acceptance.against:
            return self._commit(words, step, **changes)
        step = step.with_reason(reason) if reason else step
        return self._commit(f"{words}, forced", step, reason=reason, **changes)

    @check_arguments(SessionError)
    def exclude(self, samples: Mapping[int, str], progress: Progress | None = None) -> State:
        """Exclude samples, each with a reason, and fit again."""
        known = {int(n) for n in self.samples.numbers}
        if unknown := sorted(set(samples) - known):
            raise SessionError(f"no sample {unknown[0]}; the session has {len(known)} samples")
        excluded = {**self.state.excluded, **samples}
        reason = "; ".join(dict.fromkeys(why for why in samples.values() if why))
        words = f"exclude {_format_numbers(samples)}"
        return self._refit(words, progress, excluded=excluded, reason=reason)

    @check_arguments(SessionError)
    def include(self, samples: Sequence[int], progress: Progress | None = None) -> State:
        """Include excluded samples again, and fit again."""
        if missing := [n for n in samples if n not in self.state.excluded]:
            raise SessionError(f"sample {missing[0]} is not excluded")
        kept = {n: why for n, why in self.state.excluded.items() if n not in samples}
        return self._refit(f"include {_format_numbers(samples)}", progress, excluded=kept)

    def choose(
        self,
        progress: Progress | None = None,
        effects: Sequence[str] = (),
        nominal: Sequence[str] = (),
        values: Mapping[str, float] | None = None,
        **options: Any,
    ) -> State:
        """Fit again with other options (free, fix, prior, loss, ...), which later steps keep, and
        with more effects. The parameters that match a pattern of `nominal` first get their nominal
        values, and those named in `values` these values (SI units)."""
        fitting = {**self.state.fitting, **{key: to_json_value(v) for key, v in options.items()}}
        before = self.state.fitting
        # Of patterns, those that earlier steps did not have, if there are any.
        chosen = {
            key: [one for one in v if one not in before.get(key, ())] or list(v)
            for key, v in options.items()
            if isinstance(v, (list, tuple))
        }
        words = [
            f"{key} {', '.join(chosen[key]) or 'none' if key in chosen else v}"
            for key, v in options.items()
            if v not in ([], ()) or len(options) == 1  # to free a parameter may empty `fix`
        ]
        measured = values or {}
        for names, at in ((list(nominal), "nominal"), (list(measured), "measured values")):
            if names and names == chosen.get("fix"):
                words = [f"{word} at {at}" if word.startswith("fix ") else word for word in words]
            elif names:
                words.append(f"{', '.join(names)} at {at}")
        words += [f"with {' and '.join(effects)}"] if effects else []
        start = self.model
        if measured:
            given = start.values.copy()
            for name, value in measured.items():
                given[start.table.matching([name])] = value
            start = start.with_values(given)
        if nominal:
            reset = start.table.matching(nominal)
            start = start.with_values(np.where(reset, start.table.nominal, start.values))
        return self._refit(", ".join(words), progress, effects, start, fitting=fitting)

    def _refit(
        self,
        words: str,
        progress: Progress | None,
        effects: Sequence[str] = (),
        model: Model | None = None,
        **changes: Any,
    ) -> State:
        data = self._select_counted(changes.get("excluded", self.state.excluded))
        options = FitOptions(
            **{**self.record.fitting, **changes.get("fitting", self.state.fitting)}
        )
        given = self.model if model is None else model
        if options.update and given.table.names == self._begin_of_update.table.names:
            given = self._begin_of_update
        elif options.update:  # effects were added since
            options = self._with_prior(options, data)
        step = fitted(given, data, True, options=options, progress=progress, effects=effects)
        if step.result.implausible:  # later steps would start from it
            raise FitError(step.acceptance.against)
        if (start := self.state).errors:
            # The previous model was fitted to these samples, so its error at them proves nothing.
            # Other samples or parameters are no reason to doubt the new one either. Its validation
            # error was one at other samples if some were excluded or included since.
            step = step.without_objection()
            known = "excluded" not in changes
            changes |= {
                "before": start.errors if known else {},
                "sigmas_before": start.sigmas if known else {},
                "against": start.against,
            }
        return self._commit(words, step, **changes)

    def take(self, write: Callable[[Path], None]) -> State:
        """Add samples that were recorded since the session began. The model stays unchanged.

        They replace the samples of an earlier call.

        Parameters
        ----------
        write : callable
            Called with a path; it must write the file of samples there.

        Returns
        -------
        State
            The new state of the session. Its samples are those of the recordings and of the file.
        """
        file = self.folder / "samples" / f"{uuid4().hex}.json"
        file.parent.mkdir(exist_ok=True)
        write(file)
        taken = str(file.relative_to(self.folder))
        data = self._load(self._list_recordings(self.state.imported, taken))
        changes: dict[str, Any] = {"taken": taken, "excluded": self._find_excluded(data)}
        return self._append_state(f"take {len(data)} samples", None, **changes)

    def import_table(
        self, table: Path, columns: Mapping[str, Any], progress: Progress | None = None
    ) -> State:
        """Add the samples of a table, or of a file of samples. The model stays unchanged.

        The session keeps a copy of the table, with its column map beside it.

        Parameters
        ----------
        table : Path
            A file with the suffix .csv, .tsv or .txt, or .json of samples (`parallel-cal import`).
        columns : mapping
            The contents of a column map (docs/import_csv.md); not used for samples.
        progress : callable, optional
            Called with a stage in words and the completed share (0 to 1).

        Returns
        -------
        State
            The new state of the session.

        Raises
        ------
        SessionError, DatasetError, ModelFileError
            If the file is no table, or if the map is wrong. The session is then unchanged.
        """
        if not (is_table(table) or table.suffix == SAMPLES_SUFFIX):
            known = ", ".join([*TABLE_SUFFIXES, SAMPLES_SUFFIX])
            raise SessionError(f"{table.name}: not a table by its suffix: expected {known}")
        if progress:
            progress("reading the table", 0.0)
        folder = self.folder / "imports" / uuid4().hex[:8]
        folder.mkdir(parents=True)
        try:
            file = folder / table.name
            write_atomically(file, table.read_bytes())
            if is_table(file):
                beside = file.with_suffix(MAP_SUFFIX)
                write_atomically(beside, json.dumps(columns, indent=1) + "\n")  # JSON is YAML
            imported = [*self.state.imported, str(file.relative_to(self.folder))]
            data = self._load(self._list_recordings(imported, self.state.taken))
            changes: dict[str, Any] = {"imported": imported, "excluded": self._find_excluded(data)}
            count = len(data) - (len(self.samples) if self.recordings else 0)
            return self._append_state(f"import {count} samples of {table.name}", None, **changes)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _load(self, paths: Sequence[str]) -> Dataset:
        reading = ReadOptions(**self.record.reading)
        return load_sessions(paths, reading, mechanism=self.model.mechanism)

    def _find_excluded(self, data: Dataset) -> dict[int, str]:
        """Find the excluded samples by their joint readings in other data, in which their numbers
        may differ."""
        if not self.state.excluded:
            return {}
        found: dict[int, str] = {}
        before = self.samples
        for n, why in self.state.excluded.items():
            q = before.q[before.numbers == n]
            rows = data.numbers[(data.q == q).all(axis=1)]
            if n in rows:
                found[n] = why
            elif len(rows) == 1:
                found[int(rows[0])] = why
        return found

    def diagnose(self, progress: Progress | None = None, **options: Any) -> Diagnosis:
        """Diagnose the model of this state; the verdict is stored with the state."""
        at, data = self.state, self.dataset
        how: dict[str, Any] = {"options": self.options_for(data), "progress": progress} | options
        found = diagnose(self.model, data, **how)
        knocked = [one.sample for one in found.knocked]
        self.record_verdict(at, found.verdict.word, found.verdict.text, knocked)
        return found

    def conditions(self, names: Iterable[str]) -> Mapping[str, np.ndarray]:
        """Return the conditions (N,) of the samples by name, with the lagged ones of `names`."""
        return add_lagged_conditions(names, self.dataset).conditions

    def signals(self, sample: int) -> Signals:
        """Return the raw readings of a sample; DatasetError if they were not stored."""
        reading = ReadOptions(**self.record.reading)
        return signals(self.samples, sample, self.recordings, reading)

    @check_arguments(SessionError)
    def plan(self, poses: int, progress: Progress | None = None) -> Path:
        """Plan poses for the free parameters of this state; return the path of their CSV file (m,
        quaternions and joints).

        The poses are expected to be measured with the noise of this session's samples, as stated or
        estimated, and with typical noise where it is unknown. In a session that updates a
        calibration, they are in the order in which they decide whether the robot has drifted.
        """
        asked, weights = self.options, dict(self.state.weights)
        if not weights:
            samples = observe(self.model, self.dataset, asked.joint_sigma, asked.insist)
            weights = vars(noise_in_use(self.model, samples))
        start = self._begin_of_update if asked.update else self.model
        known = with_noise(dataclasses.replace(start, noise=Noise(**weights)))
        only = PlanOptions(free=asked.free, fix=asked.fix, update=asked.update)
        found = plan(known, poses, only, progress)
        file = self.folder / "plans" / f"{self.state.number}.csv"
        file.parent.mkdir(exist_ok=True)
        write_atomically(file, found.csv())
        return file

    @check_arguments(SessionError)
    def save(
        self,
        file: Path,
        insist: Callable[[Replacement], bool] = lambda replacement: False,
        progress: Progress | None = None,
        reason: str = "",
    ) -> Replacement:
        """Write the session's present model to the model file that the robot uses.

        The model is first compared with the model in that file, on the samples of the session.

        Parameters
        ----------
        file : Path
            The model file to replace. The previous file is kept as `FILE.previous`.
        insist : callable, optional
            Called with the comparison. If it returns True, the model is written even if the
            comparison has objections: reasons against the model, such as a larger error than that
            of the model in the file. The history of the model then records the objections, and the
            session gets a new state with that model. By default it returns False.
        progress : callable, optional
            Called with a stage in words and the completed share (0 to 1).
        reason : str, optional
            Why the owner insists, for both histories.

        Returns
        -------
        Replacement
            The comparison of the two models, with its `objections`.

        Raises
        ------
        SaveRefused
            If there are objections, and `insist` returns False.
        SessionError
            If the session or the file changed during the comparison.
        """
        if progress:
            progress("comparing with the model in use", 0.0)
        at = self.state

        def read() -> tuple[Dataset, FitOptions]:
            return self.dataset, self.options_for(self.dataset)

        found = compare_with_model_in_use(self.model, at, read, file)
        self.refresh()
        if self.state != at:
            raise SessionError(CHANGED)
        written = write_for_robot(self.model, found, insist(found), reason)
        if written is not self.model:
            kept = {name: getattr(at, name) for name in JUDGED}
            words = f"save to {file.name}, forced"
            self._append_state(words, written, keeps_redo=True, **kept, reason=reason)
        return found

    # ------------------------------------------------------------------ on disk

    def _commit(self, words: str, step: Step, **changes: Any) -> State:
        """Append a step as the last state of the branch, with its errors."""
        drift, start = step.result.drift, self.state  # a later step weighs no drift again
        judged = {
            "before": to_json_value(step.errors_to_beat.document()),
            "errors": to_json_value(step.result.held_out.summary.document()),
            "noise": to_json_value(step.result.noise_floor.document()),
            "weights": vars(noise_in_use(step.model, step.result.observations)),
            "against": step.acceptance.against,
            "samples": step.result.samples,
            "drift": start.drift if drift is None else drift.warnings[0],
            "recheck": start.recheck if drift is None else to_json_value(drift.document()),
            "sigmas": step.result.rms_sigmas(step.result.held_out),
            "sigmas_before": step.sigmas_to_beat,
        }
        # Reports of the model show the step under the name that it has in the session.
        *past, last = step.model.history
        named = dataclasses.replace(step.model, history=(*past, {**last, "label": words}))
        return self._append_state(words, named, **{**judged, **changes})

    def _append_state(
        self, words: str, model: Model | None, keeps_redo: bool = False, **changes: Any
    ) -> State:
        """Append a state to the branch with its model (None: unchanged); other fields persist
        unless `changes` names them. With `keeps_redo`, steps that were undone can be repeated."""
        start = self.state
        with self._lock_record() as record:
            if record.state != start:
                raise SessionError(CHANGED)
            number = len(record.states)
            kept = {name: getattr(start, name) for name in PERSISTENT}
            file = start.model if model is None else f"models/{number}.yaml"
            state = State(
                number=number, parent=start.number, step=words, model=file, **{**kept, **changes}
            )
            if model is not None:
                write_model(model, self.folder / file)
                self._models[file] = model
            ahead = record.forward.get(record.branch, []) if keeps_redo else []
            self._move(record, number, ahead, states=[*record.states, state])
        return self.state


def _collect_changes(options: Any, usual: Any) -> dict[str, Any]:
    """Return the options that differ from the usual ones, as JSON values."""
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    return {key: to_json_value(v) for key, v in given.items() if v != getattr(usual, key)}


def _format_numbers(samples: Any) -> str:
    return ", ".join(map(str, sorted(samples)))
