"""The services by which a person inspects, corrects and compares the collected samples."""

from __future__ import annotations

from functools import partial
from typing import Any

from parallel_cal_msgs.srv import Compare, ListSamples, LoadSamples, RemoveSample, SaveSamples
from rclpy.callback_groups import CallbackGroup
from std_srvs.srv import Trigger

from parallel_cal.base.errors import DatasetError, ParallelCalError
from parallel_cal.nodes.calibration_messages import sample_messages
from parallel_cal.nodes.calibrator import Calibrator
from parallel_cal.nodes.collection_report import CollectionReport
from parallel_cal.nodes.folders import Folders
from parallel_cal.nodes.jobs import describe_error
from parallel_cal.nodes.live_samples import LiveSamples
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.parameters import WAITING


class SampleServices:
    """Provides the services of the table SERVICES, `~/compare` and `~/undo`."""

    def __init__(
        self,
        node: ManagedNode,
        samples: LiveSamples,
        folders: Folders,
        calibrator: Calibrator,
        report: CollectionReport,
        group: CallbackGroup,
    ):
        self._node, self._samples, self._report = node, samples, report
        functions: dict[str, Any] = {
            name: (type, partial(function, samples, folders))
            for name, (type, function) in SERVICES.items()
        }
        functions["compare"] = (Compare, calibrator.compare)
        functions["undo"] = (Trigger, calibrator.undo)
        for name, (type, function) in functions.items():
            node.create_service(
                type,
                f"~/{name}",
                partial(self._serve, function),
                qos_profile=WAITING,
                callback_group=group,
            )

    def _serve(self, function: Any, request: Any, response: Any) -> Any:
        """Bring the samples up to date, call the function, and answer whatever happens."""
        has_message = hasattr(response, "message")
        try:
            if self._node.refusal:
                raise ParallelCalError(self._node.refusal)
            self._samples.refresh()
            function(request, response)
            self._samples.keep()
        except Exception as error:  # whatever it is, the node goes on and the caller gets a reason
            if has_message:
                response.success, response.message = False, describe_error(error)
            else:  # list_samples: its status contains the event
                self._report.say(describe_error(error))
        if has_message:
            self._report.say(response.message)
        if hasattr(response, "status"):
            response.status = self._report.status()
        return response


def take(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    number = samples.collector.take()
    response.success, response.message = True, f"sample {number} taken"


def remove(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    samples.collector.remove(request.id)
    response.success, response.message = True, f"sample {request.id} removed"


def list_all(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    if len(samples.collector):
        collection = samples.collector.collection()
        response.samples = sample_messages(collection)
        response.joint_names = list(collection.dataset.joint_names)


def save(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    response.samples = samples.collector.save(folders.to_write(_path(request), "samples"))
    response.success = True
    response.message = f"{response.samples} samples written to {request.path}"
    samples.close_journal(f"saved to {request.path}")


def load(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    response.samples = samples.collector.load(folders.to_read(_path(request)))
    response.success = True
    warnings = "".join(f"; warning: {text}" for text in samples.collector.warnings())
    response.message = f"{response.samples} samples read from {request.path}{warnings}"


def clear(samples: LiveSamples, folders: Folders, request: Any, response: Any) -> None:
    response.success, response.message = True, f"{samples.collector.clear()} samples cleared"


def _path(request: Any) -> str:
    if not request.path:
        raise DatasetError("no path given: expected the path of a file")
    return str(request.path)


SERVICES = {
    "take_sample": (Trigger, take),
    "remove_sample": (RemoveSample, remove),
    "list_samples": (ListSamples, list_all),
    "save_samples": (SaveSamples, save),
    "load_samples": (LoadSamples, load),
    "clear_samples": (Trigger, clear),
}
