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
    low, high = math.log10(min(known) * 0.6), math.log10(max(known) * 1.6)
    ticks = [
        digit * 10.0**power
        for power in range(math.floor(low), math.ceil(high) + 1)
        for digit in (1, 2, 5)
        if low < math.log10(digit * 10.0**power) < high
    ]
    return {
        "type": "log",
        "range": [low, high],
        "title": {"text": title},
        "tickvals": ticks,
        "ticktext": [f"{t:g}" for t in ticks],
    }


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


def space(kind: str) -> dict[str, Any]:
    """Make axes of equal scale: positions in mm, directions on the unit sphere without unit."""
    unit = " [mm]" if kind == "position" else ""
    axes = {f"{a}axis": {"title": {"text": f"{a}{unit}"}} for a in "xyz"}
    camera = {"eye": {"x": 1.5, "y": -1.5, "z": 0.75}, "center": {"x": 0, "y": 0, "z": -0.16}}
    return {
        "scene": {**axes, "aspectmode": "data", "camera": camera},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 500,
    }
