"""Works on the samples of the calibration node: compare, identify, diagnose, add an effect, find a
law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from parallel_cal_msgs.action import Diagnose, Identify
from parallel_cal_msgs.srv import AddEffect
from rclpy.callback_groups import CallbackGroup
from std_msgs.msg import String

from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.base.files import BACKUP_SUFFIX
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.base.worker import Worker
from parallel_cal.diagnosis.comparison import Comparison, compare
from parallel_cal.discovery.goal import find_laws
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import dump_model, model_text, parse_model
from parallel_cal.model.model import Model
from parallel_cal.nodes import calibration_messages as messages
from parallel_cal.nodes.calibration_settings import CalibrationSettings
from parallel_cal.nodes.collector import Collection
from parallel_cal.nodes.computing import prepare
from parallel_cal.nodes.conversions import message_class
from parallel_cal.nodes.frames import Look, to_base_frame
from parallel_cal.nodes.jobs import Job, JobServer, Say, Work, WorkSlot, describe_error
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.parameters import LATCHED, absolute
from parallel_cal.nodes.run import WorkerThreadGroup, run_in_spin_thread
from parallel_cal.recordings.residuals import TOPICS, residual_messages
from parallel_cal.session.goals import (
    Outcome,
    Request,
    examine,
    propose_model,
    undo_write,
    write_proposal,
)

# Residuals that a subscriber may fall behind: all of a session are published at once.
RESIDUAL_QUEUE_DEPTH = 1000


class Calibrator:
    """Provides the actions `~/identify`, `~/diagnose`, `~/discover` and the service `~/add_effect`.

    It publishes `~/result`, `~/diagnosis` and `~/residuals`. `collect` returns the samples, `look`
    the transforms of TF, and `say` publishes an event.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: CalibrationSettings,
        collect: Callable[[], Collection],
        look: Look,
        say: Say,
        group: CallbackGroup,
    ):
        self._node, self._settings, self._collect = node, settings, collect
        self._look, self._say = look, say
        self._result = node.create_publisher(String, "~/result", LATCHED)
        self._diagnosis = node.create_publisher(String, "~/diagnosis", LATCHED)
        self._residuals = {
            topic: node.create_publisher(
                message_class(kind),
                f"~/residuals{topic}",
                RESIDUAL_QUEUE_DEPTH if topic else LATCHED,
            )
            for topic, kind in TOPICS.items()
        }
        self.worker = Worker(first=partial(prepare, settings.get("allow_foreign_modules")))
        self._registered = ""  # the estimated frame of the samples used last, in words
        self._model: Model | None = None  # that was read last
        self._written = ""  # the model file that was written last
        self.slot = WorkSlot(self.worker)
        jobs = (
            Job(
                "identify",
                Identify,
                "an identification is running; cancel it or wait",
                self._identify,
                partial(self._on_recalibrated, "identify"),
                messages.identify_result,
            ),
            Job(
                "diagnose",
                Diagnose,
                "a diagnosis is running; cancel it or wait",
                self._diagnose,
                self._on_diagnosed,
                messages.diagnose_result,
            ),
            Job(
                "discover",
                Diagnose,
                "a search for laws is running; cancel it or wait",
                self._discover,
                self._on_discovered,
                messages.diagnose_result,
            ),
        )
        self._actions = [JobServer(node, self.slot, job, say, group) for job in jobs]
        # In a group of its own: it takes seconds and must not delay anything else.
        node.create_service(
            AddEffect, "~/add_effect", self._add_effect, callback_group=WorkerThreadGroup()
        )

    def cancel(self) -> None:
        """End the work, if any; accept other goals."""
        self.slot.cancel.ask()

    def stop(self) -> None:
        """End the work, if any, and do no other."""
        self.cancel()
        self.worker.end()

    def close(self) -> None:
        """End the work and wait for the threads of the actions."""
        self.stop()
        for action in self._actions:
            action.close()

    def warnings(self) -> list[str]:
        """Return a sentence if the samples had to be registered to the model's base frame."""
        return [KeyedWarning(self._registered, "registration")] if self._registered else []

    def _hold_out(self, goal: Any) -> float:
        """Return a goal's share of held-out poses: 0 means the node's parameter, below 0 none."""
        if goal.hold_out < 0:
            return 0.0
        return float(goal.hold_out or self._settings.get("hold_out"))

    def undo(self, request: Any, response: Any) -> None:
        """Restore the model file that the last write replaced; a second call returns to the new
        one."""
        usual = (self._settings.get("output_file"), self._model_file(""))
        paths = [absolute(path) for path in (self._written, *usual) if path]
        path = next((path for path in paths if Path(path + BACKUP_SUFFIX).exists()), paths[0])
        response.success, response.message = (
            True,
            undo_write(self._settings.folders.to_write(path, "model")),
        )

    def files(self, model_file: str, output_file: str) -> tuple[str, str]:
        """Return the paths from which to read the model and to which to write the new one."""
        model_file = self._model_file(model_file)
        output_file = output_file or self._settings.get("output_file") or model_file
        return model_file, self._settings.folders.to_write(output_file, "model")

    def _model_file(self, given: str) -> str:
        path = given or self._settings.get("model_file")
        if not path:
            raise ModelFileError("no model file: set the parameter model_file or name one")
        return self._settings.folders.to_read(path)

    def _read_model(self, path: str) -> Model:
        """Read a model; an unchanged file gives the model that was read before."""
        model = parse_model(model_text(path), path, self._model)
        if self._model is None or dump_model(model) != dump_model(self._model):
            self._model = model
        return self._model

    # ------------------------------------------------------------------ comparing

    def compare(self, request: Any, response: Any) -> None:
        """Compare a model with the samples without a fit."""
        model = self._read_model(self._model_file(request.model_file))
        collection = self._samples(model)
        document = self._compare(model, collection).document()
        for rows in (document["rows"], document["where"]["odd_samples"]):
            messages.number_samples(rows, collection)
        response.success, response.json = True, messages.json_text(document)
        response.message = f"{len(collection)} samples compared"
        self._publish_result("compare", Outcome(True, response.message, document))

    def _samples(self, model: Model) -> Collection:
        """Return the samples in the model's base frame, or as they are if a fit registers them."""
        collection = self._collect()
        dataset, registered = to_base_frame(
            collection.dataset, model, self._look, self._settings.joint_sigma
        )
        self._registered = registered if dataset is collection.dataset else ""
        if registered:
            self._say(registered)
        return replace(collection, dataset=dataset)

    def _compare(self, model: Model, collection: Collection) -> Comparison:
        """Compare a model with the samples and publish the residuals."""
        comparison = compare(model, collection.dataset, self._settings.joint_sigma)
        scale = self._settings.get("arrow_scale")
        residuals = comparison.residuals(collection.ids, collection.stamps)
        for topic, _, data in residual_messages(residuals, scale):
            self._residuals[topic].publish(data)
        return comparison

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

    def _identify(self, goal: Any) -> tuple[Work, Collection]:
        files = self.files(goal.model_file, goal.output_file)
        collection = self._samples(self._read_model(files[0]))
        options = FitOptions(
            method=goal.method or "implicit",
            free=tuple(goal.free),
            fix=tuple(goal.fix),
            hold_out=self._hold_out(goal),
            joint_sigma=goal.joint_sigma or self._settings.joint_sigma,
        )
        request = Request(*files, options, goal.force)
        return Work(
            propose_model, (request, collection.dataset), partial(write_proposal, request)
        ), collection

    def _diagnose(self, goal: Any) -> tuple[Work, Collection]:
        model_file = self._model_file(goal.model_file)
        collection = self._samples(self._read_model(model_file))
        options = FitOptions(hold_out=self._hold_out(goal), joint_sigma=self._settings.joint_sigma)

        def numbered(outcome: Outcome) -> Outcome:
            messages.number_samples(outcome.document.get("odd_samples", ()), collection)
            return outcome

        return Work(examine, (model_file, collection.dataset, options), numbered), collection

    def _on_recalibrated(self, kind: str, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.hash:
            self._written = outcome.path
        self._publish_result(kind, outcome)
        self._conclude(outcome, collection)

    def _discover(self, goal: Any) -> tuple[Work, Collection]:
        model_file = self._model_file(goal.model_file)
        collection = self._samples(self._read_model(model_file))
        options = FitOptions(hold_out=self._hold_out(goal), joint_sigma=self._settings.joint_sigma)
        return Work(
            find_laws, (model_file, collection.dataset, options), lambda one: one
        ), collection

    def _on_discovered(self, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.document:
            self._publish_result("discover", outcome)
        self._say(outcome.message)

    def _on_diagnosed(self, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.document:
            self._diagnosis.publish(messages.json_message(outcome.document))
        self._conclude(outcome, collection)

    def _conclude(self, outcome: Outcome, collection: Collection | None) -> None:
        if outcome.model is not None and collection is not None:
            self._compare(outcome.model, collection)
        self._say(outcome.message)

    # ------------------------------------------------------------------ adding an effect

    def _add_effect(self, request: Any, response: Any) -> Any:
        """Run in a worker thread of the executor; samples and publishers belong to the main one."""
        try:
            work, collection = run_in_spin_thread(self._node, self._prepare_effect, request)
        except Exception as error:
            outcome = Outcome(False, describe_error(error))
            run_in_spin_thread(self._node, self._say, outcome.message)
        else:
            outcome = self.slot.run_work(work)
            run_in_spin_thread(self._node, self._on_effect_added, outcome, collection)
        response.success, response.message = outcome.success, outcome.message
        response.json = messages.json_text(outcome.document) if outcome.document else ""
        response.hash = outcome.hash
        return response

    def _prepare_effect(self, request: Any) -> tuple[Work, Collection]:
        if self._node.refusal:
            raise ParallelCalError(self._node.refusal)
        if not request.effect:
            raise ParallelCalError("no effect named, e.g. encoder_eccentricity")
        options = FitOptions(
            hold_out=self._settings.get("hold_out"), joint_sigma=self._settings.joint_sigma
        )
        files = self.files("", request.output_file)
        wanted = Request(*files, options, request.force, request.effect)
        collection = self._samples(self._read_model(files[0]))
        self.slot.begin("an effect is being added; wait")
        self._say(f"adding {request.effect}")
        return Work(
            propose_model, (wanted, collection.dataset), partial(write_proposal, wanted)
        ), collection

    def _on_effect_added(self, outcome: Outcome, collection: Collection) -> None:
        self.slot.end()
        self._on_recalibrated("add_effect", outcome, collection)
