"""Select which poses to measure: n of many candidates, before any measurement (5.3.9)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.identification.checks import free_mask
from parallel_cal.identification.estimate import EstimationProblem
from parallel_cal.identification.update import update_prior
from parallel_cal.kinematics.contacts import find_nearest_contacts, list_contacts
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.solutions import concatenate_solutions
from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion, describe_untested_conditions
from parallel_cal.planning.approach import Approaches
from parallel_cal.planning.expectation import Expectation, View
from parallel_cal.planning.options import PlanKeywords, PlanOptions
from parallel_cal.planning.pose_table import format_pose_table
from parallel_cal.planning.posepool import Pool, given_pool, make_pool
from parallel_cal.planning.selection import SelectionProblem, anneal, exchange
from parallel_cal.planning.update import UpdatePlan
from parallel_cal.planning.visibility import (
    find_seen_poses,
    list_planned_sensors,
    stand_in_pose_device,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

N_VALIDATION_POSES = 200
RANDOM_SETS = 21
MIN_BLIND_SHARE = 0.1  # of the expected error
MAX_NAMED_PARAMETERS = 5  # of the least certain ones


@dataclass(frozen=True)
class Plan:
    """The poses to measure, with the inputs of the selection.

    Attributes
    ----------
    model : Model
        The model for which the poses were chosen.
    poses : Solutions
        The chosen poses (n): joints, positions and rotations.
    a : array (n, n_conditions)
        Conditions at the poses, in the order of `model.conditions`.
    approach : Approaches or None
        How to reach the poses; None if that does not matter.
    options : PlanOptions
        The options of the selection.
    free : array of bool (n_parameters,)
        The parameters to identify.
    expected, random : Expectation
        Expected uncertainty with the chosen poses, and with the median of 21 random sets of the
        same size from the same pool.
    pool : int
        Number of poses from which these were chosen.
    warnings : tuple of str
        What the plan does not achieve.
    update : UpdatePlan or None
        How few of the poses show the usual drifts, with the option `update`.
    """

    model: Model
    poses: Solutions
    a: np.ndarray
    approach: Approaches | None
    options: PlanOptions
    free: np.ndarray
    expected: Expectation
    random: Expectation
    pool: int
    warnings: tuple[str, ...]
    update: UpdatePlan | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def __repr__(self) -> str:
        return f"Plan({len(self)} poses for {self.model!r}, criterion {self.options.criterion})"

    @property
    def names(self) -> list[str]:
        """Names of the free parameters."""
        return [n for n, f in zip(self.model.table.names, self.free, strict=True) if f]

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal plan`; SI, None for unknown values."""
        table = self.model.table
        parameters = {
            name: {
                "sigma": float(s) if np.isfinite(s) else None,
                "sigma_tolerances": float(s / table[name].tolerance) if np.isfinite(s) else None,
                "unit": table[name].unit,
            }
            for name, s in zip(self.names, self.expected.sigma, strict=True)
        }
        return {
            "poses": [self._pose(i) for i in range(len(self))],
            "criterion": self.options.criterion,
            "method": self.options.chosen_method,
            "pool": self.pool,
            "seed": self.options.seed,
            "indices": self.expected.indices.document(),
            "random": {**self.random.indices.document(), "expected": _errors(self.random)},
            "expected": {**_errors(self.expected), "parameters": parameters},
            "noise": vars(self.model.noise),
            "warnings": list(self.warnings),
            **({} if self.update is None else {"update": self.update.document()}),
        }

    def csv(self) -> str:
        """Return the text of a CSV file with one row for each pose: position, quaternion, joints,
        conditions, and the joints at the waypoints if the approach matters. The header states the
        units."""
        poses, approach = self.poses, self.approach
        stops = () if approach is None else (approach.past.joints, approach.turn.joints)
        conditions = dict(zip(self.model.conditions, self.a.T, strict=True))
        return format_pose_table(
            self.model,
            poses.position,
            poses.quaternion,
            poses.joints,
            conditions,
            stops,
            self.describe_expectation(),
            self.contacts,
        )

    @property
    def contacts(self) -> list[str]:
        """What each pose touches, such as `socket2`; empty for a model without contacts."""
        names = list(list_contacts(self.model))
        if not names:
            return []
        return [names[k] for k in find_nearest_contacts(self.model, self.poses, self.a)]

    def describe_expectation(self) -> list[str]:
        """Say in sentences what a calibration at these poses alone tells."""
        n, kind = len(self), "position"
        if not np.isfinite(self.expected.position_rms):
            kind = "orientation"
        unit, factor = ERROR_UNITS[kind]
        planned, random = (
            f"{getattr(one, f'{kind}_rms') * factor:.3g} {unit}"
            for one in (self.expected, self.random)
        )
        tolerances = self.model.table.tolerance[self.free]
        order = np.argsort(-self.expected.sigma / tolerances, kind="stable")[:MAX_NAMED_PARAMETERS]
        worst = ", ".join(
            f"{self.names[k]} {self.expected.sigma[k] / tolerances[k]:.2g}" for k in order
        )
        return [
            f"After a calibration at these {n} poses alone, the uncertainty of the parameters "
            f"causes a {kind} error of {planned} rms; after one at {n} random poses, {random}.",
            f"Least certain parameters, sigma in tolerances: {worst}.",
        ]

    def _pose(self, i: int) -> dict[str, Any]:
        pose = self.poses[i]
        row = {
            "position": pose.position.tolist(),
            "quaternion": pose.quaternion.tolist(),
            "joints": pose.joints.tolist(),
        }
        if self.approach is not None:
            row["by_way_of"] = to_json_value(self.approach.waypoints(i))
        at = dict(zip(self.model.conditions, self.a[i].tolist(), strict=True))
        return {**row, "conditions": at} if at else row


