"""The page: drawn with NiceGUI from a bench's view, drawn anew whenever the bench changes."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import Any

from nicegui import run, ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.workbench.bench import Bench, Live
from parallel_cal.workbench.beside import Beside
from parallel_cal.workbench.live import LiveCard
from parallel_cal.workbench.looks import (
    ACCENT,
    BAND,
    CLEAR,
    COLOURS,
    CSS,
    HEAD,
    MARKED,
    QUIET,
    ROUND,
    card,
    table,
)
from parallel_cal.workbench.readings import signals

EMPTY = (
    "Looking at the measurements: this takes a few seconds.",
    "No samples yet. Move the robot from pose to pose, hold it still at each for a second, "
    "and take the samples as soon as there are twenty or more.",
)
PRIORS = {None: "where the data tell less", True: "throughout", False: "nowhere"}
PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")  # columns of planned poses
LIKELY = "99 % of means if nothing depends on it"
POLL = 0.3  # s between two looks at the bench: two windows agree within a second


def build(bench: Bench) -> None:
    """Every window that is opened on this server shows the bench."""

    @ui.page("/", title=f"parallel-cal · {bench.session.folder.name}")
    def _index() -> None:
        Window(bench)


class Window:
    """One browser's view of the bench, with its own marked samples."""

    def __init__(self, bench: Bench):
        self.bench, self.version, self.seen, self.marked = bench, -1, -1, set[int]()
        self.plots: list[Any] = []
        self.view: dict[str, Any] = {}  # the one that is drawn
        self.along, self.component, self.tab = "", 0, ""
        self.opened = set[str]()  # effects whose pattern is looked at
        ui.dark_mode(None)  # as the browser has it
        ui.colors(primary=ACCENT)
        ui.add_head_html(HEAD)
        ui.add_css(CSS)
        with ui.header().classes("shadow"):
            self.head = ui.column().classes("w-full gap-1")
        with ui.column().classes("w-full max-w-screen-xl mx-auto gap-4"):
            if bench.live is not None:
                LiveCard(bench, bench.live)
            self.body = ui.column().classes("w-full gap-4")
        self.layer = ui.element()  # dialogs stay while the body is drawn anew
        self._draw()
        ui.timer(POLL, self._poll)

    def _poll(self) -> None:
        self.bench.follow()
        if self.version != self.bench.version:
            self._draw()

    def _draw(self) -> None:
        whole = self.seen != self.bench.seen or not self.bench.busy
        self.version, self.seen = self.bench.version, self.bench.seen
        self.head.clear()
        with self.head:
            self._header()
        if not whole:
            return  # while a step is under way only its progress changes
        self.marked, self.plots = set(), []
        self.body.clear()
        with self.body:
            view = self.view = self.bench.view or {}
            if not view:
                ui.label(EMPTY[self.bench.view is not None]).classes("p-4")
                if self.bench.view is not None:
                    self._history()
                return
            self._failing(view)
            self._missing(view)
            self._history()
            self._samples(view)
            self._parameters(view)
            self._next(view)

    # ------------------------------------------------------------------ always in view

    def _header(self) -> None:
        bench, view = self.bench, self.bench.view
        verdict = (view or {}).get("verdict", {"colour": "grey", "words": "nothing measured yet"})
        ui.label(verdict["words"]).classes("text-base font-bold").style(
            f"border-left: 6px solid {COLOURS[verdict['colour']]}; padding-left: 8px"
        ).props("id=verdict role=status aria-live=polite")
        with ui.row().classes("items-center gap-6"):
            for tile in (view or {}).get("tiles", []):
                self._tile(tile)
            self._budget((view or {}).get("budget", []))
            self._iso((view or {}).get("iso", []))
            self._buttons()
        if bench.busy:
            with ui.row().classes("items-center w-full"):
                ui.label(bench.stage).props("id=stage")
                ui.linear_progress(bench.fraction, show_value=False).classes("w-64").props(
                    'aria-label="progress"'
                )
                ui.button("Cancel", on_click=bench.cancel).props("dense outline")
        elif bench.message:
            ui.label(bench.message).props("id=message role=alert").style(
                f"color: {COLOURS['amber'] if bench.failed else QUIET}"
            )

    def _tile(self, tile: dict[str, Any]) -> None:
        with ui.column().classes("gap-0"):
            ui.label(tile["name"]).classes("text-xs").style("opacity: 0.75")
            for one in tile["values"]:
                ui.label(f"{one['value']} {one['unit']}").classes("text-lg leading-tight").tooltip(
                    f"{one['kind']}, rms at poses left out"
                )

    def _budget(self, parts: list[dict[str, Any]]) -> None:
        if not parts:
            return
        with ui.column().classes("gap-0"):
            ui.label("error budget: by itself, and share of the whole").classes("text-xs").style(
                "opacity: 0.75"
            )
            words = [
                f"{p['name']} {p['alone']} {p['unit']} ({p['share']})"
                for p in parts
                if p["name"] != "rest"
            ]
            ui.label(" · ".join(words)).props("id=budget")

    def _iso(self, words: list[str]) -> None:
        if words:
            with ui.column().classes("gap-0"):
                ui.label("ISO 9283").classes("text-xs").style("opacity: 0.75")
                ui.label(" · ".join(words)).props("id=iso").tooltip(
                    "pose accuracy AP and repeatability RP, the device's noise included"
                )

    def _buttons(self) -> None:
        bench, record = self.bench, self.bench.session.record
        can_redo = bool(record.forward.get(record.branch))
        for name, step, usable in (
            ("Undo", "undo", record.state.parent is not None),
            ("Redo", "redo", can_redo),
        ):
            button = ui.button(name, on_click=partial(bench.at_once, step)).props("dense outline")
            button.set_enabled(usable and not bench.busy)
        fit = ui.button("Fit", on_click=partial(bench.begin, "fit")).props("dense")
        fit.set_enabled(bool(bench.view) and not bench.busy)
        with ui.button("Save", on_click=bench.save).props("dense outline") as save:
            ui.tooltip(f"write this model to {bench.output}")
        save.set_enabled(not bench.busy and record.state.parent is not None)

    # ------------------------------------------------------------------ where it fails

    def _failing(self, view: dict[str, Any]) -> None:
        residuals = view["residuals"]
        with card("Where it fails"):
            ui.label(
                "Drag a box in a flat view (box or lasso tool): the same samples are marked in all "
                "flat views. Arrows have the colour of their direction."
            ).classes("text-sm").style("opacity: 0.75")
            with ui.row().classes("w-full no-wrap max-lg:flex-wrap"):
                if view["arrows"]:
                    with ui.column().classes("flex-1 min-w-0 gap-0"):
                        scale = view["arrows"]["scale"]
                        ui.label(f"Residuals, drawn {scale:g} times as long as they are").classes(
                            "text-sm"
                        )
                        figure = view["arrows"]["figure"]
                        figure = figure | {"layout": figure["layout"] | CLEAR}
                        ui.plotly(figure).classes("w-full").props(
                            'role=figure aria-label="residual arrows in space"'
                        )
                self._map(view)
            self._pictures(view["pictures"])
            names = list(residuals["along"])
            self.along = self.along if self.along in residuals["along"] else next(iter(names), "")
            self.component = min(self.component, len(residuals["components"]) - 1)
            if names and residuals["components"]:
                with ui.row().classes("items-center"):
                    ui.select(
                        residuals["components"],
                        value=residuals["components"][self.component],
                        label="residual of",
                        on_change=lambda e: self._look_along(component=e.value),
                    ).classes("w-32")
                    ui.select(
                        names,
                        value=self.along,
                        label="against",
                        on_change=lambda e: self._look_along(along=e.value),
                    ).classes("w-48")
                self._points(*self._coordinates(view))

    def _map(self, view: dict[str, Any]) -> None:
        place, where = view["residuals"]["place"], view["residuals"]["where"]
        sizes = [sample["sigmas"] or 0 for sample in view["samples"]]
        self._points(
            [p[0] for p in place],
            [p[1] for p in place],
            where.format("x"),
            where.format("y"),
            "rms residual [sigmas] over the workspace",
            {"color": sizes, "colorscale": "Cividis", "showscale": True, "size": 9},
        )

    def _coordinates(self, view: dict[str, Any]) -> tuple[Any, ...]:
        residuals = view["residuals"]
        along = residuals["along"][self.along]
        name = residuals["components"][self.component]
        return (
            along["values"],
            [row[self.component] for row in residuals["sigmas"]],
            f"{self.along} [{along['unit']}]" if along["unit"] else self.along,
            f"{name} [sigmas]",
            f"residual of {name} against {self.along}",
            {"color": residuals["colours"][self.component], "size": 7, "opacity": 0.6},
            _means(along, self.component),
        )

    def _look_along(self, along: str = "", component: str = "") -> None:
        self.along = along or self.along
        if component:
            self.component = self.view["residuals"]["components"].index(component)
        self.seen = -1
        self._draw()

    def _points(
        self, x: Any, y: Any, across: str, up: str, title: str, marker: dict[str, Any],
        means: Sequence[dict[str, Any]] = (),
    ) -> None:  # fmt: skip
        """A flat view of every sample, in the samples' order, and of `means` over them."""
        figure = {
            "data": [
                {
                    "type": "scatter",
                    "mode": "markers",
                    "x": x,
                    "y": y,
                    "marker": marker,
                    "text": [f"sample {s['sample']}" for s in self.view["samples"]],
                    "customdata": [s["sample"] for s in self.view["samples"]],
                    "showlegend": False,
                },
                *means,
            ],
            "layout": {
                "height": 360,
                "margin": ROUND,
                "title": {"text": title, "font": {"size": 13}},
                "xaxis": {"title": {"text": across}},
                "yaxis": {"title": {"text": up}},
                "dragmode": "select",
                "uirevision": "kept",
            },
        }
        self._flat(figure, title)

    def _flat(self, figure: dict[str, Any], words: str, **_: Any) -> None:
        """A figure whose points are samples where they carry their numbers: these can be marked."""
        figure = {
            "data": [_markable(trace) for trace in figure["data"]],
            "layout": figure["layout"] | CLEAR | {"dragmode": "select"},
            "config": {"displaylogo": False},
        }
        plot = ui.plotly(figure).classes("flex-1 min-w-0 w-full")
        plot.props(f'role=figure aria-label="{escape(words)}"')
        plot.on("plotly_selected", lambda e: self._brush(e.args))
        plot.on("plotly_deselect", lambda: self._mark(set()))
        self.plots.append((plot, figure))

    def _pictures(self, pictures: list[dict[str, Any]]) -> None:
        """One at a time, in tabs; the one that was looked at stays."""
        if not pictures:
            return
        names = [one["name"] for one in pictures]
        self.tab = self.tab if self.tab in names else names[0]
        with ui.tabs(on_change=lambda e: setattr(self, "tab", e.value)) as tabs:
            for name in names:
                ui.tab(name)
        with ui.tab_panels(tabs, value=self.tab, animated=False).classes("w-full"):
            for one in pictures:
                with ui.tab_panel(one["name"]).classes("p-0"):
                    ui.label(one["words"]).classes("text-sm")
                    self._flat(**one)

    # ------------------------------------------------------------------ marked samples

    def _brush(self, args: Any) -> None:
        points = (args or {}).get("points") or []
        which = {int(p["customdata"]) for p in points if p.get("customdata") is not None}
        if which and which != self.marked:  # drawing a view anew says "nothing", too
            self._mark(which)

    def _mark(self, which: set[int]) -> None:
        """Mark samples, by their numbers, in every picture and in the table."""
        self.marked = which
        for plot, figure in self.plots:
            for trace in figure["data"]:
                if which and "customdata" in trace:
                    numbers = enumerate(trace["customdata"])
                    trace["selectedpoints"] = [i for i, n in numbers if n in which]
                else:
                    trace.pop("selectedpoints", None)
            plot.update()
        self.table.selected = [row for row in self.view["samples"] if row["sample"] in which]
        self.table.update()
        self.count.set_text(f"{len(which)} samples marked" if which else "no sample marked")

    # ------------------------------------------------------------------ what is missing

    def _missing(self, view: dict[str, Any]) -> None:
        with card("What is missing"):
            if not view["candidates"]:
                ui.label("No effect was tested yet: press Fit.")
            for one in view["candidates"][:8]:
                with ui.row().classes("w-full items-center no-wrap max-lg:flex-wrap"):
                    add = ui.button("Add", on_click=partial(self.bench.begin, "add", one["name"]))
                    look = "dense" if one["found"] else "dense outline"
                    add.props(f'{look} aria-label="add {one["name"]}"')
                    add.set_enabled(not self.bench.busy)
                    with ui.column().classes("gap-0 grow"):
                        ui.label(one["name"]).classes("font-bold" if one["found"] else "")
                        ui.label(one["physics"]).classes("text-sm")
                        ui.label(one["against"] or _apart(one)).classes("text-xs").style(
                            "opacity: 0.75"
                        )
                        if one["found"] and one["remedy"]:
                            ui.label(f"At the machine: {one['remedy']}.").classes("text-sm")
                        if one["pattern"]:
                            self._pattern(one["pattern"])
                    with ui.column().classes("gap-0 items-end min-w-40"):
                        ui.label(one["fall"] or "not refitted")
                        ui.label(f"explains {one['explains']} · p {one['p']}").classes("text-xs")
            if view["untested"]:
                with ui.expansion(f"{len(view['untested'])} could not be tested"):
                    for one in view["untested"]:
                        ui.label(f"{one['name']}: {one['why']}").style("opacity: 0.7")

    def _pattern(self, picture: dict[str, Any]) -> None:
        """What an effect would leave, drawn when somebody wants to see it."""
        self._unfolded("its pattern", picture["name"], partial(self._flat, **picture))

    def _unfolded(self, title: str, key: str, draw: Callable[[], None]) -> None:
        """Something that is drawn once somebody wants to see it, and then stays open."""
        shown = ui.expansion(title).classes("w-full").props("dense")

        def look() -> None:
            if shown.value and not shown.default_slot.children:
                with shown:
                    draw()
            self.opened = self.opened | {key} if shown.value else self.opened - {key}

        shown.on_value_change(look)
        shown.set_value(key in self.opened)

    # ------------------------------------------------------------------ history

    def _history(self) -> None:
        bench, session = self.bench, self.bench.session
        with card("History"):
            rows = [
                {
                    "step": state.step,
                    "before": state.shown(state.before),
                    "after": state.shown(state.errors),
                    "out": len(state.excluded),
                    "verdict": state.verdict or state.against,
                }
                for state in session.history()
            ]
            table(
                [("step", "step"), ("before", "left out, before"), ("after", "after"),
                 ("out", "samples left out"), ("verdict", "verdict")],
                rows,
                "history",
            )  # fmt: skip
            with ui.row().classes("items-center"):
                ui.select(
                    list(session.record.branches),
                    value=session.record.branch,
                    label="branch",
                    on_change=lambda e: bench.at_once("switch", e.value),
                ).classes("w-48").set_enabled(not bench.busy)
                name = ui.input("new branch from here").classes("w-48")
                ui.button(
                    "Branch", on_click=lambda: bench.at_once("start_branch", name.value or "")
                ).props("dense outline")
                if len(session.record.branches) > 1:
                    ui.button("Compare", on_click=self._compare).props("dense outline")
            if len(session.record.branches) > 1:
                beside = [
                    {"branch": k, "step": s.step, "after": s.shown(s.errors),
                     "out": len(s.excluded)}
                    for k, s in session.compared().items()
                ]  # fmt: skip
                table(
                    [("branch", "branch"), ("step", "last step"), ("after", "left out"),
                     ("out", "samples left out")],
                    beside,
                    "branches",
                )  # fmt: skip

    def _compare(self) -> None:
        with self.layer:
            Beside(self.bench.session)

    # ------------------------------------------------------------------ samples, parameters, next

    def _samples(self, view: dict[str, Any]) -> None:
        bench = self.bench
        with card("Samples"):
            self.table = table(
                [("sample", "sample"), ("time", "time [s]"), ("error", "error [µm]"),
                 ("sigmas", "residual [sigmas]"), ("odd", "odd")],
                view["samples"],
                "sample",
                selection="multiple",
                pagination={"rowsPerPage": 8, "sortBy": "sigmas", "descending": True},
            )  # fmt: skip
            self.table.on_select(lambda e: self._mark({row["sample"] for row in e.selection}))
            with ui.row().classes("items-center"):
                self.count = ui.label("no sample marked").props("id=marked aria-live=polite")
                why = ui.input("reason").classes("w-64")
                ui.button("Exclude", on_click=lambda: self._exclude(why.value)).props("dense")
                ui.button("Open", on_click=self._open).props("dense outline").tooltip(
                    "the readings that the first marked sample was made of"
                )
            left_out = bench.session.state.excluded
            for number, reason in left_out.items():
                with ui.row().classes("items-center"):
                    ui.label(f"sample {number} is left out: {reason or 'no reason given'}")
                    ui.button(
                        "Take back", on_click=partial(bench.begin, "include", [number])
                    ).props("dense flat")

    def _exclude(self, why: str | None) -> None:
        if not self.marked:
            self.count.set_text("no sample marked: mark some in a view or in the table first")
            return
        self.bench.begin("exclude", dict.fromkeys(sorted(self.marked), why or ""))

    async def _open(self) -> None:
        """Show the readings that a sample was made of."""
        if not self.marked:
            self.count.set_text("no sample marked: mark one in a view or in the table first")
            return
        sample = min(self.marked)
        shown = await run.cpu_bound(signals, self.bench.session.folder, sample) or {}
        with self.layer, ui.dialog(value=True) as dialog, ui.card().classes("w-full max-w-4xl"):
            ui.label(f"Sample {sample}: its readings, less their means").classes("font-bold")
            ui.label(shown.get("words", ""))
            if figure := shown.get("figure"):
                figure["layout"] |= CLEAR
                ui.plotly(figure).classes("w-full").props(
                    f'role=figure aria-label="readings of sample {sample}"'
                )
            ui.button("Close", on_click=dialog.close).props("dense outline")

    def _parameters(self, view: dict[str, Any]) -> None:
        if not view["parameters"]:
            return
        bench = self.bench
        with card("Parameters"):
            rows = table(
                [("name", "parameter"), ("what", "what it is"), ("value", "value"),
                 ("sigma", "sigma"), ("unit", "unit"), ("moved", "moved [tolerances]")],
                view["parameters"],
                "name",
                selection="multiple",
                pagination=12,
            )  # fmt: skip
            with ui.row().classes("items-center"):
                for words, fix in (("Hold marked", True), ("Free marked", False)):
                    chosen = partial(self._choose, rows, fix)
                    ui.button(words, on_click=chosen).props("dense").set_enabled(not bench.busy)
                ui.select(
                    PRIORS,
                    value=bench.session.options.prior,
                    label="tolerances as priors",
                    on_change=lambda e: bench.begin("choose", prior=e.value),
                ).classes("w-64").set_enabled(not bench.busy)
            if view["drawing"]:
                self._unfolded("where they are", "drawing", partial(_space, view["drawing"]))
            for line in view["cannot_tell"]:
                ui.label(f"The data cannot tell {line}.").classes("text-sm")

    def _choose(self, rows: Any, fix: bool) -> None:
        """Hold marked parameters at their values, or identify them, from here on."""
        names = [row["name"] for row in rows.selected]
        if not names:
            return ui.notify("mark parameters in the table first")
        asked = self.bench.session.options
        kept = {
            key: [n for n in patterns if n not in names]
            for key, patterns in (("fix", asked.fix), ("free", asked.free))
        }
        kept["fix" if fix else "free"] += names
        self.bench.begin("choose", **kept)

    def _next(self, view: dict[str, Any]) -> None:
        bench = self.bench
        with card("What to measure next"):
            for advice in view["advice"]:
                ui.label(advice)
            with ui.row().classes("items-center"):
                count = ui.number("poses", value=20, min=1, max=500, precision=0).classes("w-24")
                ui.button(
                    "Plan", on_click=lambda: bench.begin("plan", int(count.value or 20))
                ).props("dense").set_enabled(not bench.busy)
                if planned := bench.planned:
                    ui.button("CSV", on_click=lambda: ui.download(planned)).props("dense outline")
            if planned:
                rows = list(csv.DictReader(planned.open()))
                if bench.live is not None:
                    self._send(bench.live, rows)
                self._draw_planned(rows, view)

    def _send(self, live: Live, rows: list[dict[str, str]]) -> None:
        """One planned pose after the other, sent to the robot by a click each."""
        with ui.row().classes("items-center"):
            at = ui.number("pose", value=1, min=1, max=len(rows), precision=0).classes("w-24")
            said = ui.label().props("id=sent aria-live=polite")

            async def send() -> None:
                k = int(at.value or 1)
                pose = [[float(rows[k - 1][key]) for key in keys] for keys in (PLACE, TURN)]
                try:
                    said.set_text(f"pose {k}: {await run.io_bound(live.send, *pose)}")
                    at.set_value(min(k + 1, len(rows)))
                except ParallelCalError as error:
                    said.set_text(str(error))

            ui.button("Send to the robot", on_click=send).props("dense")

    def _draw_planned(self, rows: list[dict[str, str]], view: dict[str, Any]) -> None:
        poses = [[1e3 * float(row[k]) for k in PLACE] for row in rows]
        traces = [
            {
                "type": "scatter3d", "mode": "markers", "name": name,
                **{k: [p[i] for p in places] for i, k in enumerate("xyz")},
                "marker": {"size": size, "color": colour},
            }
            for name, places, size, colour in (
                ("measured", view["residuals"]["place"], 2, QUIET),
                ("planned", poses, 5, MARKED),
            )
        ]  # fmt: skip
        axes = {f"{k}axis": {"title": {"text": f"{k} [mm]"}} for k in "xyz"}
        layout = {**CLEAR, "height": 380, "margin": ROUND, "scene": axes}
        ui.plotly({"data": traces, "layout": layout}).classes("w-full").props(
            'role=figure aria-label="planned poses among those measured"'
        )


