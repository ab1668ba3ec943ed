"""Long work behind an action: one goal at a time, in a process of its own, cancelled at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from threading import Lock, Thread
from typing import Any, NamedTuple

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.worker import WorkCancelled, Worker
from parallel_cal.nodes.collector import Collection
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.session.goals import Outcome

Tell = Callable[..., None]


class Cancelled(Exception):
    """The goal was cancelled; nothing was written."""


class Cancel:
    """Either the goal is cancelled or the file is written, never both."""

    def __init__(self) -> None:
        self._lock, self.asked, self._committed = Lock(), False, False

    def ask(self) -> bool:
        """Ask the work to stop; False when it is too late."""
        with self._lock:
            self.asked = not self._committed
            return self.asked

    def commit(self) -> None:
        """From here on it is too late to cancel; Cancelled if it already was."""
        with self._lock:
            if self.asked:
                raise Cancelled
            self._committed = True


class Work(NamedTuple):
    """`function(*given)` in the worker, which tells its feedback's fields in order, and then
    `finish` here with its outcome."""

    function: Callable[..., Outcome]
    given: tuple[Any, ...]
    finish: Callable[[Outcome], Outcome]


class ThreadWork(NamedTuple):
    """`run`, which is given how to tell its feedback, in the thread beside, where only parts of it
    are for the worker; and then `finish` with its outcome."""

    run: Callable[[Tell], Outcome]
    finish: Callable[[Outcome], Outcome]


Prepare = Callable[[Any], tuple[Work | ThreadWork, Collection | None]]
Finished = Callable[[Outcome, Collection | None], None]
Say = Callable[[str], None]


class WorkSlot:
    """All long work of a node shares one, so that only one piece of it runs."""

    def __init__(self, worker: Worker) -> None:
        self.cancel, self._worker = Cancel(), worker
        self._running, self._promised = "", False

    def begin(self, running: str, promised: bool = False) -> None:
        """`running` is what others are told meanwhile; ParallelCalError with what they were.

        What is only `promised` gives way until it is `kept`: rclpy drops a goal that it has
        accepted where its client cannot be told so, and says nothing to us.
        """
        if self._running and not self._promised:
            raise ParallelCalError(self._running)
        self.cancel, self._running, self._promised = Cancel(), running, promised

    def confirm(self) -> None:
        """What was promised has begun."""
        self._promised = False

    def end(self) -> None:
        """Free for the next piece of work."""
        self._running = ""

    def run_work(self, work: Work | ThreadWork, tell: Tell | None = None) -> Outcome:
        """What work comes to, whatever it raises."""
        cancel = self.cancel
        try:
            if isinstance(work, ThreadWork):
                outcome = work.run(tell or (lambda *values: None))
                if cancel.asked:  # it has ended by itself, and says how
                    return outcome
            else:
                outcome = self._worker.work(
                    work.function, *work.given, tell=tell, wanted=lambda: not cancel.asked
                )
            cancel.commit()
            return work.finish(outcome)
        except (Cancelled, WorkCancelled):
            return Outcome(False, "cancelled; nothing was written")
        except Exception as error:
            return Outcome(False, describe_error(error))


@dataclass(frozen=True)
class Job:
    """What an action does for a goal.

    `prepare` turns a goal into work on samples and `finished` hears what came of it, both in the
    executor's thread; `answer` is the result message, `running` what others are told meanwhile.
    """

    name: str
    type: Any
    running: str
    prepare: Prepare
    finished: Finished
    answer: Callable[[Outcome], Any]


class JobServer:
    """Serves the action `~/NAME` of a job.

    The work runs in a thread and the goal's callback only at its end: awaiting it in rclpy would
    keep the executor spinning, blocking would keep it from serving anything else.
    """

    def __init__(self, node: ManagedNode, one: WorkSlot, job: Job, say: Say, group: CallbackGroup):
        self._node, self._one, self._job, self._say = node, one, job, say
        self._thread: Thread | None = None
        fields = job.type.Feedback.get_fields_and_field_types()
        self._feedback = lambda *values: job.type.Feedback(**dict(zip(fields, values, strict=True)))
        self._server = ActionServer(
            node,
            job.type,
            f"~/{job.name}",
            execute_callback=lambda goal: job.type.Result(),
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
            callback_group=group,
        )

    def close(self) -> None:
        """Stop the work, if any, and wait for its thread."""
        self._one.cancel.ask()
        if self._thread:
            self._thread.join()
        self._server.destroy()

    def _on_goal(self, goal: Any) -> GoalResponse:
        try:
            if self._node.refusal:
                raise ParallelCalError(self._node.refusal)
            self._one.begin(self._job.running, promised=True)
        except ParallelCalError as busy:
            self._say(f"goal rejected: {busy}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._one.cancel.ask():
            return CancelResponse.ACCEPT
        self._say("the goal cannot be cancelled: the file is being written")
        return CancelResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        self._one.confirm()
        try:
            work, collection = self._job.prepare(goal.request)
        except Exception as error:
            goal.execute(partial(self._end, Outcome(False, describe_error(error)), None))
            return
        self._thread = Thread(target=self._work, args=(goal, work, collection))
        self._thread.start()

    def _work(self, goal: Any, work: Work | ThreadWork, collection: Collection | None) -> None:
        def tell(*values: Any) -> None:
            if self._node.context.ok():
                goal.publish_feedback(self._feedback(*values))

        outcome = self._one.run_work(work, tell)
        if self._node.context.ok():
            goal.execute(partial(self._end, outcome, collection))

    def _end(self, outcome: Outcome, collection: Collection | None, goal: Any) -> Any:
        """In the executor's thread again: the goal's state, its result, and everyone else's."""
        self._one.end()
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.success:
            goal.succeed()
        else:
            goal.abort()
        self._job.finished(outcome, collection)
        return self._job.answer(outcome)


def describe_error(error: Exception) -> str:
    """What a client is told: our own errors as they are; a fault of ours must reach it, too."""
    return str(error) if isinstance(error, ParallelCalError) else f"internal error: {error!r}"
