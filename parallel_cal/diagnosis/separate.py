"""Plan what to measure next: poses and conditions that separate the remaining explanations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from parallel_cal.base.confidence import SIGMAS_AT_SIGNIFICANCE_LEVEL
from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.threads import single_threaded
from parallel_cal.causes.effects import collect_recorded_values
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.region import TOUCH_A_BLOCK, is_touched_at_one_height
from parallel_cal.diagnosis.search import Chosen, Trial, fits_as_well
from parallel_cal.diagnosis.thresholds import (
    MAX_REFITTED_CANDIDATES,
    MIN_SEPARATION_SIGMAS,
    PLAN_REACHES,
    PLAN_SIZES,
    POOL,
)
from parallel_cal.identification.fit import fit_unjudged
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations, conditions
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import Waypoint, fill, find_least_travels
from parallel_cal.planning.expectation import VAGUE_INFORMATION, white_blocks
from parallel_cal.planning.pose_table import format_pose_table
from parallel_cal.planning.posepool import Pool, find_inside_poses, make_pool
from parallel_cal.planning.schedule import BLOCKS, Schedule
from parallel_cal.planning.selection import SelectionProblem, exchange
from parallel_cal.recordings.dataset import Dataset

Allowed = Callable[[np.ndarray], np.ndarray]  # joints (n, nq) -> mask (n,)


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
class Sigmas:
    """By how many sigmas two effects differ: in the present samples, and with the planned poses."""

    now: float
    then: float


@dataclass(frozen=True)
class Separation:
    """Planned poses, in order, that separate the first of two effects from the second, and
    instructions."""

    separates: tuple[str, str]
    sigmas: Sigmas
    poses: tuple[PlannedPose, ...]
    how: tuple[str, ...]

    @property
    def is_enough(self) -> bool:
        """Whether the poses separate the two, with a margin for chance."""
        return self.sigmas.then > MIN_SEPARATION_SIGMAS + SIGMAS_AT_SIGNIFICANCE_LEVEL

    def __str__(self) -> str:
        one, other = self.separates
        return (
            f"These {len(self.poses)} poses, measured in addition, distinguish {one} from {other} "
            f"by {self.sigmas.then:.2g} sigmas; the present samples distinguish them by "
            f"{self.sigmas.now:.2g} sigmas."
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
        remarks = [str(self), *(words for words in self.how if words != THROUGH_WAYPOINTS)]
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
    plan : Separation or None
        Poses that separate the pair of effects that the present samples separate least.
    """

    best: Trial
    rivals: Mapping[str, list[str]]
    ranked: tuple[Candidate, ...]
    seed: int = 0

    @property
    def record(self) -> Mapping[str, tuple[str, ...]]:
        return {c.name: c.missing for c in self.ranked if c.missing}

    @cached_property
    @single_threaded()
    def plan(self) -> Separation | None:
        hardest = next(iter(rank_rival_pairs(self.best, self.rivals, self.ranked)), None)
        if hardest is None:
            return None
        return plan_separation(hardest, self.best.fitted.dataset.conditions, self.seed)

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


def rank_rival_pairs(
    best: Trial, rivals: Mapping[str, Sequence[str]], ranked: Sequence[Candidate]
) -> list[RivalPair]:
    """Pairs of a chosen effect and a rival, each in its settings, those first that are hardest to
    separate."""
    by_name = {c.name: c for c in ranked}
    found = [
        doubt
        for name, others in rivals.items()
        for variant in (list_effect_variants(best, name) if others else ())
        for other in others
        for rival in list_rival_variants(by_name[other], best.fitted.dataset)
        if (doubt := RivalPair.of(variant, name, rival)) is not None
    ]
    return sorted(found, key=lambda doubt: doubt.current_sigmas)


def list_effect_variants(best: Trial, name: str) -> list[Trial]:
    """A fit, and refits with one of its effects in the other settings of its scan that explain the
    samples as well, if there are only a few. Only the fit if the setting was not from the scan: it
    is known."""
    fitted = best.fitted
    model, own = fitted.model, next((e for e in fitted.model.effects if e.name == name), None)
    if own is None:  # it widened the mechanism
        return [best]
    recorded = collect_recorded_values(fitted.dataset)
    scanned = [
        model.with_settings(name, one)
        for one in islice(own.scan(model.mechanism, recorded), MAX_REFITTED_CANDIDATES + 1)
    ]
    others = [one for one in scanned if not np.allclose(one.values, model.values, atol=0)]
    if len(scanned) > MAX_REFITTED_CANDIDATES or len(others) == len(scanned):
        return [best]
    refits = [refit for one in others if (refit := _refit(best, one)) is not None]
    return [best, *(refit for refit in refits if fits_as_well(best, refit))]


