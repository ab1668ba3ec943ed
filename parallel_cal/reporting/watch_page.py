"""The page of a watch: the answer, the statistic over time, and the suspected parameter."""

from __future__ import annotations

from html import escape

import numpy as np

from parallel_cal.reporting.axes import log_axis
from parallel_cal.reporting.colours import ACCENT, QUIET, WARNING
from parallel_cal.reporting.figures import Spec
from parallel_cal.reporting.markup import Plot, as_html, paragraph, section
from parallel_cal.reporting.page import PageBuilder
from parallel_cal.reporting.readable import error_unit
from parallel_cal.reporting.watching import describe_watch, iso, say_statistic
from parallel_cal.watch.changes import LOOSE
from parallel_cal.watch.confirmation import Confirmation
from parallel_cal.watch.watch import DAY, Watch

SHOWN_FACTOR = 300.0  # of the limit: R is 0 after the first recording, and grows without bounds


def watch_page(watch: Watch, confirmation: Confirmation | None, robot: str) -> str:
    """Make one HTML page of a watch that loads nothing else."""
    drawn = PageBuilder()
    parts = [
        section("Answer", as_html(describe_watch(watch, confirmation))),
        section("Evidence over time", _draw_statistic(watch, drawn.plot)),
    ]
    if len(watch.visits) > 1:
        parts.append(section("The suspected parameter", _draw_parameter(watch, drawn.plot)))
    return drawn.page_of(f"{robot}: has it changed?", parts)


def _draw_statistic(watch: Watch, plot: Plot) -> str:
    """Draw R after each recording, and the mean time between false alarms."""
    limit = watch.false_alarm_days
    time = [iso(point.time) for point in watch.trend]
    low, high = limit / SHOWN_FACTOR, limit * SHOWN_FACTOR
    value = [min(max(point.statistic / DAY, low), high) for point in watch.trend]
    above = [v >= limit for v in value]
    traces: list[Spec] = [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "x": time,
            "y": value,
            "line": {"color": QUIET, "width": 1},
            "marker": {"color": [WARNING if one else ACCENT for one in above]},
            "hovertext": [
                f"{escape(point.recording)}: R = {say_statistic(point.statistic)}"
                for point in watch.trend
            ],
            "hovertemplate": "%{hovertext}<extra></extra>",
        },
        _dashed(time, limit),
    ]
    layout = {"height": 300, "showlegend": False, "yaxis": log_axis([*value, limit], "R [days]")}
    note = (
        "R sums the evidence of all changes. Without a change it exceeds the dashed line, the mean "
        "time between false alarms, no more often than once in that time. Very small and large "
        "values are drawn at the edge."
    )
    return paragraph(note, "note") + plot({"data": traces, "layout": layout})


def _draw_parameter(watch: Watch, plot: Plot) -> str:
    """Draw what each recording alone says of the most probable parameter."""
    best = next((one for one in watch.suspects if one.kind != LOOSE), None)
    if best is None:
        return paragraph("No parameter is suspected.", "none")
    value, sigma = watch.estimate(best.parameter)
    known = np.isfinite(value)
    unit, factor = error_unit(best.unit)
    time = [iso(t) for t, k in zip(watch.series.time, known, strict=True) if k]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": time,
        "y": (factor * value[known]).tolist(),
        "error_y": {"array": (factor * sigma[known]).tolist(), "color": ACCENT, "thickness": 1},
        "marker": {"color": ACCENT},
        "hovertemplate": f"%{{y:.3g}} {unit}<extra></extra>",
    }
    layout = {
        "height": 300,
        "showlegend": False,
        "yaxis": {"title": {"text": f"{escape(best.parameter)} [{unit}]"}},
    }
    note = (
        f"What each recording says of {best.parameter}, if nothing else has changed, with 1 sigma: "
        "its difference from the recordings before the change."
    )
    return paragraph(note, "note") + plot({"data": [trace, _dashed(time, 0.0)], "layout": layout})


def _dashed(time: list[str], value: float) -> Spec:
    return {
        "type": "scatter",
        "mode": "lines",
        "x": [time[0], time[-1]],
        "y": [value, value],
        "line": {"dash": "dash", "color": QUIET},
        "hoverinfo": "skip",
    }
