"""A session with a worker process: one step at a time, with progress; a step can be cancelled."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any, Protocol

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import read_text, write_atomically
from parallel_cal.base.worker import WorkCancelled, Worker, WorkError
from parallel_cal.session.history import History
from parallel_cal.workbench.kept_pictures import keep_pictures

if TYPE_CHECKING:
    from parallel_cal.session.session import Session

LOOK = "look"  # makes the view of a state, and changes nothing
EXAMPLE = "try_example"  # takes simulated samples
CERTIFICATE_FILE = "certificate.yaml"  # fields of the certificate, in a session's folder
# Methods of a session that take long.
STEPS = ("fit", "add", "remove", "exclude", "include", "choose", "plan", "import_table")


class Live(Protocol):
    """Nodes at a robot, as `nodes.watch` follows them."""

    def snapshot(self) -> dict[str, Any]: ...

    def save_samples(self, path: Path) -> None: ...

    def send(self, position: Sequence[float], quaternion: Sequence[float]) -> str: ...

    def calibrate(self, **goal: Any) -> None: ...

    def steer(self, word: str) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Question:
    """A question that the owner must confirm, with a reason; `key` identifies it.

    It is about `step` (its name and arguments) of the session, or about a save if that is empty.
    `yes` and `no` are the two answers, `declined` the message after `no`.
    """

    words: str
    key: str
    yes: str
    no: str
    declined: str
    step: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Done:
    """The result of work in the worker: a `message`, a `question` to the owner, and a `table` for
    either: columns and rows of the page."""

    message: str
    question: Question | None = None
    table: dict[str, Any] | None = None


class Bench:
    """The state that all windows of a session share; `version` rises with every visible change.

    A step runs in another process and is on disk when it is complete. A cancelled step leaves the
    session unchanged. The bench is `busy` while a step runs that the owner began. It is only
    `working` while it makes the view of a state that has none; the next step ends this.
    """

    def __init__(
        self,
        folder: Path,
        output: Path | None = None,
        live: Live | None = None,
        worker: Worker | None = None,
    ):
        """Open a session.

        `output` is the robot's model file, the only file outside the folder that is written.
        `live` are the nodes at the robot. `worker` is one of `make_worker`; by default a new one.
        """
        self.session, self.output = History(folder), output or folder / "model.yaml"
        self.live = live
        self.version, self.seen = 0, 0
        self.stage, self.fraction = "", 0.0
        self.message, self.failed = "", False
        self.question: Question | None = None
        self.table: dict[str, Any] | None = None  # of the message or the question
        self.working, self._looking, self._cancelled = False, False, False
        self._next: Callable[[], None] | None = None  # what ended a look, and follows it
        self._turn = Lock()
        self._worker = worker or make_worker()
        self.view: dict[str, Any] | None = None
        self._preliminary: dict[int, dict[str, Any]] = {}  # by states whose look was ended
        self._update_view()

    @property
    def busy(self) -> bool:
        """Whether a step runs that the owner began."""
        return self.working and not self._looking

    @property
    def has_samples(self) -> bool:
        """Whether the page has a view of samples."""
        return self.view is not None and "verdict" in self.view

    @property
    def is_saved(self) -> bool:
        """Whether `output` contains the present model."""
        kept = self.session.folder / self.session.state.model
        return self.output.exists() and read_text(self.output) == read_text(kept)

    def close(self) -> None:
        """End the worker and the connection to the nodes."""
        self._worker.end()
        if self.live is not None:
            self.live.close()

    def begin(self, step: str, *given: Any, **options: Any) -> None:
        """Start a step of the session and then compute its view; do nothing while a step runs."""
        self._begin(_work, step, given, options)

    def find_law(self) -> None:
        """Search for the law of what the present model leaves; the session stays unchanged."""
        self._begin(_find_law)

    def make_report(self, as_pdf: bool) -> None:
        """Write the report of the present state to a file in the session's folder."""
        self._begin(_make_report, as_pdf)

    def save(self, confirmed: str = "", reason: str = "") -> None:
        """Compare the present model with the one in `output`, and write it if it is better.

        Otherwise ask the `question`. Only its key as `confirmed` writes the model; the key of
        another question leads to a new question.
        """
        self._begin(_save, self.output, confirmed, reason)

    def confirm(self, key: str, reason: str) -> None:
        """Answer yes to the question with this key; the histories record the `reason`."""
        asked = self.question
        if asked is None or not asked.step:
            self.save(key, reason)
        elif asked.key == key:
            step, *given = asked.step
            self.begin(step, *given, force=True, reason=reason)

    def decline(self) -> None:
        """Answer no to the question: change nothing."""
        if self.question is not None:
            self.message, self.failed = self.question.declined, False
            self.question = self.table = None
            self._mark_changed()

    def _begin(self, function: Callable[..., Done], *given: Any) -> None:
        with self._turn:
            if self._looking:
                self._next, self._cancelled = partial(self._begin, function, *given), True
            if self.working:
                return
            self.working, self._looking = True, given[:1] == (LOOK,)
            self._cancelled = False
        self.stage, self.fraction = "starting", 0.0
        self.message, self.failed = "", False
        self.question = self.table = None
        self._mark_changed()
        Thread(target=self._run_in_worker, args=(function, *given), daemon=True).start()

    def cancel(self) -> None:
        """Cancel the step that is running, or that waits for the end of the view before it; the
        session stays unchanged."""
        with self._turn:
            self._next, self._cancelled = None, True

    def take(self) -> None:
        """Take the samples that calibration_node has collected into the session."""
        from parallel_cal.session.session import Session

        if self.live is not None:
            self._run_step(partial(Session(self.session.folder).take, self.live.save_samples))

    def run_now(self, step: str, *given: Any) -> None:
        """Run a step that takes no time: undo, redo, start_branch, switch."""
        self._run_step(partial(getattr(self.session, step), *given))

    def _run_step(self, step: Callable[[], object]) -> None:
        try:
            step()
            self.session.refresh()
            self.message, self.failed = "", False
        except (ParallelCalError, OSError) as error:
            self.message, self.failed = str(error), True
        self._update_view()

    @property
    def planned(self) -> Path | None:
        """The file of the poses to measure next, if some were planned for this state."""
        file = self.session.folder / "plans" / f"{self.session.state.number}.csv"
        return file if file.exists() else None

    @property
    def reports(self) -> list[Path]:
        """The reports of this state that were made."""
        return [
            file for as_pdf in (False, True) if (file := report_path(self.session, as_pdf)).exists()
        ]

    @property
    def law_view(self) -> dict[str, Any] | None:
        """The view of the laws that were searched for in this state; None if none were."""
        return _load_stored_view(law_view_path(self.session))

    @property
    def hash(self) -> str:
        """sha256 (hex) of the present model, as the nodes report it."""
        from parallel_cal.model.file.modelfile import model_hash

        return model_hash(read_text(self.session.folder / self.session.state.model))

    def follow(self) -> None:
        """Show what another program changed in the session's folder."""
        if not self.busy and self._refresh_session():
            self._update_view()

    def _run_in_worker(self, function: Callable[..., Done], *given: Any) -> None:
        before = self.session.state.number
        try:
            done: Done = self._worker.work(
                function,
                self.session.folder,
                *given,
                tell=self._on_progress,
                wanted=lambda: not self._cancelled,
            )
            self.message, self.question, self.table = done.message, done.question, done.table
        except (WorkCancelled, WorkError) as end:
            if self._next is None:
                self._explain(end, before)
        self._refresh_session()
        # If the diagnosis was cancelled, the preliminary view stays.
        found = load_view(self.session)
        self.view, self.seen = (self.view if found is None else found), self.seen + 1
        with self._turn:
            self.working = self._looking = False
            follow, self._next = self._next, None
        if follow is not None:
            follow()
        self._mark_changed()

    def _explain(self, end: WorkCancelled | WorkError, before: int) -> None:
        """Say why a step ended, and what it left of the session, whose state was `before`."""
        self.failed = isinstance(end, WorkError)
        self.message = str(end) if self.failed else "cancelled"
        self._refresh_session()
        if before == self.session.state.number:
            self.message += "; the session is unchanged"
        else:  # the step was completed, only its diagnosis was not
            self.message += f"; {self.session.state.step} was kept, the diagnosis was not completed"

    def _on_progress(self, stage: str, fraction: float, view: dict[str, Any] | None = None) -> None:
        """Show the progress of the step, and its preliminary view."""
        self.stage, self.fraction = stage, fraction
        if view is not None and not self._cancelled:
            self._refresh_session()
            self.view, self.seen = keep_pictures(view, self.view), self.seen + 1
            if self._looking:
                self._preliminary[self.session.state.number] = view
        self._mark_changed()

    def _refresh_session(self) -> bool:
        """Return whether the session on disk changed; report once if it is missing."""
        try:
            return self.session.refresh()
        except ParallelCalError as error:
            changed = self.message != str(error)
            self.message, self.failed = str(error), True
            return changed

    def _update_view(self) -> None:
        """Show the stored view of the present state, or begin to compute it."""
        self.question = self.table = None  # they were about the previous state
        with self._turn:
            if self._looking:
                self._next, self._cancelled = self._next or self._update_view, True
                return
        stored, self.seen = load_view(self.session), self.seen + 1
        self.view = stored or self._preliminary.get(self.session.state.number)
        self._mark_changed()
        if stored is None:
            self.begin(LOOK)

    def _mark_changed(self) -> None:
        self.version += 1


