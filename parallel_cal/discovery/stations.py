"""Stations: where the measuring device stood in each recording, as far as it stood elsewhere.

An error of the device goes with the device, an error of the robot with the robot. If the device
stood elsewhere in another recording, the data tell the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.diagnosis.scene import Scene
from parallel_cal.identification.stations import has_stations
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
