"""The header, always in view: the verdict, the errors, their budget, and the steps."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.reporting.colours import QUIET
from parallel_cal.reporting.readable import write_micro
from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.campaign_card import CampaignBar
from parallel_cal.workbench.widgets import COLOURS

NOTHING = {"colour": "grey", "words": "no samples in this session yet"}


class Header:
    """The header; drawn once, because a button that is redrawn under the mouse loses the click."""

    def __init__(self, bench: Bench):
        self.bench = bench
        self._key = ""  # key of the question that is shown
        self.campaign: CampaignBar | None = None
        header = ui.header().classes("shadow")
        with header, ui.column().classes("w-full no-wrap gap-1"):
            if bench.live is not None:
                header.classes("at-robot")
                header.on("vue:mounted", js_handler="() => followHeaderHeight()")
                self.campaign = CampaignBar(bench.live)
            # In a small window these details scroll, and STOP stays in view above them.
            with ui.column().classes("w-full no-wrap gap-1 header-details"):
                self._draw_details()

    def _draw_details(self) -> None:
        bench = self.bench
        with ui.column().classes("w-full gap-1") as self.asked:
            self.question = ui.label().props("id=question role=alert")
            self.question.style(f"color: {COLOURS['amber']}")
            with ui.row().classes("gap-2"):
                self._button("Keep the model in use", bench.keep_model_in_use)
                self._button("Write anyway", self._confirm)
        with ui.row().classes("w-full no-wrap items-start"):
            self.verdict = ui.label().classes("grow text-base leading-tight font-bold")
            self.verdict.props("id=verdict role=status aria-live=polite")
            with ui.row().classes("no-wrap gap-2"):
                self.undo = self._button("Undo", partial(bench.run_now, "undo"))
                self.redo = self._button("Redo", partial(bench.run_now, "redo"))
                self.fit = ui.button("Fit", on_click=partial(bench.begin, "fit")).props("dense")
                self.save = self._button("Save", lambda: bench.save())
                self.save.tooltip(
                    f"write this model to {bench.output}, unless the model there is better"
                )
        with ui.row().classes("items-center w-full") as self.work:
            self.stage = ui.label().props("id=stage")
            self.fraction = ui.linear_progress(0.0, show_value=False).classes("w-64")
            self.fraction.props('aria-label="progress"')
            self._button("Cancel", bench.cancel)
        self.message = ui.label().props("id=message role=alert")
        self.numbers = ui.row().classes("items-center gap-x-6 gap-y-0")

    def _button(self, name: str, step: Any) -> Any:
        return ui.button(name, on_click=step).props("dense outline")

    def _confirm(self) -> None:
        """Confirm the question that this window shows, even if a newer one exists."""
        self.bench.save(self._key)

    def show(self, afresh: bool) -> None:
        """Show the state; redraw the numbers only if the view changed."""
        bench, record = self.bench, self.bench.session.record
        if afresh:
            self._numbers(bench.view or {})
        for button, usable in (
            (self.undo, record.state.parent is not None),
            (self.redo, bool(record.forward.get(record.branch))),
            (self.fit, bool(bench.view)),
            (self.save, record.state.parent is not None),
        ):
            button.set_enabled(usable and not bench.busy)
        self.work.set_visibility(bench.busy)
        self.stage.set_text(bench.stage)
        self.fraction.set_value(bench.fraction)
        question = bench.question
        self.asked.set_visibility(question is not None)
        if question is not None:
            self._key = question.key
            self.question.set_text(write_micro(question.words))
        self.message.set_visibility(bool(bench.message) and not bench.busy)
        self.message.set_text(write_micro(bench.message))
        self.message.style(f"color: {COLOURS['amber'] if bench.failed else QUIET}")

    def _numbers(self, view: dict[str, Any]) -> None:
        verdict = view.get("verdict", NOTHING)
        self.verdict.set_text(write_micro(verdict["words"]))
        colour = COLOURS[verdict["colour"]]
        self.verdict.style(f"border-left: 6px solid {colour}; padding-left: 8px")
        self.numbers.clear()
        with self.numbers:
            for tile in view.get("tiles", []):
                _tile(tile)
            if budget := view.get("budget"):
                with ui.column().classes("gap-0"):
                    ui.label(budget["title"]).classes("text-xs").style("opacity: 0.75")
                    ui.label(" · ".join(budget["parts"])).props("id=budget").tooltip(
                        budget["about"]
                    )
            if words := " · ".join(filter(None, (view.get("counts"), view.get("chi2")))):
                ui.label(words).props("id=counts").classes("text-xs")
            if iso := view.get("iso"):
                figures = ui.label(iso[0]).props("id=iso").classes("text-xs")
                if iso[1:]:
                    figures.tooltip(" · ".join(iso[1:]))
            if warnings := view.get("warnings"):
                count = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
                with ui.expansion(count).props("dense id=warnings").classes("text-xs"):
                    for text in warnings:
                        ui.label(text)


def _tile(tile: dict[str, Any]) -> None:
    with ui.column().classes("gap-0"):
        ui.label(tile["name"]).classes("text-xs").style("opacity: 0.75")
        for value, unit, kind in tile["values"]:
            ui.label(f"{value} {unit}").classes("text-lg leading-tight").tooltip(
                f"{kind}: {tile['about']}, rms"
            )
