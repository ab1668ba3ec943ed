"""Choose target poses: first to identify the model, then to distinguish possible effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.decision import DECIDED, Decision, Undecided, plan_decision
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.separate import plan_refinement
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import approaches
from parallel_cal.planning.plan import equations_per_pose, plan
from parallel_cal.planning.posepool import Pool, make_pool
from parallel_cal.planning.visibility import stand_in_pose_device
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import with_noise

POOL = 400  # candidates for the first poses
N_VALIDATION_POSES = 6  # poses that no fit uses
N_REPEATED_POSES = 4  # of the first poses, approached again from the other side
# Equations per unknown in the first poses: preferred, and at least.
AMPLE_EQUATION_RATIO = 2.0
MIN_EQUATION_RATIO = 1.25
MIN_FIRST_POSES = 12
MAX_SUSPECTS = 3  # likely effects that the next poses should reveal if none is suspected
# The conditions that a person changes: the smallest change that matters, and the unit.
ADJUSTABLE_CONDITIONS = {"payload": (0.05, "kg"), "temperature": (1.5, "degC")}


@dataclass(frozen=True)
class Target:
    """Joints (nq,) to measure at, the waypoints before, the conditions to set first, and the
    purpose. `unseen` targets are validation poses: no fit uses them."""

    joints: tuple[float, ...]
    via: tuple[tuple[float, ...], ...] = ()
    conditions: Mapping[str, float] = field(default_factory=dict)
    purpose: str = ""
    unseen: bool = False

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Target:
        """From JSON."""
        via = tuple(tuple(stop) for stop in document["via"])
        return cls(**{**document, "joints": tuple(document["joints"]), "via": via})


def first_targets(guard: Guard, most: int, seed: int = 0) -> list[Target]:
    """Plan the first targets, at most `most`.

    They are validation poses that are spread over the workspace, poses that identify the free
    parameters best, and some of these poses again, approached from the other side."""
    model, rng = stand_in_pose_device(with_noise(guard.model)), np.random.default_rng(seed)
    pool = make_pool(model, POOL, rng, symmetric=False).poses
    drawn, pool = pool, pool[np.flatnonzero(guard.is_measurable(pool.joints))]
    if len(pool) < min(most, POOL // 2):
        raise PathError(
            f"only {len(pool)} of {len(drawn)} random poses in the workspace are allowed: "
            f"{guard.summarise_violations(drawn.joints)}"
        )
    unseen = select_spread_out(
        model.mechanism.controlled_coordinates(pool.position, pool.rotation), N_VALIDATION_POSES
    )
    free = int((~np.asarray(model.fixed)).sum())
    least = int(np.ceil(MIN_EQUATION_RATIO * free / equations_per_pose(model)))
    if most < least + N_VALIDATION_POSES + N_REPEATED_POSES:
        raise FitError(
            f"{most} poses are too few for {free} free parameters: at least "
            f"{least + N_VALIDATION_POSES + N_REPEATED_POSES}, of which {N_VALIDATION_POSES} are "
            f"validation poses and {N_REPEATED_POSES} are second visits. Allow more poses, or fix "
            "parameters"
        )
    ample = int(np.ceil(AMPLE_EQUATION_RATIO * free / equations_per_pose(model)))
    n = min(max(MIN_FIRST_POSES, ample), most - N_VALIDATION_POSES - N_REPEATED_POSES)
    rest = pool[np.setdiff1d(np.arange(len(pool)), unseen)]
    chosen = plan(model, n, pool=rest, seed=seed).poses
    again = rng.choice(n, min(N_REPEATED_POSES, n), replace=False)
    paths = approaches(model, chosen[again], rng)
    first = [Target(tuple(q), purpose="to identify the model") for q in chosen.joints.tolist()]
    second = []
    for k, i in enumerate(again):
        stops = [tuple(stop.joints.tolist()) for stop in paths.waypoints(k)] if paths.ok[k] else []
        if stops and guard.is_allowed(np.array(stops)).all():
            first[i] = Target(
                first[i].joints,
                tuple(stops),
                purpose="to identify the model, approached from one side",
            )
        words = "the same pose, approached from the other side"
        second.append(Target(first[i].joints, first[i].via[::-1], purpose=words))
    validation = [
        Target(tuple(q), purpose="for validation only", unseen=True)
        for q in pool.joints[unseen].tolist()
    ]
    once = [*first, *validation]
    # In random order, so that the poses do not correlate with time.
    return [*(once[i] for i in rng.permutation(len(once))), *second]


def select_spread_out(places: np.ndarray, n: int) -> np.ndarray:
    """Return the indices of n places (N, k): first the middle one, then always the one that is
    furthest from those before it."""
    scaled = (places - places.mean(axis=0)) / np.maximum(np.ptp(places, axis=0), 1e-12)
    found = [int(np.argmin(np.linalg.norm(scaled, axis=1)))]
    while len(found) < min(n, len(places)):
        away = np.linalg.norm(scaled[:, None] - scaled[found], axis=2).min(axis=1)
        found.append(int(np.argmax(away)))
    return np.array(found)


def next_targets(
    found: Diagnosis,
    guard: Guard,
    n: int,
    left: int,
    changes: Mapping[str, float],
    seed: int = 0,
) -> tuple[list[Target], tuple[str, ...]]:
    """Plan the next n targets; also return the rivals that no poses can distinguish, even if all
    the `left` poses were used for them.

    The targets are, in this order of priority:

    1. Poses under conditions that were never changed, if an effect may depend on them: their
       influence could be mistaken for any other effect. `changes` says by how much to change them.
    2. Poses that distinguish two rival explanations (one may be an error of the device): in the
       workspace, or, if that does not suffice, in the larger space of the guard's reach.
    3. Poses that reduce the uncertainty of the model, and of the effects that are suspected or the
       likeliest that the model lacks."""
    so_far = found.dataset.conditions
    may = find_allowed_changes(so_far, changes)
    if untried := _plan_untried_conditions(found, guard, n, may, seed):
        return untried, ()
    untold: tuple[str, ...] = ()
    if (doubt := Undecided.of(found.explanation.doubt)) is not None:
        if deciding := plan_deciding_targets(doubt, so_far, guard, n, left, may, seed):
            return deciding, ()
        untold = tuple(dict.fromkeys(name for one in doubt.sets for name in one.names))
    return _plan_refinement(found, guard, n, may, seed), untold


def find_allowed_changes(
    so_far: Mapping[str, np.ndarray], changes: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Return the range of each recorded condition that a person may change; `changes` says by how
    much."""
    return {
        name: get_condition_range(so_far[name], by)
        for name, by in changes.items()
        if by and name in so_far
    }


