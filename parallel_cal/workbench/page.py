"""The page, drawn with NiceGUI from a bench's view, and redrawn whenever the bench changes."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import run, ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting.colours import MEASURED, PATTERN, QUIET
from parallel_cal.reporting.readable import format_judged_error, write_micro
from parallel_cal.session.history import format_first_error
from parallel_cal.workbench.bench import Bench, Live
from parallel_cal.workbench.fixing import ask_where_to_fix
from parallel_cal.workbench.header import Header
from parallel_cal.workbench.live import LiveCard
from parallel_cal.workbench.marking import SCRIPT, FigureSlot, Marking
from parallel_cal.workbench.residuals_card import ResidualsCard
from parallel_cal.workbench.widgets import (
    CSS,
    FIGURE_MARGIN,
    HEAD,
    HEADER_HEIGHT,
    card,
    draw_figure,
    table,
)

EMPTY = (
    "Reading the measurements. This takes a few seconds.",
    "No samples yet. Move the robot from pose to pose and hold it still at each for a second. "
    "Press Take samples when there are twenty or more.",
)
PRIORS = {None: "of weakly determined parameters", True: "of all parameters", False: "none"}
PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")  # columns of planned poses
# Seconds between checks of the bench, and of the disk for changes by other programs.
POLL_INTERVAL_S = 0.05
REFRESH_INTERVAL_S = 0.3


def build(bench: Bench) -> None:
    """Show the bench in every window that is opened on this server."""

    @ui.page("/", title=f"parallel-cal · {bench.session.folder.name}")
    def _index() -> None:
        Window(bench)


class Window:
    """One browser's view of the bench, with its own marked samples."""

    def __init__(self, bench: Bench):
        self.bench, self.version, self.seen = bench, -1, -1
        self.marking = Marking(self._show_marked)
        self.opened = set[str]()  # keys of the expansions that stay open
        ui.dark_mode(None)  # use the setting of the browser
        ui.colors(primary=MEASURED)
        ui.add_head_html(HEAD + HEADER_HEIGHT + SCRIPT)
        ui.add_css(CSS)
        self.header = Header(bench)
        with ui.column().classes("w-full max-w-screen-xl mx-auto gap-4"):
            if bench.live is not None:
                LiveCard(bench, bench.live, self.header.campaign)
            with ui.column().classes("w-full") as self.top:
                self.failing = ResidualsCard(self.marking)
            self.body = ui.column().classes("w-full gap-4")
        self.layer = ui.element()  # dialogs stay while the body is redrawn
        self._draw()
        ui.timer(POLL_INTERVAL_S, self._poll)
        ui.timer(REFRESH_INTERVAL_S, bench.follow)

    def _poll(self) -> None:
        if self.version != self.bench.version:
            self._draw()

    def _draw(self) -> None:
        afresh = self.seen != self.bench.seen
        self.version, self.seen = self.bench.version, self.bench.seen
        self.header.show(afresh)
        if not afresh:
            return  # while a step runs, only its progress changes
        self.marking.numbers = set()
        self.body.clear()
        view = self.bench.view or {}
        self.top.set_visibility(bool(view))
        with self.body:
            if not view:
                ui.label(EMPTY[self.bench.view is not None]).classes("p-4")
                if self.bench.view is not None:
                    self._history()
                return
            self.failing.show(view)
            self._missing(view)
            self._history()
            self._samples(view)
            self._parameters(view)
            self._next(view)

    # ------------------------------------------------------------------ what is missing

    def _missing(self, view: dict[str, Any]) -> None:
        with card("What is missing"):
            if not view["candidates"]:
                ui.label("No effect has been tested. Press Fit.")
            if both := view["together"]:
                add = ui.button(
                    f"Add {both['names']}", on_click=partial(self.bench.begin, "add", both["text"])
                )
                add.props("dense").set_enabled(not self.bench.busy)
            for one in view["candidates"][:8]:
                with ui.row().classes("w-full items-center no-wrap max-lg:flex-wrap"):
                    name = one["effect"]
                    add = ui.button("Add", on_click=partial(self.bench.begin, "add", name))
                    look = "dense" if one["found"] else "dense outline"
                    add.props(f'{look} aria-label="add {name}"')
                    add.set_enabled(not self.bench.busy)
                    with ui.column().classes("gap-0 grow"):
                        ui.label(name).classes("font-bold" if one["found"] else "")
                        ui.label(one["effect details"]).classes("text-sm")
                        resembles = one["confused with"] and f"resembles {one['confused with']}"
                        remarks = filter(None, (resembles, one["confused with details"]))
                        ui.label("; ".join(remarks)).classes("text-xs").style("opacity: 0.75")
                        if one["pattern"]:
                            self._unfolded("Show pattern", name, partial(self._pattern, one))
                    with ui.column().classes("gap-0 items-end min-w-40"):
                        ui.label(one["fall"] if one["fall details"] else "not refitted")
                        ui.label(f"accounts for {one['explains']} · p {one['p']}").classes(
                            "text-xs"
                        ).tooltip(one["fall details"])
            if view["untested"]:
                n = len(view["untested"])
                with ui.expansion(f"{n} effect{'' if n == 1 else 's'} not tested"):
                    for one in view["untested"]:
                        ui.label(f"{one['name']}: {one['why']}").style("opacity: 0.7")

    def _pattern(self, one: dict[str, Any]) -> None:
        FigureSlot(self.marking).show(one["pattern"]["figure"], one["pattern"]["words"])

    def _unfolded(self, title: str, key: str, draw: Callable[[], None]) -> None:
        """Make an expansion that is drawn when it is first opened, and then stays open."""
        shown = ui.expansion(title).classes("w-full").props("dense")

        def toggle() -> None:
            if shown.value and not shown.default_slot.children:
                with shown:
                    draw()
            self.opened = self.opened | {key} if shown.value else self.opened - {key}

        shown.on_value_change(toggle)
        shown.set_value(key in self.opened)

    # ------------------------------------------------------------------ history

    def _history(self) -> None:
        bench, session = self.bench, self.bench.session
        with card("History"):
            rows = [
                {
                    "step": state.step,
                    "samples": state.samples,
                    "before": write_micro(format_first_error(state.before)),
                    "after": format_judged_error(state.errors, state.sigmas),
                    "out": len(state.excluded),
                    "verdict": write_micro(state.verdict_text or state.against),
                }
                for state in session.history()
            ]
            table(
                [
                    ("step", "step"),
                    ("samples", "samples"),
                    ("before", "validation error before"),
                    ("after", "validation error after"),
                    ("out", "excluded samples"),
                    ("verdict", "verdict"),
                ],
                rows,
                "history",
            )
            with ui.row().classes("items-center"):
                ui.select(
                    list(session.record.branches),
                    value=session.record.branch,
                    label="branch",
                    on_change=lambda e: bench.run_now("switch", e.value),
                ).classes("w-48").set_enabled(not bench.busy)
                name = ui.input("name of new branch").classes("w-48")
                ui.button(
                    "Branch", on_click=lambda: bench.run_now("start_branch", name.value or "")
                ).props("dense outline")
                if len(session.record.branches) > 1:
                    ui.button("Compare", on_click=self._compare).props("dense outline")
            if len(session.record.branches) > 1:
                branches = [
                    {
                        "branch": k,
                        "step": s.step,
                        "after": format_judged_error(s.errors, s.sigmas),
                        "out": len(s.excluded),
                    }
                    for k, s in session.compared().items()
                ]
                table(
                    [
                        ("branch", "branch"),
                        ("step", "last step"),
                        ("after", "validation error"),
                        ("out", "excluded samples"),
                    ],
                    branches,
                    "branches",
                )

    def _compare(self) -> None:
        from parallel_cal.workbench.branch_comparison import (
            BranchComparison,  # imports NumPy, which nothing else here needs
        )

        with self.layer:
            BranchComparison(self.bench.session)

    # ------------------------------------------------------------------ samples, parameters, next

    def _samples(self, view: dict[str, Any]) -> None:
        bench = self.bench
        with card("Samples"):
            self.table = table(
                **view["samples"],
                key="sample",
                selection="multiple",
                pagination={"rowsPerPage": 8, "sortBy": "sigmas", "descending": True},
            )
            self.table.on_select(
                lambda e: self.marking.mark({row["sample"] for row in e.selection})
            )
            with ui.row().classes("items-center"):
                self.count = ui.label("no sample marked").props("id=marked aria-live=polite")
                why = ui.input("reason").classes("w-64")
                ui.button("Exclude", on_click=lambda: self._exclude(why.value)).props("dense")
                ui.button("Open", on_click=self._open).props("dense outline").tooltip(
                    "show the readings that the first marked sample averages"
                )
            for number, reason in bench.session.state.excluded.items():
                with ui.row().classes("items-center"):
                    ui.label(f"sample {number} is excluded: {reason or 'no reason given'}")
                    ui.button("Include", on_click=partial(bench.begin, "include", [number])).props(
                        "dense flat"
                    )

    def _show_marked(self, numbers: set[int]) -> None:
        self.table.selected = [row for row in self.table.rows if row["sample"] in numbers]
        self.table.update()
        count = "1 sample" if len(numbers) == 1 else f"{len(numbers)} samples"
        self.count.set_text(f"{count} marked" if numbers else "no sample marked")

    def _exclude(self, why: str | None) -> None:
        if not self.marking.numbers:
            self.count.set_text("no sample marked: mark samples in a view or in the table first")
            return
        self.bench.begin("exclude", dict.fromkeys(sorted(self.marking.numbers), why or ""))

    async def _open(self) -> None:
        """Show the readings that a sample averages."""
        if not self.marking.numbers:
            self.count.set_text("no sample marked: mark one in a view or in the table first")
            return
        # This module imports NumPy, which nothing else here needs.
        from parallel_cal.workbench.readings import signals

        sample = min(self.marking.numbers)
        shown = await run.cpu_bound(signals, self.bench.session.folder, sample) or {}
        with self.layer, ui.dialog(value=True) as dialog, ui.card().classes("w-full max-w-4xl"):
            ui.label(f"Sample {sample}: readings minus their means").classes("font-bold")
            ui.label(shown.get("words", ""))
            if figure := shown.get("figure"):
                draw_figure(figure, f"readings of sample {sample}")
            ui.button("Close", on_click=dialog.close).props("dense outline")

    def _parameters(self, view: dict[str, Any]) -> None:
        if not view["parameters"]:
            return
        bench = self.bench
        with card("Parameters"):
            rows = table(**view["parameters"], key="name", selection="multiple", pagination=12)
            with ui.row().classes("items-center"):
                for words, fix in (("Fix marked", True), ("Free marked", False)):
                    chosen = partial(self._choose, rows, fix)
                    ui.button(words, on_click=chosen).props("dense").set_enabled(not bench.busy)
                ui.select(
                    PRIORS,
                    value=bench.session.options.prior,
                    label="tolerances as priors",
                    on_change=lambda e: bench.begin("choose", prior=e.value),
                ).classes("w-64").set_enabled(not bench.busy)
            if view["drawing"]:
                self._unfolded(
                    "Show in the mechanism",
                    "drawing",
                    partial(draw_figure, view["drawing"], "drawing of the mechanism"),
                )
            for line in view["cannot_tell"]:
                ui.label(f"The data do not determine {line}.").classes("text-sm")

    def _choose(self, rows: Any, fix: bool) -> None:
        """Fix the marked parameters, after asking at which values, or free them."""
        if not rows.selected:
            return ui.notify("no parameter marked: mark parameters in the table first")
        names = [row["name"] for row in rows.selected]
        if not fix:
            return self._refit_with(names, fix=False)
        with self.layer:
            ask_where_to_fix(rows.selected, partial(self._refit_with, names, True))

    def _refit_with(self, names: list[str], fix: bool, at_nominal: bool = False) -> None:
        """Fix or free parameters for all later steps, and fit again."""
        asked = self.bench.session.options
        kept = {
            key: [n for n in patterns if n not in names]
            for key, patterns in (("fix", asked.fix), ("free", asked.free))
        }
        kept["fix" if fix else "free"] += names
        self.bench.begin("choose", nominal=names if at_nominal else [], **kept)

    def _next(self, view: dict[str, Any]) -> None:
        bench = self.bench
        with card("What to measure next"):
            for advice in view["advice"]:
                ui.label(write_micro(advice))
            with ui.row().classes("items-center"):
                count = ui.number("poses", value=20, min=1, max=500, precision=0).classes("w-24")
                ui.button(
                    "Plan", on_click=lambda: bench.begin("plan", int(count.value or 20))
                ).props("dense").set_enabled(not bench.busy)
                if planned := bench.planned:
                    ui.button("Download CSV", on_click=lambda: ui.download(planned)).props(
                        "dense outline"
                    )
            if planned:
                rows = list(csv.DictReader(planned.open()))
                if bench.live is not None:
                    self._send(bench.live, rows)
                self._draw_planned(rows, view)

    def _send(self, live: Live, rows: list[dict[str, str]]) -> None:
        """Let a click send the next planned pose to the robot."""
        with ui.row().classes("items-center"):
            at = ui.number("pose", value=1, min=1, max=len(rows), precision=0).classes("w-24")
            answer = ui.label().props("id=sent aria-live=polite")

            async def send() -> None:
                k = int(at.value or 1)
                pose = [[float(rows[k - 1][key]) for key in keys] for keys in (PLACE, TURN)]
                try:
                    answer.set_text(f"pose {k}: {await run.io_bound(live.send, *pose)}")
                    at.set_value(min(k + 1, len(rows)))
                except ParallelCalError as error:
                    answer.set_text(str(error))

            ui.button("Send to the robot", on_click=send).props("dense")

    def _draw_planned(self, rows: list[dict[str, str]], view: dict[str, Any]) -> None:
        poses = [[1e3 * float(row[k]) for k in PLACE] for row in rows]
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
        axes = {f"{k}axis": {"title": {"text": f"{k} [mm]"}} for k in "xyz"}
        layout = {"height": 380, "margin": FIGURE_MARGIN, "scene": axes}
        draw_figure({"data": traces, "layout": layout}, "planned and measured poses")
