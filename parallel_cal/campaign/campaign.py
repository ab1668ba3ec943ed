"""Run a campaign: plan poses, move, measure, check the samples, judge them, choose further poses.

Everything is written to the campaign's folder at once. Its journal `campaign.jsonl` has one line
for each target, sample and judgement; a session in the same folder holds the steps. A campaign that
is opened again continues where it stopped, for whatever reason it stopped.
"""

from __future__ import annotations

import logging
import operator
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.calibrating import Calibration
from parallel_cal.campaign.cell import (
    AbortRequested,
    Cell,
    Control,
    PauseRequested,
    Question,
    Sample,
    UnseenError,
)
from parallel_cal.campaign.checking import Checker, ImplausibleSample
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.journal import (
    CampaignError,
    Journal,
    is_same_but_for_limits,
    with_limits_of,
)
from parallel_cal.campaign.judging import Judgement, select_primary_error
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.campaign.procedure import Procedure
from parallel_cal.campaign.status import Curve, CurvePoint, Outcome, Status
from parallel_cal.campaign.targets import ADJUSTABLE_CONDITIONS, Target
from parallel_cal.campaign.trajectory import plan_trajectory
from parallel_cal.campaign.updating import Update
from parallel_cal.identification.observations import observe
from parallel_cal.model.file.modelfile import model_hash, parse_model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.session.session import FILE as SESSION
from parallel_cal.session.session import Session

log = logging.getLogger(__name__)

MAX_UNSEEN_IN_A_ROW = 6  # targets; a camera that is covered sees none of them

Tell = Callable[[Status], None]
Work = Callable[..., Any]  # a function and its arguments -> its result


