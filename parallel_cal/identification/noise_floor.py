"""Noise floor: the errors that a perfect model of a robot would show."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.error_jacobians import differentiate_errors
from parallel_cal.identification.image_poses import find_shown_poses
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import (
    ERRORS,
    Errors,
    Summary,
    find_fully_measured_samples,
    where_known,
)
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.replicates import subtract_visits_mean

DRAWS = 64  # repetitions of all measurements that are simulated
MAX_ROWS = 20_000  # samples times repetitions that are simulated at once
KINDS_OF_REVISITS = ("position", "orientation", "joint", "reading")


@dataclass(frozen=True)
class NoiseFloor:
    """Errors that a perfect model would show.

    `sigmas` is by kind the standard deviation of its rms between repetitions of all measurements.
    `revisits` is 0 if the floor follows from the stated noise. If the noise was not stated, it is
    the number of visits beyond the first one of each pose: the scatter of these visits is the
    floor, and nothing else is known of it. Conditions that differed between them leave it fewer
    degrees of freedom, `dof`.
    """

    summary: Summary = field(default_factory=Summary)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    revisits: int = 0
    dof: int = 0


def noise_floor(model: Model, observations: Observations, seed: int = 0) -> Summary:
    """Errors that a perfect model of this robot would show with the same measurement noise; None if
    the noise is only assumed."""
    return simulate_noise_floor(model, observations, seed).summary


def find_noise_floor(
    model: Model, observations: Observations, found: Errors, dataset: Dataset
) -> NoiseFloor:
    """Return the noise floor by the stated noise, or else by what the errors `found` of the model
    show at poses that were visited more than once."""
    if observations.noise_assumed:
        return compare_revisits(found, dataset)
    return simulate_noise_floor(model, observations)


def compare_revisits(found: Errors, dataset: Dataset) -> NoiseFloor:
    """Compare the errors of the samples (N) of a dataset at each pose with their mean there.

    What depends linearly on the conditions of the visits is removed. With the covariance C (k, k)
    of the k components of an error, the sum of its squares has about tr(C)^2 / tr(C^2) degrees of
    freedom per revisit that the conditions do not take, so the standard deviation of a rms is rms
    sqrt(tr(C^2) / (2 dof)) / tr(C) (Satterthwaite, Biometrics Bulletin 2 (1946) 110).
    """
    summary, sigmas, counts = dict[str, float](), dict[str, float](), (0, 0)
    for kind in KINDS_OF_REVISITS if dataset.mode != "continuous" else ():
        known = np.isfinite(found.norms(kind))
        part, poses = np.nan_to_num(getattr(found, kind)[known]), dataset.pose_id[known]
        conditions = {name: c[known] for name, c in dataset.conditions.items()}
        apart, dof = subtract_visits_mean(part, poses, conditions)
        squares = apart.T @ apart
        if not dof or not (total := float(np.trace(squares))):
            continue
        rms = math.sqrt(total / dof)
        summary[f"{kind}_rms"] = rms
        sigmas[kind] = rms * float(np.linalg.norm(squares)) / total / math.sqrt(2 * dof)
        counts = max(counts, (len(poses) - len(np.unique(poses)), dof))
    return NoiseFloor(Summary(**summary), sigmas, *counts)


@single_threaded()
def simulate_noise_floor(model: Model, observations: Observations, seed: int = 0) -> NoiseFloor:
    """Simulate what a perfect model of this robot would show with the same measurement noise.

    Joint noise propagates to the pose and the sensors through forward kinematics, pose noise to the
    joints through inverse kinematics. Means of norms come from DRAWS draws for each sample with a
    fixed seed.
    """
    if observations.noise_assumed:
        return NoiseFloor()
    n = len(model.joints)
    closure = model.structure.phi.shape[0]
    none = np.zeros(len(model.values), dtype=bool)
    linearise = Linearisation(model, observations, none, weighted=True)
    x = linearise.start()  # where the platform is
    shown = find_shown_poses(model, observations, x)
    _, rows, by_free = linearise.blocks(model.values, x)
    jacobians = differentiate_errors(model, observations, rows, by_free, shown)
    rng = np.random.default_rng(seed)
    draws = rng.standard_normal((DRAWS, *observations.S.shape[:2]))
    factor = np.linalg.cholesky(observations.S + 1e-30 * np.eye(len(observations.S[0])))
    if shown:
        # Where only an image shows the pose, its noise is that of the pose.
        of_images = np.linalg.cholesky(shown.covariance[shown.known] + 1e-30 * np.eye(6))
        at_images = rng.standard_normal((DRAWS, len(of_images), 6))
    of_readings = rng.standard_normal((*draws.shape[:2], len(model.structure.channels)))
    fully_measured = find_fully_measured_samples(model, observations)
    means, squares = defaultdict[str, list[Any]](list), defaultdict[str, list[Any]](list)
    # All draws of many samples at once would take gigabytes, and longer.
    at_once = max(1, MAX_ROWS // max(1, len(x)))
    for some in (slice(k, k + at_once) for k in range(0, DRAWS, at_once)):
        noise = np.einsum("nij,dnj->dni", factor, draws[some])
        if shown:
            noise[:, shown.known, n : n + 6] = np.einsum("nij,dnj->dni", of_images, at_images[some])
        drawn = {}
        for kind, one in jacobians.items():
            e = np.einsum("nij,dnj->dni", one.by_measured, noise)
            if kind in ("reading", "pixel"):
                e += one.reading_sigma * of_readings[some]
            drawn[kind] = np.where(one.known, e, np.nan)
        closure_errors = np.einsum("nij,dnj->dni", rows[:, :closure], noise)
        drawn["closure"] = where_known(fully_measured, closure_errors)
        found = Errors(**{kind: np.concatenate(draw) for kind, draw in drawn.items()})
        sizes = {kind: found.norms(kind) for kind in ERRORS} | {"closure": found.closure}
        for kind, size in sizes.items():
            by_draw = size.reshape(len(noise), -1)
            known = np.isfinite(by_draw).all(axis=0)
            if known.any():
                means[kind].extend(by_draw[:, known].mean(axis=1))
                squares[kind].extend((by_draw[:, known] ** 2).mean(axis=1))
    errors = {f"{kind}_rms": float(np.sqrt(np.mean(one))) for kind, one in squares.items()}
    errors |= {f"{kind}_mean": float(np.mean(means[kind])) for kind in ERRORS if kind in means}
    sigmas = {kind: float(np.sqrt(squares[kind]).std(ddof=1)) for kind in ERRORS if kind in squares}
    return NoiseFloor(Summary(**errors), sigmas)
