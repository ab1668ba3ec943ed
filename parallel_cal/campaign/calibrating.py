"""The procedure of a campaign that calibrates a robot: diagnoses between batches of poses."""

from __future__ import annotations

from typing import Any

from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.judging import (
    Conclusion,
    Judgement,
    JudgementRequest,
    conclude,
    judge_samples,
)
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.procedure import RunningCampaign
from parallel_cal.campaign.status import Outcome
from parallel_cal.campaign.targets import Target, first_targets
from parallel_cal.identification.options import FitOptions
from parallel_cal.session.session import Session

BATCH = 8  # poses between two judgements


class Calibration:
    """Judge the samples when all planned poses are measured; each judgement may plan further ones.

    A `Procedure`; its state are the campaign's judgements."""

    judges_each_pose = False

    def __init__(self, campaign: RunningCampaign):
        self._campaign = campaign

    @property
    def _last(self) -> Judgement | None:
        judgements = self._campaign.judgements
        return judgements[-1] if judgements else None

    @property
    def verdict(self) -> str:
        return self._last.verdict if self._last else ""

    @property
    def reported(self) -> dict[str, Any]:
        return self._last.reported if self._last else {}

    def fitting(self, goal: Goal) -> FitOptions:
        return FitOptions(hold_out=goal.hold_out, joint_sigma=goal.joint_sigma)

    def plan(self, guard: Guard, text: str, goal: Goal) -> list[Target]:
        return first_targets(guard, goal.poses, goal.seed)

    def judge(self, over: str, due: bool) -> Outcome | None:
        campaign, goal, last = self._campaign, self._campaign.goal, self._last
        unjudged = len(campaign.samples) - (last.samples if last else 0)
        if not over and unjudged == 0:
            skipped = campaign.describe_skipped()
            return campaign.make_outcome(False, f"no further pose can be reached: {skipped}")
        if last is None or unjudged:
            campaign.report_status("judging", f"{len(campaign.samples)} samples")
            dataset = campaign.dataset
            Session(campaign.folder).take(dataset.to_json)
            left = 0 if over else goal.poses - len(campaign.samples)
            seed = goal.seed + 1 + len(campaign.judgements)
            changes = {"payload": goal.payload, "temperature": goal.warmer}
            question = JudgementRequest(
                campaign.model,
                goal.keep_out,
                goal.reach,
                goal.effects,
                min(BATCH, left),
                left,
                changes,
                seed,
                self.fitting(goal),
            )
            before = last
            last = campaign.work(judge_samples, question, dataset, campaign.validation_mask)
            campaign.take_judgement(last)
        else:
            before = campaign.judgements[-2] if len(campaign.judgements) > 1 else None
        if goal.enough and last.validation_error <= goal.enough:
            return campaign.make_outcome(
                True, f"the error at the validation poses is small enough: {last.summary}"
            )
        if not goal.enough and last.is_final(before):
            alike = last.untold and f"; no poses can distinguish {' from '.join(last.untold)}"
            return campaign.make_outcome(True, f"{last.summary}{alike or ''}")
        if over:
            wanted = "; ".join(one for one in last.missing if one not in last.summary)
            return campaign.make_outcome(False, f"{over}: {last.summary}{wanted and f'; {wanted}'}")
        return None

    def conclude(self) -> Conclusion:
        found: Conclusion = self._campaign.work(
            conclude, self._campaign.folder, self._campaign.judgements
        )
        return found
