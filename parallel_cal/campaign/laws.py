"""Search the law of an error that no effect describes, and plan poses that tell rivals apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from parallel_cal.base.progress import Progress
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.targets import Target, find_allowed_changes, plan_deciding_targets
from parallel_cal.discovery.discovery import discover
from parallel_cal.discovery.in_session import list_effects
from parallel_cal.discovery.law import Discovery
from parallel_cal.discovery.rivals import pair_laws
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class LawSearch:
    """Proven laws, if any.

    `laws` are names in words, such as `joint2 by load.joint2`; `effects` the text of each law's
    effect file, by the name of the effect. `rivals` are laws that describe the data equally well;
    `untold` are those, and their laws, that no poses can distinguish. `missing` says what would
    decide. `targets` are the poses to measure next; empty if poses decide nothing."""

    summary: str
    laws: tuple[str, ...] = ()
    effects: Mapping[str, str] = field(default_factory=dict)
    rivals: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()


def search_laws(
    model: Model,
    dataset: Dataset,
    options: FitOptions,
    guard: Guard,
    n: int,
    left: int,
    changes: Mapping[str, float],
    seed: int = 0,
    progress: Progress | None = None,
) -> LawSearch:
    """Search the law of what the model leaves, and plan the next n targets: poses at which a law
    and an equally good one differ most. Up to `left` poses may be measured in all; `changes` says
    by how much conditions may be changed."""
    found = discover(model, dataset, options=options, progress=progress)
    if found.verdict != "described":
        missing = (found.summary,) if found.suspected else ()
        return LawSearch(found.summary, missing=missing)
    laws = tuple(law.name for law in found.laws)
    rivals = tuple(dict.fromkeys(name for law in found.laws for name in law.alternatives))
    targets = _plan(found, options, guard, n, left, changes, seed) if n else ()
    return LawSearch(
        found.summary,
        laws,
        list_effects(found.laws),
        rivals,
        () if targets else (*laws, *rivals),
        found.measure_next,
        targets,
    )


def _plan(
    found: Discovery,
    options: FitOptions,
    guard: Guard,
    n: int,
    left: int,
    changes: Mapping[str, float],
    seed: int,
) -> tuple[Target, ...]:
    """The targets that tell one law from another, of the first pair that poses can tell; none if
    poses can tell no pair."""
    so_far = found.dataset.conditions
    may = find_allowed_changes(so_far, changes)
    for doubt in pair_laws(found, options):
        if targets := plan_deciding_targets(doubt, so_far, guard, n, left, may, seed):
            return tuple(targets)
    return ()
