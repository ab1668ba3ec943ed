"""The dialog that asks at which values parameters are fixed, and says what fixing does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nicegui import ui

from parallel_cal.base.units import UNITS
from parallel_cal.reporting.blocks import DIGITS
from parallel_cal.workbench.widgets import table

CONSEQUENCE = (
    "A fixed parameter counts as exactly known. It has no sigma, and the sigmas of parameters that "
    "are correlated with it become smaller, because they no longer contain its uncertainty. Fix a "
    "parameter only if you know its value better than these samples do."
)
PRESENT = "the present values (identified from these samples, not measured separately)"
NOMINAL = "the nominal values"
MEASURED = "values that were measured separately:"


def ask_where_to_fix(
    rows: Sequence[dict[str, Any]], fix: Callable[[bool, Mapping[str, float]], None]
) -> None:
    """Show the marked parameters (rows of the page's table); the answer calls `fix` with whether
    they get their nominal values, and with their measured values in SI units, if stated."""
    dialog = ui.dialog(value=True).props('aria-label="Fix parameters"')
    with dialog, ui.card().classes("max-w-2xl"):
        ui.label("Fix parameters").classes("text-lg font-bold")
        columns = ("name", "value", "sigma", "nominal", "unit")
        names = {"name": "parameter", "value": "present value"}
        # With the digits to which the page rounds each number.
        shown = [{k: row[k] for k in row if k.removesuffix(DIGITS) in columns} for row in rows]
        table([(key, names.get(key, key)) for key in columns], shown, "name")
        at = ui.radio([PRESENT, NOMINAL, MEASURED], value=PRESENT)
        at.props('aria-label="values at which the parameters are fixed"')
        with ui.row() as entries:
            stated = {
                row["name"]: ui.number(f"{row['name']} [{row['unit']}]", value=row["value"])
                for row in rows
            }
        entries.bind_visibility_from(at, "value", value=MEASURED)
        ui.label(CONSEQUENCE).classes("text-sm").props("id=consequence")

        def answer() -> None:
            values = {}
            if at.value == MEASURED:
                if any(entry.value is None for entry in stated.values()):
                    return ui.notify("state a value for each parameter")
                values = {
                    row["name"]: float(stated[row["name"]].value) * UNITS.get(row["unit"], 1.0)
                    for row in rows
                }
            dialog.close()
            fix(at.value == NOMINAL, values)

        with ui.row():
            ui.button("Fix and fit again", on_click=answer).props("dense")
            ui.button("Cancel", on_click=dialog.close).props("dense outline")