def _refit(best: Trial, model: Model) -> Trial | None:
    """Refit a model with other settings to the same samples; None if no fit is plausible."""
    fitted, options = best.fitted, replace(best.fitted.options, hold_out=0.0)
    try:
        refit = fit_unjudged(model, fitted.dataset, options, noise=fitted.observations)
    except (FitError, ModelError):
        return None
    return Trial(best.chosen, refit.result)


def list_rival_variants(rival: Candidate, dataset: Dataset) -> list[Chosen]:
    """A rival in each of its settings if there are only a few, because a setting that is not the
    best may explain the new poses; else only in the best setting."""
    if rival.tried > MAX_REFITTED_CANDIDATES:
        return [Chosen.of(rival)]
    scene = rival.scene
    settings = (
        rival.effect.scan(scene.model.mechanism, collect_recorded_values(dataset)) if scene else ()
    )
    return [Chosen(rival.name, tuple(sorted(setting.items()))) for setting in settings]


def explain_separation(name: str, other: str) -> str:
    """Say what separates two effects: advice for this pair, else for the first effect."""
    one, another = load_effect(name), load_effect(other)
    return one.told_from.get(other) or another.told_from.get(name) or one.separated_by


@dataclass(frozen=True)
class RivalPair:
    """An identified effect and a rival: a model with both, and the information (k, k) of the
    present samples about geometry, rival and, last, the amplitude of the effect's whole signal.

    With Z the columns of geometry and rival, and a the signal, the two differ by sqrt(a.a - a.Z
    (Z.Z)^-1 Z.a) sigmas: one over the sigma of a's amplitude.
    """

    effect: str
    rival: str
    model: Model
    measured: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, best: Trial, effect: str, rival: Chosen) -> RivalPair | None:
        """None if the rival is a larger model, or would need contradictory parameters."""
        fitted = best.fitted
        try:
            model = fitted.model.with_effect(rival.name, rival.settings)
        except ModelError:
            return None
        if model.mechanism is not fitted.model.mechanism:
            return None
        observations = replace(fitted.observations, a=conditions(model, fitted.dataset))
        model = replace(model, noise=typical_noise(model, observations))
        free, measured = ~np.asarray(model.fixed), np.asarray(observations.measured.any(axis=0))
        so_far = Linearisation(model, observations, free, True)(model.values, best.scene.x)
        doubt = cls(effect, rival.name, model, measured, np.zeros((0, 0)))
        rows = doubt.replace_by_signal(so_far.jacobian)
        rows = rows.reshape(-1, rows.shape[2])
        found = replace(
            doubt, information=rows.T @ rows + VAGUE_INFORMATION * np.eye(rows.shape[1])
        )
        return None if found.imitating_model.find_contradiction() else found

    @property
    def imitating_model(self) -> Model:
        """The model without the effect whose geometry and rival imitate it best."""
        I, free = self.information, ~np.asarray(self.model.fixed)
        own = np.array([n.startswith(f"{self.effect}.") for n in self.model.table.names])
        values = np.where(own, self.model.table.nominal, self.model.values)
        like = np.linalg.solve(I[:-1, :-1], I[:-1, -1])
        values[free & ~own] += like * self.model.table.tolerance[free & ~own]
        return self.model.with_values(values)

    @property
    def least_travels(self) -> np.ndarray:
        """How far each joint (nq,) must move after a reversal, so that the predictions of
        both models hold: with the identified effect, and with the rival as large as it must be to
        imitate it."""
        models = (self.model, self.imitating_model)
        return np.max([find_least_travels(model) for model in models], axis=0)

    @property
    def current_sigmas(self) -> float:
        """Sigmas by which the present samples separate the two."""
        return _sigmas(self.information)

    def replace_by_signal(self, J: np.ndarray) -> np.ndarray:
        """Columns in tolerances; those of the effect are replaced by their sum at the identified
        values."""
        model, free = self.model, ~np.asarray(self.model.fixed)
        names = [n for n, f in zip(model.table.names, free, strict=True) if f]
        own = np.array([n.startswith(f"{self.effect}.") for n in names])
        values = np.where(own, model.values[free], 0.0)
        scaled = J * model.table.tolerance[free]
        return np.concatenate([scaled[:, :, ~own], (J @ values)[:, :, None]], axis=2)

    def make_selection_problem(self, pool: Pool, a: np.ndarray) -> SelectionProblem:
        """Information that poses under conditions a would add; the planner lowers the amplitude's
        sigma."""
        free, size = ~np.asarray(self.model.fixed), len(self.information)
        rows = white_blocks(self.model, free, self.measured, pool.poses, a)
        amplitude = np.diag(np.arange(size) == size - 1).astype(float)
        return SelectionProblem(
            self.replace_by_signal(rows), self.information, amplitude, "A", size
        )


