"""Samples and results as ROS messages."""

from __future__ import annotations

import json
from collections.abc import Iterable, MutableMapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovariance
from parallel_cal_msgs.action import Diagnose, Identify
from parallel_cal_msgs.msg import Condition, Sample
from std_msgs.msg import String

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.nodes.collector import Collection
from parallel_cal.nodes.conversions import pose_message
from parallel_cal.recordings.recording import Dropped
from parallel_cal.session.goals import Outcome

NOT_MEASURED = 1e4  # variance of a coordinate that was not measured; readers test for > 1e3


def sample_messages(collection: Collection) -> list[Sample]:
    """Return one message for each sample, without conditions that are not finite."""
    dataset = collection.dataset
    leaders: dict[int, int] = {}  # number of the first sample of each commanded pose
    messages = []
    for i, number in enumerate(collection.ids.tolist()):
        first = leaders.setdefault(int(dataset.pose_id[i]), number)
        conditions = {name: float(column[i]) for name, column in dataset.conditions.items()}
        covariance = np.where(np.isfinite(dataset.pose_cov[i]), dataset.pose_cov[i], 0.0)
        variances = np.where(dataset.measured[i], np.diag(covariance), NOT_MEASURED)
        covariance[np.diag_indices(6)] = variances
        pose = pose_message(dataset.r[i], matrix_to_quaternion(dataset.R[i]))
        message = Sample(
            id=number,
            stamp=time_message(int(collection.stamps[i])),
            joints=dataset.q[i].tolist(),
            pose=PoseWithCovariance(pose=pose, covariance=covariance.ravel()),
            conditions=[
                Condition(name=n, value=v) for n, v in conditions.items() if np.isfinite(v)
            ],
            replicate_of=-1 if first == number else first,
            note=f"{dataset.count_q[i]} joint readings, {dataset.count_pose[i]} poses averaged",
        )
        messages.append(message)
    return messages


def number_samples(rows: Iterable[MutableMapping[str, Any]], collection: Collection) -> None:
    """Add the `id` in the collection to each row about a sample of its dataset."""
    ids = dict(zip(collection.dataset.numbers.tolist(), collection.ids.tolist(), strict=True))
    for row in rows:
        row["id"] = ids[row["sample"]]


def time_message(ns: int) -> Time:
    return Time(sec=int(ns // 1_000_000_000), nanosec=int(ns % 1_000_000_000))


def json_message(document: Any) -> String:
    """A document as one JSON text."""
    return String(data=json_text(document))


def json_text(document: Any) -> str:
    return json.dumps(to_json_value(document), allow_nan=False)


def dropped_message(dropped: Iterable[Dropped]) -> String:
    """Return the dropped messages: [{time, reason, detail, count}], time in s since the start."""
    return json_message([vars(item) for item in dropped])


def identify_result(outcome: Outcome) -> Identify.Result:
    """Return the result message; unknown errors are NaN."""
    message = Identify.Result(success=outcome.success, message=outcome.message, hash=outcome.hash)
    message.json = json_text(outcome.document) if outcome.document else ""
    message.position_before, message.position_after = outcome.means[:2]
    message.held_out_before, message.held_out_after = outcome.means[2:]
    return message


def diagnose_result(outcome: Outcome) -> Diagnose.Result:
    """Return the result message; success means that there is a verdict, whichever it is."""
    message = Diagnose.Result(success=outcome.success, message=outcome.message)
    message.verdict = outcome.verdict
    message.json = json_text(outcome.document) if outcome.document else ""
    return message