# Views kept in memory for undo and redo. That of many samples takes 20 MB, and 0.05 s to parse.
MAX_LOADED_VIEWS = 6
VIEW_VERSION = 22  # of the stored views; a view of another version is computed again


def view_path(session: History, state: int | None = None) -> Path:
    """Return the file of a state's view. A state never changes, so its view does not either."""
    number = session.state.number if state is None else state
    return session.folder / "views" / f"{number}.json"


def law_view_path(session: History) -> Path:
    """Return the file of the view of the laws found in the present state."""
    return session.folder / "laws" / f"{session.state.number}.json"


def report_path(session: History, as_pdf: bool) -> Path:
    """Return the file of the present state's report."""
    return (
        session.folder / "reports" / f"report_{session.state.number}.{'pdf' if as_pdf else 'html'}"
    )


def load_view(session: History, state: int | None = None) -> dict[str, Any] | None:
    return _load_stored_view(view_path(session, state))


def _load_stored_view(file: Path) -> dict[str, Any] | None:
    """Load a view; None if there is none, or only one of another version."""
    try:
        return _parse_view(file, file.stat().st_mtime_ns)
    except (OSError, ValueError):
        return None


@lru_cache(maxsize=MAX_LOADED_VIEWS)
def _parse_view(file: Path, written: int) -> dict[str, Any] | None:
    """Parse the file of a view that was `written` at a time (ns)."""
    found: dict[str, Any] = json.loads(read_text(file, most=256 << 20))
    return found["view"] if found.get("version") == VIEW_VERSION else None


