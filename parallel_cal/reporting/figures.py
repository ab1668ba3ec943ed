"""The 2D figures of a report as Plotly specifications, which the page draws."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from parallel_cal.discovery.shape import Shape
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.reporting.colours import ACCENT, BAND, MEASURED, PATTERN, QUIET, WARNING
from parallel_cal.reporting.contents import DescribedParameter
from parallel_cal.reporting.error_steps import FallingError, Step
from parallel_cal.reporting.readable import error_unit, number, value_unit, with_sigma

Spec = dict[str, Any]
LEGEND = {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0}
GAP = 0.11  # between panels side by side, part of the width: for the numbers and title of an axis
# px: a row of panels, the numbers and title of an axis below it, each further line of a title
ROW, BELOW_ROW, LINE = 160, 46, 16
MAX_MOVED_TOLERANCES = 5.0  # tolerances from which a parameter is marked


def select_evenly(n: int, most: int) -> np.ndarray:
    """Choose a limited number of indices of n, evenly spread, to keep the page small."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))


def select_points(
    numbers: np.ndarray, shown: np.ndarray | None, most: int
) -> tuple[np.ndarray, str]:
    """Choose at most so many samples (indices) by their numbers (N,), of those that are `shown`
    elsewhere (all if None), evenly spread; and name them, with their share if it is not all."""
    which = np.arange(len(numbers)) if shown is None else np.flatnonzero(np.isin(numbers, shown))
    chosen = which[select_evenly(len(which), most)]
    share = f" ({len(chosen)} of {len(numbers)})" if len(chosen) < len(numbers) else ""
    return chosen, f"measured{share}"


