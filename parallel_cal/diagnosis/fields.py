"""Residuals as a field over the workspace: in SI, in noise units, and what replicates say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import CHANCE
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.thresholds import ENOUGH_REPLICATES
from parallel_cal.identification.doubts import chi2_band
from parallel_cal.identification.linearisation import Linearisation

STATED = ("option", "dataset", "model file")


@dataclass(frozen=True)
class Field:
    """Measured minus predicted at every sample.

    pose (N, 6) m and rad about base axes, 0 where not measured; `noise_units` (N, k) the same
    divided by what joint and device noise explain together; `measured` (N, 6). `held` is the rms,
    in the device's sigmas, of measured coordinates that the model holds at one value.
    """

    pose: np.ndarray
    noise_units: np.ndarray
    measured: np.ndarray
    held: float


def field(here: Scene) -> Field:
    """The field of a scene; without any pose measured, `noise_units` are the closure's own."""
    n = len(here.model.joints)
    observations, x = here.observations, here.x
    seen, moved = observations.measured[:, n:], _moved(here)
    measured = seen & moved
    R, Rp = (a[:, n + 3 :].reshape(-1, 3, 3) for a in (observations.x, x))
    turn = rotation_vector(R @ Rp.transpose(0, 2, 1))
    pose = np.concatenate([observations.x[:, n : n + 3] - x[:, n : n + 3], turn], axis=1)
    variance = np.diagonal(observations.S, axis1=1, axis2=2)[:, n:]
    fixed = (pose**2 / np.where(variance > 0, variance, 1.0))[seen & ~moved]
    held = float(np.sqrt(fixed.mean())) if fixed.size else 0.0
    pose = np.where(measured, pose, 0.0)
    if not measured.any():
        return Field(pose, here.by_sample(here.residual), measured, held)
    return Field(pose, _in_noise_units(here, pose, measured), measured, held)


def _moved(here: Scene) -> np.ndarray:
    moved = np.zeros(6, dtype=bool)
    moved[here.model.mechanism.moved] = True
    return moved


def _in_noise_units(here: Scene, pose: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """L^-1 e with L L^T the covariance of measured minus predicted pose, (N, 6), 0 where not
    measured."""
    n, moved, S = len(here.model.joints), here.model.mechanism.moved, here.observations.S
    linearise = Linearisation(
        here.model, here.observations, np.zeros(len(here.model.values), dtype=bool), True
    )
    C = linearise.blocks(here.model.values, here.x)[1][:, : here.model.structure.phi.shape[0]]
    to_pose = np.zeros((len(C), 6, n))
    to_pose[:, moved] = -np.linalg.pinv(C[:, :, [n + i for i in moved]]) @ C[:, :, :n]
    total = S[:, n:, n:] + to_pose @ S[:, :n, :n] @ to_pose.transpose(0, 2, 1)
    both = measured[:, :, None] & measured[:, None, :]
    total = np.where(both, total, np.eye(6) * np.where(measured, 0.0, 1.0)[:, None, :])
    L = np.linalg.cholesky(total)
    return np.asarray(np.linalg.solve(L, pose[:, :, None])[:, :, 0])


@dataclass(frozen=True)
class Reference:
    """The noise to judge by, which must not come from the fit itself.

    `variance` in units of the observations's noise, None where nobody knows; `source` in words;
    `replicates` the same from visits of one pose, with its degrees of freedom.
    """

    variance: float | None
    dof: int | None
    source: str
    replicates: float | None
    replicates_dof: int

    def band(self, dof: int) -> tuple[float, float]:
        """Where chi2/dof lies in 99 % of complete models; infinite where the noise is unknown."""
        from scipy.special import fdtri

        if self.variance is None or dof <= 0:
            return (0.0, float("inf"))
        if self.dof is None:
            return chi2_band(dof)
        low, high = (float(fdtri(dof, self.dof, p)) for p in (CHANCE / 2, 1 - CHANCE / 2))
        return low * self.variance, high * self.variance


def reference(here: Scene, found: Field) -> Reference:
    """Stated noise counts; where it was only guessed from jitter, replicates take its place."""
    variance, dof = _pure_error(found, here)
    words = set(here.observations.noise_from.values())
    if words <= set(STATED):
        return Reference(1.0, None, f"stated ({', '.join(sorted(words))})", variance, dof)
    if variance is not None and dof >= ENOUGH_REPLICATES:
        return Reference(variance, dof, f"replicates ({dof} degrees of freedom)", variance, dof)
    return Reference(None, None, f"unknown ({', '.join(sorted(words))})", variance, dof)


def _pure_error(found: Field, here: Scene) -> tuple[float | None, int]:
    """Mean square of the visits of one pose about their mean, in noise units, and its freedoms."""
    # Without a pose nothing tells replicates from neighbours.
    if here.dataset.mode == "continuous" or not found.measured.any():
        return None, 0
    names, inverse, count = np.unique(
        here.observations.group, return_inverse=True, return_counts=True
    )
    z = found.noise_units
    sums = np.zeros((len(names), z.shape[1]))
    np.add.at(sums, inverse, z)
    apart = z - (sums / count[:, None])[inverse]
    each = int(np.any(z != 0, axis=0).sum())
    dof = int(np.sum(count - 1)) * each
    return (float(np.sum(apart**2)) / dof if dof else None), dof
