"""Noise floor: the errors that a perfect model of a robot would show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.image_poses import find_shown_poses
from parallel_cal.identification.linearisation import Linearisation, compute_joint_jacobians
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import (
    ERRORS,
    Errors,
    Summary,
    find_fully_measured_samples,
    find_judgeable_samples,
    keep_moved_coordinates,
    where_known,
)
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class NoiseFloor:
    """Errors that a perfect model would show; nothing is known if the noise is only assumed.

    `sigmas` is by kind the standard deviation of its rms between repetitions of all measurements.
    """

    summary: Summary = field(default_factory=Summary)
    sigmas: Mapping[str, float] = field(default_factory=dict)


def noise_floor(model: Model, observations: Observations, seed: int = 0) -> Summary:
    """Errors that a perfect model of this robot would show with the same measurement noise; None if
    the noise is only assumed."""
    return simulate_noise_floor(model, observations, seed).summary


@single_threaded()
def simulate_noise_floor(model: Model, observations: Observations, seed: int = 0) -> NoiseFloor:
    """Simulate what a perfect model of this robot would show with the same measurement noise.

    Joint noise propagates to the pose and the sensors through forward kinematics, pose noise to the
    joints through inverse kinematics. Means of norms come from 64 draws for each sample with a
    fixed seed.
    """
    if observations.noise_assumed:
        return NoiseFloor()
    n, m = len(model.joints), model.mechanism
    closure = model.structure.phi.shape[0]
    none = np.zeros(len(model.values), dtype=bool)
    linearise = Linearisation(model, observations, none, weighted=True)
    rows = linearise.blocks(model.values, linearise.start())[1]  # where the platform is
    measured = observations.measured[:, n : n + 6].copy()
    C, (to_pose, to_reading) = rows[:, :closure], compute_joint_jacobians(model, rows)
    solved_for = [*range(n), *[n + i for i in m.parasitic], *m.passive_columns]
    given = [n + i for i in m.controlled]
    rng = np.random.default_rng(seed)
    draws = rng.standard_normal((64, *observations.S.shape[:2]))
    noise = np.einsum(
        "nij,dnj->dni",
        np.linalg.cholesky(observations.S + 1e-30 * np.eye(len(observations.S[0]))),
        draws,
    )
    to_joint = -(np.linalg.pinv(C[:, :, solved_for]) @ C[:, :, given])[:, :n]
    if shown := find_shown_poses(model, observations, linearise.start()):
        # Where only an image shows the pose, its noise is that of the pose.
        factor = np.linalg.cholesky(shown.covariance[shown.known] + 1e-30 * np.eye(6))
        at_images = rng.standard_normal((64, len(factor), 6))
        noise[:, shown.known, n : n + 6] = np.einsum("nij,dnj->dni", factor, at_images)
        measured[shown.known] = [i in m.moved for i in range(6)]
    pose = noise[:, :, n : n + 6].copy()
    pose[:, :, m.moved] -= np.einsum("nij,dnj->dni", to_pose, noise[:, :, :n])
    joint = noise[:, :, :n] - np.einsum("nij,dnj->dni", to_joint, noise[:, :, given])
    read = observations.get_reading_sigma(model) * rng.standard_normal(
        (*draws.shape[:2], to_reading.shape[1])
    )
    read -= np.einsum("nij,dnj->dni", to_reading, noise[:, :, :n])
    read = np.where(np.isfinite(observations.reading), read, np.nan)
    in_pixels = model.structure.channel_units == "px"
    pose = np.where(measured, pose, 0.0)
    placed = find_judgeable_samples(model, measured, range(3))
    turned = find_judgeable_samples(model, measured, range(3, 6))
    each = (
        where_known(placed, keep_moved_coordinates(model, pose[:, :, :3], range(3))),
        where_known(turned, keep_moved_coordinates(model, pose[:, :, 3:], range(3, 6))),
        where_known(np.all(observations.measured[:, given], axis=1), joint),
        read * model.structure.reading_lengths,
        where_known(
            find_fully_measured_samples(model, observations), np.einsum("nij,dnj->dni", C, noise)
        ),
        np.where(in_pixels, read, np.nan),
    )
    found = Errors(*[np.concatenate(draw) for draw in each])
    sigmas = {}
    for kind in ERRORS:
        squares = found.norms(kind).reshape(len(draws), -1) ** 2
        known = np.isfinite(squares).all(axis=0)
        if known.any():
            sigmas[kind] = float(np.sqrt(squares[:, known].mean(axis=1)).std(ddof=1))
    return NoiseFloor(found.summary, sigmas)
