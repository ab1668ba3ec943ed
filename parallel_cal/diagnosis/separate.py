"""What to measure next: poses and circumstances that tell the surviving explanations apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.diagnosis.catalogue import Candidate, collect_recorded_values
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.diagnosis.thresholds import (
    MAX_RIVAL_SETTINGS,
    PLAN_REACHES,
    PLAN_SIZES,
    POOL,
    TARGET_SEPARATION_SIGMAS,
)
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations, conditions
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import Waypoint, fill
from parallel_cal.planning.expectation import VAGUE_INFORMATION, white_blocks
from parallel_cal.planning.posepool import Pool, find_inside_poses, make_pool
from parallel_cal.planning.schedule import BLOCKS, Schedule
from parallel_cal.planning.selection import SelectionProblem, exchange
from parallel_cal.recordings.dataset import Dataset

Allowed = Callable[[np.ndarray], np.ndarray]  # joints (n, nq) -> mask (n,)


@dataclass(frozen=True)
class PlannedPose:
    """A pose to measure: position (3,) m, quaternion x y z w, joints (nq,), where to go before it,
    and by name the conditions that it is measured under then."""

    position: np.ndarray
    quaternion: np.ndarray
    joints: np.ndarray
    by_way_of: tuple[Waypoint, ...]
    conditions: Mapping[str, float]


@dataclass(frozen=True)
class Sigmas:
    """By how many sigmas two effects differ: by the data so far, and with the planned poses."""

    now: float
    then: float


@dataclass(frozen=True)
class Separation:
    """Poses in the order to measure them that tell the first of two effects from the second, and
    in words how their conditions come about."""

    separates: tuple[str, str]
    sigmas: Sigmas
    poses: tuple[PlannedPose, ...]
    how: tuple[str, ...]


@dataclass(frozen=True)
class NextMeasurement:
    """What would settle a diagnosis: by effect the conditions to record, advice, planned poses."""

    record: Mapping[str, tuple[str, ...]]
    advice: tuple[str, ...]
    plan: Separation | None


def next_measurement(
    best: Trial, rivals: Mapping[str, list[str]], ranked: Sequence[Candidate], seed: int = 0
) -> NextMeasurement:
    """What to measure where `rivals` of each chosen effect fit as well; the poses tell the first
    of the chosen from the rival that is hardest to tell from it."""
    record = {c.name: c.missing for c in ranked if c.missing}
    hardest = next(iter(rank_rival_pairs(best, rivals, ranked)), None)
    plan = (
        None if hardest is None else plan_separation(hardest, best.fitted.dataset.conditions, seed)
    )
    pairs = [(name, other) for name, others in rivals.items() for other in others]
    advice = [explain_separation(*pair) for pair in pairs] + list(plan.how if plan else ())
    return NextMeasurement(record, tuple(dict.fromkeys(a for a in advice if a)), plan)


def rank_rival_pairs(
    best: Trial, rivals: Mapping[str, Sequence[str]], ranked: Sequence[Candidate]
) -> list[RivalPair]:
    """Each chosen effect beside each of its rivals, those first that are hardest to tell apart."""
    by_name = {c.name: c for c in ranked}
    found = [
        doubt
        for name, others in rivals.items()
        for other in others
        for rival in list_rival_variants(by_name[other], best.fitted.dataset)
        if (doubt := RivalPair.of(best, name, rival)) is not None
    ]
    return sorted(found, key=lambda doubt: doubt.current_sigmas)


def list_rival_variants(rival: Candidate, dataset: Dataset) -> list[Chosen]:
    """A rival in each of its settings, where a few are all there are: one that is beaten in the
    best of them may come back in another. Else in the best."""
    if rival.tried > MAX_RIVAL_SETTINGS:
        return [Chosen.of(rival)]
    scene = rival.scene
    settings = (
        rival.effect.scan(scene.model.mechanism, collect_recorded_values(dataset)) if scene else ()
    )
    return [Chosen(rival.name, tuple(sorted(setting.items()))) for setting in settings]


def explain_separation(name: str, other: str) -> str:
    """What tells two effects apart: what either says of this pair, else what the first says."""
    one, another = load_effect(name), load_effect(other)
    return one.told_from.get(other) or another.told_from.get(name) or one.separated_by


@dataclass(frozen=True)
class RivalPair:
    """An effect as identified beside a rival: a model of both, and the information (k, k) of the
    data so far about geometry, rival and the amplitude of the effect's whole signal, which is last.

    With Z the columns of geometry and rival, and a the signal, the two differ by
    sqrt(a.a - a.Z (Z.Z)^-1 Z.a) sigmas: one over the sigma of a's amplitude.
    """

    effect: str
    rival: str
    model: Model
    measured: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, best: Trial, effect: str, rival: Chosen) -> RivalPair | None:
        """None where the rival is a larger model, or would have to be what cannot be."""
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
        """The model with those of geometry and rival that look most like the effect, which is
        not there."""
        I, free = self.information, ~np.asarray(self.model.fixed)
        own = np.array([n.startswith(f"{self.effect}.") for n in self.model.table.names])
        values = np.where(own, self.model.table.nominal, self.model.values)
        like = np.linalg.solve(I[:-1, :-1], I[:-1, -1])
        values[free & ~own] += like * self.model.table.tolerance[free & ~own]
        return self.model.with_values(values)

    @property
    def current_sigmas(self) -> float:
        """Sigmas by which the data so far tell the two apart."""
        return _sigmas(self.information)

    def replace_by_signal(self, J: np.ndarray) -> np.ndarray:
        """Columns in tolerances, those of the effect replaced by their sum at the identified
        values."""
        model, free = self.model, ~np.asarray(self.model.fixed)
        names = [n for n, f in zip(model.table.names, free, strict=True) if f]
        own = np.array([n.startswith(f"{self.effect}.") for n in names])
        values = np.where(own, model.values[free], 0.0)
        scaled = J * model.table.tolerance[free]
        return np.concatenate([scaled[:, :, ~own], (J @ values)[:, :, None]], axis=2)

    def make_selection_problem(self, pool: Pool, a: np.ndarray) -> SelectionProblem:
        """What poses under conditions a would add; the planner lowers the amplitude's sigma."""
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
    """As few poses of some `sizes` as settle a doubt, in the workspace where they can, else as far
    as joint limits and singularities let the robot go; the best there are where none settles it.
    With one of some `payloads` (kg), where none are given with none or twice the heaviest so far.
    The last way to a pose is `least` (nq,) long. None where no pose can be reached, or is
    `allowed`."""
    plans = []
    for reach in reaches:
        rng = np.random.default_rng(seed)
        try:
            pool = make_pool(doubt.model, POOL, rng, symmetric=False, reach=reach)
        except FitError:
            continue
        pool = pool.rows(np.flatnonzero(allowed(pool.poses.joints)))
        pool = pool.lengthen_approach(doubt.model, least)
        course = Schedule.after(so_far, max(sizes) // BLOCKS)
        block = rng.integers(BLOCKS if depends_on_time(doubt.model) else 1, size=len(pool.poses))
        a = plan_conditions(doubt.model, pool, so_far, course, block, rng, payloads)
        problem = doubt.make_selection_problem(pool, a)
        for n in sizes:
            chosen = exchange(problem, min(n, len(a)), lambda fraction: None)
            plans.append(_separation(doubt, pool, a, course, block, chosen))
            if plans[-1].sigmas.then > TARGET_SEPARATION_SIGMAS:
                return plans[-1]
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
    """n poses that, beside the data so far, tell most of all that a model and `suspects` beside it
    have free (D-optimality), `under` these conditions and else those measured under last; the last
    way to each is `least` (nq,) long."""
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
        if name in ("time", "temperature", "payload", "session"):
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
    """The chosen poses of a pool in the order to measure them: block by block, loads together."""
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
        how.append("Reach each planned pose through its two waypoints: overshoot, then return.")
    if depends_on_time(model):
        how.append(course.describe(blocks, "temperature" in model.conditions))
    pair = (doubt.effect, doubt.rival)
    return Separation(pair, Sigmas(doubt.current_sigmas, then), tuple(planned), tuple(how))


def depends_on_time(model: Model) -> bool:
    """Whether it matters to a model when a pose is measured."""
    return bool({"time", "temperature"} & set(model.conditions))


def plan_conditions(
    model: Model,
    pool: Pool,
    so_far: Mapping[str, np.ndarray],
    course: Schedule,
    block: np.ndarray,
    rng: np.random.Generator,
    payloads: Sequence[float] = (),
) -> np.ndarray:
    """(n, n_conditions) that a user can bring about, poses (n,) in blocks of a course: what the
    approach does to the joints, with and without a load, at rest or as fast as recorded."""
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
        elif name == "temperature":
            a[:, k] = course.temperature[block]
    return a


def typical_noise(model: Model, observations: Observations) -> Noise:
    """Typical noise of the data, for a planner that wants one figure a kind."""
    n = len(model.joints)
    variance = np.median(np.diagonal(observations.S, axis1=1, axis2=2), axis=0)
    ever: np.ndarray = np.any(observations.measured, axis=0)

    def typical(part: slice) -> float | None:
        measured = variance[part][ever[part]]
        return float(np.sqrt(measured.mean())) if len(measured) else None

    return Noise(typical(slice(0, n)), typical(slice(n, n + 3)), typical(slice(n + 3, n + 6)))
