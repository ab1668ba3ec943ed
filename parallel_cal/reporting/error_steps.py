"""The picture "how the error fell", step by step and branch by branch: of the page and reports.

It needs no NumPy, so that the page can draw it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import wrap
from typing import Any

from parallel_cal.base.units import ERROR_SI_UNITS
from parallel_cal.reporting.axes import draw_noise_floor, log_axis
from parallel_cal.reporting.colours import BAND, MEASURED
from parallel_cal.reporting.readable import error_unit, number

BEFORE = "before calibration"  # name of the first step
DOTTED = "A dotted line leads to an error at other samples (hollow circle)."
# Of the branches, the one in use first (Okabe and Ito).
BRANCH_COLOURS = (MEASURED, "#cc79a7", "#009e73", "#e69f00", "#56b4e9")
MAX_LABEL_WIDTH, MAX_LABEL_LINES = 14, 3  # of the name of a step below the axis
# With more steps their labels stand upright on most screens: one line each, and a higher picture.
MANY_STEPS, MAX_UPRIGHT_WIDTH = 6, 26
HEIGHT, HEIGHT_OF_MANY = 230, 320
BAR_WIDTH = 0.5  # of the distance between two steps
MAX_LINEAR_RATIO = 5.0  # of two errors: beside a larger one, what is left could not be compared
MAX_LEVEL_RATIO = 1.05  # of two errors whose line is so flat that it crosses no label


@dataclass(frozen=True)
class Step:
    """A step with its error (m or rad); `before` is the index of the step that it follows.

    `is_comparable` is false if the two errors are of different samples.
    """

    name: str
    error: float
    before: int | None = None
    branch: int = 0
    is_comparable: bool = True
    details: str = ""


@dataclass(frozen=True)
class FallingError:
    """The steps of all branches in the order in which they are drawn; `noise` is the floor."""

    kind: str
    steps: Sequence[Step]
    branches: Sequence[str] = ("",)
    noise: float | None = None
    now: int | None = None  # index of the step whose model is on the page
    words: str = "validation error"
    unit: str = ""  # SI; needed for kinds whose unit depends on the joints


def draw_steps(found: FallingError) -> dict[str, Any]:
    """Draw the errors over the steps as bars from zero, with the noise floor."""
    unit, factor = error_unit(found.unit or ERROR_SI_UNITS[found.kind])
    values = [factor * step.error for step in found.steps]
    noise = factor * found.noise if found.noise else None
    ends = [-0.4, len(values) - 0.4]
    # The label of the floor stands in the title: in a low figure, the band has no room for it.
    floor = f"grey: noise floor {number(noise)}" if noise else "noise floor not known"
    title = f"{found.words} [{unit}]; {floor}"
    axis = _make_axis(values, noise)
    bottom = 10 ** axis["range"][0] if axis["type"] == "log" else 0.0
    many = len(found.steps) > MANY_STEPS
    width, most = (MAX_UPRIGHT_WIDTH, 1) if many else (MAX_LABEL_WIDTH, MAX_LABEL_LINES)
    return {
        "data": [
            *_draw_bars(found.steps, values),
            *([_draw_band(ends, bottom, noise)] if noise else []),
            *([draw_noise_floor(noise, ends, unit)[0]] if noise else []),
            *_draw_lines(found.steps, values),
            *_draw_points(found, values, unit),
        ],
        "layout": {
            "height": HEIGHT_OF_MANY if len(values) > MANY_STEPS else HEIGHT,
            # An upright title would be longer than an axis above upright labels.
            "title": {
                "text": escape(title),
                "font": {"size": 12},
                "x": 0,
                "xanchor": "left",
                "y": 1,
                "yanchor": "top",
                "pad": {"t": 4, "l": 4},
            },
            "margin": {"t": 44, "r": 28, "l": 40, "b": 48},
            "showlegend": False,
            "barmode": "overlay",
            "xaxis": {
                "tickvals": list(range(len(values))),
                "ticktext": [_shorten(step.name, width, most) for step in found.steps],
                "range": ends,
                # Plotly chooses the first angle at which no labels overlap. At any slanted angle it
                # omits the last label, which extends beyond the axis.
                "autotickangles": [0, 90],
                "ticklabeloverflow": "allow",
                "showgrid": False,
                "zeroline": False,
                "automargin": True,
            },
            "yaxis": axis,
        },
        "config": {"displaylogo": False, "displayModeBar": False},
    }


def describe_steps(found: FallingError) -> str:
    """Describe the picture for a screen reader."""
    unit, factor = error_unit(found.unit or ERROR_SI_UNITS[found.kind])
    steps = ", ".join(f"{step.name} {number(step.error, factor)} {unit}" for step in found.steps)
    floor = f"{number(found.noise, factor)} {unit}" if found.noise else "not known"
    return f"{found.words} over the steps: {steps}; noise floor {floor}"


def _make_axis(values: Sequence[float], noise: float | None) -> dict[str, Any]:
    """Make an axis from zero, or a logarithmic one if the errors differ too much for it."""
    known = [*([noise] if noise else []), *values]
    if values and max(values) > MAX_LINEAR_RATIO * min(values):
        return log_axis(known)
    top = 1.25 * max(known, default=1.0)
    return {"type": "linear", "range": [0.0, top], "nticks": 5, "title": {"text": ""}}


def _draw_bars(steps: Sequence[Step], values: Sequence[float]) -> Iterator[dict[str, Any]]:
    """Draw a pale bar for each step, in the colour of its branch."""
    for branch in sorted({step.branch for step in steps}):
        own = [k for k, step in enumerate(steps) if step.branch == branch]
        yield {
            "type": "bar",
            "x": own,
            "y": [values[k] for k in own],
            "width": BAR_WIDTH,
            "marker": {"color": _colour(branch), "opacity": 0.3},
            "hoverinfo": "skip",
        }


def _draw_band(ends: Sequence[float], bottom: float, noise: float) -> dict[str, Any]:
    """Draw the grey band up to the noise floor: what rises above it is an error of the model."""
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [ends[0], ends[1], ends[1], ends[0]],
        "y": [bottom, bottom, noise, noise],
        "fill": "toself",
        "fillcolor": BAND,
        "line": {"width": 0},
        "hoverinfo": "skip",
    }


def _draw_lines(steps: Sequence[Step], values: Sequence[float]) -> Iterator[dict[str, Any]]:
    """Draw a line from each step to its successors; a dotted one if the samples changed."""
    for branch in sorted({step.branch for step in steps}):
        for same, dash in ((True, "solid"), (False, "dot")):
            ends = [
                (step.before, k)
                for k, step in enumerate(steps)
                if step.branch == branch and step.before is not None and step.is_comparable == same
            ]
            if ends:
                yield {
                    "type": "scatter",
                    "mode": "lines",
                    "x": [x for pair in ends for x in (*pair, None)],
                    "y": [y for a, b in ends for y in (values[a], values[b], None)],
                    "line": {"color": _colour(branch), "width": 2, "dash": dash},
                    "hoverinfo": "skip",
                }


def _draw_points(
    found: FallingError, values: Sequence[float], unit: str
) -> Iterator[dict[str, Any]]:
    names = found.branches if len(found.branches) > 1 else ()
    for branch in sorted({step.branch for step in found.steps}):
        own = [k for k, step in enumerate(found.steps) if step.branch == branch]
        yield {
            "type": "scatter",
            "mode": "markers+text",
            "x": own,
            "y": [values[k] for k in own],
            "text": [
                f"<b>{escape(names[branch])}</b><br>{number(values[k])}"
                if names and k == own[-1]
                else number(values[k])
                for k in own
            ],
            "textposition": [
                "top center" if names and k == own[-1] else _place_label(found.steps, k)
                for k in own
            ],
            "hovertext": [
                "<br>".join(
                    filter(
                        None,
                        (
                            escape(found.steps[k].name),
                            f"{number(values[k])} {unit}",
                            escape(found.steps[k].details),
                        ),
                    )
                )
                for k in own
            ],
            "hoverinfo": "text",
            "marker": {
                "color": _colour(branch),
                "size": [13 if k == found.now else 8 for k in own],
                "symbol": [
                    "circle" if found.steps[k].is_comparable else "circle-open" for k in own
                ],
            },
            "cliponaxis": False,
        }


def _place_label(steps: Sequence[Step], k: int) -> str:
    """Choose the place of a step's label that no line from or to the step crosses."""
    error, before = steps[k].error, steps[k].before
    falls = before is not None and steps[before].error > MAX_LEVEL_RATIO * error
    rises = any(step.before == k and step.error > MAX_LEVEL_RATIO * error for step in steps)
    if falls and rises:
        return "bottom center"
    return "top right" if falls else "top left" if rises else "top center"


def _colour(branch: int) -> str:
    return BRANCH_COLOURS[branch % len(BRANCH_COLOURS)]


def _shorten(name: str, width: int, most: int) -> str:
    lines = wrap(name, width, break_long_words=False, break_on_hyphens=False) or [""]
    more = " …" if len(lines) > most else ""
    shown = "<br>".join(map(escape, lines[:most]))
    return f"{shown.removesuffix(',')}{more}" if more else shown
