"""What is always in view, and the numbers: the header, the notice below, the card Errors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.reporting.blocks import Tile
from parallel_cal.reporting.markup import tiles
from parallel_cal.reporting.names import name_effects
from parallel_cal.reporting.readable import write_micro
from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.campaign_card import CampaignBar
from parallel_cal.workbench.widgets import Chip, card, table

READING = {"words": "Reading the measurements. This takes a few seconds."}
NOTHING = {"words": "no samples in this session yet"}
UNJUDGED = {"word": "", "label": "not judged yet"}
CAMPAIGN_RUNS = {"words": "The campaign is measuring. Press Take samples to see its samples here."}


class Header:
    """The header; drawn once, because a button that is redrawn under the mouse loses the click.

    It has one line, and one more at a robot. A low window, or one that is zoomed, has no room for
    more.
    """

    def __init__(self, bench: Bench):
        self.bench = bench
        self.campaign: CampaignBar | None = None
        header = ui.header().classes("shadow")
        with header, ui.column().classes("w-full no-wrap gap-1"):
            ui.link("Skip to the content", "#content").classes("skip-link")
            if bench.live is not None:
                header.classes("at-robot")
                header.on("vue:mounted", js_handler="() => followHeaderHeight()")
                self.campaign = CampaignBar(bench.live)
            with ui.row().classes("w-full no-wrap items-center gap-3"):
                with ui.element().classes("judged grow basis-0 min-w-0"):
                    with ui.row().classes("said grow min-w-0 no-wrap items-center gap-0") as said:
                        said.props("id=verdict role=status aria-live=polite")
                        self.chip = Chip()
                        self.verdict = ui.label().classes("truncate")
                    with said:
                        self.whole = ui.tooltip()
                    with ui.row().classes("headline items-center no-wrap gap-2 shrink-0") as row:
                        self.headline = row
                        self.about = ui.label().classes("headline-about quiet text-xs")
                        self.errors = ui.label().props("id=headline")
                with ui.row().classes("items-center no-wrap gap-2 min-w-0") as self.work:
                    self.stage = ui.label().classes("truncate").props("id=stage")
                    self.fraction = ui.linear_progress(0.0, show_value=False).classes("w-24")
                    self.fraction.props('aria-label="progress"')
                    _button("Cancel", bench.cancel)
                with ui.row().classes("no-wrap gap-2 shrink-0"):
                    self.undo = _button("Undo", partial(bench.run_now, "undo"))
                    self.redo = _button("Redo", partial(bench.run_now, "redo"))
                    self.fit = _button("Fit", partial(bench.begin, "fit"))
                    self.save = _button("Save", lambda: bench.save())
                    self.save.tooltip(
                        f"write this model to {bench.output}, unless the model there is better"
                    )

    def show(self, afresh: bool) -> None:
        """Show the state; change the numbers only if the view changed."""
        bench, record = self.bench, self.bench.session.record
        if afresh:
            self.show_verdict()
            about, errors = _headline((bench.view or {}).get("tiles", []))
            self.about.set_text(about)
            self.errors.set_text(errors)
        for button, usable in (
            (self.undo, record.state.parent is not None),
            (self.redo, bool(record.forward.get(record.branch))),
            (self.fit, bench.has_samples),
            (self.save, record.state.parent is not None),
        ):
            button.set_enabled(usable and not bench.busy)
        self.work.set_visibility(bench.working)
        self.headline.set_visibility(not bench.working)
        self.stage.set_text(name_effects(bench.stage))
        self.fraction.set_value(bench.fraction)

    def show_verdict(self) -> None:
        """Show the word of the verdict, whose sentences are in the card Verdict; without samples,
        what the campaign at the robot does about it."""
        runs = self.campaign is not None and self.campaign.runs
        empty = READING if self.bench.view is None else CAMPAIGN_RUNS if runs else NOTHING
        verdict = (self.bench.view or {}).get("verdict", empty)
        words = name_effects(write_micro(verdict["words"]))
        has_card = self.bench.has_samples
        self.chip.show(verdict if "word" in verdict or not has_card else verdict | UNJUDGED)
        self.verdict.set_text("" if has_card else words)
        self.whole.set_text(words)


class Notice:
    """The line at the bottom of the window: the answer to the last step, or a question about it."""

    def __init__(self, bench: Bench):
        self.bench = bench
        self._key = ""  # key of the question that is shown
        self._dismissed = ""
        self._table: dict[str, Any] | None = None  # the one that is shown
        with ui.footer(value=False) as self.footer:
            self.compared = ui.column().classes("w-full").props("id=compared")
            with ui.row().classes("w-full items-center gap-2") as self.asked:
                self.question = ui.label().props("id=question role=alert")
                self.question.classes("grow basis-64 amber").style("white-space: pre-line")
                self.reason = ui.input("say why", on_change=self._allow_yes)
                self.reason.classes("w-64").props("dense")
                self.no = _button("", bench.decline)
                self.yes = _button("", self._confirm)
            with ui.row().classes("w-full no-wrap items-center gap-2") as self.answer:
                self.message = ui.label().props("id=message role=alert").classes("grow")
                _button("Dismiss", self._dismiss)

    def _confirm(self) -> None:
        """Confirm the question that this window shows, even if a newer one exists."""
        self.bench.confirm(self._key, self.reason.value.strip())

    def _allow_yes(self) -> None:
        """Let the owner insist only with a reason, which the histories record."""
        self.yes.set_enabled(bool((self.reason.value or "").strip()))

    def _dismiss(self) -> None:
        self._dismissed = self.bench.message
        self.show()

    def show(self) -> None:
        bench = self.bench
        question = bench.question
        self.asked.set_visibility(question is not None)
        if question is not None:
            if question.key != self._key:
                self.reason.set_value("")
            self._key = question.key
            self.question.set_text(name_effects(write_micro(question.words)))
            self.no.set_text(question.no)
            self.yes.set_text(question.yes)
            self._allow_yes()
        if bench.busy:
            self._dismissed = ""  # the next message may have the same words
        answered = bool(bench.message) and not bench.busy and bench.message != self._dismissed
        self.answer.set_visibility(answered)
        self.message.set_text(name_effects(write_micro(bench.message)))
        self.message.classes(**{"add" if bench.failed else "remove": "amber"})
        self._show_table()
        self.footer.set_value(answered or question is not None)

    def _show_table(self) -> None:
        """Show the table of the message or the question."""
        found = self.bench.table
        if found is not self._table:
            self._table = found
            self.compared.clear()
            if found is not None:
                with self.compared:
                    table(**found, key="model").classes("one-line-rows")
        self.compared.set_visibility(
            found is not None and (self.asked.visible or self.answer.visible)
        )


class ErrorsCard:
    """The card Errors: all numbers of the errors, and what they are made of."""

    def __init__(self) -> None:
        with card("Errors") as self.card:
            self.numbers = ui.column().classes("w-full gap-1")

    def show(self, view: dict[str, Any]) -> None:
        self.numbers.clear()
        with self.numbers:
            shown = [
                Tile(**tile | {"name": name_effects(tile["name"])})
                for tile in view.get("tiles", ())
            ]
            ui.html(tiles(shown), sanitize=False).classes("w-full")
            if budget := view.get("budget"):
                with ui.column().classes("gap-0 w-full"):
                    ui.label(budget["title"]).classes("text-xs quiet")
                    # A tooltip inside: `tooltip()` looks for an id that NiceGUI gives.
                    with ui.label(name_effects(" · ".join(budget["parts"]))).props("id=budget"):
                        ui.tooltip(budget["about"])
            if words := " · ".join(filter(None, (view.get("counts"), view.get("chi2")))):
                ui.label(words).props("id=counts").classes("text-xs w-full")
            if iso := view.get("iso"):
                figures = ui.label(iso[0]).props("id=iso").classes("text-xs")
                if iso[1:]:
                    with figures:
                        ui.tooltip(" · ".join(iso[1:]))
            if warnings := view.get("warnings"):
                count = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
                with ui.expansion(count).props("dense id=warnings").classes("text-xs"):
                    for text in warnings:
                        ui.label(name_effects(text))


def _headline(tiles: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """What the error now is, and its first kind: before and now if comparable, the noise floor."""
    by_name = {tile["name"]: tile for tile in tiles if tile["values"]}
    if (now := by_name.get("now")) is None:
        return "", ""
    comparable = {k: tile for k, tile in by_name.items() if tile["about"] == now["about"]}
    texts = {k: " ".join(tile["values"][0][:2]) for k, tile in comparable.items()}
    known = (texts[k] for k in ("nominal model", "now") if k in texts)
    fall = " → ".join(dict.fromkeys(known))  # an error that did not change is written once
    noise = texts.get("noise floor")
    return now["about"], f"{fall} · noise {noise}" if noise else fall


def _button(name: str, step: Any) -> Any:
    return ui.button(name, on_click=step).props("dense outline")
