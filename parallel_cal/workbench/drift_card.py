"""The card Since the last calibration, of a session that updates one."""

from __future__ import annotations

from nicegui import ui

from parallel_cal.reporting.blocks import as_rows
from parallel_cal.reporting.names import name_effects
from parallel_cal.reporting.readable import write_micro
from parallel_cal.reporting.rechecks import describe_recheck, tabulate_parts
from parallel_cal.session.history import State
from parallel_cal.workbench.widgets import Chip, card, table

TITLE = "Since the last calibration"


def draw_drift_card(state: State) -> None:
    """Show whether the robot has drifted, and which part, if the fit of this state decided it."""
    if not state.recheck:
        return
    said = describe_recheck(state.recheck, state.drift)
    with card(TITLE):
        with ui.row().classes("items-center gap-2").props("id=drift"):
            Chip().show({"word": said.word, "label": said.label, "words": said.summary})
            ui.label(said.remarks[0]).classes("text-sm")
        ui.label(name_effects(write_micro(said.summary))).props("id=drift-words")
        if (parts := tabulate_parts(state.recheck)).rows:
            table(**as_rows(parts), key="what changed")
