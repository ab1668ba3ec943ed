"""The procedure of a campaign that decides whether a robot has drifted since its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.judging import Conclusion
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.campaign.procedure import RunningCampaign
from parallel_cal.campaign.status import Outcome
from parallel_cal.campaign.targets import POOL, Target
from parallel_cal.identification.age import USUAL_FACTOR
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.recheck import (
    CHANGED,
    DRIFTED,
    Recheck,
    recheck,
)
from parallel_cal.model.file.modelfile import parse_model, readable_text
from parallel_cal.planning.plan import plan
from parallel_cal.planning.posepool import make_pool
from parallel_cal.planning.visibility import stand_in_pose_device
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import with_noise
from parallel_cal.session.session import Session

PURPOSE = "to decide whether the robot has drifted"


class Update:
    """Decide after each pose; if the robot has drifted, measure until the updated model is nearly
    as certain as the last calibration. A `Procedure`; `found` is what is known so far."""

    judges_each_pose = True

    def __init__(self, campaign: RunningCampaign):
        self._campaign = campaign
        self.found: Recheck | None = None

    @property
    def verdict(self) -> str:
        return self.found.verdict if self.found else ""

    @property
    def reported(self) -> dict[str, Any]:
        if self.found is None:
            return {}
        return {
            "verdict": self.verdict,
            "effects": [],
            "laws": [],
            "diagnosis": {},
            "drift": self.found.document(),
        }

    def fitting(self, goal: Goal) -> FitOptions:
        return FitOptions(hold_out=goal.hold_out, joint_sigma=goal.joint_sigma, update=True)

    def plan(self, guard: Guard, text: str, goal: Goal) -> list[Target]:
        return plan_targets(guard, text, goal)

    def judge(self, over: str, due: bool) -> Outcome | None:
        campaign = self._campaign
        found: Recheck = campaign.work(judge, campaign.model, campaign.dataset, campaign.goal)
        self.found, words = found, found.warnings[0]
        campaign.report_status("judging", f"{len(campaign.samples)} samples; {found.progress}")
        if done := over or ("" if due else "all planned poses were measured"):
            return campaign.make_outcome(found.is_decided, f"{done}: {words}")
        return None if needs_more(found) else campaign.make_outcome(True, words)

    def conclude(self) -> Conclusion:
        campaign = self._campaign
        found: Conclusion = campaign.work(conclude, campaign.folder, campaign.dataset, self.found)
        return found


def plan_targets(guard: Guard, text: str, goal: Goal) -> list[Target]:
    """Plan the poses that decide soonest, at most as many as the goal allows.

    FitError if the model of this text was never fitted."""
    model = stand_in_pose_device(with_noise(parse_model(text)))
    pool = make_pool(model, POOL, np.random.default_rng(goal.seed), symmetric=False).poses
    allowed = pool[np.flatnonzero(guard.is_measurable(pool.joints))]
    if len(allowed) < goal.poses:
        raise PathError(
            f"only {len(allowed)} of {len(pool)} random poses in the workspace are allowed: "
            f"{guard.summarise_violations(pool.joints)}"
        )
    found = plan(model, goal.poses, pool=allowed, seed=goal.seed, update=True)
    return [Target(tuple(q), purpose=PURPOSE) for q in found.poses.joints.tolist()]


@single_threaded()
def judge(text: str, dataset: Dataset, goal: Goal) -> Recheck:
    """Decide whether the robot of this model file's text has drifted, by the samples so far."""
    return recheck(parse_model(text), dataset, goal.joint_sigma, certainty=goal.certainty)


def needs_more(found: Recheck) -> bool:
    """Whether further poses are worthwhile: it is not decided, or the robot has drifted and an
    updated model is not yet nearly as certain as the last calibration."""
    if found.verdict != DRIFTED or found.expected is None:
        return not found.is_decided
    return found.expected.growth > USUAL_FACTOR


@single_threaded()
def conclude(folder: Path, dataset: Dataset, found: Recheck) -> Conclusion:
    """Update the model if the robot has drifted: the last step of the campaign's session."""
    if found.verdict not in (DRIFTED, CHANGED):
        return Conclusion("", "the model is kept")
    session = Session(folder)
    session.take(dataset.to_json)
    if found.verdict == CHANGED:
        return Conclusion(
            "",
            "nothing was written, because the robot may be as it was; if the device stands, update "
            f"the model with 'parallel-cal session fit {folder}'",
        )
    try:
        state = session.fit()
    except FitError as error:
        return Conclusion("", f"{error}; nothing was written")
    if state.against:
        return Conclusion("", f"{state.against}; nothing was written")
    text = readable_text(session.model, "the campaign's updated model")
    return Conclusion(text, f"the model was updated with {len(dataset)} poses")