def plan_deciding_targets(
    doubt: Undecided,
    so_far: Mapping[str, np.ndarray],
    guard: Guard,
    n: int,
    left: int,
    may: Mapping[str, tuple[float, float]],
    seed: int = 0,
) -> list[Target]:
    """Plan at most n targets that decide between sets of effects, in the workspace or, if that does
    not suffice, in the larger space of the guard's reach; none if not even the `left` poses are
    expected to decide."""
    plan = plan_decision(
        doubt,
        so_far,
        n,
        left,
        guard.is_measurable,
        seed,
        sorted({1.0, guard.reach}),
        may.get("payload", tuple(so_far.get("payload", ())[-1:])),
        guard.min_approach,
    )
    if plan is None or plan.at_last > DECIDED:
        return []
    return _make_deciding_targets(doubt, plan, may)


def repeat_first_poses(dataset: Dataset, guard: Guard, n: int) -> list[Target]:
    """Return up to n poses of the samples again: those measured least often, the earliest first."""
    _, first, count = np.unique(dataset.pose_id, return_index=True, return_counts=True)
    order = np.lexsort((dataset.time[first], count))
    joints = dataset.q[first[order]]
    allowed = joints[guard.is_measurable(joints)][:n]
    purpose = "measured before, again to see whether anything moved"
    return [Target(tuple(q), purpose=purpose) for q in allowed.tolist()]


