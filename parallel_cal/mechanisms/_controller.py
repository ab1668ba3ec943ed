"""Options of a mechanism that describe the controller with which its joints were recorded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.base.errors import ModelError


def read_one_per_joint(name: str, given: Sequence[float], n: int, part: str) -> tuple[float, ...]:
    """Return an option that has one finite number for each `part`, of which there are n."""
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (n,) or not np.isfinite(values).all():
        raise ModelError(f"{name} is {given!r}: expected {n} numbers, one for each {part}")
    return tuple(map(float, values))


def read_scale(given: Sequence[float], n: int, part: str = "joint") -> tuple[float, ...]:
    """Return the option `scale`: counts per m of each `part`, of which there are n."""
    scale = read_one_per_joint("scale", given, n, part)
    if not all(scale):
        raise ModelError(f"scale {scale}: expected numbers other than 0")
    return scale


def read_switches(
    given: Sequence[float] | None, n: int, part: str = "joint"
) -> tuple[float, ...] | None:
    """Return the option `switches`: the readings at which the controller homes each `part` of n."""
    return None if given is None else read_one_per_joint("switches", given, n, part)


def read_controller(
    scale: Sequence[float] | None, switches: Sequence[float] | None, n: int, part: str
) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Return the options `scale` and `switches`, one number for each `part` of n; None if not
    stated."""
    return (
        None if scale is None else read_scale(scale, n, part),
        read_switches(switches, n, part),
    )