def _store_view(file: Path, view: dict[str, Any]) -> None:
    file.parent.mkdir(exist_ok=True)
    write_atomically(file, json.dumps({"version": VIEW_VERSION, "view": view}))


def make_worker() -> Worker:
    """Make the process that works for a bench."""
    return Worker(first=_import_views)


def _import_views() -> None:
    """Import in the worker, before its first task, what takes long to import."""
    import parallel_cal.workbench.views  # noqa: F401


_sessions: dict[Path, Session] = {}  # of the worker, which reads the samples of each only once


def keep_open(session: Session) -> None:
    """Keep a session, with the samples that it has read, for the steps of the worker."""
    _sessions[session.folder] = session


def _open_session(folder: Path) -> Session:
    from parallel_cal.session.session import Session

    if folder not in _sessions:
        keep_open(Session(folder))
    return _sessions[folder]


def _work(
    folder: Path,
    step: str,
    given: Sequence[Any],
    options: Mapping[str, Any],
    tell: Callable[..., None],
) -> Done:
    """Run one step of the session in `folder` and write its view to a file (in the worker)."""
    from parallel_cal.session.example import simulate_example
    from parallel_cal.session.known_columns import remember_columns
    from parallel_cal.session.steps import UnprovenStepError
    from parallel_cal.workbench.views import fit_some_samples, glance, view, view_some_samples

    session = _open_session(folder)
    session.refresh()
    done, preliminary, remark = None, None, ""
    if step == EXAMPLE:
        tell("simulating poses", 0.0)
        session.take(partial(simulate_example, session.model))
    if step == "fit":
        tell("fitting", 0.0)
        for preliminary in fit_some_samples(session):
            tell("fitting", 0.0, preliminary)
    if step in STEPS:
        try:
            done = getattr(session, step)(*given, progress=tell, **options)
        except UnprovenStepError as refused:
            return Done("", _ask_to_force(session, refused.against, step, *given))
    if step == "import_table" and given[1]:  # a file of samples has no column map
        remark = remember_columns(session.model.mechanism, *given)
    if load_view(session) is None:
        numbers = glance(session)
        if preliminary is not None and numbers is not None:
            # Its verdict stays, with the errors of all samples, until all are diagnosed.
            tell("running the diagnosis", 0.0, preliminary | {"tiles": numbers["tiles"]})
        else:
            tell("running the diagnosis", 0.0, numbers)
            tell("running the diagnosis", 0.0, view_some_samples(session))
        _store_view(view_path(session), view(session, tell))
    return Done(f"written: {done}" if isinstance(done, Path) else session.state.against or remark)


