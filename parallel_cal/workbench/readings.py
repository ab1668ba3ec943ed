"""The readings that one sample averages, as a figure; computed in another process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting.colours import QUIET


def signals(folder: Path, sample: int) -> dict[str, Any]:
    """Draw the readings that a sample averages; return a sentence if they were not recorded."""
    from parallel_cal.session.session import Session  # imported in the worker process only

    try:
        found = Session(folder).signals(sample)
    except ParallelCalError as error:
        return {"words": str(error)}
    traces = [
        _draw_line(name, found.time, q, "lines", "y")
        for name, q in zip(found.joint_names, found.joints.T, strict=True)
    ] + [
        _draw_line(name, found.pose_time, r, "lines+markers", "y2")
        for name, r in zip("xyz", found.position.T, strict=True)
    ]
    # What stands still must be seen: the motion before and after goes out of the picture.
    inside = np.abs(found.time) < found.duration / 2
    placed = np.abs(found.pose_time) < found.duration / 2
    ranges = [
        5e6 * float(np.abs(values).max(initial=1e-7))
        for values in (found.joints[inside], found.position[placed])
    ]
    half = found.duration / 2
    dwell = {
        "type": "rect",
        "xref": "x",
        "yref": "paper",
        "x0": -half,
        "x1": half,
        "y0": 0,
        "y1": 1,
        "fillcolor": QUIET,
        "opacity": 0.15,
        "line": {"width": 0},
    }
    layout = {
        "height": 460,
        "margin": {"t": 8, "r": 12, "l": 64, "b": 40},
        "xaxis": {"title": {"text": "s from the middle of the dwell"}, "anchor": "y2"},
        "yaxis": {
            "domain": [0.54, 1],
            "range": [-ranges[0], ranges[0]],
            "title": {"text": "joints − sample [µrad or µm]"},
        },
        "yaxis2": {
            "domain": [0, 0.46],
            "range": [-ranges[1], ranges[1]],
            "title": {"text": "measured − sample [µm]"},
        },
        "shapes": [dwell],
    }
    return {"figure": to_json_value({"data": traces, "layout": layout})}


def _draw_line(
    name: str, time: np.ndarray, values: np.ndarray, mode: str, axis: str
) -> dict[str, Any]:
    """Draw values (rad or m) over the time (s)."""
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": time.round(4),
        "y": (1e6 * values).round(2),
        "xaxis": "x",
        "yaxis": axis,
    }
