"""Compute residuals as a field over the workspace, in SI and in noise units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.identification.image_poses import find_shown_poses
from parallel_cal.identification.linearisation import follow_closure
from parallel_cal.identification.observations import UNMEASURED
from parallel_cal.posterior.scene import Scene


@dataclass(frozen=True)
class Field:
    """Measured minus predicted at every sample.

    pose (N, 6) m and rad about base axes, 0 where neither measured nor shown by an image;
    `noise_units` (N, k) the same divided by what joint and device noise explain together;
    `measured` (N, 6). `error` (N, k) is the pose, or else the readings or the closure, 0 where
    nothing was measured, and `sigma` (N, k) what joint and device noise make of each.
    `held` is the rms, in the device's sigmas, of measured coordinates that the model holds at one
    value; 0 if these sigmas were not stated.
    """

    pose: np.ndarray = field(repr=False)
    noise_units: np.ndarray = field(repr=False)
    measured: np.ndarray = field(repr=False)
    held: float
    error: np.ndarray = field(repr=False)
    sigma: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, scene: Scene) -> Field:
        """The field of a scene; without any pose measured, `noise_units` are those of what sensors
        read, or else the closure's own."""
        n = len(scene.model.joints)
        observations = scene.observations
        moved = np.isin(np.arange(6), scene.model.mechanism.moved)
        shown = observations.measured[:, n : n + 6]
        measured = shown & moved
        seen, predicted = (scene.model.configuration(x) for x in (observations.x, scene.x))
        pose = seen.change_from(predicted)[:, n : n + 6]
        variance = np.diagonal(observations.S, axis1=1, axis2=2)[:, n : n + 6]
        fixed = (pose**2 / np.where(variance > 0, variance, 1.0))[shown & ~moved]
        unmeasured = observations.noise_from.get("pose") in UNMEASURED
        held = float(np.sqrt(fixed.mean())) if fixed.size and not unmeasured else 0.0
        pose = np.where(measured, pose, 0.0)
        S, readings = observations.S, scene.reading_residuals
        if poses := find_shown_poses(scene.model, observations, scene.x):
            images: np.ndarray = poses.known[:, None] & moved
            pose = np.where(images, poses.change, pose)
            S, measured = S.copy(), measured | images
            S[poses.known, n : n + 6, n : n + 6] = poses.covariance[poses.known]
        if measured.any():
            by_joint = _compute_joint_jacobians(scene)[0]
            total = S[:, n : n + 6, n : n + 6] + by_joint @ S[:, :n, :n] @ by_joint.transpose(
                0, 2, 1
            )
            noise_units, sigma = _in_noise_units(pose, total, measured), _sigma(total)
            return cls(pose, noise_units, measured, held, pose, sigma)
        if np.isfinite(readings).any():
            by_joint = _compute_joint_jacobians(scene)[1]
            own = observations.get_reading_sigma(scene.model)[:, :, None] ** 2
            total = by_joint @ S[:, :n, :n] @ by_joint.transpose(0, 2, 1)
            total = total + own * np.eye(own.shape[1])
            noise_units = _in_noise_units(readings, total, np.isfinite(readings))
            error = np.nan_to_num(readings)
            return cls(pose, noise_units, measured, held, error, _sigma(total))
        closure = scene.closure_residual
        return cls(pose, closure, measured, held, closure, np.ones_like(closure))

    @property
    def kind(self) -> str | None:
        """Which half of the pose is drawn: None where nothing of it was measured."""
        if self.measured[:, :3].any():
            return "position"
        return "orientation" if self.measured.any() else None

    @property
    def vectors(self) -> np.ndarray:
        """That half (N, 3): m, or rad about base axes."""
        return self.pose[:, :3] if self.kind == "position" else self.pose[:, 3:]


def _compute_joint_jacobians(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """d pose / d q (N, 6, nq) along the closure, and d reading / d q (N, n_channels, nq)."""
    moved_by, reading = follow_closure(scene.model, scene.by_measured)
    pose = np.zeros((len(moved_by), 6, len(scene.model.joints)))
    pose[:, scene.model.mechanism.moved] = moved_by
    return pose, reading


def _sigma(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _in_noise_units(apart: np.ndarray, covariance: np.ndarray, known: np.ndarray) -> np.ndarray:
    """L^-1 e with L L^T the covariance of what is known of e (N, k), 0 for what is not."""
    both = known[:, :, None] & known[:, None, :]
    covariance = np.where(both, covariance, np.eye(known.shape[1]) * ~known[:, :, None])
    apart = np.where(known, apart, 0.0)
    L = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.solve(L, apart[:, :, None])[:, :, 0])