def _sigmas(information: np.ndarray) -> float:
    """One over the standard deviation of the last parameter."""
    return float(1 / np.sqrt(np.linalg.inv(information)[-1, -1]))


def plan_separation(
    doubt: RivalPair,
    so_far: Mapping[str, np.ndarray],
    seed: int = 0,
    sizes: Sequence[int] = PLAN_SIZES,
    reaches: Sequence[float] = PLAN_REACHES,
    allowed: Allowed = lambda joints: np.ones(len(joints), bool),
    payloads: Sequence[float] = (),
    least: np.ndarray | float = 0.0,
) -> Separation | None:
    """Plan as few poses of some `sizes` as separate a pair.

    Poses are in the workspace if that is enough, else as far as joint limits and singularities
    allow; if no plan is enough, the best one is returned. Payloads are some of `payloads` (kg), by
    default none or twice the heaviest one recorded. The last approach to a pose has at least the
    length `least` (nq,). None if no pose is reachable and `allowed`.
    """
    *smaller, largest = sorted(sizes)
    plans = []
    for reach in reaches:
        rng = np.random.default_rng(seed)
        try:
            pool = make_pool(
                doubt.model,
                POOL,
                rng,
                symmetric=False,
                reach=reach,
                least_travels=doubt.least_travels,
            )
        except FitError:
            continue
        pool = pool.rows(np.flatnonzero(allowed(pool.poses.joints)))
        pool = pool.lengthen_approach(doubt.model, least)
        course = Schedule.after(so_far, max(sizes) // BLOCKS)
        block = rng.integers(BLOCKS if depends_on_time(doubt.model) else 1, size=len(pool.poses))
        a = plan_conditions(doubt.model, pool, so_far, course, block, rng, payloads)
        problem = doubt.make_selection_problem(pool, a)
        of_all_sizes = (
            _separation(doubt, pool, a, course, block, exchange(problem, n, lambda fraction: None))
            for n in (min(n, len(a)) for n in (largest, *smaller))
        )
        plans.append(next(of_all_sizes))
        if plans[-1].is_enough:  # otherwise no smaller plan is enough either
            return next((plan for plan in of_all_sizes if plan.is_enough), plans[-1])
    return max(plans, key=lambda plan: plan.sigmas.then, default=None)


def plan_refinement(
    best: Trial,
    suspects: Sequence[Candidate],
    n: int,
    under: Mapping[str, float],
    allowed: Allowed,
    seed: int = 0,
    least: np.ndarray | float = 0.0,
    reach: float = 1.0,
) -> Pool:
    """Plan n poses that determine the free parameters of the model and of `suspects` best
    (D-optimality), in addition to the present samples.

    Conditions are those `under`, else the last measured ones. The last approach to each pose has at
    least the length `least` (nq,).
    """
    fitted, model = best.fitted, best.fitted.model
    for one in suspects:
        model = model.with_effect(one.name, one.settings)
    observations = replace(fitted.observations, a=conditions(model, fitted.dataset))
    model = replace(model, noise=typical_noise(model, observations))
    free, measured = ~np.asarray(model.fixed), np.asarray(observations.measured.any(axis=0))
    scale = model.table.tolerance[free]
    J = Linearisation(model, observations, free, True)(model.values, best.scene.x).jacobian * scale
    J = J.reshape(-1, J.shape[2])
    information = J.T @ J + VAGUE_INFORMATION * np.eye(J.shape[1])
    pool = make_pool(model, POOL, np.random.default_rng(seed), symmetric=False, reach=reach)
    pool = pool.rows(np.flatnonzero(allowed(pool.poses.joints))).lengthen_approach(model, least)
    latest = int(np.argmax(fitted.dataset.time))
    for k, name in enumerate(model.conditions):
        if name.split(".")[0] in ("time", "temperature", "payload", "session"):
            pool.a[:, k] = under.get(name, fitted.dataset.conditions[name][latest])
    blocks = white_blocks(model, free, measured, pool.poses, pool.a) * scale
    problem = SelectionProblem(blocks, information, np.eye(len(scale)), "D", len(scale))
    return pool.rows(exchange(problem, min(n, len(pool.poses)), lambda fraction: None))


def _separation(
    doubt: RivalPair,
    pool: Pool,
    a: np.ndarray,
    course: Schedule,
    block: np.ndarray,
    chosen: np.ndarray,
) -> Separation:
    """Order the chosen poses of a pool for the measurement: block by block, equal payloads
    together."""
    model = doubt.model
    load = a[:, [name == "payload" for name in model.conditions]].sum(axis=1)
    order = chosen[np.lexsort([load[chosen], block[chosen]])]
    blocks, ordered = block[order], pool.rows(order)
    place = np.arange(len(order)) - np.searchsorted(blocks, blocks)
    under = schedule_conditions(model, a[order], course, blocks, place)
    then = _sigmas(doubt.make_selection_problem(ordered, under).information(np.arange(len(order))))
    planned = []
    for i, pose in enumerate(ordered.poses):
        stops = () if ordered.approach is None else ordered.approach.waypoints(i)
        at = dict(zip(model.conditions, under[i].tolist(), strict=True))
        planned.append(PlannedPose(pose.position, pose.quaternion, pose.joints, stops, at))
    how = []
    if outside := int((~find_inside_poses(model, ordered.poses)).sum()):
        how.append(
            f"{outside} of the planned poses are outside the model file's workspace, inside joint "
            "limits and away from singularities: check first that the robot collides with nothing"
        )
    if ordered.approach is not None:
        how.append(THROUGH_WAYPOINTS)
    if depends_on_time(model):
        how.append(course.describe(blocks, "temperature" in _find_kinds(model)))
    pair = (doubt.effect, doubt.rival)
    return Separation(pair, Sigmas(doubt.current_sigmas, then), tuple(planned), tuple(how))


def depends_on_time(model: Model) -> bool:
    """Whether the predictions of a model depend on when a pose is measured."""
    return bool({"time", "temperature"} & _find_kinds(model))


def _find_kinds(model: Model) -> set[str]:
    """Return the conditions of a model without their joints, parts and lags."""
    return {name.split(".")[0] for name in model.conditions}


def plan_conditions(
    model: Model,
    pool: Pool,
    so_far: Mapping[str, np.ndarray],
    course: Schedule,
    block: np.ndarray,
    rng: np.random.Generator,
    payloads: Sequence[float] = (),
) -> np.ndarray:
    """Conditions (n, n_conditions) that a user can produce, for poses (n,) in blocks of a schedule:
    approaches, with and without payload, at rest or as fast as recorded."""
    a = pool.a.copy()
    if pool.approach is not None:
        speeds = [so_far[c] for c in so_far if c.startswith("velocity.")]
        fastest = float(np.max(np.abs(speeds))) if speeds else 0.0
        fill(a, model, pool.approach.ways, rng.choice([0.0, fastest], len(a)))
    for k, name in enumerate(model.conditions):
        if name == "payload":
            a[:, k] = rng.choice(payloads or (0.0, max(1.0, 2 * np.max(so_far[name]))), len(a))
        elif name == "session":
            a[:, k] = np.max(so_far[name])  # homed no more
    return schedule_conditions(model, a, course, block, np.zeros(len(a)))


def schedule_conditions(
    model: Model, a: np.ndarray, course: Schedule, block: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Conditions a (n, n_conditions) of poses measured as number `place` (n,) of their blocks."""
    a = a.copy()
    for k, name in enumerate(model.conditions):
        if name == "time":
            a[:, k] = course.begin[block] + course.step * place
        elif name.split(".")[0] == "temperature":  # parts and lagged ones: all follow in time
            a[:, k] = course.temperature[block]
    return a


def typical_noise(model: Model, observations: Observations) -> Noise:
    """Typical noise of the data, for a planner that needs one value of each kind."""
    n = len(model.joints)
    variance = np.median(np.diagonal(observations.S, axis1=1, axis2=2), axis=0)
    ever: np.ndarray = np.any(observations.measured, axis=0)

    def typical(part: slice) -> float | None:
        measured = variance[part][ever[part]]
        return float(np.sqrt(measured.mean())) if len(measured) else None

    joint = dict(zip(model.joints, np.sqrt(variance[:n]).tolist(), strict=True))
    return Noise(joint, typical(slice(n, n + 3)), typical(slice(n + 3, n + 6)))
