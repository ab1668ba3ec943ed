"""The card What to measure next: advice, planned poses, what they tell, and their files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nicegui import run, ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import read_text
from parallel_cal.reporting.axes import space
from parallel_cal.reporting.colours import PATTERN, QUIET
from parallel_cal.reporting.names import name_effects
from parallel_cal.reporting.readable import write_micro
from parallel_cal.workbench.bench import Bench, Live
from parallel_cal.workbench.next_step import USUAL_POSES
from parallel_cal.workbench.widgets import card, draw_figure

PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")  # columns of planned poses


@dataclass(frozen=True)
class PlanWords:
    """What names one of the two tables of poses on the page."""

    id: str
    send: str
    figure: str


PLANNED = PlanWords("sent", "Send to the robot", "planned and measured poses")
DISTINGUISHING = PlanWords(
    "sent-distinguishing", "Send one that distinguishes effects", "poses that distinguish effects"
)


@dataclass(frozen=True)
class PlannedPoses:
    """The text of a file of planned poses, its remarks, and its numbers by column name."""

    text: str
    remarks: list[str]
    rows: list[dict[str, float]]

    @classmethod
    def parse(cls, text: str) -> PlannedPoses:
        lines = text.splitlines()
        remarks = [line.removeprefix("# ") for line in lines if line.startswith("#")]
        header, *rows = csv.reader(line for line in lines if not line.startswith("#"))
        names = [word.split(" [")[0] for word in header]
        numbers = [dict(zip(names, map(float, row), strict=True)) for row in rows]
        return cls(text, remarks, numbers)


def draw_plan_card(bench: Bench, view: dict[str, Any]) -> None:
    """Draw the card of a complete view."""
    with card("What to measure next").props("id=plan tabindex=-1"):
        for advice in view["advice"]:
            ui.label(name_effects(write_micro(advice)))
        if separation := view["separation"]:
            poses = PlannedPoses.parse(separation)
            _draw_poses(bench, view, poses, "distinguish_effects.csv", DISTINGUISHING)
        file = bench.planned
        planned = PlannedPoses.parse(read_text(file)) if file else None
        with ui.row().classes("items-center"):
            usual = len(planned.rows) if planned else USUAL_POSES
            count = ui.number("poses", value=usual, min=1, max=500, precision=0).classes("w-24")
            plan = ui.button(
                "Plan", on_click=lambda: bench.begin("plan", int(count.value or usual))
            )
            plan.props("dense outline").set_enabled(not bench.busy)
            ui.label("poses that determine the free parameters of this step").classes("quiet")
        if file and planned:
            _draw_poses(bench, view, planned, file.name, PLANNED)


def show_plan_card() -> None:
    """Bring the card into view, and the keyboard to it."""
    ui.run_javascript("plan.scrollIntoView(); plan.focus({preventScroll: true})")


def _draw_poses(
    bench: Bench, view: dict[str, Any], planned: PlannedPoses, file: str, words: PlanWords
) -> None:
    """Draw planned poses with what they tell and how to reach them."""
    with ui.column().classes("gap-0"):
        for remark in planned.remarks:
            ui.label(name_effects(write_micro(remark))).classes("text-sm")
    with ui.row().classes("items-center"):
        ui.button(
            "Download CSV", on_click=lambda: ui.download(planned.text.encode(), file, "text/csv")
        ).props(f'dense outline aria-label="download {file}"')
        ui.label("lengths in m, angles in rad; each column states its unit").classes("quiet")
    if bench.live is not None:
        _send(bench.live, planned.rows, words)
    poses = [[1e3 * row[k] for k in PLACE] for row in planned.rows]
    traces = [
        {
            "type": "scatter3d",
            "mode": "markers",
            "name": name,
            **{k: [p[i] for p in places] for i, k in enumerate("xyz")},
            "marker": {"size": size, "color": colour},
        }
        for name, places, size, colour in (
            ("measured", view["residuals"]["place"], 2, QUIET),
            ("planned", poses, 5, PATTERN),
        )
    ]
    legend = {"x": 0, "y": 1, "bgcolor": "rgba(0,0,0,0)"}
    layout = space("position") | {"height": 420, "legend": legend}
    draw_figure({"data": traces, "layout": layout}, words.figure)


def _send(live: Live, rows: Sequence[dict[str, float]], words: PlanWords) -> None:
    """Let a click send the next planned pose to the robot."""
    with ui.row().classes("items-center"):
        at = ui.number("pose", value=1, min=1, max=len(rows), precision=0).classes("w-24")
        answer = ui.label().props(f"id={words.id} aria-live=polite")

        async def send() -> None:
            k = int(at.value or 1)
            pose = [[rows[k - 1][key] for key in keys] for keys in (PLACE, TURN)]
            try:
                answer.set_text(f"pose {k}: {await run.io_bound(live.send, *pose)}")
                at.set_value(min(k + 1, len(rows)))
            except ParallelCalError as error:
                answer.set_text(str(error))

        ui.button(words.send, on_click=send).props("dense outline")
