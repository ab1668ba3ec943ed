"""Compare a model with measurements: the errors of each sample, and where the model fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import LackOfFit, lack_of_fit
from parallel_cal.diagnosis.noise import PureError
from parallel_cal.diagnosis.patterns import (
    OddSample,
    Region,
    ResidualProfile,
    compute_residual_profiles,
    odd_samples,
    regions,
)
from parallel_cal.identification.budget import Iso9283, iso_9283, list_sides
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.noise_floor import NoiseFloor, find_noise_floor
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import ERRORS, Errors, Summary
from parallel_cal.identification.predictions import predict_positions
from parallel_cal.identification.registration import Registration, add_registration_warning
from parallel_cal.identification.variance_components import estimate_noise
from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion, describe_untested_conditions
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.configuration import explain_other_configuration
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.recordings.residuals import Residuals


@dataclass(frozen=True)
class Comparison(ShownInNotebook):
    """A model compared with measurements: the errors of each sample, and the noise floor.

    Attributes
    ----------
    model : Model
        The given model, in the frame of the measurements, as in the result of a fit.
    dataset : Dataset
        The samples (N).
    observations : Observations
        What was measured, with its covariance.
    errors : Errors
        Errors of the model at each sample; `errors.summary` holds their means and rms.
    noise_floor : NoiseFloor
        The error that the noise alone would cause; `noise` is its summary.
    given : GivenModel
        The model as it was given.
    registration : Registration or None
        The device's frame, if the poses had to be moved into {B}.
    """

    model: Model
    dataset: Dataset
    observations: Observations
    errors: Errors
    noise_floor: NoiseFloor
    given: GivenModel
    registration: Registration | None = None

    def __repr__(self) -> str:
        return f"Comparison({self.model.mechanism.name}, {len(self.dataset)} samples)"

    @property
    def noise(self) -> Summary:
        """The noise floor."""
        return self.noise_floor.summary

    @cached_property
    @single_threaded()
    def held_out(self) -> Errors:
        """Errors at held-out poses, each registered by the other poses; in the folds of a fit with
        default options."""
        options = FitOptions()
        return self.given.errors_at_held_out(self.dataset.folds(options.hold_out, options.seed))

    @cached_property
    @single_threaded()
    def scene(self) -> Scene:
        """The residuals of the model at its predicted poses; no parameter is free."""
        nothing = np.zeros(len(self.model.values), bool)
        return Scene.of(self.model, self.dataset, self.observations, nothing)

    @cached_property
    @single_threaded()
    def field(self) -> Field:
        """The residuals by sample and component."""
        return Field.of(self.scene)

    @cached_property
    @single_threaded()
    def residual_profiles(self) -> tuple[ResidualProfile, ...]:
        """The residuals against joints, coordinates and conditions, the most significant first."""
        return compute_residual_profiles(self.scene, self.field)

    @cached_property
    @single_threaded()
    def regions(self) -> tuple[Region, ...]:
        """The rms errors in the octants of the workspace, worst first."""
        return regions(self.scene, self.field)

    @cached_property
    @single_threaded()
    def structure(self) -> LackOfFit:
        """Whether the residuals show more structure than noise has."""
        return lack_of_fit(self.scene, self.field)

    @cached_property
    @single_threaded()
    def odd_samples(self) -> tuple[OddSample, ...]:
        """The samples whose residuals contradict those of the others."""
        return odd_samples(self.scene, self.field)

    @cached_property
    def iso_9283(self) -> tuple[Iso9283, ...]:
        """Pose accuracy and repeatability with the unchanged model."""
        found = iso_9283(
            self.errors,
            self.observations.group,
            list_sides(self.dataset),
            sides_from_order=self.dataset.sides_from_order,
        )
        unused = self.given.is_judged_by_unused_samples
        placed = self.given.is_registered or self.given.lacked_start
        return tuple(replace(one, unused=unused, frames_fitted=placed) for one in found)

    @property
    def position(self) -> np.ndarray:
        """(N, 3) m, NaN where not measured."""
        at = slice(len(self.model.joints), len(self.model.joints) + 3)
        return np.where(self.observations.measured[:, at], self.observations.x[:, at], np.nan)

    @property
    def place(self) -> np.ndarray:
        """(N, 3) m: the measured position, or else the predicted one."""
        n = len(self.model.joints)
        return np.where(np.isnan(self.position), self.scene.x[:, n : n + 3], self.position)

    @cached_property
    def worst_first(self) -> np.ndarray:
        """Indices (N,) of the samples by their pose error, or by their reading error if no pose was
        measured."""
        kinds = [
            self.errors.norms(kind) for kind in ("position", "orientation", "reading", "pixel")
        ]
        norms = next((n for n in kinds if np.isfinite(n).any()), kinds[0])
        return np.argsort(-np.nan_to_num(norms, nan=-1.0), kind="stable")

    def residuals(self, numbers: np.ndarray, stamps: np.ndarray) -> Residuals:
        """Return the residuals as the ROS messages contain them.

        Parameters
        ----------
        numbers : ndarray of int (N,)
            The numbers of the samples.
        stamps : ndarray of int (N,)
            The stamps of the samples in ns.

        Returns
        -------
        Residuals
        """
        field, errors = self.field, self.errors
        seen, reached = (
            self.scene.model.configuration(x) for x in (self.observations.x, self.scene.x)
        )
        unsolved = np.isfinite(self.position).all(axis=1) & np.isnan(errors.position).any(axis=1)
        # Without a pose there are noise units of something else.
        sigmas = field.noise_units if field.measured.any() else np.full((len(seen.q), 6), np.nan)
        return Residuals(
            numbers,
            stamps,
            self.dataset.frame or self.model.frames["base"],
            self.model.joints,
            errors.joint,
            self.scene.sigmas,
            {
                "/position": errors.position,
                "/orientation": errors.orientation,
                "/position_sigmas": np.where(np.isnan(errors.position), np.nan, sigmas[:, :3]),
                "/orientation_sigmas": np.where(
                    np.isnan(errors.orientation), np.nan, sigmas[:, 3:]
                ),
            },
            {
                "/measured": (self.position, matrix_to_quaternion(seen.R)),
                "/predicted": (
                    np.where(unsolved[:, None], np.nan, reached.r),
                    matrix_to_quaternion(reached.R),
                ),
            },
        )

    def document(self) -> dict[str, Any]:
        """Return the JSON document of `parallel-cal compare --json`.

        It contains the error statistics, one row per sample (the largest error first), and where in
        the workspace the model fails. Values are SI, None if unknown.
        """
        norms = {f"{kind}_norm": self.errors.norms(kind) for kind in ERRORS}
        columns = {
            "sample": self.dataset.numbers,
            "time": self.dataset.time,
            "joints": self.observations.x[:, : len(self.model.joints)],
            "position": self.position,
            "place": self.place,
            **{f"{kind}_error": getattr(self.errors, kind) for kind in ERRORS},
            "sigmas": self.scene.sigmas,
            **norms,
        }
        document = {
            **self.errors.document(),
            "as_given": self.given.errors_as_given.summary,
            "held_out": self.held_out.summary,
            "registered_only": self.given.is_registered,
            "noise_floor": self.noise,
            "revisits": self.noise_floor.revisits,
            "registration": self.registration,
            "iso_9283": self.iso_9283,
            "samples": len(self.observations),
            "channels": self.model.structure.channels,
            "rows": [{key: c[i] for key, c in columns.items()} for i in self.worst_first],
            "where": {
                "along": self.residual_profiles,
                "regions": self.regions,
                "structure": self.structure,
                "odd_samples": self.odd_samples,
                "chi2_per_dof": self.scene.chi2_per_dof,
                "replicates": PureError.of(self.scene, self.field),
            },
        }
        return {key: to_json_value(value) for key, value in document.items()}


@check_arguments(FitError)
@single_threaded()
def compare(model: Model, dataset: Dataset, joint_sigma: float | None = None) -> Comparison:
    """Compare the predictions of a model with measurements.

    No parameter of the robot is fitted. If the device measures in its own frame, the pose of this
    frame and the position of the target are estimated first. Joint readings that are impossible
    for this robot cause a warning only; `fit` refuses them.

    Parameters
    ----------
    model : Model
    dataset : Dataset
    joint_sigma : float, optional
        Noise of the joint readings, 1 sigma, in rad or m. It replaces what recording and model file
        state.

    Returns
    -------
    Comparison
        `errors` of every sample (m, rad), the `noise` floor, and what the errors correlate with
        (`along`, `regions`, `structure`).

    Raises
    ------
    FitError
        If the samples have no usable pose.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> comparison = pc.compare(model, data)
    >>> bool(comparison.errors.summary.position_rms > 5e-4)
    True
    """
    if not dataset.sha256:  # so that the samples of a fit are recognised
        dataset = replace(dataset, sha256=fingerprint(dataset))
    given = GivenModel.of(model, dataset, joint_sigma, insist=True)
    dataset = add_registration_warning(given.dataset, given.registration)
    if other := explain_other_configuration(model, dataset.configuration, dataset.source):
        dataset = replace(dataset, warnings=(*dataset.warnings, other))
    doubts = filter(None, (given.observations.doubts, given.doubted_columns))
    dataset = replace(dataset, warnings=(*dataset.warnings, *doubts))
    if region := IdentifiedRegion.of_model(model):
        joints = given.observations.x[:, : len(model.joints)]
        place = predict_positions(given.model, given.observations)
        if words := region.describe_excess(region.compute_excess(joints, place), "samples"):
            dataset = replace(dataset, warnings=(*dataset.warnings, words))
    if untested := describe_untested_conditions(model, given.observations.a):
        dataset = replace(dataset, warnings=(*dataset.warnings, untested))
    observations = given.observations
    if observations.unknown:  # in units of the errors, not of a guess
        none = np.zeros(len(given.model.values), dtype=bool)
        observations = estimate_noise(given.model, observations, none).observations
    noise = find_noise_floor(given.model, observations, given.errors, dataset)
    return Comparison(
        given.model,
        dataset,
        observations,
        given.errors,
        noise,
        given,
        given.registration,
    )
