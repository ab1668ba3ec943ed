"""What to measure next: poses and circumstances that tell the surviving explanations apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.diagnosis.thresholds import POOL, POSES
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations, conditions
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.shelf import load_effect
from parallel_cal.planning.expectation import VAGUE, white_blocks
from parallel_cal.planning.posepool import make_pool
from parallel_cal.planning.selection import Choice, exchange


@dataclass(frozen=True)
class PlannedPose:
    """A pose to measure: position (3,) m, quaternion x y z w, joints (nq,), and by name the
    conditions to bring about."""

    position: np.ndarray
    quaternion: np.ndarray
    joints: np.ndarray
    conditions: Mapping[str, float]


@dataclass(frozen=True)
class Sigmas:
    """By how many sigmas two effects differ: by the data so far, and with the planned poses."""

    now: float
    then: float


@dataclass(frozen=True)
class Separation:
    """Poses, each under its conditions, that tell the first of two effects from the second."""

    separates: tuple[str, str]
    sigmas: Sigmas
    poses: tuple[PlannedPose, ...]


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
    advice = [load_effect(name).separated_by for name, others in rivals.items() if others]
    by_name = {c.name: Chosen.of(c) for c in ranked}
    plans = [
        plan
        for name, others in rivals.items()
        for other in others
        if (plan := separating(best, name, by_name[other], seed)) is not None
    ]
    hardest = min(plans, key=lambda plan: plan.sigmas.now, default=None)
    return NextMeasurement(record, tuple(a for a in advice if a), hardest)


def separating(
    best: Trial, effect: str, rival: Chosen, seed: int = 0, poses: int = POSES
) -> Separation | None:
    """Poses, each under its circumstances, that best tell an effect as identified from a rival.

    With Z the columns of geometry and rival, and a the effect's whole signal, the two differ by
    sqrt(a.a - a.Z (Z.Z)^-1 Z.a) sigmas: one over the sigma of a's amplitude in a model of both.
    The planner lowers that sigma, on top of what the data so far tell. None where nothing can be
    planned (a larger model, no reachable pool).
    """
    try:
        model = best.fitted.model.with_effect(rival.name, rival.settings)
        if model.mechanism is not best.fitted.model.mechanism:
            return None
        observations = replace(best.fitted.observations, a=conditions(model, best.fitted.dataset))
        model = replace(model, noise=_noise(model, observations))
        rng = np.random.default_rng(seed)
        pool = make_pool(model, POOL, rng, symmetric=False)
    except (FitError, ModelError):
        return None
    a = circumstances(model, best.fitted.dataset.conditions, len(pool.poses), rng)
    free, measured = ~np.asarray(model.fixed), np.asarray(observations.measured.any(axis=0))
    so_far = Linearisation(model, observations, free, True)(model.values, best.scene.x).jacobian
    ahead = white_blocks(model, free, measured, pool.poses, a)
    so_far, ahead = (_with_signal(J, model, free, effect) for J in (so_far, ahead))
    size = ahead.shape[2]
    measured_rows = so_far.reshape(-1, size)
    before = measured_rows.T @ measured_rows + VAGUE * np.eye(size)
    amplitude = np.zeros((size, size))
    amplitude[-1, -1] = 1.0
    problem = Choice(ahead, before, amplitude, "A", size)
    chosen = exchange(problem, min(poses, len(ahead)), lambda fraction: None)
    sigmas = Sigmas(*(_sigmas(M) for M in (before, problem.information(chosen))))
    planned = []
    for i in chosen:
        pose, under = pool.poses[int(i)], dict(zip(model.conditions, a[i].tolist(), strict=True))
        planned.append(PlannedPose(pose.position, pose.quaternion, pose.joints, under))
    return Separation((effect, rival.name), sigmas, tuple(planned))


def _with_signal(J: np.ndarray, model: Model, free: np.ndarray, effect: str) -> np.ndarray:
    """Columns in tolerances, those of the effect replaced by their sum at the identified values."""
    names = [n for n, f in zip(model.table.names, free, strict=True) if f]
    own = np.array([n.startswith(f"{effect}.") for n in names])
    values = np.where(own, model.values[free], 0.0)
    scaled = J * model.table.tolerance[free]
    return np.concatenate([scaled[:, :, ~own], (J @ values)[:, :, None]], axis=2)


def _sigmas(M: np.ndarray) -> float:
    """One over the standard deviation of the last parameter."""
    return float(1 / np.sqrt(np.linalg.inv(M)[-1, -1]))


def circumstances(
    model: Model, recorded: Mapping[str, np.ndarray], n: int, rng: np.random.Generator
) -> np.ndarray:
    """(n, n_conditions) drawn from what a user can bring about: both approaches, some payload,
    a cold and a warm robot, other speeds; time goes on after the recording."""
    a = model.condition_rows(None, n)
    for k, name in enumerate(model.conditions):
        a[:, k] = rng.choice(_levels(name, recorded.get(name)), n)
    return a


def _levels(name: str, recorded: np.ndarray | None) -> list[float]:
    kind = name.split(".")[0]
    usual = np.array([CONDITIONS[kind][1]])
    values = recorded if recorded is not None and len(recorded) else usual
    low, high = float(np.min(values)), float(np.max(values))
    around = {
        "direction": [-1.0, 1.0],
        "payload": [0.0, max(1.0, 2 * high)],
        "temperature": [low - 4, (low + high) / 2, high + 4],
        "time": [high, high + (high - low) / 2, high + (high - low)],
    }
    return around.get(kind, [low, (low + high) / 2, high])


def _noise(model: Model, observations: Observations) -> Noise:
    """Typical noise of the data, for a planner that wants one figure a kind."""
    n = len(model.joints)
    variance = np.median(np.diagonal(observations.S, axis1=1, axis2=2), axis=0)
    ever: np.ndarray = np.any(observations.measured, axis=0)

    def typical(part: slice) -> float | None:
        measured = variance[part][ever[part]]
        return float(np.sqrt(measured.mean())) if len(measured) else None

    return Noise(typical(slice(0, n)), typical(slice(n, n + 3)), typical(slice(n + 3, n + 6)))