def _errors(e: Expectation) -> dict[str, float | None]:
    values = {k: getattr(e, k) for k in ("position_rms", "orientation_rms", "pose_rms")}
    return {k: float(v) if np.isfinite(v) else None for k, v in values.items()}


@check_arguments(FitError)
@single_threaded()
def plan(
    model: Model,
    n: int,
    options: PlanOptions | None = None,
    progress: Progress | None = None,
    **changes: Unpack[PlanKeywords],
) -> Plan:
    """Select the poses to measure, before anything is measured.

    n poses are selected from a pool of random poses of the workspace so that a criterion of the
    identification is optimal. The plan assumes that the position is measured if the model states
    the noise of the position. The same applies to the orientation.

    Parameters
    ----------
    model : Model
        States the free parameters, their tolerances and the measurement noise.
    n : int
        Number of poses.
    options : PlanOptions, optional
        All options as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1).
    **changes
        Single options by name: `criterion` (default `"prediction"`: mean variance of the predicted
        pose over the workspace; or `"D"`, `"A"`, `"condition"`, `"noise_amplification"`), `method`
        (`"exchange"` or `"annealing"`), `pool` (number of candidate poses, or the poses),
        `symmetric` (choose triples of poses, 120 degrees about z apart), `seed` of the candidates;
        `free`, `fix` and `prior` as in `fit`.

    Returns
    -------
    Plan
        `poses` (n configurations; m, rad), `expected` and `random`: the expected errors with these
        poses and with poses drawn at random. `csv()` gives the poses as a table.

    Raises
    ------
    FitError
        If n poses cannot determine the free parameters, the pool is too small, or the model states
        no noise.

    References
    ----------
    Vischer, P. (1996). Thesis 1570, EPFL, section 5.3.9.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> plan = pc.plan(model, 30, pool=200)
    >>> bool(plan.expected.position_rms < plan.random.position_rms)
    True
    """
    options = with_changes(options, PlanOptions, changes, FitError)
    model = stand_in_pose_device(model)
    measured = _measured(model)
    last = update_prior(model) if options.update else None
    sought = EstimationProblem(
        model, free_mask(model, options.free, options.fix), last or options.prior
    )
    if last is None:
        _check_enough(model, n, sought.free)
    rng = np.random.default_rng(options.seed)

    def report(fraction: float) -> None:
        if progress:
            progress("selecting poses", fraction)

    pool = _make_candidates(model, n, options, rng)
    groups = n // pool.groups.shape[1]
    unseen = make_pool(
        model, N_VALIDATION_POSES, np.random.default_rng([options.seed, 1]), symmetric=False
    )
    view = View(sought, measured, pool, unseen)
    problem = view.problem(options.criterion)
    report(0.0)
    if options.chosen_method == "exchange":
        chosen = exchange(problem, groups, report)
    else:
        chosen = anneal(problem, groups, rng, report)
    random = view.expectation(view.rows(_draw_middling_set(problem, groups, rng)))
    rows = view.rows(chosen)
    expected = view.expectation(rows)
    if not (view.is_without_device or last):
        _check_determined(expected, view.rank, options.prior)
    update = None if last is None else view.order_for_update(rows, last)
    if update is not None:
        rows = rows[list(update.order)]
    return Plan(
        model=model,
        poses=pool.poses[rows],
        a=pool.a[rows],
        approach=None if pool.approach is None else pool.approach[rows],
        options=options,
        free=sought.free,
        expected=expected,
        random=random,
        pool=pool.groups.size,
        update=update,
        warnings=tuple(_list_warnings(view, expected, pool.rows(rows))),
    )


