"""The one step that the page proposes: its only filled button."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from parallel_cal.reporting.names import title_of
from parallel_cal.workbench.bench import Bench

USUAL_POSES = 20  # of a plan


@dataclass(frozen=True)
class NextStep:
    """A step in words, and what a click does."""

    words: str
    begin: Callable[[], object]


@dataclass(frozen=True)
class WaysOn:
    """What a click on the page opens: the dialog that imports a table, the poses to measure."""

    import_table: Callable[[], object]
    show_poses: Callable[[], object]


def find_next_step(bench: Bench, ways: WaysOn) -> NextStep | None:
    """Find the step that follows from the state: Import, Fit, Add, Find its law, Plan poses, Save,
    or poses to measure.

    None while the present model is not judged yet, and if it is the one in use and nothing is left
    to decide.
    """
    view, state = bench.view, bench.session.state
    if view is None:
        return None
    if not bench.has_samples:
        if bench.live is not None:
            return NextStep("Take samples", bench.take)
        return NextStep("Import a table", ways.import_table)
    if not state.errors:
        return NextStep("Fit", partial(bench.begin, "fit"))
    if (answers := view.get("answers")) is None:
        return None
    if view["needs_poses"]:
        if bench.planned is None:
            return NextStep(f"Plan {USUAL_POSES} poses", partial(bench.begin, "plan", USUAL_POSES))
        return NextStep("See the planned poses", ways.show_poses)
    if offered := view["offered"]:
        names = " and ".join(map(title_of, offered["effects"]))
        return NextStep(f"Add {names}", partial(bench.begin, "add", offered["text"]))
    if view["find_law"] and answers["is_left"] == "yes" and bench.law_view is None:
        return NextStep("Find its law", bench.find_law)
    if not bench.is_saved:
        return NextStep("Save", bench.save)
    words = offer_deciding_poses(view)
    return NextStep(words, ways.show_poses) if words else None


def offer_deciding_poses(view: Mapping[str, Any]) -> str:
    """Name the planned poses that separate effects which explain the samples equally well."""
    count = view.get("deciding_poses", 0)
    return f"See {count} poses that help to decide" if count else ""
