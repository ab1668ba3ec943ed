"""The picture of the page: how the error falls, step by step and branch by branch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import wrap
from typing import Any

from parallel_cal.base.units import ERROR_SI_UNITS, ERROR_UNITS
from parallel_cal.reporting.axes import draw_noise_floor, log_axis
from parallel_cal.reporting.colours import MEASURED
from parallel_cal.reporting.readable import error_unit, number
from parallel_cal.session.history import History, State

# Of the branches, the one in use first (Okabe and Ito).
BRANCH_COLOURS = (MEASURED, "#cc79a7", "#009e73", "#e69f00", "#56b4e9")
MAX_LABEL_WIDTH, MAX_LABEL_LINES = 14, 2  # of the name of a step below the axis
HEIGHT = 230


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


def find_steps(history: History) -> FallingError | None:
    """Return the errors of all branches of a session; None if no model was fitted yet."""
    record = history.record
    names = [record.branch, *(name for name in record.branches if name != record.branch)]
    paths = [history.history(name) for name in names]
    kind = next((k for k in ERROR_UNITS for path in paths for s in path if _error(s, k)), None)
    if kind is None:
        return None
    steps: list[Step] = []
    drawn: dict[int, int] = {}  # number of a state -> index of the step that shows it
    for branch, path in enumerate(paths):
        shown: tuple[int, State] | None = None  # the last step of this path
        for parent, state in zip([None, *path], path, strict=False):
            if state.number in drawn:
                shown = drawn[state.number], state
                continue
            error = _error(state, kind)
            if error is None:
                continue
            if shown is None and (first := _positive(state.before.get(f"{kind}_rms"))):
                # The state before the first fit has no errors of its own.
                steps.append(Step("before calibration", first, branch=branch))
                shown = len(steps) - 1, state
            if shown and parent and error == _error(parent, kind):
                drawn[state.number] = shown[0]  # a saved model: the error is the same
                continue
            same = shown is None or _samples(shown[1]) == _samples(state)
            before = shown[0] if shown else None
            count = len(state.excluded)
            about = f"{count} excluded sample{'' if count == 1 else 's'}" if count else ""
            steps.append(Step(state.step, error, before, branch, same, about))
            drawn[state.number] = len(steps) - 1
            shown = len(steps) - 1, state
    noise = next((n for s in reversed(paths[0]) if (n := s.noise.get(f"{kind}_rms"))), None)
    return FallingError(kind, steps, names, noise, drawn.get(history.state.number))


def draw_steps(found: FallingError) -> dict[str, Any]:
    """Draw the errors over the steps on a logarithmic axis, with the noise floor."""
    unit, factor = error_unit(ERROR_SI_UNITS[found.kind])
    values = [factor * step.error for step in found.steps]
    noise = factor * found.noise if found.noise else None
    ends = [-0.4, len(values) - 0.4]
    floor = draw_noise_floor(noise, ends, unit) if noise else ()
    return {
        "data": [
            *floor[:1],
            *_draw_lines(found.steps, values),
            *_draw_points(found, values, unit),
        ],
        "layout": {
            "height": HEIGHT,
            "margin": {"t": 30, "r": 12, "l": 56, "b": 48},
            "showlegend": False,
            "xaxis": {
                "tickvals": list(range(len(values))),
                "ticktext": [_shorten(step.name) for step in found.steps],
                "range": ends,
                "showgrid": False,
                "zeroline": False,
                "automargin": True,
            },
            "yaxis": log_axis([noise, *values], f"{found.words} [{unit}]"),
            "annotations": [*floor[1:]],
        },
        "config": {"displaylogo": False, "displayModeBar": False},
    }


def describe_steps(found: FallingError) -> str:
    """Describe the picture for a screen reader."""
    unit, factor = error_unit(ERROR_SI_UNITS[found.kind])
    steps = ", ".join(f"{step.name} {number(step.error, factor)} {unit}" for step in found.steps)
    floor = f"; noise floor {number(found.noise, factor)} {unit}" if found.noise else ""
    return f"{found.words} over the steps: {steps}{floor}"


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
            "textposition": "top center",
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


def _colour(branch: int) -> str:
    return BRANCH_COLOURS[branch % len(BRANCH_COLOURS)]


def _shorten(name: str) -> str:
    lines = wrap(name, MAX_LABEL_WIDTH) or [""]
    more = " …" if len(lines) > MAX_LABEL_LINES else ""
    return "<br>".join(map(escape, lines[:MAX_LABEL_LINES])) + more


def _positive(value: float | None) -> float | None:
    return value if value and value > 0 else None


def _error(state: State, kind: str) -> float | None:
    return _positive(state.errors.get(f"{kind}_rms"))


def _samples(state: State) -> tuple[str, Mapping[int, str]]:
    """What decides which samples judge a state."""
    return state.taken, dict.fromkeys(state.excluded, "")
