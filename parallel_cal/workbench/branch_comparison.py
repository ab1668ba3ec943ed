"""The comparison of branches: their errors, and their residuals in one scale and one view."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import numpy as np
from nicegui import run, ui

from parallel_cal.diagnosis.verdict_words import describe_verdict
from parallel_cal.reporting.names import name_effects, name_step
from parallel_cal.reporting.readable import MISSING, format_judged_error, write_micro
from parallel_cal.reporting.spaces import sides
from parallel_cal.session.history import History, format_first_error
from parallel_cal.workbench.bench import load_view
from parallel_cal.workbench.prediction_difference import compare_predictions
from parallel_cal.workbench.widgets import draw_figure, table


class BranchComparison:
    """A dialog with the last state of every branch."""

    def __init__(self, session: History):
        self.camera: Any = None
        states = session.compared()
        views = {name: load_view(session, state.number) or {} for name, state in states.items()}
        fields = {name: v["field"] for name, v in views.items() if v.get("field")}
        # A dialog that grows from nothing has no size by which Plotly could draw in space.
        dialog = ui.dialog(value=True)
        dialog.props('maximized transition-show=fade aria-label="Compare branches"')
        with dialog, ui.card():
            ui.label("Compare branches").classes("text-lg font-bold")
            rows = [
                {
                    "branch": name,
                    "step": name_step(s.step),
                    "out": len(s.excluded),
                    "verdict": name_effects(write_micro(describe_verdict(s.verdict, s.summary))),
                    "after": format_judged_error(s.errors, s.sigmas),
                    "noise": write_micro(format_first_error(s.noise, MISSING)),
                }
                for name, s in states.items()
            ]
            table(
                [
                    ("branch", "branch"),
                    ("step", "last step"),
                    ("after", "validation error"),
                    ("noise", "noise floor"),
                    ("out", "excluded samples"),
                    ("verdict", "verdict"),
                ],
                rows,
                "branch",
            )
            with ui.row().classes("w-full no-wrap side-by-side"):
                self.plots = self._plots(fields) if fields else []
            self.differences = ui.column().classes("w-full gap-2")
            for name in sorted(set(states) - set(fields)):
                ui.label(
                    f"{name}: no residuals to show: its last state was not diagnosed. Switch to "
                    "this branch first."
                )
            ui.button("Close", on_click=dialog.close).props("dense outline")

    async def show_differences(self, session: History) -> None:
        """Show how far the predictions of each other branch differ from those of this one."""
        this = session.record.branch
        for name in session.record.branches:
            if name == this:
                continue
            shown = await run.cpu_bound(compare_predictions, session.folder, this, name)
            if shown is None or self.differences.is_deleted:
                return  # the server or the dialog was closed meanwhile
            with self.differences:
                ui.label(shown["words"])
                if figure := shown.get("figure"):
                    draw_figure(figure, f"difference of the predictions of {name}")

    def _plots(self, fields: dict[str, Any]) -> list[Any]:
        """Draw the residuals of each branch with a common scale and common axes."""
        models = [
            (
                np.array(field["places"], dtype=float).reshape(-1, 3),
                np.array(field["vectors"], dtype=float).reshape(-1, 3),
                np.array(field["numbers"]),
            )
            for field in fields.values()
        ]
        figures, scale = sides(models, next(iter(fields.values()))["kind"])
        plots = []
        for name, figure in zip(fields, figures, strict=True):
            with ui.column().classes("flex-1 min-w-0 gap-0"):
                ui.label(f"{name}: residuals, magnified {scale:g} times")
                plot = draw_figure(figure, f"residuals of {name}")
                plot.on("plotly_relayout", partial(self._turn, plot))
            plots.append(plot)
        return plots

    def _turn(self, turned: Any, event: Any) -> None:
        """Turn the other plots like the one that was turned; ignore the events that this causes."""
        camera = (event.args or {}).get("scene.camera")
        if camera is None or camera == self.camera:
            return
        self.camera = camera
        for plot in self.plots:
            if plot is not turned:
                ui.run_javascript(
                    f"Plotly.relayout(getElement({plot.id}).$el, "
                    f"{{'scene.camera': {json.dumps(camera)}}})"
                )
