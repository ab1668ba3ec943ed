"""The fewest poses that would confirm what a watch suspects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from parallel_cal.planning.options import PlanOptions
from parallel_cal.planning.plan import Plan, plan
from parallel_cal.recordings.simulate import with_noise
from parallel_cal.watch.changes import DRIFT, STEP

if TYPE_CHECKING:
    from parallel_cal.watch.watch import Suspect, Watch

NUMBERS_OF_POSES = (3, 6, 12, 24)
MIN_SIGMAS = 5.0  # of a change beside its rival: then chance decides in one of two million cases


@dataclass(frozen=True)
class Confirmation:
    """Poses that separate the suspect from its rival, with the sigma (SI) that they give each."""

    plan: Plan
    suspect: Suspect
    rival: Suspect | None
    sigma: float
    rival_sigma: float | None

    @property
    def decides(self) -> bool:
        """Whether the change would stand out by five sigmas, with the rival unknown."""
        return abs(self.suspect.value) >= MIN_SIGMAS * self.sigma


def plan_confirmation(watch: Watch) -> Confirmation | None:
    """Plan the poses to measure after an alarm; None if no parameter of the model is suspected.

    The two parameters, of different parts if possible, are identified together from poses that are
    optimal for both (criterion D); the others are as they were.
    """
    geometry = set(watch.model.table.names)
    able = [s for s in watch.suspects if s.kind in (STEP, DRIFT) and s.parameter in geometry]
    if not able:
        return None
    first = able[0]
    rivals = [s for s in able if s.parameter != first.parameter and s.probability > 0.01]
    rival = next((s for s in rivals if s.part != first.part), next(iter(rivals), None))
    wanted = {first.parameter, *([rival.parameter] if rival else [])}
    fix = [name for name in watch.model.table.names if name not in wanted]
    model = with_noise(watch.model)
    for number in NUMBERS_OF_POSES:
        found = plan(model, number, PlanOptions(criterion="D", free=[*wanted], fix=fix, pool=300))
        sigma = dict(zip(found.names, found.expected.sigma.tolist(), strict=True))
        other = sigma[rival.parameter] if rival else None
        confirmation = Confirmation(found, first, rival, sigma[first.parameter], other)
        if confirmation.decides:
            break
    return confirmation
