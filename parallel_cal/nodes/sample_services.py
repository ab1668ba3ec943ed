"""The services by which a person looks at the collection and corrects it."""

from __future__ import annotations

from typing import Any

from parallel_cal_msgs.srv import ListSamples, LoadSamples, RemoveSample, SaveSamples
from std_srvs.srv import Trigger

from parallel_cal.base.errors import DatasetError
from parallel_cal.nodes.calibration_messages import sample_messages
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.folders import Folders


def take(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    number = collector.take()
    response.success, response.message = True, f"sample {number} taken"


def remove(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    collector.remove(request.id)
    response.success, response.message = True, f"sample {request.id} removed"


def list_all(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    if len(collector):
        collection = collector.collection()
        response.samples = sample_messages(collection)
        response.joint_names = list(collection.dataset.joint_names)


def save(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    response.samples = collector.save(folders.to_write(_path(request), "samples"))
    response.success = True
    response.message = f"{response.samples} samples written to {request.path}"


def load(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    response.samples = collector.load(folders.to_read(_path(request)))
    response.success = True
    told = "".join(f"; warning: {text}" for text in collector.warnings())
    response.message = f"{response.samples} samples read from {request.path}{told}"


def clear(collector: Collector, folders: Folders, request: Any, response: Any) -> None:
    response.success, response.message = True, f"{collector.clear()} samples cleared"


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
