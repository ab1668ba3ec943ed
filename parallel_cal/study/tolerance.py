"""Predict the accuracy of a design, and which tolerances contribute most to its error."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from parallel_cal import __version__
from parallel_cal.base.errors import FitError
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.base.threads import single_threaded
from parallel_cal.fleet.cluster import (
    KILLED_WORKER_REASON,
    check_extra_installed,
    cluster,
    run_each,
)
from parallel_cal.fleet.jobs import FleetError, check_version
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable
from parallel_cal.planning.expectation import Expectation, prediction_blocks
from parallel_cal.planning.plan import expected_at
from parallel_cal.planning.posepool import Pool, make_pool

KINDS = {"position": slice(0, 3), "orientation": slice(3, 6)}
ROBOTS_PER_CALL = 50
# The linear budget is reported as inaccurate if it deviates from the Monte Carlo result by more
# than this share of the rms, and by more than so many sigmas of the Monte Carlo mean square.
MAX_LINEAR_DEVIATION = 0.1
MIN_DEVIATION_SIGMAS = 3.0


@dataclass(frozen=True)
class Share:
    """The error that alike parameters (`chain*.Lb`) cause together.

    `tolerance` is the smallest and the largest of their tolerances; `rms` the error that they cause
    alone, by kind (m, rad); `halved` the total error if their tolerances were halved."""

    name: str
    label: str
    unit: str
    tolerance: tuple[float, float]
    count: int
    rms: Mapping[str, float]
    halved: Mapping[str, float]

    def compute_fraction(self, whole: Mapping[str, float], kind: str) -> float:
        """Return its share of the total mean square."""
        return (self.rms[kind] / whole[kind]) ** 2 if whole[kind] else 0.0


@dataclass(frozen=True)
class Tolerances:
    """The pose errors of robots drawn from a model's tolerances and controlled with its nominal
    parameters.

    `errors` (robots, poses) are given for each kind in which the platform moves (m, rad), NaN at
    poses that a robot cannot reach. `linear` is the rms by the first-order `budget`, whose shares
    are sorted from the largest. `calibrated` is the expected result of an identification at the
    poses of a plan, if one was given.
    """

    model: Model
    seed: int
    errors: Mapping[str, np.ndarray]
    linear: Mapping[str, float]
    budget: tuple[Share, ...]
    calibrated: Expectation | None = None
    planned: int = 0

    @property
    def kind(self) -> str:
        """The kind of error that ranks the budget: position, if the platform translates."""
        return next(iter(self.errors))

    def robots(self, kind: str) -> np.ndarray:
        """Return the rms error of each robot that reaches any pose."""
        errors = self.errors[kind]
        reach = np.isfinite(errors).any(axis=1)
        return np.asarray(np.sqrt(np.nanmean(errors[reach] ** 2, axis=1)))

    def summary(self, kind: str) -> dict[str, float]:
        """Return the rms, 95 % quantile and maximum over robots and poses, and the 95 % quantile of
        the robots' rms."""
        errors = self.errors[kind]
        return {
            "rms": float(np.sqrt(np.nanmean(errors**2))),
            "p95": float(np.nanquantile(errors, 0.95)),
            "max": float(np.nanmax(errors)),
            "robots_p95": float(np.quantile(self.robots(kind), 0.95)),
        }

    @property
    def unreached(self) -> int:
        """The number of poses, over all robots, that a robot could not reach."""
        return int(np.isnan(self.errors[self.kind]).sum())

    def differs(self, kind: str) -> bool:
        """Whether the linear budget deviates from the Monte Carlo result: the errors are not
        proportional to the tolerances."""
        squares = self.robots(kind) ** 2
        mean, linear = squares.mean(), self.linear[kind] ** 2
        chance = MIN_DEVIATION_SIGMAS * squares.std() / np.sqrt(len(squares))
        far = abs(np.sqrt(mean) - self.linear[kind]) > MAX_LINEAR_DEVIATION * np.sqrt(mean)
        return bool(far and abs(mean - linear) > chance)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal study tolerance`; SI."""
        robots, poses = self.errors[self.kind].shape
        return {
            "mechanism": self.model.mechanism.name,
            "robots": robots,
            "poses": poses,
            "unreached": self.unreached,
            "seed": self.seed,
            "errors": {
                kind: self.summary(kind)
                | {"linear_rms": self.linear[kind], "linear_differs": self.differs(kind)}
                for kind in self.errors
            },
            "budget": [
                {
                    "parameters": one.name,
                    "label": one.label,
                    "count": one.count,
                    "unit": one.unit,
                    "tolerance": one.tolerance,
                    "rms": dict(one.rms),
                    "share": {
                        kind: one.compute_fraction(self.linear, kind) for kind in self.errors
                    },
                    "rms_of_all_if_halved": dict(one.halved),
                }
                for one in self.budget
            ],
            "calibrated": self.calibrated
            and {
                "poses": self.planned,
                "position_rms": self.calibrated.position_rms,
                "orientation_rms": self.calibrated.orientation_rms,
            },
        }


def tolerances(
    model: Model,
    robots: int = 200,
    poses: int = 200,
    *,
    seed: int = 0,
    at: Mapping[str, float] | None = None,
    planned: np.ndarray | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Tolerances:
    """Draw robots from a model's tolerances and compute their pose errors at nominal joints.

    `at` sets conditions; a `scheduler` names the Dask cluster to use. Effects of the measuring
    device do not move the robot, and known numbers (the ratio of a gear) do not vary. `planned`
    (N, nq) are the joints at which a robot would be calibrated. Raises FitError if no parameter has
    a tolerance or if the workspace cannot be reached.
    """
    table = model.table
    drawn = find_varying_parameters(model)
    nominal = model.with_values(np.where(drawn, table.nominal, model.values)).robot()
    if not drawn.any():
        raise FitError(f"{model.mechanism.name}: no parameter of the model has a tolerance")
    report = progress or ignore_progress
    with single_threaded():
        pool = make_pool(nominal, poses, np.random.default_rng([seed, 0]), symmetric=False)
        for k, name in enumerate(model.conditions):
            if at and name in at:
                pool.a[:, k] = at[name]
        moved = {*model.mechanism.moved}
        kinds = {kind: part for kind, part in KINDS.items() if moved & {*range(6)[part]}}
        linear, budget = _compute_budget(nominal, drawn, pool, kinds)
    text = dump_model(nominal)
    calls = [
        (__version__, text, seed, range(k, min(k + ROBOTS_PER_CALL, robots)), pool.poses, pool.a)
        for k in range(0, robots, ROBOTS_PER_CALL)
    ]
    found: dict[int, np.ndarray] = {}
    for k, norms in _run_calls(calls, scheduler):
        found[k] = norms
        report("simulating robots", len(found) / len(calls))
    norms = np.concatenate([found[k] for k in range(len(calls))])
    if np.isnan(norms).all():
        raise FitError(
            f"{model.mechanism.name}: no robot drawn from these tolerances can be assembled"
        )
    return Tolerances(
        model,
        seed,
        {kind: norms[..., list(KINDS).index(kind)] for kind in kinds},
        linear,
        budget,
        None if planned is None else expected_at(model, planned),
        0 if planned is None else len(planned),
    )


def find_varying_parameters(model: Model) -> np.ndarray:
    """Return the mask of the parameters that differ from robot to robot: the geometry, identifiable
    or not, and the coefficients of the robot's effects, without known numbers."""
    device = [f"{effect.name}.*" for effect in model.effects if effect.of_device]
    known = [pattern for effect in model.effects for pattern in effect.fixed_patterns()]
    out = model.table.matching([*device, *known])
    sensor = np.array([p.group == "sensor" for p in model.table])
    return np.asarray((model.table.tolerance > 0) & ~out & ~sensor)


def draw_values(
    table: ParameterTable, values: np.ndarray, which: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Draw the values of a robot: `which` deviate by their tolerance (1 sigma).

    A value beyond its range is mirrored at the limit: a backlash is never negative."""
    low, high = (np.array([getattr(p, side) for p in table]) for side in ("low", "high"))
    values = values + np.where(which, table.tolerance * rng.standard_normal(len(table)), 0.0)
    values = np.where(values < low, 2 * low - values, values)
    return np.asarray(np.clip(np.where(values > high, 2 * high - values, values), low, high))


def _compute_budget(
    nominal: Model, drawn: np.ndarray, pool: Pool, kinds: Mapping[str, slice]
) -> tuple[dict[str, float], tuple[Share, ...]]:
    """Compute the linear rms of all parameters, and of alike ones: G sigma, G = -J_x^-1 J_v."""
    table, everything = nominal.table, np.ones(len(nominal.structure.scale), bool)
    G = prediction_blocks(nominal, drawn, everything, pool) * table.tolerance[drawn]
    G[:, 3:] /= nominal.mechanism.length
    squares = {k: np.sum(G[:, part] ** 2, axis=1).mean(axis=0) for k, part in kinds.items()}
    names = [name for name, is_drawn in zip(table.names, drawn, strict=True) if is_drawn]
    alike = [re.sub(r"\d+(?=\.)", "*", name) for name in names]
    whole = {kind: float(np.sqrt(parts.sum())) for kind, parts in squares.items()}

    def shares() -> Iterator[Share]:
        for pattern in dict.fromkeys(alike):
            own = np.array([other == pattern for other in alike])
            some = [table[name] for name, is_own in zip(names, own, strict=True) if is_own]
            parts = {kind: float(square[own].sum()) for kind, square in squares.items()}
            # Half the tolerance leaves a quarter of the mean square.
            halved = {k: float(np.sqrt(whole[k] ** 2 - 0.75 * part)) for k, part in parts.items()}
            sizes = [p.tolerance for p in some]
            yield Share(
                pattern,
                some[0].label,
                some[0].unit,
                (min(sizes), max(sizes)),
                len(some),
                {kind: float(np.sqrt(part)) for kind, part in parts.items()},
                halved,
            )

    first = next(iter(kinds))
    return whole, tuple(sorted(shares(), key=lambda share: -share.rms[first]))


def _run_calls(
    calls: Sequence[tuple[Any, ...]], scheduler: str | None
) -> Iterator[tuple[int, Any]]:
    """Run the calls here, or on a Dask cluster if one is given.

    A few thousand poses are computed here before other processes have even started."""
    if scheduler is None:
        yield from ((k, errors_of(*call)) for k, call in enumerate(calls))
        return
    check_extra_installed()
    with cluster(scheduler, None) as client:
        for k, norms in run_each(client, errors_of, calls):
            if norms is None:
                raise FleetError(f"of {ROBOTS_PER_CALL} robots: {KILLED_WORKER_REASON}")
            yield k, norms


@lru_cache(maxsize=8)
def model_of(text: str) -> Model:
    """Parse a model, or return the one parsed before: robots and sessions of one model share the
    expressions derived from it."""
    return parse_model(text)


def errors_of(
    version: str, text: str, seed: int, robots: Sequence[int], poses: Solutions, a: np.ndarray
) -> np.ndarray:
    """Return the error norms (robots, N, 2) in m and rad of robots drawn from the model in `text`.

    `poses` are those of the nominal model under conditions a (N, n_conditions); each robot moves to
    the same joints. `robots` are numbers, each of which seeds its robot."""
    check_version(version)
    nominal = model_of(text)
    drawn, at = find_varying_parameters(nominal), dict(zip(nominal.conditions, a.T, strict=True))
    norms = np.full((len(robots), len(poses), 2), np.nan)
    with single_threaded():
        for k, robot in enumerate(robots):
            rng = np.random.default_rng([seed, 1, robot])
            values = draw_values(nominal.table, nominal.values, drawn, rng)
            there = Kinematics(nominal.with_values(values)).direct(poses.joints, at)
            norms[k, :, 0] = np.linalg.norm(there.position - poses.position, axis=1)
            turned = rotation_vector(there.rotation @ poses.rotation.transpose(0, 2, 1))
            norms[k, :, 1] = np.linalg.norm(turned, axis=1)
            norms[k, ~there.solved] = np.nan
    return norms
