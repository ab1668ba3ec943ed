"""Long work behind an action: one goal at a time, in its own process, cancelled at once."""

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
    """Decides a race: either the goal is cancelled or the file is written, never both."""

    def __init__(self) -> None:
        self._lock, self.asked, self._committed = Lock(), False, False

    def ask(self) -> bool:
        """Ask the work to stop; return False if it is too late."""
        with self._lock:
            self.asked = not self._committed
            return self.asked

    def commit(self) -> None:
        """Make it too late to cancel; raise Cancelled if it already was cancelled."""
        with self._lock:
            if self.asked:
                raise Cancelled
            self._committed = True


class Work(NamedTuple):
    """Work for the worker process.

    The worker calls `function(*given)`, which passes the fields of its feedback in order to `tell`.
    Then `finish` is called in this process with the outcome.
    """

    function: Callable[..., Outcome]
    given: tuple[Any, ...]
    finish: Callable[[Outcome], Outcome]


class ThreadWork(NamedTuple):
    """Work for a thread of this process that passes only parts of it to the worker.

    The thread calls `run(tell)`, then `finish` with the outcome.
    """

    run: Callable[[Tell], Outcome]
    finish: Callable[[Outcome], Outcome]


Prepare = Callable[[Any], tuple[Work | ThreadWork, Collection | None]]
Finished = Callable[[Outcome, Collection | None], None]
Say = Callable[[str], None]


class WorkSlot:
    """Lets one piece of long work run at a time; all long work of a node shares one slot."""

    def __init__(self, worker: Worker) -> None:
        self.cancel, self._worker = Cancel(), worker
        self._running, self._promised = "", False

    def begin(self, running: str, promised: bool = False) -> None:
        """Occupy the slot; ParallelCalError if other work occupies it.

        `running` is the message of that error while this work runs. `promised` work has to
        `confirm`: until then, other work may take the slot. The reason is that rclpy silently drops
        an accepted goal if it cannot send the acceptance to the client.
        """
        if self._running and not self._promised:
            raise ParallelCalError(self._running)
        self.cancel, self._running, self._promised = Cancel(), running, promised

    def confirm(self) -> None:
        """Report that promised work has begun."""
        self._promised = False

    def end(self) -> None:
        """Free the slot for the next piece of work."""
        self._running = ""

    def run_work(self, work: Work | ThreadWork, tell: Tell | None = None) -> Outcome:
        """Do the work and return its outcome; an exception becomes a failed outcome."""
        cancel = self.cancel
        try:
            if isinstance(work, ThreadWork):
                outcome = work.run(tell or (lambda *values: None))
                if cancel.asked:  # it stopped in its own time, and its outcome says where
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

    `prepare` turns a goal into work on samples, and `finished` receives its outcome, both in the
    executor's thread. `answer` makes the result message. `running` is the reason for rejecting
    another goal meanwhile.
    """

    name: str
    type: Any
    running: str
    prepare: Prepare
    finished: Finished
    answer: Callable[[Outcome], Any]


class JobServer:
    """Provides the action `~/NAME` of a job.

    The work runs in a thread, and the goal's callback runs only when the work has ended: awaiting
    the work in rclpy would keep the executor busy, blocking would stop it from serving others.
    """

    def __init__(self, node: ManagedNode, slot: WorkSlot, job: Job, say: Say, group: CallbackGroup):
        self._node, self._slot, self._job, self._say = node, slot, job, say
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
        self._slot.cancel.ask()
        if self._thread:
            self._thread.join()
        self._server.destroy()

    def _on_goal(self, goal: Any) -> GoalResponse:
        try:
            if self._node.refusal:
                raise ParallelCalError(self._node.refusal)
            self._slot.begin(self._job.running, promised=True)
        except ParallelCalError as busy:
            self._say(f"goal rejected: {busy}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._slot.cancel.ask():
            return CancelResponse.ACCEPT
        self._say("the goal cannot be cancelled: the file is being written")
        return CancelResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        self._slot.confirm()
        try:
            work, collection = self._job.prepare(goal.request)
        except Exception as error:
            goal.execute(partial(self._end, Outcome(False, describe_error(error)), None))
            return
        self._thread = Thread(target=self._do_work, args=(goal, work, collection))
        self._thread.start()

    def _do_work(self, goal: Any, work: Work | ThreadWork, collection: Collection | None) -> None:
        def tell(*values: Any) -> None:
            if self._node.context.ok():
                goal.publish_feedback(self._feedback(*values))

        outcome = self._slot.run_work(work, tell)
        if self._node.context.ok():
            goal.execute(partial(self._end, outcome, collection))

    def _end(self, outcome: Outcome, collection: Collection | None, goal: Any) -> Any:
        """Set the goal's state and return its result, in the executor's thread."""
        self._slot.end()
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.success:
            goal.succeed()
        else:
            goal.abort()
        self._job.finished(outcome, collection)
        return self._job.answer(outcome)


def describe_error(error: Exception) -> str:
    """Return the message for a client, who learns of internal errors, too."""
    return str(error) if isinstance(error, ParallelCalError) else f"internal error: {error!r}"
