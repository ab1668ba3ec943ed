"""A model beside measurements: errors a sample, and where it fails."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.diagnosis.fields import Field, field, reference
from parallel_cal.diagnosis.lack_of_fit import lack_of_fit
from parallel_cal.diagnosis.patterns import along, odd_samples, regions
from parallel_cal.diagnosis.scene import Scene, scene
from parallel_cal.identification.doubts import finite_or_none
from parallel_cal.identification.fit import single_threaded
from parallel_cal.identification.noise_floor import noise_floor
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.prediction_errors import ERRORS, Errors, Summary, errors
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class Comparison:
    """A model beside measurements: errors a sample, and what noise alone would show."""

    model: Model
    dataset: Dataset
    observations: Observations
    errors: Errors
    noise: Summary

    def document(self) -> dict[str, Any]:
        """E, one row a sample, worst first, and where the model fails."""
        return {
            **self.errors.document(),
            "noise_floor": self.noise.document(),
            "samples": len(self.observations),
            "channels": list(self.model.structure.channels),
            "rows": [self._row(i) for i in self._worst_first()],
            "where": self._where(),
        }

    @cached_property
    def scene(self) -> Scene:
        """The model linearised at its own predictions, nothing of it free."""
        return scene(
            self.model, self.dataset, self.observations, np.zeros(len(self.model.values), bool)
        )

    @cached_property
    def field(self) -> Field:
        return field(self.scene)

    def _where(self) -> dict[str, Any]:
        """LackOfFit over workspace, joints and conditions; odd samples; replicates."""
        known = reference(self.scene, self.field)
        return {
            "along": along(self.scene, self.field),
            "regions": regions(self.scene, self.field),
            "structure": lack_of_fit(self.scene, self.field).document(),
            "odd_samples": odd_samples(self.scene, self.field),
            "chi2_per_dof": finite_or_none(self.scene.chi2_per_dof),
            "replicates": {"variance": known.replicates, "dof": known.replicates_dof},
        }

    def _worst_first(self) -> np.ndarray:
        found = [self.errors.norms(kind) for kind in ("position", "orientation", "reading")]
        norms = next((n for n in found if np.isfinite(n).any()), found[0])
        return np.argsort(-np.nan_to_num(norms, nan=-1.0), kind="stable")

    def _row(self, i: int) -> dict[str, Any]:
        n = len(self.model.joints)
        parts = {kind: getattr(self.errors, kind)[i] for kind in ERRORS}
        measured = self.observations.measured[i, n : n + 3]
        position = np.where(measured, self.observations.x[i, n : n + 3], np.nan)
        return {
            "sample": int(self.dataset.numbers[i]),
            "time": float(self.dataset.time[i]),
            "joints": self.observations.x[i, :n].tolist(),
            "position": [finite_or_none(v) for v in position],
            **{f"{k}_error": [finite_or_none(v) for v in part] for k, part in parts.items()},
            "sigmas": finite_or_none(self.scene.sigmas[i]),
            **{f"{kind}_norm": finite_or_none(self.errors.norms(kind)[i]) for kind in ERRORS},
        }


def compare(model: Model, dataset: Dataset, joint_sigma: float | None = None) -> Comparison:
    """Predictions of a model beside what was measured, fitting nothing."""
    observations = observe(model, dataset, joint_sigma)
    with single_threaded():
        return Comparison(
            model,
            dataset,
            observations,
            errors(model, observations),
            noise_floor(model, observations),
        )
