"""The page of a fleet: robots by error, over time, missing effects; each robot has a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from datetime import datetime, timezone
from html import escape
from pathlib import Path
from urllib.parse import quote, unquote

from parallel_cal.base.files import write_atomically
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.fleet.findings import Change, Deviation, Drift, Findings
from parallel_cal.fleet.fleet import Fleet
from parallel_cal.fleet.judging import Row, sort_recordings
from parallel_cal.fleet.rows import KINDS
from parallel_cal.reporting.axes import log_axis
from parallel_cal.reporting.blocks import Cell
from parallel_cal.reporting.colours import ACCENT, MEASURED, QUIET, WARNING
from parallel_cal.reporting.figures import LEGEND, Spec
from parallel_cal.reporting.fleets import (
    effect_in_words,
    kind_of,
    together_in_words,
    verdicts_in_words,
)
from parallel_cal.reporting.markup import Plot, items, paragraph, section, sentence, table
from parallel_cal.reporting.page import PageBuilder, page, plotly
from parallel_cal.reporting.readable import (
    error_unit,
    number,
    round_to_sigma,
    value_unit,
    with_unit,
)
from parallel_cal.reporting.report import report_of

LIBRARY = "plotly.min.js"  # next to the robots' reports, which share it
WHEN = {"before": "before", "identified": "fitted", "after": "with effects found"}


def robot_page(found: Diagnosis) -> str:
    """Render the report of one robot."""
    return page(report_of(found, vars(found.base.fitted.options)), LIBRARY)


def write_fleet_page(fleet: Fleet, folder: Path) -> None:
    """Write `fleet.html` and the library that the robots' reports share."""
    pages = {unquote(path.stem) for path in (folder / "reports").glob("*.html")}
    write_atomically(folder / "reports" / LIBRARY, plotly())
    write_atomically(folder / "fleet.html", fleet_page(fleet, pages))


def fleet_page(fleet: Fleet, reports: Collection[str]) -> str:
    """Render the page of a fleet; `reports` are the robots that have a page in `reports/`."""
    drawn, found = PageBuilder(), fleet.findings
    robots, failed = len({row["robot"] for row in fleet.rows}), fleet.failed
    title = f"{robots} robots, {len(fleet.rows)} recordings"
    failures = paragraph("Every recording was judged.", "none")
    if failed:
        rows = [(row["robot"], row["recording"], row["reason"]) for row in failed]
        failures = table(("robot", "recording", "reason"), rows)
    verdicts = verdicts_in_words(fleet, VERDICT_LABELS.__getitem__)
    parts = [
        section("Verdicts", paragraph(sentence(verdicts), "verdict")),
        section("Findings", _render_findings(found)),
        section("Robots by error", _by_error(fleet, drawn.plot) + _robots(fleet, reports)),
        section("Robots over time", _over_time(fleet, drawn.plot)),
        section("Missing effects", _render_effects(fleet, drawn.plot)),
        section("Fleet compared with the drawing", _spreads(found, drawn.plot)),
        section("Failed", failures, f"{len(failed)}", closed=not failed),
    ]
    return drawn.page_of(title, parts)


def _render_findings(found: Findings | None) -> str:
    """Render the effects of the fleet, its outliers and its changes."""
    if found is None:
        return paragraph("Fewer than four robots: no findings on the fleet as a whole.", "none")
    findings = [*together_in_words(found, _plus_minus)]
    findings += [f"{robot}: another mechanism than {found.mechanism}" for robot in found.others]
    return items(findings) or paragraph("No robot is an outlier, and none changes.", "none")


def _plus_minus(value: float, sigma: float, unit: str) -> str:
    name, factor = value_unit(unit)
    return f"{' ± '.join(round_to_sigma(value, sigma, factor))} {name}"


