"""Axes, space and the noise floor of figures, without NumPy, so that the page can draw them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from parallel_cal.reporting.colours import QUIET
from parallel_cal.reporting.readable import number


def log_axis(values: Sequence[float | None], title: str = "") -> dict[str, Any]:
    """Make a logarithmic axis with ticks at 1, 2, 5 times powers of ten.

    Only positive values can be drawn; the axis holds all of them.
    """
    known = [v for v in values if v]
    low, high = min(known) * 0.6, max(known) * 1.6
    ticks = list_round_ticks(low, high)
    return {
        "type": "log",
        "range": [math.log10(low), math.log10(high)],
        "title": {"text": title},
        "tickvals": ticks,
        "ticktext": [f"{t:g}" for t in ticks],
    }


def list_round_ticks(low: float, high: float) -> list[float]:
    """List 1, 2 and 5 times powers of ten between two positive numbers."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = (digit * 10.0**power for power in powers for digit in (1, 2, 5))
    return [tick for tick in ticks if low < tick < high]


def draw_noise_floor(
    noise: float, ends: Sequence[float], unit: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the dashed line of the noise floor (in `unit`) between two ends, and its label."""
    line = {
        "type": "scatter",
        "mode": "lines",
        "x": [*ends],
        "y": [noise] * 2,
        "line": {"dash": "dash", "color": QUIET},
        "hoverinfo": "skip",
    }
    label = {
        "xref": "paper",
        "x": 0.005,
        "xanchor": "left",
        "y": math.log10(noise),
        "yanchor": "top",
        "text": f"noise floor {number(noise)} {unit}",
        "showarrow": False,
    }
    return line, label


def name_axis(axis: str, kind: str = "position") -> str:
    """Name an axis of a figure in the frame of the base."""
    return f"{axis} of base [mm]" if kind == "position" else f"platform axis, {axis} of base"


def space(kind: str) -> dict[str, Any]:
    """Make axes of equal scale in {B}: positions in mm, directions on the unit sphere."""
    axes = {f"{a}axis": {"title": {"text": name_axis(a, kind)}} for a in "xyz"}
    camera = {"eye": {"x": 1.5, "y": -1.5, "z": 0.75}, "center": {"x": 0, "y": 0, "z": -0.16}}
    return {
        "scene": {**axes, "aspectmode": "data", "camera": camera},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 500,
    }