def _list_warnings(view: View, expected: Expectation, chosen: Pool) -> Iterator[str]:
    """Say what the chosen poses leave unknown, and what to see to before they are measured."""
    yield from _list_blind_warnings(expected, view, chosen)
    yield from view.warnings()
    yield from _list_sensor_warnings(view.model)
    yield from _list_region_warnings(view.model, chosen.poses)
    if untested := describe_untested_conditions(view.model, chosen.a):
        yield untested


def _make_candidates(model: Model, n: int, options: PlanOptions, rng: np.random.Generator) -> Pool:
    """Make the candidates that the device sees; FitError if n poses cannot be chosen of them."""
    contacts = list_contacts(model)
    if contacts and options.symmetric:
        raise FitError("symmetric sets of poses do not keep a contact: plan without --symmetric")
    if isinstance(options.pool, Solutions):
        pool = given_pool(model, options.pool, rng)
    else:
        pool = make_pool(model, options.pool, rng, options.symmetric, in_contact=bool(contacts))
    pool = _keep_seen_groups(model, pool)
    size = pool.groups.shape[1]
    if n % size:
        raise FitError(
            f"{n} poses are not a multiple of {size}, the size of a symmetric set: "
            f"plan {n // size * size or size} or {n // size * size + size}"
        )
    if n > pool.groups.size:
        raise FitError(
            f"{n} poses requested, but only {pool.groups.size} candidates are reachable, inside "
            "the limits and away from singularities: take a larger pool"
        )
    return pool


