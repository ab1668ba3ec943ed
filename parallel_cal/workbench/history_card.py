"""The part of the page with the steps of the session, its branches, and its documents."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from nicegui import ui

from parallel_cal.diagnosis.verdict_words import describe_verdict
from parallel_cal.reporting.names import name_effects, name_step
from parallel_cal.reporting.readable import format_judged_error, write_micro
from parallel_cal.workbench.bench import CERTIFICATE_FILE, Bench
from parallel_cal.workbench.widgets import card, table

if TYPE_CHECKING:
    from parallel_cal.session.history import State

STEP_COLUMNS = [
    ("step", "step"),
    ("samples", "samples"),
    ("before", "validation error before"),
    ("after", "validation error after"),
    ("out", "excluded samples"),
    ("verdict", "verdict"),
]
BRANCH_COLUMNS = [
    ("branch", "branch"),
    ("step", "last step"),
    ("after", "validation error"),
    ("out", "excluded samples"),
]


def draw_history_card(bench: Bench, layer: ui.element) -> None:
    """Show the steps and branches, and make certificates and reports; dialogs are in the layer."""
    session = bench.session
    with card("History"):
        rows = [_describe(state) for state in session.history()]
        reasons = [("reason", "reason")] * any(row["reason"] for row in rows)
        table([*STEP_COLUMNS, *reasons], rows, "history")
        several = len(session.record.branches) > 1
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
            if several:
                ui.button("Compare", on_click=partial(_compare, bench, layer)).props(
                    "dense outline"
                )
        with ui.row().classes("items-center"):
            ui.button("Certificate", on_click=partial(_certify, bench, layer)).props(
                "dense outline"
            )
            for words, as_pdf in (("Report", False), ("Report as PDF", True)):
                make = ui.button(words, on_click=partial(bench.make_report, as_pdf))
                make.props("dense outline").set_enabled(bench.has_samples and not bench.busy)
            for file in bench.reports:
                download = ui.button(
                    f"Download {file.name}", on_click=partial(ui.download.file, file)
                )
                download.props("dense no-caps")
        if several:
            compared = session.compared().items()
            branches = [{"branch": k, **_describe(state)} for k, state in compared]
            table(BRANCH_COLUMNS, branches, "branches")


def _describe(state: State) -> dict[str, Any]:
    """Return a row of a table: the step that led to a state, and what it reached."""
    verdict = describe_verdict(state.verdict, state.summary) or state.against
    return {
        "step": name_step(state.step),
        "samples": state.samples,
        "before": format_judged_error(state.before, state.sigmas_before),
        "after": format_judged_error(state.errors, state.sigmas),
        "out": len(state.excluded),
        "verdict": name_effects(write_micro(verdict)),
        "reason": state.reason,
    }


def _certify(bench: Bench, layer: ui.element) -> None:
    from parallel_cal.workbench.certificate_dialog import (
        CertificateDialog,  # imports NumPy, which nothing else here needs
    )

    with layer:
        CertificateDialog(bench.session.folder / CERTIFICATE_FILE)


async def _compare(bench: Bench, layer: ui.element) -> None:
    from parallel_cal.workbench.branch_comparison import (
        BranchComparison,  # imports NumPy, which nothing else here needs
    )

    with layer:
        comparison = BranchComparison(bench.session)
    await comparison.show_differences(bench.session)
