"""The report: a diagnosis with all its evidence, as one document and one offline page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

from parallel_cal import __version__
from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.patterns import (
    Region,
    ResidualProfile,
    compute_residual_profiles,
    regions,
)
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.identification.age import Age
from parallel_cal.identification.budget import Budget, Iso9283
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.position_uncertainty import PositionUncertainty
from parallel_cal.model.file.modelfile import model_hash
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import contents
from parallel_cal.reporting.certificate import CertificateFields, Conformity, decide
from parallel_cal.reporting.height_changes import HeightChanges
from parallel_cal.reporting.versus import Versus

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True)
class Provenance:
    """The version, time, model, data and options of a report."""

    version: str
    made: str
    mechanism: str
    joint_units: Mapping[str, str]
    effects: list[str]
    found_in_data: list[str]  # effects whose physical cause is unknown
    model_sha256: str
    dataset: Mapping[str, Any]
    dropped: int
    noise_from: Mapping[str, str]
    options: Mapping[str, Any]

    @classmethod
    def of(cls, diagnosis: Diagnosis, options: Mapping[str, Any]) -> Provenance:
        model, data = diagnosis.base.fitted.given.unregistered, diagnosis.dataset
        return cls(
            version=__version__,
            made=datetime.now(timezone.utc).isoformat(timespec="minutes"),
            mechanism=model.mechanism.name,
            joint_units=dict(zip(model.joints, model.mechanism.joint_units, strict=True)),
            effects=[effect.name for effect in model.effects],
            found_in_data=[effect.name for effect in model.effects if effect.found_in_data],
            model_sha256=model_hash(model),
            dataset={
                "source": data.source,
                "sha256": data.sha256,
                "samples": len(data),
                "excluded": data.excluded,
            },
            dropped=len(data.dropped),
            noise_from=diagnosis.base.fitted.observations.noise_from,
            options=to_json_value(options),
        )


@dataclass(frozen=True)
class Report:
    """A diagnosis with its evidence, and optionally a comparison with another model.

    Attributes
    ----------
    diagnosis : Diagnosis
        The diagnosis that is reported.
    errors : HeldOutErrors
        Errors at held-out poses: before, now, and with the effects found.
    history : list of dict
        One row for each step of the model: its name, its error and its data.
    residuals, along, along_found, joints : Residuals, tuple, tuple, JointResiduals
        Residuals of the present model in space, against quantities (without and with the effects
        found), and of each joint.
    spread : PositionUncertainty or None
        Uncertainty of the model over the workspace.
    regions, samples : tuple of Region, list of JudgedSample
        Errors by octant of the workspace and by sample, worst first.
    budget, iso_9283 : tuple of Budget, tuple of Iso9283
        What contributes to the error; pose accuracy and repeatability (after ISO 9283).
    parameters : dict of DescribedParameter
        The parameters with the effects found, by name.
    height_changes : HeightChanges or None
        How the heights of a touched bed change if one parameter is wrong; None without touches.
    combinations, correlated : dict, list of Correlation
        What the data do not determine, and what they cannot tell apart.
    map : dict
        The smooth part of the residuals.
    against : Versus or None
        The comparison with another model.
    provenance, certificate, certified, conformity
        Where the numbers come from, and the certificate's block with its decision.
    age : Age
        Until when the given model can be trusted, as its history states.
    """

    diagnosis: Diagnosis
    errors: contents.HeldOutErrors
    history: list[dict[str, Any]]
    residuals: contents.Residuals
    along: tuple[ResidualProfile, ...]
    along_found: tuple[ResidualProfile, ...]
    joints: contents.JointResiduals
    spread: PositionUncertainty | None
    regions: tuple[Region, ...]
    samples: list[contents.JudgedSample]
    budget: tuple[Budget, ...]
    iso_9283: tuple[Iso9283, ...]
    parameters: Mapping[str, contents.DescribedParameter]
    height_changes: HeightChanges | None
    combinations: Mapping[str, Any]
    correlated: list[contents.Correlation]
    map: Mapping[str, Any]
    against: Versus | None
    provenance: Provenance
    certificate: CertificateFields
    certified: contents.CertifiedErrors
    conformity: tuple[Conformity, ...]
    age: Age

    def __repr__(self) -> str:
        return f"Report({self.diagnosis!r})"

    def document(self) -> Any:
        """The JSON document of `parallel-cal report`; all values SI, None where not known."""
        return to_json_value(vars(self))


@check_arguments(FitError)
@single_threaded()
def report(
    model: Model,
    dataset: Dataset,
    *,
    against: Model | None = None,
    effects: Iterable[str] = (),
    also: Iterable[str] = (),
    certificate: CertificateFields | None = None,
    options: FitOptions | None = None,
    progress: Progress | None = None,
    **changes: Unpack[FitKeywords],
) -> Report:
    """Diagnose a model and collect everything that a reader needs to judge it.

    Parameters
    ----------
    model : Model
    dataset : Dataset
    against : Model, optional
        A second model, compared with the first on the same samples. Neither is fitted for this.
    certificate : CertificateFields, optional
        What the owner states on the certificate. Default: nothing.
    effects, also, options, progress, **changes
        As in `diagnose`.

    Returns
    -------
    Report
        `page(report)` makes one HTML page of it.

    Raises
    ------
    FitError
        If the model cannot be identified, or the second model needs a condition that was not
        recorded.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> report = pc.report(model, data, effects=["backlash"])
    >>> "<html" in pc.page(report)
    True
    """
    fitting = with_changes(options, FitOptions, changes, FitError)
    found = diagnose(model, dataset, effects=effects, also=also, options=fitting, progress=progress)
    versus = None
    if against is not None:
        sigma = fitting.joint_sigma
        versus = Versus.of(compare(model, dataset, sigma), compare(against, dataset, sigma))
    stated = {**vars(fitting), "effects": tuple(effects), "also": tuple(also)}
    return report_of(found, stated, versus, certificate)


@single_threaded()
def report_of(
    found: Diagnosis,
    options: Mapping[str, Any],
    versus: Versus | None = None,
    certificate: CertificateFields | None = None,
) -> Report:
    """Make the report of a finished diagnosis."""
    scene, best, stated = found.base.scene, found.best.fitted, certificate or CertificateFields()
    field, errors = Field.of(scene), contents.HeldOutErrors.of(found)
    certified = contents.CertifiedErrors.of(found)
    return Report(
        diagnosis=found,
        errors=errors,
        history=contents.history(found, errors),
        residuals=contents.Residuals.of(scene, field, found.field if found.effects else None),
        along=compute_residual_profiles(scene, field),
        along_found=compute_residual_profiles(found.best.scene, found.field)
        if found.effects
        else (),
        joints=contents.JointResiduals.of(scene),
        spread=PositionUncertainty.of(best.model),
        regions=regions(scene, field) if field.kind == "position" else (),
        samples=contents.samples(found),
        budget=best.budgets,
        iso_9283=best.iso_9283,
        parameters=contents.parameters(best),
        height_changes=HeightChanges.of(best),
        combinations=contents.combinations(best),
        correlated=contents.find_correlations(best),
        map=contents.smooth_map(found.structure.map),
        against=versus,
        provenance=Provenance.of(found, options),
        certificate=stated,
        certified=certified,
        conformity=decide(stated, certified.errors, certified.sigmas),
        age=Age.of_model(found.base.fitted.given.unregistered),
    )
