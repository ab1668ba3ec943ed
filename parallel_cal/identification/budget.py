"""Error budget: what geometry and each effect remove; and figures after ISO 9283."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.noise_floor import NoiseFloor
from parallel_cal.identification.observations import Observations, blocks
from parallel_cal.identification.prediction_errors import (
    Errors,
    compute_mean_and_sigma,
    compute_rms_and_sigma,
    find_judgeable_samples,
)
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

KINDS = {"position": slice(0, 3), "orientation": slice(3, 6)}
GEOMETRY, NOISE, REST = "geometry", "noise", "rest"


@dataclass(frozen=True)
class Part:
    """One line of a budget, in m or rad.

    `removed` is the rms error that the part removes where it is added last; of `noise` and `rest`
    it is the rms error that remains. `sigma` is its standard deviation; None if not known. `alone`
    is the rms motion of the measured point of the platform (the target) by the part; None for noise
    and rest.
    """

    name: str
    removed: float | None
    sigma: float | None
    alone: float | None


@dataclass(frozen=True)
class Budget:
    """The rms error of the nominal model, registered only, and its parts, the largest first.

    A part that is added last removes sqrt(e_without^2 - e_with^2): e_with is the error of the
    complete model, e_without that of the model without the part. It is 0 if the part does not
    lower the error. The last two parts share the error of the complete model: its `noise`, and the
    `rest`. All errors are at the same samples, at held-out poses if `held_out`.
    """

    kind: str
    total: float
    sigma: float | None
    samples: int
    poses: int
    held_out: bool
    parts: tuple[Part, ...]


def list_parts(model: Model) -> dict[str, np.ndarray]:
    """Masks (n_parameters,) of the parameters of geometry and of each effect, by name; settings of
    an effect, such as the ratio of a gear, are no part of an error."""
    table = model.table
    found = {GEOMETRY: np.isin(table.names, model.mechanism.parameters.names)}
    for effect in model.effects:
        settings = table.matching(effect.fixed_patterns())
        found[effect.name] = table.matching([f"{effect.name}.*"]) & ~settings
    return found


@single_threaded()
def budgets(
    model: Model,
    dataset: Dataset,
    observations: Observations,
    present: Errors,
    nominal: Errors,
    without: Mapping[str, Errors | None],
    noise: NoiseFloor,
    held_out: bool,
) -> tuple[Budget, ...]:
    """Make a budget for each kind of error that was measured.

    `present` are the errors of the model, `nominal` those of the nominal one, and `without` by name
    those of the model without geometry or an effect (None if they are not known).
    """
    alone, groups = _compute_motions(model, observations), blocks(dataset)
    titles = {effect.name: effect.title for effect in model.effects}
    found = []
    for kind, part in KINDS.items():
        judged = [present, nominal, *(one for one in without.values() if one is not None)]
        known = np.isfinite([one.norms(kind) for one in judged]).all(axis=0)
        if not known.any():
            continue
        at, now = groups[known], present.norms(kind)[known] ** 2
        total, sigma = compute_rms_and_sigma(nominal.norms(kind)[known] ** 2, at)
        parts = []
        for name, other in without.items():
            removed: tuple[float | None, float | None] = (None, None)
            if other is not None:
                removed = _root(*compute_mean_and_sigma(other.norms(kind)[known] ** 2 - now, at))
            squares = np.sum(alone[name][known, part] ** 2, axis=1)
            squares = squares[np.isfinite(squares)]
            moves = float(np.sqrt(squares.mean())) if len(squares) else None
            parts.append(Part(titles.get(name) or name, *removed, moves))
        parts.sort(key=lambda one: -(one.removed or 0.0))
        floor = noise.summary.rms(kind)
        if floor is not None:
            # Stated noise may be larger than all that remains.
            left = compute_rms_and_sigma(now, at)
            less = floor < left[0]
            remaining = (floor, noise.sigmas.get(kind)) if less else left
            parts.append(Part(NOISE, *remaining, None))
        rest = _root(*compute_mean_and_sigma(now - (floor or 0.0) ** 2, at))
        parts.append(Part(REST, *rest, None))
        poses = len(np.unique(at))
        found.append(Budget(kind, total, sigma, int(known.sum()), poses, held_out, tuple(parts)))
    return tuple(found)


def _root(mean: float, sigma: float) -> tuple[float, float | None]:
    """Root of a difference of mean squares, 0 for a negative one, and its standard deviation: the
    distance to the root of a difference that is larger by its own sigma."""
    root = math.sqrt(max(mean, 0.0))
    return root, None if math.isnan(sigma) else math.sqrt(max(mean, 0.0) + sigma) - root


def _compute_motions(model: Model, observations: Observations) -> dict[str, np.ndarray]:
    """By name of geometry and each effect, how far it moves the platform (N, 6) at the samples: its
    identified parameters instead of the nominal ones. NaN where a pose was not measured."""
    n, table = len(model.joints), model.table
    complete = model.configuration(predict_configurations(model, observations))
    judged = [
        find_judgeable_samples(model, observations.measured[:, n : n + 6], range(6)[part])
        for part in KINDS.values()
    ]
    known = np.repeat(np.stack(judged, axis=1), 3, axis=1)
    found = {}
    for name, which in list_parts(model).items():
        values = np.where(which, table.nominal, model.values)
        less = predict_configurations(model.with_values(values), observations)
        change = complete.change_from(model.configuration(less))[:, n : n + 6]
        found[name] = np.where(known, change, np.nan)
    return found


# Of the distance of a point from its mean, with equal normal noise in three coordinates
DISTANCE_SKEWNESS = 0.486


@dataclass(frozen=True)
class Iso9283:
    """Pose accuracy and repeatability of a robot that the model commands (after ISO 9283, 7.2).

    The visits of a pose from one side are averaged: the accuracy is the distance of this barycentre
    from the predicted pose, mean (with its standard deviation) and maximum over all of them. The
    repeatability is the mean distance of the visits from their barycentre plus three of its
    standard deviations, pooled over the poses that were visited again from the same side
    (`repeated_poses`, and `visits` in total), each pose by the degrees of freedom of its visits;
    None for less than two degrees of freedom: two visits alone do not tell how distances scatter.
    Both contain the noise of the
    device. `poses` counts the poses, `samples` all visits. If the recording does not know the side
    from which a pose was approached (`sides_known`), all its visits count as from one side.
    `sides_from_order`: these sides follow from the order of a table's rows. `unused`: no fit in the
    model's history used these samples; `frames_fitted`: only the frames of the device were fitted
    to them.
    """

    kind: str
    accuracy_mean: float
    accuracy_sigma: float | None
    accuracy_max: float
    repeatability: float | None
    repeatability_sigma: float | None
    poses: int
    samples: int
    repeated_poses: int
    visits: int
    sides_known: bool
    held_out: bool
    sides_from_order: bool = False
    unused: bool = False
    frames_fitted: bool = False


def iso_9283(
    errors: Errors,
    group: np.ndarray,
    sides: np.ndarray | None = None,
    held_out: bool = False,
    sides_from_order: bool = False,
) -> tuple[Iso9283, ...]:
    """Figures for each kind of error that was measured; the measured pose counts as the attained
    pose.

    `group` (N,) is equal for visits of one pose; `sides` (N,) is equal for visits from the same
    side (`list_sides`). `held_out`: the errors are at held-out poses. `sides_from_order` is that of
    the dataset.
    """
    found = []
    for kind in KINDS:
        known = np.isfinite(errors.norms(kind))
        if known.any():
            e, seen = getattr(errors, kind)[known], group[known]
            side = None if sides is None else sides[known]
            figures = _compute_iso_figures(kind, np.nan_to_num(e), seen, side, held_out)
            found.append(replace(figures, sides_from_order=sides_from_order))
    return tuple(found)


def list_sides(dataset: Dataset) -> np.ndarray | None:
    """Number (N,) of the side from which each sample was approached, by the directions of its
    joints; None if they were not recorded."""
    names = [f"direction.{joint}" for joint in dataset.joint_names]
    if not all(name in dataset.conditions for name in names):
        return None
    directions = np.column_stack([dataset.conditions[name] for name in names])
    if not np.isfinite(directions).all():
        return None
    return np.asarray(np.unique(directions, axis=0, return_inverse=True)[1].reshape(-1))


def _compute_iso_figures(
    kind: str, e: np.ndarray, group: np.ndarray, sides: np.ndarray | None, held_out: bool
) -> Iso9283:
    pairs = np.column_stack([group, np.zeros_like(group) if sides is None else sides])
    _, cell, visits = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    middle = np.stack([np.bincount(cell, column) for column in e.T], axis=1) / visits[:, None]
    accuracy = np.linalg.norm(middle, axis=1)
    poses = np.zeros(len(visits), group.dtype)
    poses[cell] = group
    mean, sigma = compute_mean_and_sigma(accuracy, poses)
    again = visits[cell] > 1
    # n visits scatter about their own mean by (n - 1) / n of their variance
    widened = np.sqrt(visits / np.maximum(visits - 1, 1))[cell]
    l = (widened * np.linalg.norm(e - middle[cell], axis=1))[again]
    repeatability = repeatability_sigma = None
    # Visits of one pose share their barycentre: two have equal distances from it.
    freedoms = len(l) - int((visits > 1).sum())
    if freedoms > 1:
        scatter = float(l.std()) * math.sqrt(freedoms / (freedoms - 1))
        repeatability = float(l.mean()) + 3 * scatter
        # Large distances raise both the mean and the scatter.
        of_mean = (1 + 3 * DISTANCE_SKEWNESS) / freedoms
        repeatability_sigma = scatter * math.sqrt(of_mean + 9 / (2 * (freedoms - 1)))
    return Iso9283(
        kind=kind,
        accuracy_mean=mean,
        accuracy_sigma=None if math.isnan(sigma) else sigma,
        accuracy_max=float(accuracy.max()),
        repeatability=repeatability,
        repeatability_sigma=repeatability_sigma,
        poses=len(np.unique(group)),
        samples=len(e),
        repeated_poses=len(np.unique(group[again])),
        visits=int(again.sum()),
        sides_known=sides is not None,
        held_out=held_out,
    )
