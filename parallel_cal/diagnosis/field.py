"""Residuals as a field over the workspace: in SI, and in noise units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.diagnosis.scene import Scene
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.model.configuration import Configuration


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

    @classmethod
    def of(cls, scene: Scene) -> Field:
        """The field of a scene; without any pose measured, `noise_units` are the closure's own."""
        n = len(scene.model.joints)
        observations = scene.observations
        moved = np.isin(np.arange(6), scene.model.mechanism.moved)
        shown = observations.measured[:, n:]
        measured = shown & moved
        seen, predicted = (Configuration.from_rows(x) for x in (observations.x, scene.x))
        pose = seen.change_from(predicted)[:, n:]
        variance = np.diagonal(observations.S, axis1=1, axis2=2)[:, n:]
        fixed = (pose**2 / np.where(variance > 0, variance, 1.0))[shown & ~moved]
        held = float(np.sqrt(fixed.mean())) if fixed.size else 0.0
        pose = np.where(measured, pose, 0.0)
        if not measured.any():
            return cls(pose, scene.by_sample(scene.residual), measured, held)
        return cls(pose, _in_noise_units(scene, pose, measured), measured, held)

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


def _in_noise_units(scene: Scene, pose: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """L^-1 e with L L^T the covariance of measured minus predicted pose, (N, 6), 0 where not
    measured."""
    n, moved, S = len(scene.model.joints), scene.model.mechanism.moved, scene.observations.S
    linearise = Linearisation(
        scene.model, scene.observations, np.zeros(len(scene.model.values), dtype=bool), True
    )
    C = linearise.blocks(scene.model.values, scene.x)[1][:, : scene.model.structure.phi.shape[0]]
    to_pose = np.zeros((len(C), 6, n))
    to_pose[:, moved] = -np.linalg.pinv(C[:, :, [n + i for i in moved]]) @ C[:, :, :n]
    total = S[:, n:, n:] + to_pose @ S[:, :n, :n] @ to_pose.transpose(0, 2, 1)
    both = measured[:, :, None] & measured[:, None, :]
    total = np.where(both, total, np.eye(6) * np.where(measured, 0.0, 1.0)[:, None, :])
    L = np.linalg.cholesky(total)
    return np.asarray(np.linalg.solve(L, pose[:, :, None])[:, :, 0])
