"""What separates explanations: advice, the conditions that a user can produce, and poses that show
effects which may be hidden."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.search import Trial
from parallel_cal.diagnosis.thresholds import POOL
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations, conditions
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.approach import fill
from parallel_cal.planning.expectation import VAGUE_INFORMATION, white_blocks
from parallel_cal.planning.posepool import Pool, make_pool
from parallel_cal.planning.schedule import Schedule
from parallel_cal.planning.selection import SelectionProblem, exchange

Allowed = Callable[[np.ndarray], np.ndarray]  # joints (n, nq) -> mask (n,)


def explain_separation(name: str, other: str) -> str:
    """Say what separates two effects: advice for this pair, else for the first effect."""
    one, another = load_effect(name), load_effect(other)
    return one.told_from.get(other) or another.told_from.get(name) or one.separated_by


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


def depends_on_time(model: Model) -> bool:
    """Whether the predictions of a model depend on when a pose is measured."""
    return bool({"time", "temperature"} & _find_kinds(model))


def depends_on_temperature(model: Model) -> bool:
    return "temperature" in _find_kinds(model)


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
