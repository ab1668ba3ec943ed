"""The page, drawn with NiceGUI from a bench's view, and redrawn whenever the bench changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from nicegui import run, ui

from parallel_cal.base.sample_names import format_sample
from parallel_cal.reporting.colours import MEASURED
from parallel_cal.reporting.names import name_effects, title_of
from parallel_cal.reporting.readable import (
    ABOUT_SAMPLES,
)
from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.drift_card import draw_drift_card
from parallel_cal.workbench.first_screen import (
    MachineCard,
    Strip,
    VerdictCard,
    WelcomeCard,
    explain_exclusion,
)
from parallel_cal.workbench.fixing import ask_where_to_fix
from parallel_cal.workbench.header import READING, ErrorsCard, Header, Notice
from parallel_cal.workbench.history_card import draw_history_card
from parallel_cal.workbench.import_dialog import ImportDialog
from parallel_cal.workbench.law_card import draw_law_card
from parallel_cal.workbench.live import LiveCard
from parallel_cal.workbench.marking import SCRIPT, FigureSlot, Marking
from parallel_cal.workbench.next_step import WaysOn
from parallel_cal.workbench.plan_card import draw_plan_card, show_plan_card
from parallel_cal.workbench.residuals_card import ResidualsCard
from parallel_cal.workbench.widgets import (
    BLOCKS,
    CSS,
    HEAD,
    HEADER_HEIGHT,
    UTILITIES,
    card,
    draw_figure,
    table,
)

EMPTY = "No samples yet. Import a table of measured poses."
EMPTY_AT_ROBOT = (
    "No samples yet. Move the robot from pose to pose and hold it still at each for a second. "
    "Press Take samples when there are twenty or more."
)
CAMPAIGN_RUNS = (
    "No samples here yet: the campaign is measuring them. Press Take samples to see them."
)
PRIORS = {None: "of weakly determined parameters", True: "of all parameters", False: "none"}
# Seconds between checks of the bench, and of the disk for changes by other programs.
POLL_INTERVAL_S = 0.02
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
        self.pages: dict[str, dict[str, Any]] = {  # which rows of the long tables are shown
            "samples": {"rowsPerPage": 12, "sortBy": "sigmas", "descending": True},
            "parameters": {"rowsPerPage": 12},
        }
        ui.dark_mode(None)  # use the setting of the browser
        ui.colors(primary=MEASURED)
        ui.add_head_html(HEAD + HEADER_HEIGHT + SCRIPT)
        ui.add_css(UTILITIES + BLOCKS + CSS)
        self.header, self.notice = Header(bench), Notice(bench)
        with ui.column().classes("w-full mx-auto gap-3") as content:
            content.props("id=content tabindex=-1")
            ui.label(f"Session {bench.session.folder.name}").classes("text-sm font-bold").props(
                "role=heading aria-level=1"
            )
            with ui.element().classes("first"):
                self.machine = MachineCard()
                ways = WaysOn(self._import, show_plan_card)
                self.verdict = VerdictCard(bench, ways)
                self.welcome = WelcomeCard(bench, ways)
                self.strip = Strip(partial(bench.begin, "exclude"))
            with ui.element().classes("columns") as self.work:
                with ui.column().classes("w-full gap-3"):
                    self.errors = ErrorsCard()
                    self.missing = ui.column().classes("w-full gap-3")
                    if bench.live is not None:
                        LiveCard(bench, bench.live, self._follow_campaign)
                with ui.column().classes("w-full gap-3 right") as self.right:
                    self.failing = ResidualsCard(self.marking)
                self.rest = ui.element().classes("rest")  # its cards stand in the columns in turn
        self.layer = ui.element()  # dialogs stay while the page is redrawn
        self._draw()
        ui.timer(POLL_INTERVAL_S, self._poll)
        ui.timer(REFRESH_INTERVAL_S, bench.follow)

    def _poll(self) -> None:
        if self.version != self.bench.version:
            self._draw()

    def _follow_campaign(self, told: dict[str, Any]) -> None:
        """Show the campaign in the header, and that it measures where there are no samples."""
        if (bar := self.header.campaign) is not None:
            ran = bar.runs
            bar.show(told)
            if bar.runs != ran:
                self.header.show_verdict()
                self._show_empty()

    def _show_empty(self) -> None:
        """Say what to do if there are no samples, or that they are being read."""
        view, bar = self.bench.view, self.header.campaign
        runs = bar is not None and bar.runs
        if view is None:
            words = READING["words"]
        elif runs:
            words = CAMPAIGN_RUNS
        else:
            words = EMPTY if self.bench.live is None else EMPTY_AT_ROBOT
        self.welcome.card.set_visibility(not self.bench.has_samples)
        self.welcome.show(words, can_begin=view is not None and not runs)

    def _import(self) -> None:
        with self.layer:
            ImportDialog(self.bench)

    def _draw(self) -> None:
        afresh = self.seen != self.bench.seen
        self.version, self.seen = self.bench.version, self.bench.seen
        self.header.show(afresh)
        self.notice.show()
        if not afresh:
            self.verdict.show_next()
            self._show_empty()
            return  # while a step runs, only its progress changes
        self.marking.numbers = set()
        view = self.bench.view or {}
        self._show_empty()
        if "machine" in view:  # a preliminary view of many samples leaves the picture before it
            self.machine.show(view["machine"])
        has_samples = self.bench.has_samples
        for one in (self.verdict.card, self.errors.card, self.strip.row):
            one.set_visibility(has_samples)
        complete = "residuals" in view  # a preliminary view of many samples has only numbers
        self.right.set_visibility(complete)
        self.missing.clear()
        self.rest.clear()
        self.work.classes(**{"add" if complete else "remove": "paired"})
        if has_samples:
            self.verdict.show(view)
            self.strip.show(view)
            self.errors.show(view)
            with self.missing:
                draw_drift_card(self.bench.session.state)
                self._missing(view)
                draw_law_card(self.bench, view)
        if complete:
            self.failing.show(view)
        with self.rest:
            if complete:
                self._samples(view)
                self._parameters(view)
            if self.bench.view is not None:
                draw_history_card(self.bench, self.layer)
            if complete:
                draw_plan_card(self.bench, view)

    # ------------------------------------------------------------------ what is missing

    def _missing(self, view: dict[str, Any]) -> None:
        with card("What is missing"):
            candidates = view["candidates"]
            if effects := view["effects"]:
                with ui.row().classes("items-center gap-x-2 gap-y-0"):
                    ui.label("in the model:").classes("quiet")
                    for name in effects:
                        ui.label(title_of(name)).classes("font-bold")
                        if rivals := view["ambiguous"].get(name):
                            words = (
                                f"or {' or '.join(map(title_of, rivals))}: the samples do not tell"
                            )
                            ui.label(words).classes("ambiguous")
                        remove = partial(self.bench.begin, "remove", name)
                        button = ui.button("Remove", on_click=remove)
                        button.props(f'dense outline aria-label="remove {title_of(name)}"')
                        button.set_enabled(not self.bench.busy)
            if not candidates:
                running = "The effects are being tested."
                ui.label(running if self.bench.working else "No effect has been tested. Press Fit.")
            for one in candidates:
                if one["probable"]:
                    self._candidate(one)
            others = [one for one in candidates if not one["probable"]]
            if candidates and len(others) == len(candidates):
                ui.label("No tested effect is probable.")
            if others:
                title = f"{_count(others, 'tested effect')} less probable"
                self._unfolded(title, "less probable", partial(self._candidates, others))
            if untested := view["untested"]:
                title = f"{_count(untested, 'effect')} not tested"
                self._unfolded(title, "not tested", partial(_list_untested, untested))

    def _candidates(self, candidates: list[dict[str, Any]]) -> None:
        for one in candidates:
            self._candidate(one)

    def _candidate(self, one: dict[str, Any]) -> None:
        name = one["effect"]
        with ui.element().classes("candidate"):
            add = ui.button("Add", on_click=partial(self.bench.begin, "add", name))
            add.props(f'dense outline aria-label="add {title_of(name)}"')
            add.set_enabled(not self.bench.busy)
            with ui.column().classes("gap-0"):
                ui.label(title_of(name)).classes("font-bold" if one["found"] else "")
                ui.label(one["effect details"]).classes("text-sm")
                resembles = one["confused with"] and f"resembles {one['confused with']}"
                remarks = filter(None, (resembles, one["confused with details"]))
                ui.label(name_effects("; ".join(remarks))).classes("text-xs quiet")
            with ui.column().classes("gap-0 items-end whitespace-nowrap"):
                ui.label(one["fall"] if one["fall details"] else "not refitted")
                ui.label(f"probability {one['probability']}").classes("text-xs").tooltip(
                    f"alone, it accounts for {one['explains']} of the error above the noise. "
                    f"{one['fall details']}"
                )
            if one["pattern"]:
                with ui.element().classes("wide"):
                    self._unfolded("Show pattern", name, partial(self._pattern, one))

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

    # ------------------------------------------------------------------ samples, parameters, next

    def _samples(self, view: dict[str, Any]) -> None:
        bench = self.bench
        with card("Samples"):
            self.table = table(
                **view["samples"],
                key="sample",
                selection="multiple",
                pagination=self.pages["samples"],
            ).classes("one-line-rows")
            self._keep_page(self.table, "samples")
            self.table.on_select(
                lambda e: self.marking.mark({row["sample"] for row in e.selection})
            )
            with ui.row().classes("items-center"):
                self.count = ui.label().props("id=marked aria-live=polite")
                self.reason = ui.input("reason", on_change=self._allow_excluding).classes("w-64")
                self.exclude = ui.button("Exclude", on_click=self._exclude)
                self.exclude.props("dense outline")
                self.open = ui.button("Open", on_click=self._open).props("dense outline")
                self.open.tooltip("show the readings that the first marked sample averages")
                ui.button("Import a table", on_click=self._import).props("dense outline")
            ui.label(ABOUT_SAMPLES).classes("quiet")
            self._show_count(set())
            for number, size in view["knocked"].items():
                self._offer_exclusion(int(number), size)
            self._list_excluded(bench.session.state.excluded)

    def _keep_page(self, shown: Any, name: str) -> None:
        """Show the next table of this name with the same order and number of rows."""

        def keep() -> None:
            kept = {key: shown.pagination.get(key) for key in ("rowsPerPage", "sortBy")}
            self.pages[name] = kept | {"descending": bool(shown.pagination.get("descending"))}

        shown.on_pagination_change(keep)

    def _list_excluded(self, excluded: Mapping[int, str]) -> None:
        """List the excluded samples by reason, with buttons that include them again."""
        by_reason: dict[str, list[int]] = {}
        for number, reason in excluded.items():
            by_reason.setdefault(reason or "no reason given", []).append(number)
        if len(by_reason) > 1:
            with ui.row().classes("items-center"):
                ui.label(f"{len(excluded)} samples are excluded")
                self._include("Include all", list(excluded))
        for reason, numbers in by_reason.items():
            one = len(numbers) == 1
            these = "all" if len(by_reason) == 1 else f"these {len(numbers)}"
            with ui.row().classes("items-center"):
                which = f"sample {self._title(numbers[0])} is"
                if not one:
                    which = f"{len(numbers)} samples are"
                ui.label(f"{which} excluded: {reason}")
                self._include("Include" if one else f"Include {these}", numbers)
            if not one:
                draw = partial(self._include_one_by_one, numbers)
                self._unfolded("Include one by one", f"excluded: {reason}", draw)

    def _include_one_by_one(self, numbers: list[int]) -> None:
        with ui.row().classes("items-center"):
            for number in numbers:
                self._include(f"Include {self._title(number)}", [number])

    def _title(self, number: int) -> str:
        """Return the number of a sample with its name, if it has one."""
        return format_sample(number, (self.bench.view or {}).get("names", {}).get(str(number), ""))

    def _offer_exclusion(self, number: int, size: str) -> None:
        """Offer to exclude a sample that the verdict set aside: no view shows it."""
        why = explain_exclusion(size)
        with ui.row().classes("items-center"):
            ui.label(f"sample {self._title(number)} is {why}; the verdict does not use it")
            button = ui.button(f"Exclude sample {number}").props("dense outline")
            button.on_click(
                lambda: self.bench.begin("exclude", {number: self.reason.value.strip() or why})
            )
            button.tooltip("The history states this reason, or yours if you enter one.")
            button.set_enabled(not self.bench.busy)

    def _include(self, words: str, numbers: list[int]) -> None:
        """Make a button that includes excluded samples again, in one step."""
        button = ui.button(words, on_click=partial(self.bench.begin, "include", numbers))
        button.props("dense flat").set_enabled(not self.bench.busy)

    def _show_marked(self, numbers: set[int]) -> None:
        self.table.selected = [row for row in self.table.rows if row["sample"] in numbers]
        self.table.update()
        self._show_count(numbers)

    def _show_count(self, numbers: set[int]) -> None:
        """Show how many samples are marked, and what the buttons need."""
        if numbers:
            self.count.set_text(f"{_count(list(numbers), 'sample')} marked; to exclude, say why")
        else:
            self.count.set_text("no sample marked: mark samples in a view or in the table")
        self.open.set_enabled(bool(numbers))
        self._allow_excluding()

    def _allow_excluding(self) -> None:
        """Let marked samples be excluded for a reason, which the history and the report show."""
        reason = (self.reason.value or "").strip()
        self.exclude.set_enabled(bool(self.marking.numbers and reason) and not self.bench.busy)

    def _exclude(self) -> None:
        reason = self.reason.value.strip()
        self.bench.begin("exclude", dict.fromkeys(sorted(self.marking.numbers), reason))

    async def _open(self) -> None:
        """Show the readings that a sample averages."""
        if not self.marking.numbers:
            return  # the marks were removed after the click
        # This module imports NumPy, which nothing else here needs.
        from parallel_cal.workbench.readings import signals

        sample = min(self.marking.numbers)
        shown = await run.cpu_bound(signals, self.bench.session.folder, sample) or {}
        name = f'aria-label="Readings of sample {sample}"'
        with (
            self.layer,
            ui.dialog(value=True).props(name) as dialog,
            ui.card().classes("w-full max-w-4xl"),
        ):
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
            page = self.pages["parameters"]
            rows = table(**view["parameters"], key="name", selection="multiple", pagination=page)
            self._keep_page(rows, "parameters")
            with ui.row().classes("items-center"):
                count = ui.label().props("id=marked-parameters aria-live=polite")
                buttons = [
                    ui.button(words, on_click=partial(self._choose, rows, fix)).props(
                        "dense outline"
                    )
                    for words, fix in (("Fix marked", True), ("Free marked", False))
                ]

                def show_count() -> None:
                    marked = rows.selected
                    none = "no parameter marked: mark parameters in the table"
                    count.set_text(f"{_count(marked, 'parameter')} marked" if marked else none)
                    for button in buttons:
                        button.set_enabled(bool(marked) and not bench.busy)

                rows.on_select(show_count)
                show_count()
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
        names = [row["name"] for row in rows.selected]
        if not fix:
            return self._refit_with(names, fix=False)
        with self.layer:
            ask_where_to_fix(rows.selected, partial(self._refit_with, names, True))

    def _refit_with(
        self,
        names: list[str],
        fix: bool,
        at_nominal: bool = False,
        measured: Mapping[str, float] | None = None,
    ) -> None:
        """Fix or free parameters for all later steps, and fit again."""
        asked = self.bench.session.options
        kept = {
            key: [n for n in patterns if n not in names]
            for key, patterns in (("fix", asked.fix), ("free", asked.free))
        }
        step = "fix" if fix else "free"
        kept[step] += names
        changed = {k: v for k, v in kept.items() if k == step or v != list(getattr(asked, k))}
        nominal = names if at_nominal else []
        self.bench.begin("choose", nominal=nominal, values=measured or {}, **changed)


def _list_untested(untested: list[dict[str, Any]]) -> None:
    for one in untested:
        ui.label(name_effects(f"{one['name']}: {one['why']}")).classes("quiet")


def _count(things: Sequence[Any], name: str) -> str:
    return f"{len(things)} {name}{'' if len(things) == 1 else 's'}"
