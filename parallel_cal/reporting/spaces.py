"""The 3D figures: residuals, two models side by side, the smooth map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.diagnosis.lack_of_fit import SmoothMap
from parallel_cal.reporting.arrows import Ramp, arrows, scale_of, typical
from parallel_cal.reporting.axes import space
from parallel_cal.reporting.colours import PATTERN
from parallel_cal.reporting.figures import Spec, round_values, select_evenly
from parallel_cal.reporting.readable import with_unit

MAX_ARROWS = 300  # more hide each other
SI = {"position": "m", "orientation": "rad"}


def residual_arrows(
    places: np.ndarray, fields: Sequence[np.ndarray], kind: str, numbers: np.ndarray
) -> tuple[Spec, float]:
    """Draw residual fields (N, 3) at places (N, 3); return the figure and its magnification.

    The first field is visible (traces with `meta` 0), the others are hidden (1, ...). A bar shows
    the scale.
    """
    scale, ramp = scale_of(places, fields), Ramp.over(fields)
    traces = [
        trace | {"visible": k == 0, "meta": k}
        for k, field in enumerate(fields)
        for trace in draw_arrows(places, field, scale, kind, numbers, ramp)
    ]
    traces.append(ramp.bar(kind))
    return _add_scale_arrow(traces, places, fields[0], scale, kind), scale


def sides(
    models: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], kind: str
) -> tuple[list[Spec], float]:
    """Draw the residuals of several models: one magnification, one bar and the same axes for all.

    A model is its places (N, 3), residuals (N, 3) and sample numbers (N,). The result is a figure
    for each model, and the magnification.
    """
    scale = min(scale_of(places, [field]) for places, field, _ in models)
    places = np.concatenate([places for places, _, _ in models])
    fields = np.concatenate([field for _, field, _ in models])
    ends = np.concatenate([places, places + scale * fields])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.1 * (high - low).max()  # the bar lies there
    ranges = _axis_factor(kind) * np.stack([low - margin, high + margin], axis=1)
    axes = {f"{a}axis": {"range": pair} for a, pair in zip("xyz", ranges.tolist(), strict=True)}
    figures, ramp = [], Ramp.over([fields])
    for own_places, own_field, numbers in models:
        traces = [
            *draw_arrows(own_places, own_field, scale, kind, numbers, ramp),
            ramp.bar(kind),
        ]
        figure = _add_scale_arrow(traces, places, fields, scale, kind)
        scene = figure["layout"]["scene"]
        scene |= {name: scene.get(name, {}) | axis for name, axis in axes.items()}
        figures.append(figure | {"layout": figure["layout"] | {"height": 380}})
    return figures, scale


def smooth_map(found: SmoothMap) -> tuple[Spec, float] | None:
    """Draw the smooth map; return the figure and its magnification.

    The result is None if there is no map, or if it has more than three dimensions.
    """
    if found.share <= 0 or not found.size or found.places.shape[1:] != (3,):
        return None
    scale = scale_of(found.places, [found.field])
    ramp, numbers = Ramp.over([found.field]), np.arange(len(found.field))
    drawn = draw_arrows(found.places, found.field, scale, found.kind, numbers, ramp)
    drawn.append(ramp.bar(found.kind))
    layout = space(found.kind)
    if found.kind == "orientation":
        layout["scene"] |= {
            f"{a}axis": {"title": {"text": f"joint {k}"}} for k, a in enumerate("xyz", 1)
        }
    return {"data": drawn, "layout": layout}, scale


def draw_arrows(
    places: np.ndarray,
    field: np.ndarray,
    scale: float,
    kind: str,
    numbers: np.ndarray,
    ramp: Ramp,
) -> list[Spec]:
    """Draw arrows with their sizes as hover texts, a part of them if there are many."""
    kept = select_evenly(len(places), MAX_ARROWS)
    places, field, numbers = places[kept], field[kept], numbers[kept]
    sizes = np.linalg.norm(field, axis=1)
    words = [f"{n}: {with_unit(size, SI[kind])}" for n, size in zip(numbers, sizes, strict=True)]
    return arrows(places, field, scale, words, _axis_factor(kind), ramp)


def _axis_factor(kind: str) -> float:
    """Return the factor from SI to the unit of the axes: mm, or rad."""
    return 1e3 if kind == "position" else 1.0


def _add_scale_arrow(
    traces: list[Spec], places: np.ndarray, field: np.ndarray, scale: float, kind: str
) -> Spec:
    """Add a length to compare arrows with, outside the lowest corner, where no arrow covers it."""
    size, low = typical(field), places.min(axis=0)
    x, y, z = _axis_factor(kind) * (low - 0.1 * (places.max(axis=0) - low))
    long = _axis_factor(kind) * scale * size
    bar = {
        "type": "scatter3d",
        "mode": "lines",
        "showlegend": False,
        "hoverinfo": "skip",
        "x": round_values(np.array([x, x + long])),
        "y": round_values(np.array([y, y])),
        "z": round_values(np.array([z, z])),
        "line": {"width": 8, "color": PATTERN},
    }
    words = {
        "x": x + long,
        "y": y,
        "z": z,
        "text": with_unit(size, SI[kind]),
        "showarrow": False,
        "xanchor": "left",
        "xshift": 8,
    }
    layout = space(kind)
    return {
        "data": [*traces, bar],
        "layout": layout | {"scene": layout["scene"] | {"annotations": [words]}},
    }
