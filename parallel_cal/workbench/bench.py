"""A session with its long work beside it: one step at a time, with progress, cancelled at once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, Protocol

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import read_text, write_atomically
from parallel_cal.base.worker import WorkCancelled, Worker, WorkError
from parallel_cal.session.history import History

if TYPE_CHECKING:
    from parallel_cal.session.session import Session

# Methods of a session that take their time.
STEPS = ("fit", "add", "remove", "exclude", "include", "choose", "plan")


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
    """What the owner has to confirm before a model is saved; `key` names just that."""

    words: str
    key: str


@dataclass(frozen=True)
class Done:
    """What came out of work in the worker: a `message`, and a `question` to the owner."""

    message: str
    question: Question | None = None


class Bench:
    """What all windows on a session share; `version` rises whenever something to be seen changes.

    A step is done in a process of its own and is on disk when it is done: ended early, it leaves
    the session as it was.
    """

    def __init__(self, folder: Path, output: Path | None = None, live: Live | None = None):
        """`output` is the only file outside the folder that is written: the robot's model; `live`
        are the nodes at the robot."""
        self.session, self.output = History(folder), output or folder / "model.yaml"
        self.live = live
        self.version, self.seen = 0, 0
        self.stage, self.fraction = "", 0.0
        self.message, self.failed = "", False
        self.question: Question | None = None
        self.busy, self._cancelled = False, False
        self._worker = Worker(first=_import_views)
        self.view: dict[str, Any] | None = None
        self._update_view()

    def close(self) -> None:
        """End whatever is under way, and what was started for it."""
        self._worker.end()
        if self.live is not None:
            self.live.close()

    def begin(self, step: str, *given: Any, **options: Any) -> None:
        """Take a step of the session, then look at what came out; nothing while one goes on."""
        self._begin(_work, step, given, options)

    def save(self, confirmed: str = "") -> None:
        """Compare the present model with the one in `output`, and write it there where it is
        better; where it is not, that is the `question`, and only its key as `confirmed` writes
        it. A key of another question counts for nothing: it is asked anew."""
        self._begin(_save, self.output, confirmed)

    def keep_model_in_use(self) -> None:
        """The owner's other answer to the question: nothing is written."""
        if self.question is not None:
            self.question = None
            self.message, self.failed = f"not saved: {self.output} is as it was", False
            self._mark_changed()

    def _begin(self, function: Callable[..., Done], *given: Any) -> None:
        if self.busy:
            return
        self.busy, self._cancelled = True, False
        self.stage, self.fraction = "starting", 0.0
        self.message, self.failed, self.question = "", False, None
        self._mark_changed()
        Thread(target=self._run_in_worker, args=(function, *given), daemon=True).start()

    def cancel(self) -> None:
        """End the step that is under way; the session stays as it was."""
        self._cancelled = True

    def take(self) -> None:
        """Take what calibration_node has collected into the session."""
        from parallel_cal.session.session import Session

        if self.live is not None:
            self._run_step(partial(Session(self.session.folder).take, self.live.save_samples))

    def run_now(self, step: str, *given: Any) -> None:
        """A step that takes no time: undo, redo, start_branch, switch."""
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
        """The poses to measure next, where some were planned for this state."""
        file = self.session.folder / "plans" / f"{self.session.state.number}.csv"
        return file if file.exists() else None

    @property
    def hash(self) -> str:
        """sha256 (hex) of the present model, as the nodes tell it."""
        from parallel_cal.model.file.modelfile import model_hash

        return model_hash(read_text(self.session.folder / self.session.state.model))

    def follow(self) -> None:
        """Take up what another program has done in the session's folder."""
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
            self.message, self.question = done.message, done.question
        except WorkCancelled:
            self.message = "cancelled"
        except WorkError as error:
            self.message, self.failed = str(error), True
        else:
            before = -1
        self._refresh_session()
        if before == self.session.state.number:
            self.message += "; the session is as it was"
        elif before >= 0:  # the step was done, only the look at what it left was not
            self.message += f"; {self.session.state.step} is done, what it leaves is not looked at"
        # Where the look was ended what could be seen at once stays.
        found = load_view(self.session)
        self.view, self.seen = (self.view if found is None else found), self.seen + 1
        self.busy = False
        self._mark_changed()

    def _on_progress(self, stage: str, fraction: float, view: dict[str, Any] | None = None) -> None:
        """How far the step is, and what can be seen before all of it is."""
        self.stage, self.fraction = stage, fraction
        if view is not None:
            self._refresh_session()
            self.view, self.seen = view, self.seen + 1
        self._mark_changed()

    def _refresh_session(self) -> bool:
        """Whether the session on disk is another one now; one that is gone is said, once."""
        try:
            return self.session.refresh()
        except ParallelCalError as error:
            changed = self.message != str(error)
            self.message, self.failed = str(error), True
            return changed

    def _update_view(self) -> None:
        """Show the present state: what is kept of it, else look at it anew."""
        self.question = None  # it was about the state before
        self.view, self.seen = load_view(self.session), self.seen + 1
        self._mark_changed()
        if self.view is None:
            self.begin("look")

    def _mark_changed(self) -> None:
        self.version += 1


VIEW_VERSION = 7  # of what is kept of a view: another one is looked at anew


def view_path(session: History, state: int | None = None) -> Path:
    """Where a state's view is kept; a state never changes, and so neither does its view."""
    number = session.state.number if state is None else state
    return session.folder / "views" / f"{number}.json"


def load_view(session: History, state: int | None = None) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads(read_text(view_path(session, state), most=256 << 20))
    except (OSError, ValueError):
        return None
    return found["view"] if found.get("version") == VIEW_VERSION else None


def _import_views() -> None:
    """What a worker has at hand before it is asked."""
    import parallel_cal.workbench.views  # noqa: F401


@cache
def _open_session(folder: Path) -> Session:
    """The worker's own session, with the samples that it has read."""
    from parallel_cal.session.session import Session

    return Session(folder)


def _work(
    folder: Path,
    step: str,
    given: Sequence[Any],
    options: Mapping[str, Any],
    tell: Callable[..., None],
) -> Done:
    """In the worker: one step of the session in `folder`, then its view, kept in a file; a word
    on what came out."""
    from parallel_cal.workbench.views import glance, view

    session = _open_session(folder)
    session.refresh()
    done = None
    if step in STEPS:
        done = getattr(session, step)(*given, progress=tell, **options)
    if load_view(session) is None:
        tell("looking for what is missing", 0.0, glance(session))
        shown = view(session, tell)
        file = view_path(session)
        file.parent.mkdir(exist_ok=True)
        write_atomically(file, json.dumps({"version": VIEW_VERSION, "view": shown}))
    return Done(f"written: {done}" if isinstance(done, Path) else session.state.against)


def _save(folder: Path, output: Path, confirmed: str, tell: Callable[..., None]) -> Done:
    """In the worker: write the present model to `output`, or the question that has to be confirmed
    first."""
    from parallel_cal.session.saving import SaveRefused

    session = _open_session(folder)
    session.refresh()
    before = view_path(session)
    try:
        found = session.save(output, lambda replacement: replacement.key == confirmed, tell)
    except SaveRefused as refused:
        asked = refused.replacement
        words = f"{'; '.join(asked.reasons)}. Write it to {output} all the same?"
        return Done("", Question(words, asked.key))
    if before.exists() and view_path(session) != before:  # the same numbers under another state
        shutil.copyfile(before, view_path(session))
    if found.is_in_use:
        return Done(f"{output} holds this model already")
    return Done("; ".join(filter(None, (f"written: {output}", found.comparison))))
