"""Express samples in the base frame of the model.

If they are in another frame, TF transforms them, or their registration is estimated as on the
command line. If neither is possible, they are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.time import Time

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.identification.registration import register_device
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.transforming import transform_poses

DEVICE_FRAME_SENSOR = "device_frame"  # the sensor whose parameters are the pose of the device


class Transform(NamedTuple):
    """The pose of a frame in another one: r (3,) [m], R (3, 3), and its age [s]."""

    r: np.ndarray
    R: np.ndarray
    age: float


Look = Callable[[str, str], Transform | None]


def foreign_frame(dataset: Dataset, model: Model) -> str:
    """Return the frame of the samples if it is not the model's base and no sensor models it."""
    own = model.frames["base"]
    accounted = any(sensor.name == DEVICE_FRAME_SENSOR for sensor in model.sensors)
    return "" if accounted or dataset.frame in ("", own) else dataset.frame


def to_base_frame(
    dataset: Dataset, model: Model, look: Look, joint_sigma: float | None = None
) -> tuple[Dataset, str]:
    """Transform the samples to the base frame of the model by TF, if TF has the transform.

    Otherwise the samples stay as they are, and the fit estimates their registration.

    Returns
    -------
    The samples, and a sentence about what was done or will be done. It is empty if nothing is
    needed.

    Raises
    ------
    DatasetError
        If TF has no transform and the samples are too few to estimate it.
    """
    frame, base = foreign_frame(dataset, model), model.frames["base"]
    found = look(base, frame) if frame else None
    if found is not None:
        age = "static" if found.age == 0.0 else f"{found.age:.1f} s old"
        return transform_dataset(dataset, found, base), (
            f"poses transformed from '{frame}' to '{base}' by TF ({age})"
        )
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
    """Transform the samples to the base frame of the model if TF can, else return them as is."""
    frame, base = foreign_frame(dataset, model), model.frames["base"]
    found = look(base, frame) if frame else None
    return dataset if found is None else transform_dataset(dataset, found, base)


def transform_dataset(dataset: Dataset, by: Transform, frame: str) -> Dataset:
    """Transform poses and covariances: r -> R_t r + r_t, R -> R_t R.

    Raise DatasetError if the rotation mixes measured coordinates with others.
    """
    return transform_poses(dataset, by.r, by.R, frame)


def lookup(node: Node) -> Look:
    """Return a function that looks transforms up in tf2; without tf2 it returns None."""
    try:
        from tf2_ros import Buffer, TransformException, TransformListener
    except ImportError:
        return lambda target, source: None
    buffer = Buffer()
    listener = TransformListener(buffer, node)  # `look` keeps a reference, so that it stays alive

    def look(target: str, source: str) -> Transform | None:
        try:
            found = buffer.lookup_transform(target, source, Time(clock_type=ClockType.ROS_TIME))
        except TransformException:
            return None
        assert listener is not None
        t, o = found.transform.translation, found.transform.rotation
        stamp = Time.from_msg(found.header.stamp, clock_type=ClockType.ROS_TIME)
        # A static transform has the stamp 0 and no age.
        age = (node.get_clock().now() - stamp).nanoseconds * 1e-9 if stamp.nanoseconds else 0.0
        R = quaternion_to_matrix(np.array([o.x, o.y, o.z, o.w]))
        return Transform(np.array([t.x, t.y, t.z]), R, age)

    return look
