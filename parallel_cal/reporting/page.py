"""One HTML file with everything in it: text, figures, Plotly, style; it loads nothing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from parallel_cal.reporting.readable import day
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.sections import body


def page(report: Report) -> str:
    """The page of a report."""
    from plotly.offline import get_plotlyjs

    drawn: list[Mapping[str, Any]] = []

    def plot(figure: Mapping[str, Any]) -> str:
        drawn.append(figure)
        height = figure["layout"]["height"]
        return f'<div class="plot" data-figure="{len(drawn) - 1}" style="height:{height}px"></div>'

    content = body(report, plot)
    p, samples = report.provenance, len(report.diagnosis.dataset)
    return Template(_text("page.html")).substitute(
        title=escape(f"{p.mechanism} on {report.diagnosis.dataset.source}"),
        made=escape(f"{day(p.made)}, {samples} samples, model {p.model_sha256[:12]}"),
        style=_text("page.css"),
        body=content,
        figures=_in_script(drawn),
        plotly=get_plotlyjs(),
        script=_text("page.js"),
    )


def _text(name: str) -> str:
    return files("parallel_cal.reporting").joinpath(name).read_text(encoding="utf-8")


def _in_script(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
