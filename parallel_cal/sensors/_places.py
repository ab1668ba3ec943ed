"""Start values of objects that stand somewhere in the workspace: nobody measured where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.sensor import Sensor

AXES = ("xyz", "xy", "xz", "yz")
SPREAD = 0.5  # of the half-widths of the workspace, between its middle and the objects


def check_touch(sensor: Sensor, axes: str) -> None:
    """Raise ModelError unless sigma is positive and the axes are known."""
    if sensor.sigma is not None and not sensor.sigma > 0:
        raise ModelError(f"{sensor.name}: sigma is {sensor.sigma} m, expected a positive length")
    if axes not in AXES:
        raise ModelError(f"{sensor.name}: axes is {axes!r}, expected one of {', '.join(AXES)}")


def check_axes(sensor: Sensor, axes: str, mechanism: Mechanism) -> None:
    """Raise ModelError for an axis along which the robot moves no point: nothing is measured there.

    A platform moves its points along an axis by a shift along it, or a turn about another one."""
    able = "".join(
        axis
        for i, axis in enumerate("xyz")
        if i in mechanism.moved or any(k >= 3 and k != 3 + i for k in mechanism.moved)
    )
    if set(axes) - set(able):
        raise ModelError(
            f"{sensor.name}: axes is {axes}, but {mechanism.name} moves points along "
            f"{', '.join(able)} only: state axes: {able}"
        )


def spread_places(mechanism: Mechanism, n: int, tip: Sequence[float]) -> np.ndarray:
    """Return n places (n, 3) of the point `tip` of {P}, around the middle of the workspace."""
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    middle, half = (low + high) / 2, (high - low) / 2
    phase = 2 * np.pi * (np.arange(n)[:, None] / n + np.arange(len(low)) / 4)
    controls = np.array(mechanism.controls)
    shift = np.where(np.isin(controls, list("xyz")), SPREAD * half * np.cos(phase), 0.0)
    r, R = mechanism.poses(middle + (shift if n > 1 else 0.0 * phase))
    return np.asarray(r + R @ np.asarray(tip, dtype=float))


def workspace_radius(mechanism: Mechanism) -> float:
    """Return half the diagonal (m) of the workspace: how far an object in it is from its middle."""
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    is_length = np.isin(mechanism.controls, list("xyz"))
    half = float(np.linalg.norm((high - low)[is_length])) / 2
    return half or float(mechanism.length)
