"""Plan poses that decide between the sets of effects that the samples leave possible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.diagnosis.causes import Doubt
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.diagnosis.separate import (
    Allowed,
    depends_on_time,
    plan_conditions,
    typical_noise,
)
from parallel_cal.diagnosis.thresholds import CREDIBLE, POOL
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import conditions
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import find_least_travels
from parallel_cal.planning.expectation import VAGUE_INFORMATION, white_blocks
from parallel_cal.planning.posepool import Pool, make_pool
from parallel_cal.planning.schedule import BLOCKS, Schedule
from parallel_cal.posterior.blocks import EFFECT
from parallel_cal.posterior.decision import Rival, choose_deciding_poses, compute_entropy
from parallel_cal.posterior.evidence import Choice
from parallel_cal.posterior.scene import Scene

DECIDED = compute_entropy(np.array([CREDIBLE, 1 - CREDIBLE]))  # nats
# The entropy to expect of a session that nobody wants to repeat: chance may leave it higher.
SURELY_DECIDED = compute_entropy(np.array([0.99, 0.01]))


@dataclass(frozen=True)
class Supposed:
    """What the samples tell if the robot has this set of effects.

    `estimate` (k,) of the parameters of geometry and effects, in tolerances, and `factor` (k, m) L
    of their covariance L L'; zero for the effects that it then has not.
    """

    names: tuple[str, ...]
    p: float
    estimate: np.ndarray = field(repr=False)
    factor: np.ndarray = field(repr=False)

    @classmethod
    def refit(
        cls,
        names: tuple[str, ...],
        p: float,
        J: np.ndarray,
        r: np.ndarray,
        nominal: np.ndarray,
        usual: np.ndarray,
    ) -> Supposed:
        """From rows r (n,) with derivatives J (n, k), in units of the noise; the parameters (k,)
        are distributed about their `nominal` values with the covariance L L' of the root L (k, m)
        `usual`."""
        A = J @ usual
        information = np.eye(A.shape[1]) + A.T @ A
        away = np.linalg.solve(information, A.T @ (r + J @ nominal))
        factor = usual @ np.linalg.inv(np.linalg.cholesky(information)).T
        estimate = nominal - usual @ away
        return cls(names, p, estimate, factor)

    def __str__(self) -> str:
        return " and ".join(self.names) or "none of them"


@dataclass(frozen=True)
class Undecided:
    """Sets of effects among which the samples leave the choice, each refitted to them.

    Attributes
    ----------
    model : Model
        The model that the sum is about, with all these effects at zero.
    free : array of bool (n_parameters,)
        Its parameters that a fit would find.
    measured : array of bool
        What was measured of a pose.
    variance : float
        Of the noise, in units of the noise with which the samples were weighted.
    sets : tuple of Supposed
        The likeliest first.
    """

    model: Model = field(repr=False)
    free: np.ndarray = field(repr=False)
    measured: np.ndarray = field(repr=False)
    variance: float
    sets: tuple[Supposed, ...]

    @classmethod
    def of(cls, doubt: Doubt | None) -> Undecided | None:
        """From a sum, with the sizes and settings that are the likeliest there; None if the samples
        decide, or leave only what no pose of this mechanism tells."""
        if doubt is None:
            return None
        scene = doubt.scene
        model, sets = _list_possible(doubt, scene.model)
        held = {n for n, f in zip(scene.model.table.names, scene.free, strict=True) if not f}
        free = np.array([n not in held for n in model.table.names]) & ~np.asarray(model.fixed)
        each = [
            (
                tuple(sorted(one.block.name for one in chosen)),
                p,
                {c.block.name: c.usual for c in chosen},
            )
            for p, chosen in sets
        ]
        return cls._supposing(model, scene, free, doubt.variance, each)

    @classmethod
    def between(cls, best: Trial, sets: Mapping[str, Chosen]) -> Undecided | None:
        """From the fit of a model and effects by name, one of which it has: the samples tell none
        of them from another, however large it is. None if all but one contradict the model."""
        model, known = best.fitted.model, dict[str, Chosen]()
        for words, one in sets.items():
            if (wider := _extend(model, {one.name: one.settings})) is not None:
                model, known[words] = wider, one
        each = [((words,), 1 / len(known), {one.name: None}) for words, one in known.items()]
        return cls._supposing(model, best.scene, ~np.asarray(model.fixed), 1.0, each)

    @classmethod
    def _supposing(
        cls,
        model: Model,
        scene: Scene,
        free: np.ndarray,
        variance: float,
        sets: Sequence[tuple[tuple[str, ...], float, Mapping[str, np.ndarray | None]]],
    ) -> Undecided | None:
        """Sets by their names, with their probabilities and a root of the covariance of each of
        their effects, in tolerances (None: it may be of any size), refitted to the samples of a
        scene; None if only one is plausible."""
        observations = replace(scene.observations, a=conditions(model, scene.dataset))
        model = replace(model, noise=typical_noise(model, observations))
        table, names = model.table, np.array(model.table.names)[free]
        system = Linearisation(model, observations, free, True)(model.values, scene.x)
        J = (system.jacobian * table.tolerance[free]).reshape(-1, len(names))
        r = system.residual.reshape(-1)
        nominal = ((table.nominal - model.values) / table.tolerance)[free]
        vague = np.diag(np.full(len(names), VAGUE_INFORMATION**-0.5))
        in_doubt, supposed = {name for *_, roots in sets for name in roots}, list[Supposed]()
        if (known := scene.within) is not None:
            sure = [name in known.names and name.split(".")[0] not in in_doubt for name in names]
            held = free.copy()
            held[free] = sure
            vague[np.ix_(sure, sure)] = known.factor(table, held)
            away = (known.of_table(table).mean - model.values) / table.tolerance
            nominal[sure] = away[held]
        for words, p, roots in sets:
            usual = vague.copy()
            for name in in_doubt:
                own = np.flatnonzero(np.char.startswith(names, f"{name}."))
                root = roots.get(name, np.zeros((len(own), 0)))
                if root is not None:
                    usual[own] = 0.0
                    usual[np.ix_(own, own[: root.shape[1]])] = root
            usual = usual[:, usual.any(axis=0)]
            one = Supposed.refit(words, p, J / variance**0.5, r / variance**0.5, nominal, usual)
            values = model.values.copy()
            values[free] += one.estimate * table.tolerance[free]
            if not model.with_values(values).find_contradiction():
                supposed.append(one)
        if len(supposed) < 2:
            return None
        measured = np.asarray(observations.measured.any(axis=0))
        return cls(model, free, measured, variance, tuple(supposed))

    @property
    def entropy(self) -> float:
        """Of the posterior of these sets, in nats."""
        p = np.array([one.p for one in self.sets])
        return compute_entropy(p / p.sum())

    @property
    def least_travels(self) -> np.ndarray:
        """How far each joint (nq,) must move after a reversal, so that all predictions hold."""
        found = []
        for one in self.sets:
            values = self.model.values.copy()
            values[self.free] += one.estimate * self.model.table.tolerance[self.free]
            found.append(find_least_travels(self.model.with_values(values)))
        return np.max(found, axis=0)

    def predict(self, pool: Pool, a: np.ndarray) -> list[Rival]:
        """What each set predicts of poses under conditions a (K, n_conditions)."""
        J = white_blocks(self.model, self.free, self.measured, pool.poses, a)
        J = J * self.model.table.tolerance[self.free] * self.variance**-0.5
        return [Rival(one.p, -J @ one.estimate, J @ one.factor) for one in self.sets]


def _list_possible(
    doubt: Doubt, model: Model
) -> tuple[Model, list[tuple[float, tuple[Choice, ...]]]]:
    """The set of effects that was found, and those with a rival in the place of one of them, the
    likeliest first with their probabilities; the model with all of these effects.

    What is no effect (noise that drifts, a knocked sample, a field of the device) is in no set: it
    predicts nothing of further poses. Nor is a larger mechanism, which has other rows.
    """
    sets = list[tuple[float, tuple[Choice, ...]]]()
    for p, causes in sorted(doubt.sets, key=lambda one: -one[0]):
        chosen = tuple(one for one in causes if one.block.kind == EFFECT)
        has = doubt.scene.model.has_effect
        if any(load_effect(one.block.name).widens or has(one.block.name) for one in chosen):
            continue
        settings = {one.block.name: one.block.settings[one.setting] for one in chosen}
        if (wider := _extend(model, settings)) is not None:
            model = wider
            sets.append((p, chosen))
    return model, sets


def _extend(model: Model, settings: Mapping[str, Mapping[str, float]]) -> Model | None:
    """The model with those of these effects that it has not; None if one contradicts it, or is a
    larger mechanism."""
    has, wider = {effect.name for effect in model.effects}, model
    try:
        for name, numbers in settings.items():
            if name not in has:
                wider = wider.with_effect(name, numbers)
    except ModelError:
        return None
    return wider if wider.mechanism is model.mechanism else None


@dataclass(frozen=True)
class Decision:
    """Poses that decide, in the order in which each lowers the expected entropy most, under
    conditions `a` (n, n_conditions), each in a `block` (n,) of the `course` of a session; the upper
    bound of the entropy, in nats, that is expected `after` them, and after as many such poses
    `at_last` as may be measured in all."""

    pool: Pool
    a: np.ndarray
    block: np.ndarray
    course: Schedule
    after: float
    at_last: float


def plan_decision(
    doubt: Undecided,
    so_far: Mapping[str, np.ndarray],
    n: int,
    left: int,
    allowed: Allowed,
    seed: int = 0,
    reaches: Sequence[float] = (1.0,),
    payloads: Sequence[float] = (),
    least: np.ndarray | float = 0.0,
    enough: float = DECIDED,
) -> Decision | None:
    """Plan the fewest poses, at most n, after which the expected entropy is `enough`.

    They are in the workspace if that is enough, else in the larger spaces of `reaches`. The last
    approach to a pose has at least the length `least` (nq,). `left` poses may be measured in all.
    None if no pose is reachable and `allowed`.
    """
    plans = list[Decision]()
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
        if not len(pool.poses):
            continue
        pool = pool.lengthen_approach(doubt.model, least)
        course = Schedule.after(so_far, -(-n // BLOCKS))
        block = rng.integers(BLOCKS if depends_on_time(doubt.model) else 1, size=len(pool.poses))
        a = plan_conditions(doubt.model, pool, so_far, course, block, rng, payloads)
        chosen, entropy = choose_deciding_poses(doubt.predict(pool, a), max(n, left), enough)
        rows = np.array(chosen[:n])
        after, at_last = entropy[len(rows) - 1], entropy[-1]
        plans.append(Decision(pool.rows(rows), a[rows], block[rows], course, after, at_last))
        if after <= enough:
            break
    return min(plans, key=lambda plan: (plan.after, plan.at_last), default=None)
