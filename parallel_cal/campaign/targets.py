"""Choose target poses: first to identify the model, then to distinguish possible effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.campaign.path_guard import Guard, PathError
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.diagnose import Diagnosis
from parallel_cal.diagnosis.separate import plan_refinement, plan_separation, rank_rival_pairs
from parallel_cal.diagnosis.thresholds import MIN_SEPARATION_SIGMAS
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import approaches, controlled_coordinates
from parallel_cal.planning.plan import equations_per_pose, plan
from parallel_cal.planning.posepool import Pool, make_pool
from parallel_cal.recordings.simulate import with_noise

POOL = 400  # poses to choose the first ones from
N_VALIDATION_POSES = 6  # poses that no fit uses
N_REPEATED_POSES = 4  # of the first poses, approached again from the other side
# times as many equations as unknowns, in the first poses; at least
AMPLE_EQUATION_RATIO = 2.0
MIN_EQUATION_RATIO = 1.25
MIN_FIRST_POSES = 12  # first poses
SUSPECTS = 3  # effects that the next poses are to tell of, where nothing is in doubt yet
# What a person changes: so much makes it another one, and its unit.
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
    """At most so many: poses that no fit will see, spread over the workspace, poses that identify
    what is free best, and some of these again, come to from the other side."""
    model, rng = with_noise(guard.model), np.random.default_rng(seed)
    pool = make_pool(model, POOL, rng, symmetric=False).poses
    drawn, pool = pool, pool[np.flatnonzero(guard.is_allowed(pool.joints))]
    if len(pool) < min(most, POOL // 2):  # of many the next are drawn anew
        raise PathError(
            f"only {len(pool)} of {len(drawn)} random poses in the workspace are allowed: "
            f"{guard.summarise_violations(drawn.joints)}"
        )
    unseen = select_spread_out(controlled_coordinates(model, pool), N_VALIDATION_POSES)
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
    ways = approaches(model, chosen[again], rng)
    first = [Target(tuple(q), purpose="to identify the model") for q in chosen.joints.tolist()]
    second = []
    for k, i in enumerate(again):
        stops = [tuple(stop.joints.tolist()) for stop in ways.waypoints(k)] if ways.ok[k] else []
        if stops and guard.is_allowed(np.array(stops)).all():
            first[i] = Target(
                first[i].joints,
                tuple(stops),
                purpose="to identify the model, approached from one side",
            )
        words = "the same pose, approached from the other side"
        second.append(Target(first[i].joints, first[i].via[::-1], purpose=words))
    kept = [
        Target(tuple(q), purpose="for validation only", unseen=True)
        for q in pool.joints[unseen].tolist()
    ]
    once = [*first, *kept]
    return [*(once[i] for i in rng.permutation(len(once))), *second]


def select_spread_out(places: np.ndarray, n: int) -> np.ndarray:
    """Indices of n places (N, k), each the furthest from those before it; first the middle one."""
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
    """n more: under conditions that were never another, `changes` by how much, if an effect may
    depend on them: what they do may look like anything else; else where two explanations are alike,
    or the device is one, what tells these apart; else what tells most of the model, and of the
    effects that are suspected, or are the likeliest that it does not have. And the rivals that no
    poses tell, were all that are `left` spent on them.

    What tells two apart lies in the workspace, or where that does not settle it in as much more as
    the guard's reach allows."""
    so_far = found.dataset.conditions
    may = {
        name: get_condition_range(so_far[name], by)
        for name, by in changes.items()
        if by and name in so_far
    }
    reaches = sorted({1.0, guard.reach})
    if untried := _plan_untried_conditions(found, guard, n, may, seed):
        return untried, ()
    payloads, untold = may.get("payload", tuple(so_far.get("payload", ())[-1:])), list[str]()
    for doubt in rank_rival_pairs(found.best, find_rivals(found), found.ranked):
        telling, last = (
            plan_separation(
                doubt,
                so_far,
                seed,
                (size,),
                reaches,
                guard.is_allowed,
                payloads,
                guard.min_approach,
            )
            for size in (n, left)
        )
        if telling is None or last is None or last.sigmas.then < MIN_SEPARATION_SIGMAS:
            untold += [doubt.effect, doubt.rival]
            continue
        purpose = f"to distinguish {' from '.join(telling.separates)}"
        targets = [
            Target(
                tuple(pose.joints.tolist()),
                tuple(tuple(stop.joints.tolist()) for stop in pose.by_way_of),
                {k: v for k, v in pose.conditions.items() if k in may},
                purpose,
            )
            for pose in telling.poses
        ]
        return targets, ()
    return _plan_refinement(found, guard, n, may, seed), tuple(dict.fromkeys(untold))


def _plan_untried_conditions(
    found: Diagnosis, guard: Guard, n: int, may: Mapping[str, tuple[float, float]], seed: int
) -> list[Target]:
    """n poses under conditions that were never others and that effects may depend on, one at a
    time, and a load comes off again: what goes back is no bump. None where all were."""
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
            found.best, suspects[name], share, under, guard.is_allowed, seed, guard.min_approach
        )
        targets += _targets(pool, f"to see the influence of {name}", under)
    return targets


def _plan_refinement(
    found: Diagnosis, guard: Guard, n: int, may: Mapping[str, tuple[float, float]], seed: int
) -> list[Target]:
    """Where nothing can be told apart: n poses that make the model surer, and what it lacks."""
    so_far = found.dataset.conditions
    likely = [one for one in find_addable_effects(found) if one.testable]
    suspects = [one for one in likely if one.name in found.suspected]
    under = {
        name: select_rarer(so_far[name], both)
        for name, both in may.items()
        if any(name in one.effect.needs for one in suspects)
    }
    # What looks like an effect that was found hides beside it best.
    kin = {other for name in found.effects for other in load_effect(name).lookalikes}
    suspects = suspects or sorted(likely, key=lambda one: one.name not in kin)[:SUSPECTS]
    purpose = "to reduce the uncertainty of the model"
    if suspects:
        purpose += f" and of {', '.join(one.name for one in suspects)}"
    pool = plan_refinement(
        found.best, suspects, n, under, guard.is_allowed, seed, guard.min_approach, guard.reach
    )
    return _targets(pool, purpose, under)


def get_condition_range(so_far: np.ndarray, change: float) -> tuple[float, float]:
    """What a condition was at least, (N,), and what it may be changed to."""
    return float(np.min(so_far)), float(np.min(so_far)) + change


def select_rarer(so_far: np.ndarray, both: tuple[float, float]) -> float:
    """Which of two values of a condition was measured under, (N,), at fewer of the samples."""
    low, high = both
    return high if 2 * np.count_nonzero(so_far > (low + high) / 2) < len(so_far) else low


def find_rivals(found: Diagnosis) -> dict[str, list[str]]:
    """For each effect found those that fit as well, errors of the device among them."""
    device = [
        one.name
        for one in found.ranked
        if one.effect.of_device and not one.effect.needs and one.testable
    ]
    return {
        name: [*found.swaps.get(name, ()), *(device if name in found.robot_or_device else ())]
        for name in found.effects
    }


def find_addable_effects(found: Diagnosis) -> list[Candidate]:
    """Effects of the robot that the model does not have, the likeliest first, and that could be
    told beside it."""
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
    ways = pool.approach
    return [
        Target(
            tuple(q),
            () if ways is None else tuple(tuple(s.joints.tolist()) for s in ways.waypoints(i)),
            conditions,
            purpose,
        )
        for i, q in enumerate(pool.poses.joints.tolist())
    ]