class Campaign:
    """A campaign in a folder, started with a model file's text or continued.

    Every sample and judgement is on disk before the next one begins: a campaign that was
    interrupted continues where it was. `run` takes it to its end.

    Parameters
    ----------
    folder : str or Path
        Folder of the campaign; created if it does not exist.
    model : str
        Text of the model file.
    goal : Goal
        When the campaign ends, and its limits.
    cell : Cell
        The robot and its measuring device.
    tell : callable, optional
        Receives each status. Default: nobody is told.
    work : callable, optional
        `work(function, *arguments)` runs the long computations. Default: at once.
    control : Control, optional
        Pauses or aborts the campaign from another thread.

    Raises
    ------
    CampaignError
        If another process uses the folder, or it holds the campaign of another model.
    ModelFileError
        If the model cannot be read.
    """

    def __init__(
        self,
        folder: str | Path,
        model: str,
        goal: Goal,
        cell: Cell,
        tell: Tell = lambda status: None,
        work: Work = operator.call,
        control: Control | None = None,
    ):
        parse_model(model, "the campaign's model")  # store nothing that cannot be read again
        self.folder, self.goal, self.control = Path(folder), goal, control or Control()
        self._cell, self._tell, self.work = cell, tell, work
        self.folder.mkdir(parents=True, exist_ok=True)
        self._journal = Journal(self.folder, model)
        self._unseen = 0  # targets in a row at which the device saw too little
        self._status = Status("planning", "", 0, np.nan, "")
        self._procedure: Procedure = Update(self) if goal.update else Calibration(self)
        self._continue_with(model)
        last = next(reversed(self.samples), None)
        self._sent = None if last is None else np.array(self.targets[last].joints)
        if not (self.folder / SESSION).exists():
            fitting = self._procedure.fitting(goal)
            Session.new(self.folder, parse_model(model), [], fitting=fitting)
        self._use_model_of(self.judgements[-1] if self.judgements else None)

    def _continue_with(self, model: str) -> None:
        """Go on with this model file's text, in which the limits of the motion may have changed."""
        journal = self._journal
        self.model, before = model, journal.model
        self.targets, self.samples, self.left_out = (
            journal.targets,
            journal.samples,
            journal.left_out,
        )
        self.warnings = journal.warnings
        other = "" if is_same_but_for_limits(before, model) else "of another model"
        if self.targets and journal.is_update != self.goal.update:
            other = "with another goal (only one of both is an update)"
        if other:
            journal.close()
            raise CampaignError(
                f"{self.folder}: this folder holds the campaign {other}; choose another folder"
            )
        if self.targets and model_hash(before) != model_hash(model):
            journal.write(model=model)
        # A limit that the owner has changed holds for the models found before, too.
        self.judgements = [
            replace(one, text=with_limits_of(one.text, model)) for one in journal.judgements
        ]
        if not self.targets:
            journal.write(begin=to_json_value(self.goal), model=model)
        journal.leave_out_ignored_targets()

    def close(self) -> None:
        """Release the folder."""
        self._journal.close()

    @property
    def spent(self) -> float:
        """Seconds so far, including earlier runs of this campaign."""
        return self._journal.spent

    @property
    def dataset(self) -> Dataset:
        """All samples, in the order in which they were measured."""
        found = list(self.samples.values())
        return join_datasets([s.dataset for s in found], [s.start_ns for s in found])

    @property
    def _last(self) -> Dataset | None:
        """The newest sample."""
        last = next(reversed(self.samples.values()), None)
        return None if last is None else last.dataset

    @property
    def validation_mask(self) -> np.ndarray:
        """Mask (N,) of the samples at validation poses, which no fit may use."""
        return np.array([self.targets[k].unseen for k in self.samples], dtype=bool)

    @property
    def curve(self) -> Curve:
        """The error at the validation poses: of the initial model, and after each judgement."""
        if not self.judgements:
            return Curve()
        last = self.judgements[-1]
        kind = next(iter(last.unseen), "position")
        points = [CurvePoint(0, select_primary_error(last.before))]
        points += [
            CurvePoint(one.samples, one.validation_error, one.effects) for one in self.judgements
        ]
        return Curve(tuple(points), kind, last.floor.get(kind))

    # ------------------------------------------------------------------ the loop

    def run(self) -> Outcome:
        """Run until the campaign ends; stop the robot in every case."""
        for text in self.warnings:
            log.warning("%s", text)
            self.report_status("planning", text)
        try:
            while True:
                try:
                    if (outcome := self._step()) is not None:
                        return self._end(outcome)
                except PauseRequested:
                    self._cell.stop()
                    self.report_status("paused", "on request; call resume to continue")
                    self.control.wait()
        except AbortRequested:
            self._cell.stop()
            return self._make_stopped_outcome(
                "aborted on request; repeat the calibrate command to continue"
            )
        except ParallelCalError as error:
            self._cell.stop()
            return self._make_stopped_outcome(str(error))
        except BaseException:
            self._cell.stop()
            raise

    def _step(self) -> Outcome | None:
        """Measure one pose or judge once; return the outcome if that was the last step."""
        self.control.check_interrupted()
        if not self.targets:
            self.report_status("planning", "selecting the first poses")
            for name in self.goal.effects:
                load_effect(name)  # reject unknown effects before the robot moves
            self._add_targets(self._procedure.plan(self._guard, self.model, self.goal))
        due = [
            k for k in range(len(self.targets)) if k not in self.samples and k not in self.left_out
        ]
        over = ""
        if len(self.samples) >= self.goal.poses:
            over = f"{len(self.samples)} poses were measured, the maximum that was allowed"
        elif self.spent > 60 * self.goal.minutes:
            over = f"the time limit of {self.goal.minutes:g} minutes was reached"
        ends_plan = bool(over or not due)
        if ends_plan and not self.samples:
            raise CampaignError(over or f"no pose can be reached: {self.describe_skipped()}")
        if self.samples and (ends_plan or self._procedure.judges_each_pose):
            outcome = self._procedure.judge(over, bool(due))
            if outcome is not None or ends_plan:
                return outcome
        self._measure(due[0])
        return None

    def describe_skipped(self) -> str:
        """Give each reason for a skipped target once."""
        return "; ".join(dict.fromkeys(self.left_out.values()))

    def report_status(
        self, state: str, reason: str, purpose: str = "", questions: tuple[Question, ...] = ()
    ) -> None:
        """Tell the state, and why."""
        last = self.judgements[-1] if self.judgements else None
        self._status = Status(
            state,
            reason,
            len(self.samples),
            last.validation_error if last else np.nan,
            self._procedure.verdict,
            purpose,
            questions,
            self.curve,
        )
        self._tell(self._status)

    # ------------------------------------------------------------------ one pose

    def _measure(self, k: int) -> None:
        """Measure a target, or skip it if no path to it is allowed."""
        target = self.targets[k]
        self._request_conditions(target.conditions)
        try:
            sample = self._take_sample(
                target, f"pose {k + 1} of {len(self.targets)}, {target.purpose}"
            )
        except PathError as error:
            # From a forbidden pose no target can be reached: stop instead of skipping them all.
            if self._guard.describe_violation(self._get_current_joints()):
                raise
            self._journal.leave_out(k, str(error))
            return
        except UnseenError as error:
            self._unseen += 1
            if self._unseen >= MAX_UNSEEN_IN_A_ROW:
                raise
            self._journal.leave_out(k, str(error))
            return
        self._unseen = 0
        again = None
        try:
            self._checker.check(sample.dataset, np.array(target.joints), self._last)
        except ImplausibleSample as odd:
            again = self._remeasure_previous(odd)
        self._store_sample(k, sample)
        if again is not None:
            self._add_targets([again[0]])
            self._store_sample(len(self.targets) - 1, again[1])

    def _take_sample(self, target: Target, why: str) -> Sample:
        """Move to a target and take its sample; PathError if no path is allowed."""
        stops = [np.array(q) for q in (*target.via, target.joints)]
        here = self._get_current_joints()
        try:  # approach by a move longer than the backlash, if that path is allowed
            path = self._guard.plan_path(here, self._guard.lengthen_approach(here, stops))
        except PathError:
            path = self._guard.plan_path(here, stops)
        self.report_status("moving", why, target.purpose)
        self._cell.move(
            plan_trajectory(path, self._guard.model.mechanism), self.control.check_interrupted
        )
        self._checker.check_arrived(self._cell.joints(), stops[-1], path)
        self._sent = stops[-1]
        self.report_status("sampling", why, target.purpose)
        return self._cell.sample(self.control.check_interrupted)

    def _get_current_joints(self) -> np.ndarray:
        """Return the present joints (nq,).

        While the robot rests at its target these are the commanded joints: at a joint limit the
        readings may lie slightly beyond it."""
        here = self._cell.joints()
        if self._sent is None or not self._checker.has_arrived(here, self._sent):
            return here
        return self._sent

    def _remeasure_previous(self, odd: ImplausibleSample) -> tuple[Target, Sample]:
        """Measure the previous pose again and return that sample; raise `odd` if the pose changed.

        If the pose is unchanged, robot and device are in order and the model is wrong."""
        k, before = next(reversed(self.samples.items()))
        target = replace(
            self.targets[k], purpose="the previous pose again, to check whether anything moved"
        )
        try:
            sample = self._take_sample(target, f"{odd}; measuring {target.purpose}")
        except (PathError, UnseenError):
            raise odd from None
        if not self._checker.is_same_pose(sample.dataset, before.dataset):
            raise odd
        # The model is known to be wrong until a better one is identified.
        self._checker.mark_conditions_changed()
        return target, sample

    def _add_targets(self, targets: list[Target]) -> None:
        self._journal.write(targets=targets)
        self.targets += targets

    def _store_sample(self, k: int, sample: Sample) -> None:
        if not self.samples:  # fail now if a fit will lack data, not after all the first poses
            observe(self._guard.model, sample.dataset, self.goal.joint_sigma)
        self._journal.write(target=k, sample=sample.dataset, start_ns=sample.start_ns)
        self.samples[k] = sample

    def _request_conditions(self, conditions: Mapping[str, float]) -> None:
        """Ask a person to change the conditions that are not yet as wanted."""
        known = self._last.conditions if self._last else {}
        questions = tuple(
            Question(name, value, float(known[name][0]), ADJUSTABLE_CONDITIONS[name][1])
            for name, value in conditions.items()
            if name in known and abs(float(known[name][0]) - value) > ADJUSTABLE_CONDITIONS[name][0]
        )
        if not questions:
            return
        words = "; ".join(map(str, questions))
        self.report_status("asking", f"{words}, then continue", questions=questions)
        wanted = {question.condition: question.value for question in questions}
        self._cell.ask(words, wanted, self.control.check_interrupted)
        self._checker.mark_conditions_changed()

    # ------------------------------------------------------------------ judgements and the outcome

    def take_judgement(self, judgement: Judgement) -> None:
        """Store a judgement with its further targets, and use its model from now on.

        If this model forbids the robot's present pose, first move home on a path that the previous
        model allows."""
        self._journal.write(judged=judgement)
        self.targets += judgement.targets
        self.judgements.append(judgement)
        before, here = self._guard, self._get_current_joints()
        self._use_model_of(judgement)
        if judgement.targets and self._guard.describe_violation(here):
            home = np.array(before.model.mechanism.home.joints)
            trajectory = plan_trajectory(before.plan_path(here, [home]), before.model.mechanism)
            self._cell.move(trajectory, self.control.check_interrupted)
            self._sent = home

    def _use_model_of(self, judgement: Judgement | None) -> None:
        """Use the best model so far to check paths and samples."""
        model = parse_model(judgement.text if judgement else self.model)
        self._guard = Guard.of(replace(model, covariance=None), self.goal.keep_out, self.goal.reach)
        self._checker = Checker(model, judgement.usual if judgement else {})

    def make_outcome(self, success: bool, message: str) -> Outcome:
        """The outcome of a campaign that ends so, with its document."""
        curve = [(one.poses, one.error) for one in self.curve.points]
        judged = self._procedure.reported
        document = {
            "success": success,
            "message": message,
            **judged,
            "poses": len(self.samples),
            "minutes": self.spent / 60,
            "curve": [{"poses": n, "error_unseen": error} for n, error in curve],
            "left_out": list(self.left_out.values()),
            "warnings": self.warnings,
            "folder": str(self.folder),
        }
        return Outcome(
            success,
            message,
            to_json_value(document),
            verdict=judged["verdict"],
            samples=len(self.samples),
            curve=tuple(curve),
        )

    def _end(self, outcome: Outcome) -> Outcome:
        """Add the final model to the outcome if it is proven better, and write the last line."""
        self.report_status("judging", "preparing the final model")
        found = self._procedure.conclude()
        text = found.text and with_limits_of(found.text, self.model)
        outcome = replace(outcome, text=text, message=f"{outcome.message} ({found.words})")
        self._journal.write(end=outcome.message, success=outcome.success)
        self.report_status("done", outcome.message)
        return outcome

    def _make_stopped_outcome(self, why: str) -> Outcome:
        self.report_status("stopped", why)
        if not self._procedure.verdict:
            return Outcome(False, why, ended=False, samples=len(self.samples))
        return replace(self.make_outcome(False, why), ended=False)
