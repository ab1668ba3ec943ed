"""Samples in the model's base frame: as they are, moved by TF where it is there, registered by
themselves as the command line does it, or refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.time import Time

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.identification.registration import register_device
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

DEVICE_FRAME_SENSOR = "device_frame"  # the sensor that finds out where the device stands


class Transform(NamedTuple):
    """Where a frame stands in another: position (3,) m, rotation (3, 3), its age (s)."""

    r: np.ndarray
    R: np.ndarray
    age: float


Look = Callable[[str, str], Transform | None]


def foreign_frame(dataset: Dataset, model: Model) -> str:
    """The frame of the samples where it is not the model's base and nothing accounts for it."""
    own = model.frames["base"]
    accounted = any(sensor.name == DEVICE_FRAME_SENSOR for sensor in model.sensors)
    return "" if accounted or dataset.frame in ("", own) else dataset.frame


def to_base_frame(
    dataset: Dataset, model: Model, look: Look, joint_sigma: float | None = None
) -> tuple[Dataset, str]:
    """The samples in the model's base frame by TF, or as they are, where whoever uses them finds
    out where their frame stands; in words, what was or will be done to them.

    DatasetError where their frame is another one, no transform is known and they are too few to
    tell.
    """
    frame, base = foreign_frame(dataset, model), model.frames["base"]
    found = look(base, frame) if frame else None
    if found is not None:
        age = "static" if found.age == 0.0 else f"{found.age:.1f} s old"
        return transform_dataset(
            dataset, found, base
        ), f"poses transformed from '{frame}' to '{base}' by TF ({age})"
    _, registration = register_device(model, dataset, joint_sigma)
    if registration is not None:
        return dataset, registration.description
    if not frame:
        return dataset, ""
    raise DatasetError(
        f"the poses are in frame '{frame}', the model's base is '{base}': TF has no transform "
        "between them, and these samples do not determine it. Take more samples, publish the "
        f"transform (TF needs tf2) or the poses in '{base}', name the frame in the model file "
        f"(frames.base), or add the sensor {DEVICE_FRAME_SENSOR} to the model"
    )


def by_tf(dataset: Dataset, model: Model, look: Look) -> Dataset:
    """The samples in the model's base frame where TF leads there, else as they are."""
    frame, base = foreign_frame(dataset, model), model.frames["base"]
    found = look(base, frame) if frame else None
    return dataset if found is None else transform_dataset(dataset, found, base)


def transform_dataset(dataset: Dataset, by: Transform, frame: str) -> Dataset:
    """r -> R_t r + r_t, R -> R_t R, covariances turned likewise; measured directions must be all
    or none of the position and of the rotation (DatasetError)."""
    for part in (dataset.measured[:, :3], dataset.measured[:, 3:]):
        if (part.any(axis=1) != part.all(axis=1)).any():
            raise DatasetError(
                "single coordinates were measured: TF transforms only whole positions and rotations"
            )
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = by.R
    placed, turned = dataset.measured[:, :1], dataset.measured[:, 3, None, None]
    known = np.nan_to_num(dataset.pose_cov)
    diagonal = np.diagonal(dataset.pose_cov, axis1=1, axis2=2)
    given = ~np.isnan(diagonal)
    covariance = turn @ known @ turn.T
    gaps = ~(given[:, :, None] & given[:, None, :])
    covariance[gaps] = np.nan
    return dataclasses.replace(
        dataset,
        r=np.where(placed, dataset.r @ by.R.T + by.r, dataset.r),
        R=np.where(turned, by.R @ dataset.R, dataset.R),
        pose_cov=covariance,
        frame=frame,
    )


def lookup(node: Node) -> Look:
    """Transforms by tf2 where it is installed; None for every one where it is not."""
    try:
        from tf2_ros import Buffer, TransformException, TransformListener
    except ImportError:
        return lambda target, source: None
    buffer = Buffer()
    listener = TransformListener(buffer, node)  # held by the function below

    def look(target: str, source: str) -> Transform | None:
        try:
            found = buffer.lookup_transform(target, source, Time(clock_type=ClockType.ROS_TIME))
        except TransformException:
            return None
        assert listener is not None
        return _transform(found, node)

    return look


def _transform(message: Any, node: Node) -> Transform:
    t, o = message.transform.translation, message.transform.rotation
    stamp = Time.from_msg(message.header.stamp, clock_type=ClockType.ROS_TIME)
    age = (node.get_clock().now() - stamp).nanoseconds * 1e-9 if stamp.nanoseconds else 0.0
    R = quaternion_to_matrix(np.array([o.x, o.y, o.z, o.w]))
    return Transform(np.array([t.x, t.y, t.z]), R, age)