def side_by_side(
    panels: Sequence[Sequence[Spec]],
    axes: Sequence[tuple[str, str]],
    heights: Sequence[float],
    columns: int = 3,
) -> Spec:
    """Draw small multiples as one figure from the traces and axis titles (x, y) of each panel.

    A title x may have two lines. The legend names the traces of the first panel.
    """
    data: list[Spec] = []
    layout: Spec = {}
    rows, wide = max(-(-len(panels) // columns), 1), min(columns, max(len(panels), 1))
    lines = max((across.count("\n") for across, _ in axes), default=0)
    below = BELOW_ROW + LINE * lines
    whole = rows * ROW + (rows - 1) * below
    width, height = (1 - GAP * (wide - 1)) / wide, ROW / whole
    for k, (traces, (across, up)) in enumerate(zip(panels, axes, strict=True)):
        mark, (row, column) = str(k + 1) if k else "", divmod(k, columns)
        data += [
            {"showlegend": not k} | t | {"xaxis": f"x{mark}", "yaxis": f"y{mark}"} for t in traces
        ]
        left, low = column * (width + GAP), 1 - row * (ROW + below) / whole - height
        layout[f"xaxis{mark}"] = {
            "domain": [left, min(left + width, 1.0)],
            "anchor": f"y{mark}",
            "title": {"text": escape(across).replace("\n", "<br>"), "standoff": 4},
            "nticks": 6,
        }
        layout[f"yaxis{mark}"] = {
            "domain": [max(low, 0.0), min(low + height, 1.0)],
            "anchor": f"x{mark}",
            "title": {"text": escape(up), "standoff": 4},
            "range": list(heights),
            "nticks": 5,
        }
    margin = {"t": 44, "r": 8, "l": 48, "b": below}
    height = whole + margin["t"] + margin["b"]
    about = {"height": height, "showlegend": True, "legend": LEGEND, "margin": margin}
    return {"data": data, "layout": layout | about}


def circles(
    panels: Sequence[Sequence[Spec]],
    names: Sequence[str],
    sector: tuple[float, float],
    size: float,
    unit: str,
    columns: int = 3,
) -> Spec:
    """Draw polar small multiples as one figure with radii from -size to size."""
    rows, wide = -(-len(panels) // columns), min(columns, len(panels))
    data: list[Spec] = []
    layout: Spec = {"annotations": []}
    for k, (traces, name) in enumerate(zip(panels, names, strict=True)):
        mark, (row, column) = f"polar{k + 1 if k else ''}", divmod(k, columns)
        data += [
            t | {"type": "scatterpolar", "subplot": mark, "showlegend": not k and i > 0}
            for i, t in enumerate(traces)
        ]
        x, y = (
            [column / wide, (column + 0.92) / wide],
            [1 - (row + 1) / rows, 1 - (row + 0.1) / rows],
        )
        ticks = [-size / 2, 0.0, size / 2]
        layout[mark] = {
            "domain": {"x": x, "y": y},
            "sector": list(sector),
            "bgcolor": "rgba(0,0,0,0)",
            "radialaxis": {
                "range": [-2 * size, size],
                "tickvals": ticks,
                "angle": sector[0],
                "ticktext": [f"{t:+.2g}" if t else f"0 {unit}" for t in ticks],
                "tickfont": {"size": 10},
                "gridcolor": BAND,
            },
            "angularaxis": {
                "nticks": 12,
                "tickfont": {"size": 10},
                "ticksuffix": "°",
                "gridcolor": BAND,
            },
        }
        layout["annotations"].append(
            {
                "text": escape(name),
                "x": x[0],
                "xanchor": "left",
                "y": y[0],
                "yanchor": "bottom",
                "xref": "paper",
                "yref": "paper",
                "showarrow": False,
            }
        )
    about = {"height": 60 + 300 * rows, "showlegend": True, "legend": LEGEND}
    return {
        "data": data,
        "layout": layout | about | {"margin": {"t": 44, "r": 30, "l": 30, "b": 30}},
    }


def round_values(values: np.ndarray) -> list[float]:
    """Round to five digits: a figure needs no more, and the page is smaller."""
    return [float(f"{v:.5g}") for v in values.tolist()]


def round_with_gaps(values: np.ndarray) -> list[float | None]:
    """Round like `round_values`; an unknown number becomes None, a gap in the line."""
    return [float(f"{v:.5g}") if math.isfinite(v) else None for v in values.ravel().tolist()]


def find_steps(
    rows: Sequence[Mapping[str, Any]], floor: Summary, kind: str, si: str
) -> FallingError:
    """Return the validation errors of a kind, step by step, with the noise floor; `si` is the unit
    of the kind."""
    steps: list[Step] = []
    samples: list[tuple[Any, ...]] = []
    for row in rows:
        error = row["error"].rms(kind)
        if not error:
            continue
        judged_on = row["sha256"], row["samples"], tuple(row["excluded"])
        same = not samples or samples[-1] == judged_on
        about = f"{row['samples']} samples, data {row['sha256'][:12]}"
        before = len(steps) - 1 if steps else None
        steps.append(Step(row["name"], error, before, 0, same, about))
        samples.append(judged_on)
    return FallingError(kind, steps, noise=floor.rms(kind), words=f"{kind}, rms", unit=si)


def parameter_bars(parameters: Mapping[str, DescribedParameter]) -> Spec:
    """Draw how far every free parameter moved from nominal, in tolerances, with 1 sigma."""
    rows = [p for p in parameters.values() if not p.fixed][::-1]
    sigma = [p.sigma_tolerances or 0.0 for p in rows]
    colours = []
    for p in rows:
        moved_far = abs(p.moved_tolerances) > MAX_MOVED_TOLERANCES
        colours.append(QUIET if p.sigma is None else WARNING if moved_far else ACCENT)
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [p.moved_tolerances for p in rows],
        "y": [escape(p.shown_name) for p in rows],
        "error_x": {"array": sigma, "thickness": 1.2, "width": 2, "color": QUIET},
        "marker": {"color": colours},
        "hovertext": [describe_parameter(p) for p in rows],
        "hoverinfo": "text",
    }
    return {
        "data": [bars],
        "layout": {
            "height": 90 + 16 * len(rows),
            "bargap": 0.35,
            "xaxis": {"title": {"text": "moved from nominal [tolerances], bars 1 σ"}},
            "yaxis": {"tickfont": {"size": 10}, "showgrid": False, "dtick": 1},
            "margin": {"t": 8, "r": 12},
        },
    }


def describe_parameter(p: DescribedParameter) -> str:
    unit, factor = value_unit(p.unit)
    value, nominal = (number(v, factor, 6) for v in (p.value, p.nominal))
    if p.sigma is not None:
        value = with_sigma(p.value, p.sigma, factor)
    state = ", fixed" if p.fixed else ", not identified" if p.sigma is None else ""
    return f"{escape(p.words)}: {value} {unit}{state}, nominal {nominal}"


def law_over_shape(shape: Shape) -> Spec:
    """Draw an error along its driver without a formula, with its band of 2 sigma, and the law."""
    unit, factor = error_unit(shape.unit)
    along = round_values(shape.along)
    error, law = shape.error * factor, shape.law * factor
    band = 2 * shape.sigma * factor
    edges = {
        "type": "scatter",
        "mode": "lines",
        "x": along + along[::-1],
        "y": round_values(error + band) + round_values(error - band)[::-1],
        "fill": "toself",
        "fillcolor": BAND,
        "line": {"width": 0},
        "hoverinfo": "skip",
        "name": "2 sigma",
    }
    curves = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": along,
            "y": round_values(values),
            "name": name,
            "line": {"color": colour, "width": 3, "dash": dash},
        }
        for values, name, colour, dash in (
            (error, "without a formula", MEASURED, "solid"),
            (law, "the law", PATTERN, "dash"),
        )
    ]
    across = f" [{shape.driver_unit}]" if shape.driver_unit != "1" else ""
    return {
        "data": [edges, *curves],
        "layout": {
            "height": 320,
            "xaxis": {"title": {"text": escape(shape.driver + across)}},
            "yaxis": {"title": {"text": f"error [{unit}]"}},
            "legend": LEGEND,
            "margin": {"t": 44, "r": 16},
        },
    }