def _last(fleet: Fleet) -> list[Row]:
    """Return the last recording of each robot, the worst first."""
    last = [own[-1] for own in sort_recordings(fleet.judged).values()]
    key = f"{kind_of(fleet)}_rms"
    return sorted(last, key=lambda row: -(row["after"][key] or 0.0))


def _by_error(fleet: Fleet, plot: Plot) -> str:
    """Draw the errors of each robot's last recording: before, fitted, with the effects found."""
    kind, rows = kind_of(fleet), _last(fleet)
    if kind is None:
        return paragraph("No pose was measured.", "none")
    unit, factor = error_unit(KINDS[kind])
    colours = {"before": QUIET, "identified": ACCENT, "after": WARNING}
    traces: list[Spec] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "marker": {"color": colours[when]},
            "x": [escape(row["robot"]) for row in rows],
            "y": [_scale(row[when][f"{kind}_rms"], factor) for row in rows],
            "hovertemplate": f"%{{x}}: %{{y:.3g}} {unit}",
        }
        for when, name in WHEN.items()
    ]
    note = "Validation error of each robot's last recording, worst first."
    layout = {
        "height": 320,
        "showlegend": True,
        "legend": LEGEND,
        "margin": {"t": 40},
        "xaxis": {"type": "category", "nticks": 20},
        "yaxis": log_axis([v for t in traces for v in t["y"]], f"{kind} error, rms [{unit}]"),
    }
    return paragraph(note, "note") + plot({"data": traces, "layout": layout})


def _scale(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _robots(fleet: Fleet, reports: Collection[str]) -> str:
    kind = kind_of(fleet)
    if kind is None:
        return ""
    found = fleet.findings
    apart = _names(found.outlying if found else ())
    changes = _names((*found.drifts, *found.changed) if found else ())
    recordings = Counter(row["robot"] for row in fleet.rows)
    unit = KINDS[kind]
    rows: list[Sequence[Cell | str]] = [
        (
            Cell(name, link=report_name(name) if name in reports else ""),
            str(recordings[name]),
            VERDICT_LABELS[row["verdict"]],
            ", ".join(row["effects"]),
            *(
                Cell(with_unit(value, unit), key=value)
                for value in (row[when][f"{kind}_rms"] for when in WHEN)
            ),
            ", ".join(apart.get(name, [])),
            ", ".join(changes.get(name, [])),
        )
        for row in _last(fleet)
        for name in [row["robot"]]
    ]
    header = ("robot", "recordings", "verdict", "effects", *WHEN.values(), "outliers", "changes")
    return table(header, rows, "sortable", WHEN["after"])


def _names(told: Iterable[Deviation | Drift | Change]) -> dict[str, list[str]]:
    """Group the names of the parameters by robot."""
    names: dict[str, list[str]] = {}
    for one in told:
        names.setdefault(one.robot, []).append(one.name)
    return names


def report_name(robot: str) -> str:
    """Return the path of a robot's report, relative to the fleet's page."""
    return f"reports/{quote(quote(robot, safe=''))}.html"


def _over_time(fleet: Fleet, plot: Plot) -> str:
    """Draw the error of each recording over time, with changing robots in colour."""
    kind = kind_of(fleet)
    rows = [row for row in fleet.judged if row["time"] is not None]
    if kind is None or len({row["time"] for row in rows}) < 2:
        return paragraph("The recordings have no times, or only one.", "none")
    unit, factor = error_unit(KINDS[kind])
    found = fleet.findings
    changing = set(_names((*found.drifts, *found.changed))) if found else set()
    traces: list[Spec] = []
    for robot in sorted({row["robot"] for row in rows}, key=lambda name: name in changing):
        own = sorted((row for row in rows if row["robot"] == robot), key=lambda row: row["time"])
        colour = WARNING if robot in changing else QUIET
        traces.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": escape(robot),
                "x": [datetime.fromtimestamp(row["time"], timezone.utc).isoformat() for row in own],
                "y": [_scale(row["before"][f"{kind}_rms"], factor) for row in own],
                "line": {"color": colour, "width": 2 if robot in changing else 1},
                "opacity": 1.0 if robot in changing else 0.4,
                "hovertemplate": f"{escape(robot)}: %{{y:.3g}} {unit}<extra></extra>",
            }
        )
    layout = {
        "height": 300,
        "showlegend": False,
        "yaxis": {"title": {"text": f"{kind} error before, rms [{unit}]"}},
    }
    note = f"In colour: {', '.join(sorted(changing))}." if changing else "No robot changes."
    return paragraph(note, "note") + plot({"data": traces, "layout": layout})