def _draw_middling_set(
    problem: SelectionProblem, groups: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw sets of so many groups of poses at random, and return that with the median criterion."""
    sets = [rng.permutation(len(problem.blocks))[:groups] for _ in range(RANDOM_SETS)]
    costs = [problem.cost(problem.information(s)) for s in sets]
    return sets[int(np.argsort(costs)[RANDOM_SETS // 2])]


@single_threaded()
def expected_at(model: Model, q: np.ndarray) -> Expectation:
    """Predict the result of an identification from poses at joints q (N, nq), under neutral
    conditions. Raises FitError if they are too few for the free parameters, or if the noise is not
    known."""
    model = stand_in_pose_device(model)
    measured, free = _measured(model), free_mask(model, (), ())
    _check_enough(model, len(q), free)
    rng = np.random.default_rng(0)
    poses = Kinematics(model).direct(q)
    unseen = make_pool(model, N_VALIDATION_POSES, rng, symmetric=False)
    whole = Pool(
        concatenate_solutions([poses, unseen.poses]),
        np.arange(len(q) + len(unseen.poses))[:, None],
        np.vstack([model.condition_rows(None, len(q)), unseen.a]),
        None,
    )
    view = View(EstimationProblem(model, free, False), measured, whole, unseen)
    expected = view.expectation(np.arange(len(q)))
    _check_determined(expected, view.rank, prior=False)
    return expected


def _measured(model: Model) -> np.ndarray:
    """Return the mask (nq + 6 + nu,) of joints and coordinates whose noise the model states."""
    noise, channels = model.noise, model.structure.channels
    given = [noise.position is not None, noise.orientation is not None]
    planned = list_planned_sensors(model)
    if channels and not planned and not any(given):
        raise FitError(
            f"a plan needs a device that measures poses; the model's sensors read "
            f"{', '.join(channels)} instead: spread the tip along the rim of the plate and of "
            "each sphere, or remove the sensors from the model file and state noise.position"
        )
    silent = np.isnan(model.joint_noise).any()
    if silent or not (planned or any(given)):
        missing = "noise.joint" if silent else "noise.position or noise.orientation"
        raise FitError(
            f"the model states no {missing}: a plan weights measurements by their noise; state "
            "noise (1 sigma, rad or m) in the model file"
        )
    passive = [False] * len(model.mechanism.passive)
    return np.array([True] * len(model.joints) + [given[0]] * 3 + [given[1]] * 3 + passive)


def _keep_seen_groups(model: Model, pool: Pool) -> Pool:
    """Keep the groups of poses at which a camera sees its board; FitError without any."""
    seen = find_seen_poses(model, pool.poses)[pool.groups].all(axis=1)
    if not seen.any():
        sensors = model.sensors
        what = {
            "no camera sees its board": any(sensor.shows_pose for sensor in sensors),
            f"no contact is made ({', '.join(list_contacts(model))})": any(list_contacts(model)),
        }
        raise FitError(
            f"{' and '.join(words for words, applies in what.items() if applies)} at any of "
            f"{len(pool.poses)} poses in the workspace: check the places of "
            f"{', '.join(sensor.name for sensor in sensors)} in the model file"
        )
    return replace(pool, groups=pool.groups[seen])


def _list_sensor_warnings(model: Model) -> list[str]:
    planned = list_planned_sensors(model)
    channels = ", ".join(c for s in model.sensors if s not in planned for c in s.channels)
    return [f"planned for the pose device only: readings of {channels} are ignored"] * bool(
        channels
    )


def _list_blind_warnings(expected: Expectation, view: View, chosen: Pool) -> list[str]:
    """Say what no pose can show, before anybody measures: the size of the robot, and how large an
    error remains if the robot is as far from its drawing as its tolerances state. Name contacts
    that no planned pose makes, too."""
    words, model = [], view.model
    if contacts := list(list_contacts(model)):
        used = {contacts[k] for k in find_nearest_contacts(model, chosen.poses, chosen.a)}
        if unused := [name for name in contacts if name not in used]:
            words.append(
                f"no planned pose touches {', '.join(unused)}: remove it from the sensor in the "
                "model file"
            )
    if not view.sees_size:
        words.append(
            "no reading contains a known length: a robot all of whose lengths are longer by the "
            "same factor would give the same readings. Measure one length and fix it, or use "
            "sockets with known distances"
        )
    if expected.undetermined_rms > MIN_BLIND_SHARE * expected.position_rms:
        error = f"{expected.undetermined_rms * 1e6:.3g} um"
        words.append(
            f"what no pose can show leaves a position error of {error} rms, if the robot is as far "
            "from its drawing as its tolerances state"
        )
    return words


def _list_region_warnings(model: Model, poses: Solutions) -> list[str]:
    """Name poses beyond the region in which the model was identified."""
    region = IdentifiedRegion.of_model(model)
    if region is None:
        return []
    excess = region.compute_excess(poses.joints, poses.position)
    words = region.describe_excess(excess, "planned poses")
    return [f"{words}; samples of these poses would extend the region"] if words else []


def equations_per_pose(model: Model) -> int:
    """Return the number of equations that a measured pose gives; FitError if it is zero, or if the
    noise is not known. An image of a board gives as many as a pose."""
    model = stand_in_pose_device(model)
    moved = [len(model.joints) + i for i in model.mechanism.moved]
    unmeasured = int((~_measured(model)[moved]).sum())
    each = model.structure.equations - (0 if list_planned_sensors(model) else unmeasured)
    if each <= 0:
        raise FitError(
            "the measured coordinates give no equation: state the noise of the "
            "others that you measure"
        )
    return each


def _check_enough(model: Model, n: int, free: np.ndarray) -> None:
    each, wanted = equations_per_pose(model), int(free.sum())
    if n * each < wanted:
        least = -(-wanted // each)
        raise FitError(
            f"{n} poses give {n * each} equations, but {wanted} parameters are free: plan at "
            f"least {least} poses (better {2 * least}), or fix parameters"
        )


def _check_determined(expected: Expectation, rank: int, prior: bool) -> None:
    """Raise FitError if even the best set does not determine every direction."""
    seen = expected.indices
    if seen.rank < rank and not prior:
        raise FitError(
            f"{seen.poses} poses determine only {seen.rank} of the {rank} directions of the "
            "parameters that the workspace determines: plan more, fix parameters, or use "
            "priors (--prior)"
        )
