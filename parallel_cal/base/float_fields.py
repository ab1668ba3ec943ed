"""Recognise numbers that were no floats when a driver assigned them to a field of a message.

rclpy 7.1 (Jazzy) does not convert what Python code assigns to a `float64` field. It copies the
bytes of the object: a `numpy.float32` or an `int` arrives as a number below 1e-300, and a negative
`int` as NaN. No device measures such a number.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SMALLEST_MEASURED = 1e-300  # m, rad, degC or kg
CURE = (
    "convert it with float() in the driver; ROS_PYTHON_CHECK_FIELDS=1 makes rclpy refuse the "
    "assignment"
)
UNCONVERTED = (
    "number below 1e-300: a numpy.float32 or an int was assigned to a float64 field of the message "
    f"({CURE})"
)
NEGATIVE_INT = " (probably a negative int in a float64 field: other numbers are below 1e-300)"


def is_unconverted(values: ArrayLike) -> NDArray[np.bool_]:
    """Mark the values that are not zero and below 1e-300."""
    size = np.abs(np.asarray(values, float))
    return np.asarray((size > 0) & (size < SMALLEST_MEASURED))


def find_unconverted(values: Any) -> int | None:
    """Return the first row of values (n, ...) with an unconverted number; None if there is none."""
    found = np.argwhere(is_unconverted(values))
    return int(found[0, 0]) if len(found) else None
