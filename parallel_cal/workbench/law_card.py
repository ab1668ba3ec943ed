"""The part of the page that finds the law of an error that no effect describes."""

from __future__ import annotations

from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.workbench.bench import Bench
from parallel_cal.workbench.widgets import card, draw_figure, table

OFFER = (
    "The effects of the catalogue do not describe this error completely, or only with an effect "
    "that is larger than usual. The search finds where the error enters and on what it depends, "
    "without the catalogue. It takes about as long as a diagnosis."
)


def draw_law_card(bench: Bench, view: dict[str, Any]) -> None:
    """Offer the search where the catalogue left something; show the laws of this state, if any."""
    found = bench.law_view
    if found is None and not view.get("find_law"):
        return
    with card("Law of the error"):
        if found is None:
            ui.label(OFFER)
            find = ui.button("Find its law", on_click=bench.find_law).props("dense outline")
            find.set_enabled(not bench.busy)
            return
        ui.label(found["words"]).props("id=law role=status")
        for one in found["figures"]:
            draw_figure(one["figure"], one["words"])
        if found["table"]["rows"]:
            table(**found["table"], key="law")
        for one in found["effects"]:
            _draw_addition(bench, f"Add {one['law']}", one["name"], f"effect file: {one['file']}")
        if len(found["effects"]) > 1:
            every = "+".join(one["name"] for one in found["effects"])
            _draw_addition(bench, "Add all laws", every, "")
        for advice in found["advice"]:
            ui.label(f"Measure next: {advice}").classes("text-sm")


def _draw_addition(bench: Bench, title: str, effects: str, remark: str) -> None:
    with ui.row().classes("w-full items-center"):
        add = ui.button(title, on_click=partial(bench.begin, "add", effects))
        add.props("dense outline no-caps").set_enabled(not bench.busy)
        ui.label(remark).classes("text-xs break-all").style("opacity: 0.75")
