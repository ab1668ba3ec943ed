"""Long work behind an action: one goal at a time, in a thread of its own, cancelled at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from threading import Thread
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.collector import Collection
from parallel_cal.session.goals import Cancel, Cancelled, Outcome

Work = Callable[[Callable[..., None], Cancel], Outcome]  # tells its feedback's fields in order
Prepare = Callable[[Any], tuple[Work, Collection]]
Finished = Callable[[Outcome, Collection | None], None]
Say = Callable[[str], None]


class OneAtATime:
    """All long work of a node shares one, so that only one piece of it runs."""

    def __init__(self) -> None:
        self.cancel, self._running = Cancel(), ""

    def begin(self, running: str) -> None:
        """`running` is what others are told meanwhile; ParallelCalError with what they were."""
        if self._running:
            raise ParallelCalError(self._running)
        self.cancel, self._running = Cancel(), running

    def end(self) -> None:
        """Free for the next piece of work."""
        self._running = ""


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

    def __init__(self, node: Node, one: OneAtATime, job: Job, say: Say, group: CallbackGroup):
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
            self._one.begin(self._job.running)
        except ParallelCalError as busy:
            self._say(f"goal rejected: {busy}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._one.cancel.ask():
            return CancelResponse.ACCEPT
        self._say("too late to cancel: the file is being written")
        return CancelResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        try:
            work, collection = self._job.prepare(goal.request)
        except Exception as error:
            goal.execute(partial(self._end, Outcome(False, in_words(error)), None))
            return
        self._thread = Thread(target=self._work, args=(goal, work, collection))
        self._thread.start()

    def _work(self, goal: Any, work: Work, collection: Collection) -> None:
        def tell(*values: Any) -> None:
            if self._node.context.ok():
                goal.publish_feedback(self._feedback(*values))

        outcome = outcome_of(work, tell, self._one.cancel)
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


def outcome_of(work: Work, tell: Callable[..., None], cancel: Cancel) -> Outcome:
    """What work comes to, whatever it raises."""
    try:
        return work(tell, cancel)
    except Cancelled:
        return Outcome(False, "cancelled; nothing was written")
    except Exception as error:
        return Outcome(False, in_words(error))


def in_words(error: Exception) -> str:
    """What a client is told: our own errors as they are; a fault of ours must reach it, too."""
    return str(error) if isinstance(error, ParallelCalError) else f"internal error: {error!r}"
