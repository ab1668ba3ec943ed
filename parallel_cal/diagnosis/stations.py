"""Stations: where the measuring device stood in each recording, as far as it stood elsewhere.

An error of the device goes with the device, an error of the robot stays in {B}. If the device
stood elsewhere in another recording, the data tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from math import comb

import numpy as np

from parallel_cal.causes.effects import find_new_parameters
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.thresholds import (
    MAX_DEGREE,
    MIN_COLUMN_REMAINDER,
    MIN_RIVAL_SHARE,
    MIN_SEPARATION_SIGMAS,
    SAMPLES_PER_NUMBER,
)
from parallel_cal.identification.stations import has_stations
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class Stations:
    """For each recording the rotation and the shift that take a position in {B} to the frame of the
    device; `recording` (N,) is the recording of each sample."""

    by_recording: dict[int, tuple[np.ndarray, np.ndarray]]
    recording: np.ndarray = field(repr=False)

    @property
    def turns(self) -> np.ndarray:
        """The rotation (N, 3, 3) of each sample."""
        return np.array([self.by_recording[k][0] for k in self.recording])

    def show(self, r: np.ndarray) -> np.ndarray:
        """What the device shows (N, 3) of positions r (N, 3) in {B}."""
        shifts = np.array([self.by_recording[k][1] for k in self.recording])
        return np.asarray(np.einsum("nij,nj->ni", self.turns, r) + shifts)


def find_stations(scene: Scene, given: Dataset) -> Stations | None:
    """Find where the device stood in each recording of a scene, from the samples before they were
    moved into one frame; None if it stood at one place."""
    if not has_stations(scene.model):
        return None
    n = len(scene.model.joints)
    r, shown = scene.seen[:, n : n + 3], given.r
    recording = scene.dataset.conditions["session"].astype(int)
    found = {}
    for k in np.unique(recording).tolist():
        its = (recording == k) & np.isfinite(shown).all(axis=1)
        here, there = r[its].mean(axis=0), shown[its].mean(axis=0)
        U, _, V = np.linalg.svd((r[its] - here).T @ (shown[its] - there))
        proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
        turn = (U @ proper @ V).T
        found[k] = turn, there - turn @ here
    return Stations(found, recording)


class DeviceField:
    """Smooth errors of a device that stood at several stations, on the residuals of a scene: along
    each of its axes, it errs with a polynomial in the position that it shows, of the highest degree
    that the samples determine well."""

    def __init__(self, scene: Scene, stations: Stations) -> None:
        n, turns = len(scene.model.joints), stations.turns
        by_axis = scene.measured_jacobian[:, :, n : n + 3] @ turns.transpose(0, 2, 1)
        along = [by_axis[:, :, i] for i in scene.model.mechanism.moved if i < 3]
        shown = stations.show(scene.seen[:, n : n + 3])
        low, high = shown.min(axis=0), shown.max(axis=0)
        x = (2 * shown - low - high) / np.maximum(high - low, 1e-12)
        degree = max(
            d
            for d in range(1, MAX_DEGREE + 2)
            if d == 1 or len(along) * comb(d + 3, 3) * SAMPLES_PER_NUMBER <= along[0].size
        )
        powers = [p for p in product(range(degree + 1), repeat=3) if sum(p) <= degree]
        terms = [np.prod(x**p, axis=1) for p in powers]
        B = np.stack([(own * term[:, None]).ravel() for own in along for term in terms], axis=1)
        self._columns = B / np.maximum(np.linalg.norm(B, axis=0), 1e-12)

    def excludes(self, signal: np.ndarray, directions: np.ndarray) -> bool:
        """Whether neither such an error nor the model, which imitates `directions` (n, p),
        imitates a signal (n,)."""
        s = signal - directions @ (directions.T @ signal)
        left = self._remove(s, directions)
        return float(left @ left) > (1 - MIN_RIVAL_SHARE) * max(float(s @ s), 1e-300)

    def gain(self, residual: np.ndarray, signal: np.ndarray, directions: np.ndarray) -> float:
        """By how much a signal (n,), in the size that fits best, lowers the sum of squares of a
        residual (n,) next to such an error, in units of the noise that both leave."""
        r, s = (self._remove(one, directions) for one in (residual, signal))
        gained = float(r @ s) ** 2 / max(float(s @ s), 1e-300)
        dof = max(len(r) - directions.shape[1] - self._columns.shape[1] - 1, 1)
        return gained / max((float(r @ r) - gained) / dof, 1e-300)

    def _remove(self, vector: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """What neither such an error nor the model imitates of a vector (n,)."""
        Q = directions
        columns = self._columns - Q @ (Q.T @ self._columns)
        U, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        U, left = U[:, sizes > MIN_COLUMN_REMAINDER], vector - Q @ (Q.T @ vector)
        return np.asarray(left - U @ (U.T @ left))


def exclude_device(scene: Scene, given: Dataset, added: Sequence[Candidate], fitted: Model) -> bool:
    """Whether samples from several stations show that the device is not the cause of the effects
    that a fitted model has besides that of the scene: no smooth error of the device imitates them,
    and next to such an error they lower the misfit by more than five sigmas.

    Of effects that go with what changes slowly, nothing is known: a device may drift.
    """
    of_robot = not any(one.effect.of_device or one.varies_slowly for one in added)
    here = all(one.scene is scene for one in added)
    if not of_robot or not here or len(given) != len(scene.dataset):
        return False
    stations = find_stations(scene, given)
    if stations is None:
        return False
    signal = np.zeros(len(scene.residual))
    for one in added:
        extended = scene.model.with_effect(one.name, one.settings)
        new = find_new_parameters(scene.model, extended)
        sizes = [
            fitted.values[fitted.table.names.index(extended.table.names[k])]
            / extended.table.tolerance[k]
            for k in np.flatnonzero(new)
        ]
        signal += columns(extended, scene, new) @ np.array(sizes)
    device = DeviceField(scene, stations)
    needed = device.gain(scene.residual, signal, scene.basis) > MIN_SEPARATION_SIGMAS**2
    return needed and device.excludes(signal, scene.basis)
