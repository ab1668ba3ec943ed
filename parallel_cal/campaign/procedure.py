"""What a campaign is for decides its first poses, its judgements and its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from parallel_cal.campaign.cell import Sample
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.judging import Conclusion, Judgement
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.status import Outcome
from parallel_cal.campaign.targets import Target
from parallel_cal.identification.options import FitOptions
from parallel_cal.recordings.dataset import Dataset


class RunningCampaign(Protocol):
    """What a procedure uses of its campaign."""

    folder: Path
    goal: Goal
    model: str
    work: Callable[..., Any]

    @property
    def samples(self) -> Mapping[int, Sample]: ...

    @property
    def judgements(self) -> Sequence[Judgement]: ...

    @property
    def dataset(self) -> Dataset: ...

    @property
    def validation_mask(self) -> np.ndarray: ...

    def describe_skipped(self) -> str: ...

    def report_status(self, state: str, reason: str) -> None: ...

    def take_judgement(self, judgement: Judgement) -> None: ...

    def make_outcome(self, success: bool, message: str) -> Outcome: ...


class Procedure(Protocol):
    """One kind of campaign, chosen once by its goal.

    `judges_each_pose` is whether it judges after each pose, not only when all planned ones are
    measured. `verdict` is the latest one, empty before the first; `reported` are the keys of the
    campaign's document that it states, none before the first judgement."""

    judges_each_pose: bool

    @property
    def verdict(self) -> str: ...

    @property
    def reported(self) -> dict[str, Any]: ...

    def fitting(self, goal: Goal) -> FitOptions:
        """The options of the fits in the campaign's session."""
        ...

    def plan(self, guard: Guard, text: str, goal: Goal) -> list[Target]:
        """The first targets, for the model of this text; PathError if too few are allowed."""
        ...

    def judge(self, over: str, due: bool) -> Outcome | None:
        """Judge all samples; return an outcome if that was the last step. `over` is the limit that
        was reached, if one was; `due` is whether planned poses remain."""
        ...

    def conclude(self) -> Conclusion:
        """The last step: the model that is proven better, if there is one."""
        ...
