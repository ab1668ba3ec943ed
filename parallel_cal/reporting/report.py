"""A diagnosis as one document that says it all, and as one page that people read offline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from parallel_cal import __version__
from parallel_cal.base.documents import plain
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.patterns import Along, Region, along, regions
from parallel_cal.identification.budget import Budget, Iso9283
from parallel_cal.identification.spread import Spread
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import contents
from parallel_cal.reporting.versus import Versus


@dataclass(frozen=True)
class Provenance:
    """When and of which model, data and options a report was made, and by which version."""

    version: str
    made: str
    mechanism: str
    joint_units: Mapping[str, str]
    effects: list[str]
    model_sha256: str
    dataset: Mapping[str, Any]
    dropped: int
    noise_from: Mapping[str, str]
    options: Mapping[str, Any]

    @classmethod
    def of(cls, diagnosis: Diagnosis, options: Mapping[str, Any]) -> Provenance:
        model, data = diagnosis.model, diagnosis.dataset
        return cls(
            version=__version__,
            made=datetime.now(timezone.utc).isoformat(timespec="minutes"),
            mechanism=model.mechanism.name,
            joint_units=dict(zip(model.joints, model.mechanism.joint_units, strict=True)),
            effects=[effect.name for effect in model.effects],
            model_sha256=model_hash(model),
            dataset={"source": data.source, "sha256": data.sha256, "samples": len(data)},
            dropped=len(data.dropped),
            noise_from=diagnosis.base.fitted.observations.noise_from,
            options=plain(options),
        )


@dataclass(frozen=True)
class Report:
    """A diagnosis with all that shows it, and another model beside it where wanted; residuals are
    those of the model as it is, parameters those with the effects found."""

    diagnosis: Diagnosis
    errors: contents.LeftOut
    history: list[dict[str, Any]]
    residuals: contents.Residuals
    along: tuple[Along, ...]
    along_found: tuple[Along, ...]
    joints: contents.JointResiduals
    spread: Spread | None
    regions: tuple[Region, ...]
    samples: list[contents.JudgedSample]
    budget: tuple[Budget, ...]
    iso_9283: tuple[Iso9283, ...]
    parameters: Mapping[str, contents.Described]
    combinations: Mapping[str, Any]
    correlated: list[contents.Correlation]
    map: Mapping[str, Any]
    against: Versus | None
    provenance: Provenance

    def document(self) -> Any:
        """The JSON document of `parallel-cal report`; all values SI, None where not known."""
        return plain(vars(self))


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
    versus = None
    if against is not None:
        sigma = options.get("joint_sigma")
        versus = Versus.of(compare(model, dataset, sigma), compare(against, dataset, sigma))
    return report_of(found, options, versus)


def report_of(found: Diagnosis, options: Mapping[str, Any], versus: Versus | None = None) -> Report:
    """A diagnosis that was made with some options, and all that shows it."""
    scene, best = found.base.scene, found.best.fitted
    field, errors = Field.of(scene), contents.LeftOut.of(found)
    return Report(
        diagnosis=found,
        errors=errors,
        history=contents.history(found, errors),
        residuals=contents.Residuals.of(scene, field, found.field if found.effects else None),
        along=along(scene, field),
        along_found=along(found.best.scene, found.field) if found.effects else (),
        joints=contents.JointResiduals.of(scene),
        spread=Spread.of(best.model),
        regions=regions(scene, field) if field.kind == "position" else (),
        samples=contents.samples(found),
        budget=best.budgets,
        iso_9283=best.iso_9283,
        parameters=contents.parameters(best),
        combinations=contents.combinations(best),
        correlated=contents.correlated(best),
        map=contents.smooth_map(found.structure.map),
        against=versus,
        provenance=Provenance.of(found, options),
    )
