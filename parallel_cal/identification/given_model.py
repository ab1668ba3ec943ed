"""The given model before identification: `compare` shows its errors, and a fit must beat them.

If the model does not state where the pose device stands, its frame and target are fitted and
nothing else is changed ("registered only"): a frame that is a little off is no error of the robot.
At held-out poses they are fitted to the other poses only, so that these errors are as much out of
sample as those of the fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.column_doubts import doubt_columns
from parallel_cal.identification.image_poses import measure_image_noise
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.placement import place_sensors
from parallel_cal.identification.prediction_errors import Errors, errors
from parallel_cal.identification.registration import (
    DevicePoses,
    Registration,
    is_registrable,
    place_frames,
    prepared_for_fit,
    register_observed,
    registered_by,
    shows_pose,
)
from parallel_cal.identification.set_up import find_set_up, place
from parallel_cal.identification.stations import has_stations, register_recordings
from parallel_cal.model.model import Model
from parallel_cal.recordings.configuration import explain_other_configuration
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions

Folds = list[tuple[np.ndarray, np.ndarray]]  # indices of the training and of the held-out samples


@dataclass(frozen=True)
class GivenModel:
    """A given model and the samples that judge it.

    `unregistered` is the model as it was given. `model` is the one whose errors count: registered
    only, if the samples determine where the device stands. A fit begins at `start`: it identifies
    frames only if the `registration` is needed. `known_held_out` are the errors at held-out poses
    if another fit of the same samples has computed them. If a sensor `lacked_start` values, the
    given model had no errors, and `unregistered` contains values that the samples gave.
    `unregistered_observations` are the samples as `unregistered` sees them, if they were made.
    `doubted_columns` says which other joint readings would fit, if the caller insisted on these.
    """

    unregistered: Model
    model: Model
    dataset: Dataset
    joint_sigma: float | None = None
    insist: bool = False
    registration: Registration | None = None
    known_held_out: Errors | None = None
    lacked_start: bool = False
    unregistered_observations: Observations | None = None
    doubted_columns: str = ""

    @classmethod
    def of(
        cls,
        model: Model,
        dataset: Dataset,
        joint_sigma: float | None = None,
        insist: bool = False,
    ) -> GivenModel:
        """Register the model if the samples allow it; `insist` accepts implausible readings.

        Several recordings are first brought into the frame of one device. FitError for samples
        that were imported with another configuration or have readings in the wrong columns, unless
        insisted.
        """
        other = explain_other_configuration(model, dataset.configuration, dataset.source)
        if other and not insist:
            raise FitError(other)
        parts = [f"temperature.{body}" for body in model.mechanism.expanding_bodies]
        dataset = add_lagged_conditions([*model.conditions, *parts], dataset)
        model, dataset = register_recordings(model, dataset, joint_sigma, insist)
        started = not all(sensor.is_placed for sensor in model.sensors)
        if started:
            model = place_sensors(model, observe(model, dataset, joint_sigma, insist), insist)
        observations = observe(model, dataset, joint_sigma, insist)
        there = DevicePoses.of(model, observations)
        doubts = doubt_columns(model, observations, there, dataset.source)
        if doubts and not insist:
            raise FitError(doubts)
        placed, registration = register_observed(model, dataset.frame, observations, there)
        if registration is None and (has_stations(model) or is_registrable(model, there)):
            placed = place_frames(model, observations, there) or model
        return cls(
            model,
            placed,
            dataset,
            joint_sigma,
            insist,
            registration,
            lacked_start=started,
            unregistered_observations=observations,
            doubted_columns=doubts,
        )

    def place(self, larger: Model, how: FitOptions) -> Model:
        """Return the start of a fit with further effects, and with the device where it stands if
        the robot has them: the lack of a large one moves it."""
        start = self.start
        if len(larger.sensors) > len(start.sensors):  # an update placed the device that moved
            return larger
        larger = larger.with_sensors(start.sensors)
        values, fixed = larger.values.copy(), np.array(larger.fixed)
        for i, parameter in enumerate(start.table):
            if parameter.group == "sensor":
                k = larger.table.index_of(parameter.name)
                values[k], fixed[k] = start.values[i], start.fixed[i]
        larger = replace(larger, values=values, fixed=fixed)
        return prepared_for_fit(larger, self.registration, self.dataset, how)[0]

    def with_dataset(self, dataset: Dataset) -> GivenModel:
        """Return this model, judged by some of its samples, or by all with other warnings."""
        same = np.array_equal(dataset.numbers, self.dataset.numbers)
        known = self.unregistered_observations if same else None
        return replace(self, dataset=dataset, unregistered_observations=known)

    @property
    def is_registered(self) -> bool:
        """Whether the frames of the device were fitted to the samples."""
        return self.model is not self.unregistered

    @property
    def label(self) -> str:
        """Name of the errors in tables."""
        return "registered only" if self.is_registered else "before"

    @property
    def start(self) -> Model:
        """The model at which a fit begins."""
        placed = self.registration is not None or shows_pose(self.model)
        return self.model if placed else self.unregistered

    @cached_property
    def errors_as_given(self) -> Errors:
        """Errors at all samples if the device stands where the given model says."""
        return errors(self.unregistered, self.observations) if self.is_registered else self.errors

    @cached_property
    def observations(self) -> Observations:
        observations = self.observe(self.model, self.dataset, self.joint_sigma, self.insist)
        return measure_image_noise(self.model, observations)

    def observe(
        self, model: Model, dataset: Dataset, joint_sigma: float | None, insist: bool
    ) -> Observations:
        """Make observations; those of the registration serve if nothing has changed since."""
        unchanged = model is self.unregistered and dataset is self.dataset
        unchanged &= (joint_sigma, insist) == (self.joint_sigma, self.insist)
        if unchanged and self.unregistered_observations is not None:
            return self.unregistered_observations
        return observe(model, dataset, joint_sigma, insist)

    @cached_property
    def errors(self) -> Errors:
        """Errors at all samples."""
        return errors(self.model, self.observations)

    def errors_at_held_out(self, folds: Folds, places_set_up: bool = False) -> Errors:
        """Errors at all samples, each registered by the folds that do not contain it; NaN if these
        are too few to register the device. With `places_set_up`, they place sockets and edges,
        too; by default all samples have placed them, which favours the given model."""
        has_set_up = places_set_up and bool(find_set_up(self.model).any())
        if not (self.is_registered or has_set_up):
            return self.errors
        parts = self.errors.blank().parts()
        for train, test in folds:
            kept = self.observations.select(train)
            known = self.is_registered
            placed = registered_by(self.unregistered, kept) if known else self.model
            if placed is not None and has_set_up:
                placed = place(placed, kept)
            if placed is not None:
                unseen = errors(placed, self.observations.select(test))
                for name, array in unseen.parts().items():
                    parts[name][test] = array
        return Errors(**parts)

    @property
    def fits_of_these_samples(self) -> tuple[Mapping[str, Any], ...]:
        """Steps of the model's history that used these samples: its error at them is in-sample."""
        return tuple(fits_of(self.unregistered, self.dataset))

    @cached_property
    def known_samples(self) -> np.ndarray:
        """Mask (N,) of the samples of recordings that the model was fitted to before."""
        if self.fits_of_these_samples:
            return np.ones(len(self.dataset), dtype=bool)
        used = {sha256 for entry in self.unregistered.history for sha256 in _recordings_of(entry)}
        session = self.dataset.conditions.get("session", np.zeros(len(self.dataset)))
        known = [k for k, sha256 in enumerate(self.dataset.recordings) if sha256 in used]
        return np.isin(session, known)

    @property
    def is_judged_by_unused_samples(self) -> bool:
        """Whether no fit in the model's history used any of these samples; False if not known."""
        if not was_fitted(self.unregistered):  # a fit without a step leaves a covariance
            return self.unregistered.covariance is None
        fits = (entry for entry in self.unregistered.history if "dataset" in entry)
        known = bool(self.dataset.sha256) and all(map(_recordings_of, fits))
        return known and not self.known_samples.any()

    @property
    def earlier_fits(self) -> tuple[Mapping[str, Any], ...]:
        """Steps of the model's history that used other samples too, or only other samples."""
        mine = self.fits_of_these_samples
        return tuple(e for e in self.unregistered.history if _recordings_of(e) and e not in mine)