def _space(figure: dict[str, Any]) -> None:
    """The mechanism, its parameters named."""
    figure = figure | {"layout": figure["layout"] | CLEAR}
    ui.plotly(figure).classes("w-full").props('role=figure aria-label="the mechanism"')


def _means(along: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """The rolling mean of a component, or one a level, over the band of 99 % about none."""
    at, band = along["at"], along["band"]
    mean = {"x": at, "y": [row[component] for row in along["means"]], "name": "mean"}
    if along["rolls"]:
        edges = {"x": at + at[::-1], "y": band + [-b for b in band[::-1]]}
        grey = {"fill": "toself", "fillcolor": BAND, "line": {"width": 0}, "hoverinfo": "skip"}
        drawn = [edges | grey | {"name": LIKELY}, mean | {"line": {"color": MARKED, "width": 2}}]
        return [trace | {"type": "scatter", "mode": "lines"} for trace in drawn]
    bars = {"array": band, "color": BAND, "thickness": 14, "width": 0}
    none = {"x": at, "y": [0.0] * len(at), "error_y": bars, "marker": {"size": 1, "color": QUIET}}
    dots = mean | {"marker": {"size": 12, "color": MARKED, "symbol": "diamond"}}
    drawn = [none | {"name": LIKELY}, dots]
    return [trace | {"type": "scatter", "mode": "markers"} for trace in drawn]


def _markable(trace: dict[str, Any]) -> dict[str, Any]:
    """A trace that shows which of its samples are marked, where it has any."""
    if "customdata" not in trace:
        return trace
    marked = {"selected": {"marker": {"color": MARKED, "size": 11}}}
    return trace | marked | {"unselected": {"marker": {"opacity": 0.35}}}


def _apart(one: dict[str, Any]) -> str:
    """What a candidate is taken for, and what tells it from that."""
    words = [f"looks like {one['lookalikes']}"] if one["lookalikes"] else []
    return "; ".join(words + ([f"told apart by {one['apart']}"] if one["apart"] else []))
