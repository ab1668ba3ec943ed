"""A diagnosis as one document that says it all, and as one page that people read offline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from parallel_cal import __version__
from parallel_cal.base.documents import plain
from parallel_cal.diagnosis.comparison import Comparison, compare
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.patterns import along, regions
from parallel_cal.diagnosis.scene import Progress
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import contents
from parallel_cal.reporting.versus import versus


@dataclass(frozen=True)
class Report:
    """A diagnosis, the options it was made with, and another model beside it where wanted."""

    diagnosis: Diagnosis
    options: Mapping[str, Any]
    other: tuple[Comparison, Comparison] | None = None

    @cached_property
    def field(self) -> Field:
        """Residuals of the model as it is, identified without further effects."""
        return Field.of(self.diagnosis.base.scene)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal report`, which `reporting.page.page` shows to people;
        all values SI, None where not known."""
        found, seen = self.diagnosis, self.field
        scene = found.base.scene
        return {
            "diagnosis": found.document(),
            "errors": contents.errors(found),
            "history": contents.history(found),
            "residuals": contents.residuals(found, seen),
            "along": plain(along(scene, seen)),
            "regions": plain(regions(scene, seen)) if seen.measured[:, :3].any() else [],
            "samples": contents.samples(found),
            "parameters": contents.parameters(found.best.fitted),
            "combinations": contents.combinations(found.best.fitted),
            "correlated": contents.correlated(found.best.fitted),
            "map": contents.smooth_map(found),
            "against": versus(*self.other) if self.other else None,
            "provenance": self._provenance(),
        }

    def _provenance(self) -> dict[str, Any]:
        model, data = self.diagnosis.model, self.diagnosis.dataset
        return {
            "version": __version__,
            "mechanism": model.mechanism.name,
            "joint_units": dict(zip(model.joints, model.mechanism.joint_units, strict=True)),
            "effects": [effect.name for effect in model.effects],
            "model_sha256": model_hash(model),
            "dataset": {"source": data.source, "sha256": data.sha256, "samples": len(data)},
            "dropped": len(data.dropped),
            "noise_from": dict(self.diagnosis.base.fitted.observations.noise_from),
            "options": dict(self.options),
        }


def report(
    model: Model,
    dataset: Dataset,
    *,
    against: Model | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Report:
    """Diagnose a model and gather what shows it; `against` is another model on the same data.

    Options as in `diagnosis.diagnose`; two models are compared as they stand, nothing is fitted.
    FitError where the model cannot be identified or the other lacks something recorded.
    """
    options = {"hold_out": 0.25, "seed": 0} | options
    found = diagnose(model, dataset, progress=progress, **options)
    if against is None:
        return Report(found, options)
    sigma = options.get("joint_sigma")
    sides = tuple(compare(one, dataset, sigma) for one in (model, against))
    return Report(found, options, sides)  # type: ignore[arg-type]
