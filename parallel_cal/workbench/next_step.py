"""The one step that the page proposes: its only filled button."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from parallel_cal.reporting.names import title_of
from parallel_cal.workbench.bench import Bench


@dataclass(frozen=True)
class NextStep:
    """A step in words, and what a click does."""

    words: str
    begin: Callable[[], object]


def find_next_step(bench: Bench, import_table: Callable[[], object]) -> NextStep | None:
    """Find the step that follows from the state: Import, Fit, Add, Find its law or Save.

    None while the present model is not judged yet, and if it is the one in use.
    """
    view, state = bench.view, bench.session.state
    if view is None:
        return None
    if not bench.has_samples:
        if bench.live is not None:
            return NextStep("Take samples", bench.take)
        return NextStep("Import a table", import_table)
    if not state.errors:
        return NextStep("Fit", partial(bench.begin, "fit"))
    if (answers := view.get("answers")) is None:
        return None
    if offered := view["offered"]:
        names = " and ".join(map(title_of, offered["effects"]))
        return NextStep(f"Add {names}", partial(bench.begin, "add", offered["text"]))
    if view["find_law"] and answers["is_left"] == "yes" and bench.law_view is None:
        return NextStep("Find its law", bench.find_law)
    return None if bench.is_saved else NextStep("Save", bench.save)
