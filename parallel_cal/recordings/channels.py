"""The channels of a recording: topic, message types, and how their messages are used.

A new topic or reading is one entry in CHANNELS and one decoder. Bags, live collection, the
command line and the report of a recording use this table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from typing import Any, Literal

import numpy as np

from parallel_cal.base.errors import BagError, wrap_plugin_error
from parallel_cal.model.effect import parse_part
from parallel_cal.model.shelf import require_allowed
from parallel_cal.recordings.pose_messages import pose_row

NO_EFFORT = np.zeros(0)

Kind = Literal["joints", "poses", "condition", "words", "readings", "images"]


@dataclass(frozen=True)
class Channel:
    """The message types of a channel, and how a message is decoded.

    Parameters
    ----------
    kind : str
        `joints`, `poses`, `condition`, `words`, `readings` or `images`.
    types : tuple of str
        Accepted message types, the usual one first.
    decode : callable
        Returns the row of a message. Its content depends on the kind:

        - joints: (names, q, effort)
        - poses: (frame, position, quaternion or None, covariance or None)
        - condition: (value,), interpolated between messages, or, if `held`, valid until the next
        - words: (text,), the name of the constraint that holds the tip of the robot until the
          next message
        - readings: (name of the device's channel, value in m); the values are averaged over a dwell
        - images: (camera, numbers of corners, their pixels), as detected in an image
    by_name : bool
        Whether a topic is used only if it has the name of the channel or is stated by name, because
        the message type has many other uses. Default False.
    latched : bool
        Whether the topic is often published once, before anything subscribes. Default False.
    held : bool
        Whether a condition stays valid until the next message. Default False.
    unit : str
        Unit of a condition. Default: none.
    plausible : tuple of 2 float
        A condition outside this range, in `unit`, causes a warning. Default: unbounded.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> humidity = pc.Channel(
    ...     "condition",
    ...     ("sensor_msgs/msg/RelativeHumidity",),
    ...     lambda message: (message.relative_humidity,),
    ...     unit="1",
    ...     plausible=(0.0, 1.0),
    ... )
    >>> humidity.types
    ('sensor_msgs/msg/RelativeHumidity',)
    """

    kind: Kind
    types: tuple[str, ...]
    decode: Callable[[Any], tuple]
    by_name: bool = False
    latched: bool = False
    held: bool = False
    unit: str = ""
    plausible: tuple[float, float] = (-math.inf, math.inf)


def joint_row(message: Any) -> tuple:
    """Return (names, positions, efforts) as numpy arrays of their own: those of a message keep all
    of it in memory, and a collection holds a hundred thousand."""
    effort = np.array(message.effort, float) if len(message.effort) else NO_EFFORT
    return _share_names(tuple(message.name)), np.array(message.position, float), effort


@lru_cache(maxsize=64)
def _share_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the same tuple for equal names."""
    return names


def corner_row(message: Any) -> tuple:
    """Return (camera, numbers (n,), pixels (n, 2)) of the corners that were detected."""
    return message.camera, message.corners.numbers, message.corners.pixels


# The corners of a board, which calibration_node detects in images. No topic has them: a recording
# is searched for the images of the option `images`.
CORNERS = "corners"
# The name of a channel is also the name of its usual topic.
CHANNELS = {
    "joint_states": Channel("joints", ("sensor_msgs/msg/JointState",), joint_row),
    "measured_pose": Channel(
        "poses",
        ("geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/PoseStamped"),
        pose_row,
    ),
    "measured_position": Channel("poses", ("geometry_msgs/msg/PointStamped",), pose_row),
    "temperature": Channel(
        "condition",
        ("sensor_msgs/msg/Temperature",),
        lambda message: (message.temperature,),
        unit="degC",
        plausible=(-60.0, 150.0),  # a temperature in kelvin is outside
    ),
    "payload": Channel(
        "condition",
        ("geometry_msgs/msg/InertiaStamped",),
        lambda message: (message.inertia.m,),
        latched=True,
        held=True,
        unit="kg",
        plausible=(0.0, 1e5),
    ),
    "constraint": Channel(
        "words",
        ("std_msgs/msg/String",),
        lambda message: (message.data,),
        by_name=True,
        latched=True,
    ),
    "distance": Channel(
        "readings",
        ("sensor_msgs/msg/Range",),
        lambda message: (message.header.frame_id, message.range),
        by_name=True,
    ),
    CORNERS: Channel(
        "images", ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"), corner_row
    ),
}


def list_channels(*kinds: Kind, among: Iterable[str] = ()) -> list[str]:
    """Return the names of the channels of some kinds, first those of `among` that belong to parts,
    such as `temperature.arms`."""
    parts = [name for name in among if parse_part(name)]
    names = dict.fromkeys([*parts, *CHANNELS])
    known = {name: CHANNELS.get(name) or find_channel(name) for name in names}
    return [name for name, one in known.items() if one and one.kind in kinds]


def find_channel(name: str) -> Channel | None:
    """Return the channel of a name in a recording; that of a part's own sensor has no usual
    topic."""
    if name in CHANNELS and name != CORNERS:
        return CHANNELS[name]
    part = parse_part(name)
    return replace(CHANNELS[part[0]], by_name=True) if part else None


def register_channels(path: str) -> None:
    """Add the channels of a plug-in module, by its Python path, under their names in the module."""
    require_allowed(path, BagError)
    try:
        own = {k: v for k, v in vars(import_module(path)).items() if isinstance(v, Channel)}
    except Exception as error:
        raise wrap_plugin_error(path, error) from error
    if not own:
        raise BagError(f"{path} defines no Channel: assign one to a name there")
    CHANNELS.update(own)
