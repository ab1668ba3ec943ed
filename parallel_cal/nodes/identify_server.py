"""The identify action: one goal at a time, in a thread of its own, cancelled at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from threading import Thread
from typing import Any

from parallel_cal_msgs.action import Identify
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from parallel_cal.errors import ParallelCalError
from parallel_cal.nodes.calibration_messages import json_text
from parallel_cal.nodes.collector import Collection
from parallel_cal.nodes.recalibration import Cancel, Cancelled, Outcome, Request, recalibrate

Prepare = Callable[[Identify.Goal], tuple[Request, Collection]]
Finished = Callable[[str, Outcome, Collection | None], None]


class IdentifyServer:
    """Serves `~/identify`; `prepare` turns a goal into work, `finished` hears what came of it.

    The work runs in a thread and the goal's callback only at its end: awaiting it in rclpy would
    keep the executor spinning, blocking would keep it from serving anything else.
    """

    def __init__(
        self,
        node: Node,
        prepare: Prepare,
        finished: Finished,
        say: Callable[[str], None],
        group: CallbackGroup,
    ):
        self._node = node
        self._prepare, self._finished, self._say = prepare, finished, say
        self._cancel = Cancel()
        self._thread: Thread | None = None
        self._accepted = False
        self._server = ActionServer(
            node,
            Identify,
            "~/identify",
            execute_callback=lambda goal: Identify.Result(),
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
            callback_group=group,
        )

    @property
    def busy(self) -> bool:
        """True from the acceptance of a goal until its result is out."""
        return self._accepted

    def close(self) -> None:
        """Stop the work, if any, and wait for its thread."""
        self._cancel.ask()
        if self._thread:
            self._thread.join()
        self._server.destroy()

    def _on_goal(self, goal: Identify.Goal) -> GoalResponse:
        if self.busy:
            self._say("goal rejected: an identification is running; cancel it or wait")
            return GoalResponse.REJECT
        self._accepted = True
        return GoalResponse.ACCEPT

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._cancel.ask():
            return CancelResponse.ACCEPT
        self._say("too late to cancel: the file is being written")
        return CancelResponse.REJECT

    def _on_accepted(self, goal: Any) -> None:
        self._cancel = Cancel()
        try:
            request, collection = self._prepare(goal.request)
        except Exception as error:
            goal.execute(partial(self._end, Outcome(False, in_words(error)), None))
            return
        self._thread = Thread(target=self._work, args=(goal, request, collection, self._cancel))
        self._thread.start()

    def _work(self, goal: Any, request: Request, collection: Collection, cancel: Cancel) -> None:
        def tell(stage: str, fraction: float, position_error: float) -> None:
            if self._node.context.ok():
                feedback = Identify.Feedback(stage=stage, fraction=fraction)
                feedback.position_error = position_error
                goal.publish_feedback(feedback)

        try:
            outcome = recalibrate(request, collection.dataset, tell, cancel)
        except Cancelled:
            outcome = Outcome(False, "cancelled; nothing was written")
        except Exception as error:
            outcome = Outcome(False, in_words(error))
        if self._node.context.ok():
            goal.execute(partial(self._end, outcome, collection))

    def _end(self, outcome: Outcome, collection: Collection | None, goal: Any) -> Identify.Result:
        """In the executor's thread again: the goal's state, its result, and everyone else's."""
        self._accepted = False
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.success:
            goal.succeed()
        else:
            goal.abort()
        self._finished("identify", outcome, collection)
        return result_message(outcome)


def in_words(error: Exception) -> str:
    """What a client is told: our own errors as they are; a fault of ours must reach it, too."""
    return str(error) if isinstance(error, ParallelCalError) else f"internal error: {error!r}"


def result_message(outcome: Outcome) -> Identify.Result:
    """NaN for errors that are not known."""
    document = outcome.document
    held_out = document.get("held_out", {})
    return Identify.Result(
        success=outcome.success,
        message=outcome.message,
        json=json_text(document) if document else "",
        hash=outcome.hash,
        position_before=_mean(document.get("before")),
        position_after=_mean(document.get("after")),
        held_out_before=_mean(held_out.get("before")),
        held_out_after=_mean(held_out.get("after")),
    )


def _mean(errors: dict[str, float | None] | None) -> float:
    value = (errors or {}).get("position_mean")
    return math.nan if value is None else value