def _ask_to_force(session: Session, against: str, step: str, effect: str) -> Question:
    """Ask whether to add or remove an effect in spite of an objection."""
    outcome = {"add": "added", "remove": "removed"}[step]
    return Question(
        f"{against}. {step.capitalize()} {effect} anyway?",
        key=f"{session.state.number} {step} {effect}",
        yes=f"{step.capitalize()} anyway",
        no="Keep the model",
        declined=f"{effect} was not {outcome}: the model is unchanged",
        step=(step, effect),
    )


def _find_law(folder: Path, tell: Callable[..., None]) -> Done:
    """Search for laws in the present state of the session in `folder` (in the worker)."""
    from parallel_cal.discovery.in_session import discover_in_session
    from parallel_cal.workbench.law_view import make_law_view

    session = _open_session(folder)
    session.refresh()
    file = law_view_path(session)
    found, files = discover_in_session(session, tell)
    _store_view(file, make_law_view(found, files))
    return Done("")


def _make_report(folder: Path, as_pdf: bool, tell: Callable[..., None]) -> Done:
    """Write the report of the present state, with the certificate's fields in `folder`, if any (in
    the worker)."""
    from parallel_cal.reporting.certificate import CertificateFields
    from parallel_cal.reporting.page import page
    from parallel_cal.reporting.pdf import find_browser, print_to_pdf
    from parallel_cal.reporting.report import report

    browser = find_browser() if as_pdf else ""  # report what is missing before the diagnosis
    stated = folder / CERTIFICATE_FILE
    fields = CertificateFields.read(stated if stated.exists() else None)
    session = _open_session(folder)
    session.refresh()
    found = report(
        session.model,
        session.dataset,
        certificate=fields,
        options=session.options_for(session.dataset),
        progress=tell,
    )
    file = report_path(session, as_pdf)
    file.parent.mkdir(exist_ok=True)
    if as_pdf:
        tell("printing the report", 1.0)
        print_to_pdf(page(found), file, browser)
    else:
        write_atomically(file, page(found))
    return Done(f"written: {file}")


def _save(
    folder: Path, output: Path, confirmed: str, reason: str, tell: Callable[..., None]
) -> Done:
    """Write the present model to `output`, or return the question to confirm (in the worker)."""
    from parallel_cal.reporting.blocks import as_rows
    from parallel_cal.reporting.tables import saving_table
    from parallel_cal.session.saving import Replacement, SaveRefused

    def compared(found: Replacement) -> dict[str, Any] | None:
        return as_rows(saving_table(found.models)) if found.models else None

    session = _open_session(folder)
    session.refresh()
    before = view_path(session)
    try:
        found = session.save(output, lambda replacement: replacement.key == confirmed, tell, reason)
    except SaveRefused as refused:
        asked = refused.replacement
        others = [words for words in asked.objections if words != asked.comparison]
        reasons = filter(None, (asked.judgement, *others))
        words = "\n".join((*reasons, f"Write this model to {output} anyway?"))
        return Done(
            "",
            Question(
                words,
                asked.key,
                yes="Write anyway",
                no="Keep the model in use",
                declined=f"not saved: {output} is unchanged",
            ),
            compared(asked),
        )
    if before.exists() and view_path(session) != before:  # the same numbers under another state
        shutil.copyfile(before, view_path(session))
    if found.is_in_use:
        return Done(f"{output} contains this model already")
    parts = (f"written: {output}", found.judgement, session.effects_note)
    return Done("; ".join(filter(None, parts)), table=compared(found))
