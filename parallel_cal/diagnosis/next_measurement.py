"""What to measure next: poses that decide between explanations, conditions to record, advice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.causes import Doubt
from parallel_cal.diagnosis.decision import (
    SURELY_DECIDED,
    Decision,
    Undecided,
    plan_decision,
)
from parallel_cal.diagnosis.region import TOUCH_A_BLOCK, is_touched_at_one_height
from parallel_cal.diagnosis.search import Trial
from parallel_cal.diagnosis.separate import (
    depends_on_temperature,
    depends_on_time,
    explain_separation,
    schedule_conditions,
)
from parallel_cal.diagnosis.thresholds import CREDIBLE, MAX_PLANNED_POSES, PLAN_REACHES
from parallel_cal.model.model import Model
from parallel_cal.planning.approach import Waypoint
from parallel_cal.planning.pose_table import format_pose_table
from parallel_cal.planning.posepool import find_inside_poses
from parallel_cal.posterior.decision import choose_deciding_poses, compute_certainty

THROUGH_WAYPOINTS = "Reach each planned pose through its two waypoints: overshoot, then return."


@dataclass(frozen=True)
class PlannedPose:
    """A pose to measure: position (3,) m, quaternion x y z w, joints (nq,), the waypoints before
    it, and the conditions during its measurement by name."""

    position: np.ndarray
    quaternion: np.ndarray
    joints: np.ndarray
    by_way_of: tuple[Waypoint, ...]
    conditions: Mapping[str, float]


@dataclass(frozen=True)
class Certainty:
    """How probable the likeliest explanation is: `now`, and as it is expected `then`, after the
    planned poses."""

    now: float
    then: float


@dataclass(frozen=True)
class DecidingPoses:
    """Planned poses, in order, that decide `between` sets of effects, and instructions."""

    between: tuple[str, ...]
    certainty: Certainty
    poses: tuple[PlannedPose, ...]
    how: tuple[str, ...]

    @classmethod
    def of(cls, doubt: Undecided, plan: Decision) -> DecidingPoses:
        """The poses of a plan ordered for the measurement: block by block, equal payloads
        together."""
        model = doubt.model
        load = plan.a[:, [name == "payload" for name in model.conditions]].sum(axis=1)
        order = np.lexsort([load, plan.block])
        blocks, pool = plan.block[order], plan.pool.rows(order)
        place = np.arange(len(order)) - np.searchsorted(blocks, blocks)
        under = schedule_conditions(model, plan.a[order], plan.course, blocks, place)
        entropy = choose_deciding_poses(doubt.predict(pool, under), len(order), 0.0)[1][-1]
        planned = []
        for i, pose in enumerate(pool.poses):
            stops = () if pool.approach is None else pool.approach.waypoints(i)
            at = dict(zip(model.conditions, under[i].tolist(), strict=True))
            planned.append(PlannedPose(pose.position, pose.quaternion, pose.joints, stops, at))
        how = []
        if outside := int((~find_inside_poses(model, pool.poses)).sum()):
            how.append(
                f"{outside} of the planned poses are outside the model file's workspace, inside "
                "joint limits and away from singularities: check first that the robot collides "
                "with nothing"
            )
        if pool.approach is not None:
            how.append(THROUGH_WAYPOINTS)
        if depends_on_time(model):
            how.append(plan.course.describe(blocks, depends_on_temperature(model)))
        certainty = Certainty(*map(compute_certainty, (doubt.entropy, entropy)))
        return cls(tuple(map(str, doubt.sets)), certainty, tuple(planned), tuple(how))

    @property
    def is_enough(self) -> bool:
        """Whether the poses are expected to decide."""
        return self.certainty.then >= CREDIBLE

    def __str__(self) -> str:
        return (
            f"{len(self.poses)} planned pose{'s are' if len(self.poses) > 1 else ' is'} expected "
            f"to show with a probability of {self.certainty.then:.2f} whether the robot has "
            f"{' or '.join(self.between)}; the present samples do with {self.certainty.now:.2f}"
        )

    def csv(self, model: Model) -> str:
        """Return the text of a CSV file of the poses, of a model with these joints."""
        position, quaternion, joints = (
            np.array([getattr(pose, name) for pose in self.poses])
            for name in ("position", "quaternion", "joints")
        )
        conditions = {
            name: np.array([pose.conditions[name] for pose in self.poses])
            for name in self.poses[0].conditions
        }
        stops = [
            np.array([stop.joints for stop in stops])
            for stops in zip(*(pose.by_way_of for pose in self.poses), strict=True)
        ]
        # The table itself explains the waypoints.
        remarks = [f"{self}.", *(words for words in self.how if words != THROUGH_WAYPOINTS)]
        return format_pose_table(model, position, quaternion, joints, conditions, stops, remarks)


@dataclass(frozen=True)
class NextMeasurement:
    """What to measure if `rivals` of a chosen effect fit as well. Poses are planned when `plan` or
    `advice` is first read: this takes as long as several fits.

    Attributes
    ----------
    record : mapping
        For each effect that cannot be tested, the conditions to record.
    advice : tuple of str
        Instructions.
    plan : DecidingPoses or None
        Poses that decide between the effects that the samples leave possible.
    """

    best: Trial
    rivals: Mapping[str, list[str]]
    ranked: tuple[Candidate, ...]
    doubts: tuple[Doubt, ...] = ()
    seed: int = 0

    @property
    def record(self) -> Mapping[str, tuple[str, ...]]:
        return {c.name: c.missing for c in self.ranked if c.missing}

    @cached_property
    @single_threaded()
    def plan(self) -> DecidingPoses | None:
        undecided = filter(None, map(Undecided.of, self.doubts))
        doubt = next(undecided, None)
        if doubt is None:
            return None
        so_far, most = self.best.fitted.dataset.conditions, MAX_PLANNED_POSES
        plan = plan_decision(
            doubt,
            so_far,
            most,
            most,
            lambda joints: np.ones(len(joints), bool),
            self.seed,
            PLAN_REACHES,
            enough=SURELY_DECIDED,
        )
        return None if plan is None else DecidingPoses.of(doubt, plan)

    @property
    def advice(self) -> tuple[str, ...]:
        pairs = [(name, other) for name, others in self.rivals.items() for other in others]
        advice = [explain_separation(*pair) for pair in pairs]
        advice += self.plan.how if self.plan else ()
        if is_touched_at_one_height(self.best.fitted):
            advice.append(TOUCH_A_BLOCK)
        return tuple(dict.fromkeys(words for words in advice if words))

    def document(self) -> dict[str, Any]:
        """The part of the JSON document of `parallel-cal diagnose`."""
        return {name: getattr(self, name) for name in ("record", "advice", "plan")}
