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

NOT_MEASURED = 1e4  # a variance above 1e3 says so


def sample_messages(collection: Collection) -> list[Sample]:
    """One message a sample; conditions that are not finite are left out."""
    leaders: dict[int, int] = {}
    messages = []
    for i, number in enumerate(collection.ids.tolist()):
        first = leaders.setdefault(int(collection.dataset.pose_id[i]), number)
        messages.append(_sample(collection, i, number, -1 if first == number else first))
    return messages


def _sample(collection: Collection, i: int, number: int, first: int) -> Sample:
    dataset = collection.dataset
    conditions = {name: float(column[i]) for name, column in dataset.conditions.items()}
    return Sample(
        id=number,
        stamp=time_message(int(collection.stamps[i])),
        joints=dataset.q[i].tolist(),
        pose=_pose(dataset.r[i], dataset.R[i], dataset.measured[i], dataset.pose_cov[i]),
        conditions=[Condition(name=n, value=v) for n, v in conditions.items() if np.isfinite(v)],
        replicate_of=first,
        note=f"{dataset.count_q[i]} joint readings, {dataset.count_pose[i]} poses averaged",
    )


def _pose(r: Any, R: Any, measured: Any, covariance: Any) -> PoseWithCovariance:
    spread = np.where(np.isfinite(covariance), covariance, 0.0)
    spread[np.diag_indices(6)] = np.where(measured, np.diag(spread), NOT_MEASURED)
    pose = pose_message(r, matrix_to_quaternion(R))
    return PoseWithCovariance(pose=pose, covariance=spread.ravel())


def number_samples(rows: Iterable[MutableMapping[str, Any]], collection: Collection) -> None:
    """Add to rows about samples of the dataset the `id` that each has in the collection."""
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
    """What was received and is not used: [{time, reason, detail, count}], s since the start."""
    return json_message([vars(item) for item in dropped])


def identify_result(outcome: Outcome) -> Identify.Result:
    """NaN for errors that are not known."""
    message = Identify.Result(success=outcome.success, message=outcome.message, hash=outcome.hash)
    message.json = json_text(outcome.document) if outcome.document else ""
    message.position_before, message.position_after = outcome.means[:2]
    message.held_out_before, message.held_out_after = outcome.means[2:]
    return message


def diagnose_result(outcome: Outcome) -> Diagnose.Result:
    """Success means that there is a verdict, whichever it is."""
    message = Diagnose.Result(success=outcome.success, message=outcome.message)
    message.verdict = outcome.verdict
    message.json = json_text(outcome.document) if outcome.document else ""
    return message