def fits_of(model: Model, dataset: Dataset) -> Iterator[Mapping[str, Any]]:
    """Steps of a model's history that used these samples, recognised by their sha256."""
    for entry in model.history:
        if dataset.sha256 and dataset.sha256 in _recordings_of(entry):
            yield entry


def was_fitted(model: Model) -> bool:
    """Whether a model's history contains a fit to samples."""
    return any("dataset" in entry for entry in model.history)


def last_fit_to(model: Model, dataset: Dataset) -> Mapping[str, Any] | None:
    """The last fit in a model's history if it used these samples, whichever of them it excluded."""
    last: Mapping[str, Any] = next((e for e in reversed(model.history) if "dataset" in e), {})
    return last if dataset.sha256 and _recordings_of(last)[:1] == (dataset.sha256,) else None


def was_last_fitted_to(model: Model, dataset: Dataset) -> bool:
    """Whether the last fit of a model used exactly these samples, with the same ones excluded."""
    last = last_fit_to(model, dataset)
    return last is not None and list(last.get("excluded", [])) == sorted(dataset.excluded)


def _recordings_of(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """The sha256 of the samples of a step, and of each of its recordings if they were several."""
    data = entry.get("dataset")
    if not isinstance(data, Mapping) or not data.get("sha256"):
        return ()
    return (data["sha256"], *data.get("recordings", ()))