def _render_effects(fleet: Fleet, plot: Plot) -> str:
    """Render how many robots have each effect, and the statistics of its parameters."""
    found = fleet.findings
    if found is None or not found.effects:
        return paragraph("No effect was found in most recordings of any robot.", "none")
    upwards = found.effects[::-1]
    bars = {
        "type": "bar",
        "orientation": "h",
        "y": [effect.name for effect in upwards],
        "x": [len(effect.robots) for effect in upwards],
        "marker": {"color": [WARNING if e.kind == "fault" else ACCENT for e in upwards]},
        "hovertext": [escape(effect_in_words(effect)) for effect in upwards],
        "hoverinfo": "text",
    }
    layout = {
        "height": 90 + 30 * len(upwards),
        "xaxis": {"title": {"text": "number of robots"}, "range": [0, len(found.robots)]},
        "yaxis": {"dtick": 1, "ticks": "outside", "tickcolor": "rgba(0,0,0,0)"},
        "bargap": 0.4,
    }
    rows = []
    for effect in found.effects:
        for one in effect.numbers:
            name, factor = error_unit(one.unit)
            mean, sigma = round_to_sigma(one.mean, one.sigma, factor)
            rows.append(
                (
                    one.name,
                    f"{mean} ± {sigma} {name}",
                    with_unit(one.spread, one.unit),
                    f"{number(one.low, factor)} … {number(one.high, factor)} {name}",
                )
            )
    shown = table(("parameter", "mean", "spread", "95 %"), rows)
    return plot({"data": [bars], "layout": layout}) + shown


def _spreads(found: Findings | None, plot: Plot) -> str:
    """Draw the fleet's spread and mean of each parameter, in tolerances of the drawing."""
    if found is None:
        return paragraph("Fewer than four robots: no findings on the fleet as a whole.", "none")
    rows = found.parameters[::-1]
    share = [one.spread / one.tolerance for one in rows]
    traces: list[Spec] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": "spread, 95 % interval",
            "y": [escape(one.name) for one in rows],
            "x": share,
            "marker": {"color": MEASURED},
            "error_x": {
                "array": [one.high / one.tolerance - s for one, s in zip(rows, share, strict=True)],
                "arrayminus": [
                    s - one.low / one.tolerance for one, s in zip(rows, share, strict=True)
                ],
                "color": MEASURED,
                "thickness": 1,
            },
        },
        {
            "type": "scatter",
            "mode": "markers",
            "name": "mean minus nominal, 1 σ",
            "y": [escape(one.name) for one in rows],
            "x": [(one.mean - one.nominal) / one.tolerance for one in rows],
            "error_x": {
                "array": [one.sigma / one.tolerance for one in rows],
                "color": WARNING,
                "thickness": 1,
            },
            "marker": {"color": WARNING, "symbol": "diamond-open"},
        },
    ]
    layout = {
        "height": 110 + 16 * len(rows),
        "showlegend": True,
        "legend": LEGEND,
        "margin": {"t": 40},
        "xaxis": {"title": {"text": "tolerances of the drawing"}},
        "yaxis": {"dtick": 1, "tickfont": {"size": 10}},
    }
    note = (
        "next_robot.yaml contains these means and spreads as nominal values and tolerances. With "
        "--prior, the next robot needs fewer poses."
    )
    return paragraph(note, "note") + plot({"data": traces, "layout": layout})
