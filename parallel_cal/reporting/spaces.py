"""The 3D figures: residuals, two models side by side, the smooth map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.diagnosis.lack_of_fit import SmoothMap
from parallel_cal.reporting.arrows import arrows, scale_of, typical
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
    scale = scale_of(places, fields)
    traces = [
        trace | {"visible": k == 0, "meta": k}
        for k, field in enumerate(fields)
        for trace in _draw_arrows(places, field, scale, kind, numbers)
    ]
    return _add_scale_arrow(traces, places, fields[0], scale, kind), scale


def side(
    places: np.ndarray, field: np.ndarray, kind: str, numbers: np.ndarray, scale: float = 0.0
) -> tuple[Spec, float]:
    """Draw the residuals of one of several models; without a scale, choose one."""
    scale = scale or scale_of(places, [field])
    drawn = _add_scale_arrow(
        _draw_arrows(places, field, scale, kind, numbers), places, field, scale, kind
    )
    return drawn | {"layout": drawn["layout"] | {"height": 380}}, scale


def smooth_map(found: SmoothMap) -> tuple[Spec, float] | None:
    """Draw the smooth map; return the figure and its magnification.

    The result is None if there is no map, or if it has more than three dimensions.
    """
    if found.share <= 0 or not found.size or found.places.shape[1:] != (3,):
        return None
    scale = scale_of(found.places, [found.field])
    drawn = _draw_arrows(found.places, found.field, scale, found.kind, np.arange(len(found.field)))
    layout = space(found.kind)
    if found.kind == "orientation":
        layout["scene"] |= {
            f"{a}axis": {"title": {"text": f"joint {k}"}} for k, a in enumerate("xyz", 1)
        }
    return {"data": drawn, "layout": layout}, scale


def _draw_arrows(
    places: np.ndarray, field: np.ndarray, scale: float, kind: str, numbers: np.ndarray
) -> list[Spec]:
    """Draw arrows with their sizes as hover texts, a part of them if there are many."""
    kept = select_evenly(len(places), MAX_ARROWS)
    places, field, numbers = places[kept], field[kept], numbers[kept]
    sizes = np.linalg.norm(field, axis=1)
    words = [f"{n}: {with_unit(size, SI[kind])}" for n, size in zip(numbers, sizes, strict=True)]
    return arrows(places, field, scale, words, 1e3 if kind == "position" else 1.0)


def _add_scale_arrow(
    traces: list[Spec], places: np.ndarray, field: np.ndarray, scale: float, kind: str
) -> Spec:
    """Add a length to compare arrows with, outside the lowest corner, where no arrow covers it."""
    size, low = typical(field), places.min(axis=0)
    x, y, z = (1e3 if kind == "position" else 1.0) * (low - 0.1 * (places.max(axis=0) - low))
    long = (1e3 if kind == "position" else 1.0) * scale * size
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
