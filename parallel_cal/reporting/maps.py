"""2D maps in plan, front and side view: residual arrows and model uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.identification.position_uncertainty import PositionUncertainty
from parallel_cal.reporting.arrows import scale_of, typical
from parallel_cal.reporting.axes import name_axis
from parallel_cal.reporting.colours import MEASURED, PATTERN, QUIET
from parallel_cal.reporting.figures import (
    Spec,
    round_values,
    round_with_gaps,
    select_evenly,
    side_by_side,
)
from parallel_cal.reporting.readable import with_unit
from parallel_cal.reporting.spaces import SI

VIEWS = {"plan": (0, 1), "front": (0, 2), "side": (1, 2)}
CORNERS = 37  # points of an ellipse
MAX_ARROWS = 150  # in each of the three views, which are smaller than one view in space


def residuals(
    places: np.ndarray, fields: Sequence[np.ndarray], kind: str, numbers: np.ndarray
) -> tuple[Spec, float]:
    """Draw residual fields (N, 3) at places (N, 3) from three sides; return figure and scale.

    The first field is visible (traces with `meta` 0), the others are hidden (1, ...).
    """
    scale, factor = scale_of(places, fields), 1e3 if kind == "position" else 1.0
    # The largest residuals are drawn last, on top of others at the same place.
    by_size = np.argsort(np.linalg.norm(fields[0], axis=1), kind="stable")
    kept = by_size[select_evenly(len(places), MAX_ARROWS)]
    panels = []
    for axes in VIEWS.values():
        drawn = [
            _arrows(places[kept], field[kept], scale, factor, axes, numbers[kept], kind)
            | {"meta": k, "visible": k == 0}
            for k, field in enumerate(fields)
        ]
        panels.append([*drawn, _bar(places, fields[0], scale, factor, axes, kind)])
    return _three(panels, list(VIEWS.values()), kind), scale


def workspace(found: PositionUncertainty) -> tuple[Spec, float]:
    """Draw the 1-sigma ellipses over the workspace; return the figure and its magnification.

    The colour is the sigma, the square root of the covariance's trace.
    """
    sigma = np.sqrt(np.trace(found.covariance, axis1=1, axis2=2))
    scale = 0.5 * scale_of(found.places, [np.outer(sigma, np.eye(3)[0])])
    views = [axes for axes in VIEWS.values() if all("xyz"[k] in found.across for k in axes)]
    middle = np.median(found.places, axis=0)
    panels = []
    for axes in views:
        (rest,) = {0, 1, 2} - set(axes)
        own = np.isclose(found.places[:, rest], middle[rest], atol=1e-6)
        places, spread = found.places[own], found.covariance[own]
        marks = {
            "type": "scatter",
            "mode": "markers",
            "name": "pose",
            "showlegend": False,
            "x": round_values(1e3 * places[:, axes[0]]),
            "y": round_values(1e3 * places[:, axes[1]]),
            "marker": {
                "size": 7,
                "color": round_values(1e6 * sigma[own]),
                "coloraxis": "coloraxis",
            },
            "text": [f"1 σ {with_unit(s, 'm')}" for s in sigma[own]],
            "hoverinfo": "text",
        }
        ellipses = _ellipses(places, spread, scale, 1e3, axes)
        panels.append([ellipses, marks])
    drawn = _three(panels, views, "position")
    drawn["layout"]["coloraxis"] = {
        "colorscale": "Cividis",
        "cmin": 0.0,
        "cmax": float(f"{1e6 * sigma.max():.3g}"),
        "colorbar": {"title": {"text": "1 σ [µm]"}, "thickness": 12},
    }
    return drawn, scale


def _three(panels: list[list[Spec]], views: list[tuple[int, int]], kind: str) -> Spec:
    """Arrange panels with equal axes, as on a drawing."""
    names = {axes: name for name, axes in VIEWS.items()}
    axes = [
        (f"{names[a, b]}: {name_axis('xyz'[a], kind)}", name_axis("xyz"[b], kind)) for a, b in views
    ]
    drawn = side_by_side(panels, axes, [])
    for k in range(len(panels)):
        mark = str(k + 1) if k else ""
        up = drawn["layout"][f"yaxis{mark}"]
        del up["range"]
        up |= {"scaleanchor": f"x{mark}", "constrain": "domain"}
        drawn["layout"][f"xaxis{mark}"]["constrain"] = "domain"
    drawn["layout"]["height"] = 380
    return drawn


def _arrows(
    places: np.ndarray,
    field: np.ndarray,
    scale: float,
    factor: float,
    axes: tuple[int, int],
    numbers: np.ndarray,
    kind: str,
) -> Spec:
    ends = np.stack([places, places + scale * field, np.full_like(places, np.nan)], axis=1)
    x, y = (factor * ends[:, :, k].ravel() for k in axes)
    sizes = np.linalg.norm(field, axis=1)
    words = [f"{n}: {with_unit(size, SI[kind])}" for n, size in zip(numbers, sizes, strict=True)]
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": "residual",
        "x": round_with_gaps(x),
        "y": round_with_gaps(y),
        "line": {"color": MEASURED, "width": 1.5},
        "marker": {
            "symbol": ["circle", "arrow", "circle"] * len(places),
            "size": [3, 7, 0] * len(places),
            "angleref": "previous",
            "color": MEASURED,
        },
        "text": [text for word in words for text in (word, word, "")],
        "hoverinfo": "text",
        "customdata": np.repeat(numbers, 3).tolist(),
    }


def _ellipses(
    places: np.ndarray,
    covariance: np.ndarray,
    scale: float,
    factor: float,
    axes: tuple[int, int],
) -> Spec:
    """Draw the 1-sigma ellipses of two coordinates at each place, on one scale."""
    two = covariance[np.ix_(range(len(places)), axes, axes)]
    sizes, directions = np.linalg.eigh(two)
    half = directions * np.sqrt(np.maximum(sizes, 0.0))[:, None, :]
    turn = np.linspace(0, 2 * np.pi, CORNERS)
    round_ = scale * half @ np.stack([np.cos(turn), np.sin(turn)])
    edges = factor * (places[:, axes, None] + round_)
    broken = np.concatenate([edges, np.full((len(places), 2, 1), np.nan)], axis=2)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": "1 σ of the model",
        "hoverinfo": "skip",
        "x": round_with_gaps(broken[:, 0].ravel()),
        "y": round_with_gaps(broken[:, 1].ravel()),
        "line": {"color": QUIET, "width": 1},
    }


def _bar(
    places: np.ndarray,
    field: np.ndarray,
    scale: float,
    factor: float,
    axes: tuple[int, int],
    kind: str,
) -> Spec:
    """Draw a length to compare arrows with, below the left end of the figure."""
    size = typical(field)
    low = factor * (places.min(axis=0) - 0.12 * np.ptp(places, axis=0))
    x, y = low[axes[0]], low[axes[1]]
    return {
        "type": "scatter",
        "mode": "lines+markers+text",
        "name": "scale",
        "showlegend": False,
        "x": round_with_gaps(np.array([x, x + factor * scale * size])),
        "y": round_with_gaps(np.array([y, y])),
        "line": {"color": PATTERN, "width": 3},
        "marker": {"color": PATTERN, "size": 4},
        "text": ["", with_unit(size, SI[kind])],
        "textposition": "middle right",
        "hoverinfo": "skip",
    }
