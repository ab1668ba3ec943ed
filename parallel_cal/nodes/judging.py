"""What the calibration node does with its samples: compare, identify, diagnose, add an effect."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from parallel_cal_msgs.srv import AddEffect
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.diagnosis.comparison import Comparison, compare
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes import calibration_messages as messages
from parallel_cal.nodes.action_work import ActionWork, Say, Turn, Work, in_words, outcome_of
from parallel_cal.nodes.collector import Collection
from parallel_cal.nodes.diagnose_server import diagnose_job, examine
from parallel_cal.nodes.identify_server import identify_job, request_of
from parallel_cal.nodes.parameters import LATCHED, absolute
from parallel_cal.nodes.run import in_front
from parallel_cal.session.recalibration import Outcome, Request, recalibrate


class Judging:
    """Services, actions and latched topics; `collect` gives the samples, `say` tells of events."""

    def __init__(
        self, node: Node, collect: Callable[[], Collection], say: Say, group: CallbackGroup
    ):
        self._node, self._collect, self._say = node, collect, say
        self._result = node.create_publisher(String, "~/result", LATCHED)
        self._diagnosis = node.create_publisher(String, "~/diagnosis", LATCHED)
        self._arrows = node.create_publisher(MarkerArray, "~/residuals", LATCHED)
        self._turn = Turn()
        jobs = (
            identify_job(self._prepare, partial(self._recalibrated, "identify")),
            diagnose_job(self._prepare_diagnosis, self._diagnosed),
        )
        self._actions = [ActionWork(node, self._turn, job, say, group) for job in jobs]
        # the node's default group: it takes seconds, and must not keep anything else waiting
        node.create_service(AddEffect, "~/add_effect", self._add_effect)

    def close(self) -> None:
        """Stop the work, if any."""
        for action in self._actions:
            action.close()

    def _parameter(self, name: str) -> Any:
        return self._node.get_parameter(name).value

    def _sigma(self) -> float | None:
        return self._parameter("joint_sigma") or None

    def _files(self, model_file: str, output_file: str) -> dict[str, Any]:
        model_file = self._model_file(model_file)
        output_file = output_file or self._parameter("output_file") or model_file
        return {"model_file": model_file, "output_file": absolute(output_file)}

    def _model_file(self, given: str) -> str:
        path = given or self._parameter("model_file")
        if not path:
            raise ModelFileError("no model file: set the parameter model_file or name one")
        return absolute(path)

    # ------------------------------------------------------------------ comparing

    def compare(self, request: Any, response: Any) -> None:
        """A model beside the samples, nothing fitted."""
        model, collection = read_model(self._model_file(request.model_file)), self._collect()
        found = compare(model, collection.dataset, self._sigma())
        document = found.document()
        for rows in (document["rows"], document["where"]["odd_samples"]):
            messages.number_samples(rows, collection)
        response.success, response.json = True, messages.json_text(document)
        response.message = f"{len(collection)} samples compared"
        self._show(found, collection)
        self._publish_result("compare", Outcome(True, response.message, document))

    def _show(self, found: Comparison, collection: Collection) -> None:
        frame, scale = collection.dataset.frame, self._parameter("arrow_scale")
        ids = collection.ids
        self._arrows.publish(
            messages.residual_markers(found.observations, found.errors, ids, frame, scale)
        )

    def _publish_result(self, kind: str, outcome: Outcome) -> None:
        content = {
            "kind": kind,
            "success": outcome.success,
            "message": outcome.message,
            "hash": outcome.hash,
            "document": outcome.document,
        }
        self._result.publish(messages.json_message(content))

    # ------------------------------------------------------------------ identifying, diagnosing

    def _prepare(self, goal: Any) -> tuple[Work, Collection]:
        files = self._files(goal.model_file, goal.output_file)
        collection = self._collect()
        request = request_of(goal, files, self._sigma())
        return partial(recalibrate, request, collection.dataset), collection

    def _prepare_diagnosis(self, goal: Any) -> tuple[Work, Collection]:
        model_file, collection = self._model_file(goal.model_file), self._collect()
        hold_out = goal.hold_out or self._parameter("hold_out")
        return partial(examine, model_file, collection, hold_out, self._sigma()), collection

    def _recalibrated(self, kind: str, outcome: Outcome, collection: Collection | None) -> None:
        self._publish_result(kind, outcome)
        self._conclude(outcome, collection)

    def _diagnosed(self, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.document:
            self._diagnosis.publish(messages.json_message(outcome.document))
        self._conclude(outcome, collection)

    def _conclude(self, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.model is not None and collection is not None:
            found = compare(outcome.model, collection.dataset, self._sigma())
            self._show(found, collection)
        self._say(outcome.message)

    # ------------------------------------------------------------------ adding an effect

    def _add_effect(self, request: Any, response: Any) -> Any:
        """In the executor's second thread; samples, turn and publishers belong to the first."""
        try:
            work, collection = in_front(self._node, self._prepare_effect, request)
        except Exception as error:
            outcome = Outcome(False, in_words(error))
            in_front(self._node, self._say, outcome.message)
        else:
            outcome = outcome_of(work, self._end_with_the_node, self._turn.cancel)
            in_front(self._node, self._effect_added, outcome, collection)
        response.success, response.message = outcome.success, outcome.message
        response.json = messages.json_text(outcome.document) if outcome.document else ""
        response.hash = outcome.hash
        return response

    def _prepare_effect(self, request: Any) -> tuple[Work, Collection]:
        if not request.effect:
            raise ParallelCalError("no effect named, e.g. encoder_eccentricity")
        work = Request(
            **self._files("", request.output_file),
            options=FitOptions(hold_out=self._parameter("hold_out"), joint_sigma=self._sigma()),
            force=request.force,
            effect=request.effect,
        )
        collection = self._collect()
        self._turn.take("an effect is being added; wait")
        self._say(f"adding {request.effect}")
        return partial(recalibrate, work, collection.dataset), collection

    def _end_with_the_node(self, *progress: Any) -> None:
        """Nobody else can cancel a service."""
        if not self._node.context.ok():
            self._turn.cancel.ask()

    def _effect_added(self, outcome: Outcome, collection: Collection) -> None:
        self._turn.end()
        self._recalibrated("add_effect", outcome, collection)