def _plan_untried_conditions(
    found: Diagnosis, guard: Guard, n: int, may: Mapping[str, tuple[float, float]], seed: int
) -> list[Target]:
    """Plan n poses under conditions that were never changed and on which effects may depend, one
    condition at a time; none if all were changed.

    A payload is taken off again at the end: an error that then disappears was no bump."""
    so_far = found.dataset.conditions
    suspects = {
        name: [one for one in find_addable_effects(found) if name in one.effect.needs]
        for name, (_, high) in may.items()
        if np.max(so_far[name]) < high - ADJUSTABLE_CONDITIONS[name][0]
    }
    never = [name for name, some in suspects.items() if some]
    blocks = [
        (name, {other: may[other][0] for other in never[:k]} | {name: may[name][1]})
        for k, name in enumerate(never)
    ]
    if never == ["payload"]:
        blocks.append(("payload", {"payload": may["payload"][0]}))
    blocks, targets = blocks[:n], list[Target]()
    for k, (name, under) in enumerate(blocks):
        share = (n - len(targets)) // (len(blocks) - k)
        pool = plan_refinement(
            found.best, suspects[name], share, under, guard.is_measurable, seed, guard.min_approach
        )
        targets += _targets(pool, f"to see the influence of {name}", under)
    return targets


def _make_deciding_targets(
    doubt: Undecided, plan: Decision, may: Mapping[str, tuple[float, float]]
) -> list[Target]:
    """Make targets of poses that decide between sets of effects, equal payloads together."""
    names = doubt.model.conditions
    under = [dict(zip(names, row, strict=True)) for row in plan.a.tolist()]
    targets = [
        replace(target, conditions={name: at[name] for name in names if name in may})
        for target, at in zip(
            _targets(plan.pool, f"to decide between {', '.join(map(str, doubt.sets))}", {}),
            under,
            strict=True,
        )
    ]
    return sorted(targets, key=lambda target: target.conditions.get("payload", 0.0))


def _plan_refinement(
    found: Diagnosis, guard: Guard, n: int, may: Mapping[str, tuple[float, float]], seed: int
) -> list[Target]:
    """Plan n poses that reduce the uncertainty of the model and of the effects that it may lack."""
    so_far = found.dataset.conditions
    likely = [one for one in find_addable_effects(found) if one.testable]
    suspects = [one for one in likely if one.name in found.suspected]
    under = {
        name: select_rarer(so_far[name], both)
        for name, both in may.items()
        if any(name in one.effect.needs for one in suspects)
    }
    # A lookalike of an effect that was found is most easily masked by it.
    kin = {other for name in found.effects for other in load_effect(name).lookalikes}
    suspects = suspects or sorted(likely, key=lambda one: one.name not in kin)[:MAX_SUSPECTS]
    purpose = "to reduce the uncertainty of the model"
    if suspects:
        purpose += f" and of {', '.join(one.name for one in suspects)}"
    pool = plan_refinement(
        found.best, suspects, n, under, guard.is_measurable, seed, guard.min_approach, guard.reach
    )
    return _targets(pool, purpose, under)


def get_condition_range(so_far: np.ndarray, change: float) -> tuple[float, float]:
    """Return the smallest value (N,) of a condition so far, and the value to change it to."""
    return float(np.min(so_far)), float(np.min(so_far)) + change


def select_rarer(so_far: np.ndarray, both: tuple[float, float]) -> float:
    """Return the one of two values of a condition that is rarer among the samples (N,)."""
    low, high = both
    return high if 2 * np.count_nonzero(so_far > (low + high) / 2) < len(so_far) else low


def find_addable_effects(found: Diagnosis) -> list[Candidate]:
    """List the effects of the robot that could be added to the model, the likeliest first."""
    best = found.best.fitted.model
    taken = {effect.name for effect in best.effects}
    return [
        one
        for one in found.ranked
        if one.scene is found.base.scene
        and one.name not in taken
        and not one.effect.of_device
        and "session" not in one.effect.needs
    ]


def _targets(pool: Pool, purpose: str, conditions: Mapping[str, float]) -> list[Target]:
    paths = pool.approach
    return [
        Target(
            tuple(q),
            () if paths is None else tuple(tuple(s.joints.tolist()) for s in paths.waypoints(i)),
            conditions,
            purpose,
        )
        for i, q in enumerate(pool.poses.joints.tolist())
    ]
