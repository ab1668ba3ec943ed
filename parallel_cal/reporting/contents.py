"""The contents of a report other than the diagnosis; its fields are the keys of the JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import SmoothMap, regressors
from parallel_cal.diagnosis.patterns import ResidualProfile
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.signature import compute_joint_components
from parallel_cal.identification.fit import FitResult, ParameterEstimate
from parallel_cal.identification.given_model import last_fit_to, was_last_fitted_to
from parallel_cal.identification.observability import directions_in_words
from parallel_cal.identification.prediction_errors import ERRORS, Errors, Summary
from parallel_cal.identification.registration import SENSOR, frames_of
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.mechanism import POSE, Mechanism
from parallel_cal.model.model import Model
from parallel_cal.model.words import describe
from parallel_cal.posterior.scene import Scene
from parallel_cal.reporting.error_steps import BEFORE

MAX_REST_SPEED = 1e-3  # rad/s or m/s: below it the robot stands still
MIN_STRONG_CORRELATION = 0.98  # correlation from which two parameters are hardly distinguishable


@dataclass(frozen=True)
class HeldOutErrors:
    """Validation errors at the same samples: of the uncalibrated model, now and with the effects
    found; and the noise floor.

    `before_name` is the name of the uncalibrated model: the given one, or the nominal one if the
    given model was fitted before. `sigmas` is by error ("before", "now", "found", "noise") and
    kind the standard deviation of the rms. `samples` of `poses` were held out. `keeps_sensors` is
    whether `before` are errors of the nominal robot with sensors where its fit found them.
    """

    before: Summary
    now: Summary
    found: Summary | None
    noise: Summary
    before_name: str
    sigmas: Mapping[str, Mapping[str, float]]
    samples: int
    poses: int
    keeps_sensors: bool

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> HeldOutErrors:
        base, best = diagnosis.base.fitted, diagnosis.best.fitted
        fitted_before = bool(_list_judged_steps(diagnosis))
        before, judged = errors_before(diagnosis), base.held_out.judged
        owners = [name.partition(".")[0] for name in base.model.table.names]
        others = [sensor.name for sensor in base.model.sensors if sensor.name != SENSOR]
        of_sensors = np.isin(owners, others)
        placed = before.summary.reading_rms is not None and (of_sensors & base.free).any()
        return cls(
            before=before.summary,
            now=base.held_out.summary,
            found=best.held_out.summary if diagnosis.effects else None,
            noise=best.noise_floor,
            before_name="nominal model" if fitted_before else "before calibration",
            sigmas={
                "before": base.rms_sigmas(before),
                "now": base.rms_sigmas(base.held_out),
                "found": best.rms_sigmas(best.held_out),
                "noise": best.simulated_noise.sigmas,
            },
            samples=int(judged.sum()),
            poses=len(np.unique(diagnosis.dataset.pose_id[judged])),
            keeps_sensors=fitted_before and bool(placed),
        )

    @property
    def kinds(self) -> list[str]:
        """The kinds of error: of the pose; if none was measured, of readings, or of joints."""
        return list_shown_kinds(self.now, self.noise)


def errors_before(diagnosis: Diagnosis) -> Errors:
    """Errors of the uncalibrated model at the samples of the validation errors: of the given one,
    or of the nominal one if the given model was fitted before."""
    base = diagnosis.base.fitted
    # Errors in the model's history may be those of other samples.
    fitted_before = bool(_list_judged_steps(diagnosis))
    before = base.nominal_errors if fitted_before else base.held_out_before
    return before.only_at(base.held_out.judged)


def list_shown_kinds(errors: Summary, noise: Summary) -> list[str]:
    """List the kinds of error of the pose; if none was measured, of readings, or of joints."""
    for group in (("position", "orientation"), ("reading",), ("joint",)):
        if kinds := [kind for kind in group if errors.rms(kind) or noise.rms(kind)]:
            return kinds
    return []


@dataclass(frozen=True)
class CertifiedErrors:
    """Errors of exactly the model that was given, with the standard deviation of each rms by kind.

    If its last fit used these samples (`identified_here`), they are the validation errors of this
    fit; otherwise those of the unchanged model. If that fit excluded other samples than the
    diagnosis, such as none of those that the diagnosis sets aside, they are not known:
    `fit_excluded` are then the samples that it excluded.
    """

    errors: Summary
    sigmas: Mapping[str, float]
    identified_here: bool
    fit_excluded: tuple[int, ...] | None = None

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> CertifiedErrors:
        base, data = diagnosis.base.fitted, diagnosis.dataset
        last = last_fit_to(base.given.unregistered, data)
        if last is not None and not was_last_fitted_to(base.given.unregistered, data):
            return cls(Summary(), {}, True, tuple(last.get("excluded", [])))
        found = base.unchanged_errors if last is None else base.held_out
        return cls(found.summary, base.rms_sigmas(found), last is not None)


def _list_judged_steps(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Return the steps of the model's history that have validation errors."""
    past = (entry for entry in diagnosis.model.history if isinstance(entry.get("held_out"), dict))
    return [entry for entry in past if {"before", "after"} <= entry["held_out"].keys()]


def history(diagnosis: Diagnosis, errors: HeldOutErrors) -> list[dict[str, Any]]:
    """Make one row per step: its `name`, its validation `error`, and the data it was judged on."""
    data = diagnosis.base.fitted.dataset
    here = {"samples": len(data), "sha256": data.sha256, "excluded": sorted(data.excluded)}
    steps: list[dict[str, Any]] = [
        {
            "name": entry.get("label")
            or " ".join(str(entry[key]) for key in ("step", "effect") if key in entry),
            "error": Summary(**entry["held_out"]["after"]),
            "samples": entry.get("samples"),
            "sha256": (entry.get("dataset") or {}).get("sha256", ""),
            "excluded": entry.get("excluded", []),
        }
        for entry in _list_judged_steps(diagnosis)
    ]
    first = _list_judged_steps(diagnosis)[:1]
    before = Summary(**first[0]["held_out"]["before"]) if first else errors.before
    rows = [(steps[0] if steps else here) | {"name": BEFORE, "error": before}, *steps]
    is_last_now = False  # whether the last step has the errors of now: it was written and repeated
    if steps:
        last, now = ([v or 0.0 for v in vars(e).values()] for e in (steps[-1]["error"], errors.now))
        is_last_now = np.allclose(last, now, rtol=1e-4, atol=0.0)
    if not is_last_now:
        rows.append({"name": "now", "error": errors.now, **here})
    if errors.found:
        name = f"with {' and '.join(diagnosis.effects)}"
        rows.append({"name": name, "error": errors.found, **here})
    return rows


@dataclass(frozen=True)
class Residuals:
    """Residuals of a fit, one row per sample.

    `place` (N, 3) is the position of the target in m, or the platform's axis. `now` and `found`
    (N, 3) are measured minus predicted in m or rad, of the present model and with the effects
    found. All three are in the frame of the base, wherever the device stands, as are planned poses
    and the maps of the workspace.
    `noise_units` (N, k) are the components in sigmas. `regressors` are quantities (N,) that
    residuals may depend on, with their SI `units`, empty if none is stated.
    """

    kind: str | None
    components: list[str]
    sample: np.ndarray
    place: np.ndarray
    now: np.ndarray
    found: np.ndarray | None
    noise_units: np.ndarray
    noise_units_found: np.ndarray | None
    regressors: Mapping[str, np.ndarray]
    units: Mapping[str, str]

    @classmethod
    def of(cls, scene: Scene, field: Field, found: Field | None = None) -> Residuals:
        used = np.flatnonzero(np.any(field.noise_units != 0, axis=0))
        names = list(POSE)
        if not field.kind:
            names = [f"equation {k + 1}" for k in range(field.noise_units.shape[1])]
            if np.isfinite(scene.reading_residuals).any():
                names = [str(channel) for channel in scene.model.structure.channels]
        return cls(
            kind=field.kind,
            components=[names[k] for k in used],
            sample=scene.dataset.numbers,
            place=places(scene, field.kind),
            now=vectors_in_base(scene, field),
            found=None if found is None else vectors_in_base(scene, found),
            noise_units=field.noise_units[:, used],
            noise_units_found=None if found is None else found.noise_units[:, used],
            regressors=dict(regressors(scene)),
            units={name: unit_along(scene.model.mechanism, name) for name, _ in regressors(scene)},
        )

    def select(self, kept: np.ndarray) -> Residuals:
        """Return the residuals of some samples: indices or a mask."""
        return replace(
            self,
            sample=self.sample[kept],
            place=self.place[kept],
            now=self.now[kept],
            found=None if self.found is None else self.found[kept],
            noise_units=self.noise_units[kept],
            noise_units_found=(
                None if self.noise_units_found is None else self.noise_units_found[kept]
            ),
            regressors={name: values[kept] for name, values in self.regressors.items()},
        )

    def select_informative(self, along: Sequence[ResidualProfile]) -> Iterator[ResidualProfile]:
        """Select the quantities that varied; velocities of a robot at rest are omitted."""
        for entry in along:
            values = self.regressors[entry.name]
            rests = entry.name.startswith("velocity.") and np.abs(values).max() < MAX_REST_SPEED
            if np.ptp(values) > 0 and not rests:
                yield entry


@dataclass(frozen=True)
class JointResiduals:
    """Encoder reading minus inverse kinematics of the measured pose (N, k), with its sigma.

    `readings` (N, k) and `errors` are in rad or m, as `units` say. Only joints that the measured
    coordinates determine are included; an undetermined value is NaN.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    sample: np.ndarray
    readings: np.ndarray
    errors: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> JointResiduals:
        found, mechanism = compute_joint_components(scene), scene.model.mechanism
        at = [mechanism.joints.index(name) for name in found.names]
        return cls(
            joints=found.names,
            units=tuple(mechanism.joint_units[k] for k in at),
            sample=scene.dataset.numbers,
            readings=scene.x[:, at],
            errors=found.values(scene.by_sample(scene.residual)),
            sigma=found.sigma,
        )


def places(scene: Scene, kind: str | None) -> np.ndarray:
    """Return the predicted positions (N, 3) of the target in {B}, or its z axis if only the
    orientation is measured."""
    predicted, device = scene.model.configuration(scene.x), frames_of(scene.model)
    if kind == "orientation":
        return predicted.R[:, :, 2] @ device.F.T
    return device.to_base(predicted.r)


def vectors_in_base(scene: Scene, field: Field) -> np.ndarray:
    """Return the vectors (N, 3) of a field, which are in the frame of the device, in {B}."""
    return field.vectors @ frames_of(scene.model).F.T


def map_in_base(scene: Scene, drawn: SmoothMap) -> SmoothMap:
    """Return a smooth map, which is in the frame of the device, in {B}; orientations lie over the
    joints."""
    device = frames_of(scene.model)
    places = device.to_base(drawn.places) if drawn.kind == "position" else drawn.places
    return replace(drawn, places=places, field=drawn.field @ device.F.T)


def unit_along(m: Mechanism, name: str) -> str:
    """Return the SI unit of a joint, a coordinate or a condition; empty if none is stated."""
    units = dict.fromkeys(POSE[:3], "m") | dict.fromkeys(POSE[3:], "rad")
    own = dict(zip(m.joints, m.joint_units, strict=True)) | units
    kind, _, joint = name.partition(".")
    stated = CONDITIONS[kind][0] if kind in CONDITIONS else ""
    # The unit of a joint's condition is stated for revolute joints.
    return own.get(name) or stated.replace("rad", own.get(joint, "rad"))


@dataclass(frozen=True)
class JudgedSample:
    """A sample with its joints (nq,) and position (3,), and the norms of its errors by kind.

    The errors are those of the fit that held the sample out. `sigmas` is from the fit of all
    samples. Unknown values are NaN.
    """

    sample: int
    time: float
    joints: np.ndarray
    position: np.ndarray
    now: Mapping[str, float]
    found: Mapping[str, float] | None
    odd: str
    name: str = ""


def samples(diagnosis: Diagnosis) -> list[JudgedSample]:
    """List every sample of a diagnosis, worst first."""
    odd = {one.sample: one.label for one in diagnosis.odd_samples}
    now, found = (
        _list_sample_errors(trial.fitted.held_out, trial.scene)
        for trial in (diagnosis.base, diagnosis.best)
    )
    return _list_samples(diagnosis.base.scene, now, found if diagnosis.effects else None, odd)


def compared_samples(
    comparison: Comparison, numbers: np.ndarray | None = None
) -> list[JudgedSample]:
    """List the samples of a comparison, or those with these numbers, worst first."""
    odd = {one.sample: one.label for one in comparison.odd_samples}
    now = _list_sample_errors(comparison.errors, comparison.scene)
    return _list_samples(comparison.scene, now, None, odd, numbers)


def _list_samples(
    scene: Scene,
    now: Mapping[str, np.ndarray],
    found: Mapping[str, np.ndarray] | None,
    odd: Mapping[int, str],
    only: np.ndarray | None = None,
) -> list[JudgedSample]:
    data = scene.dataset
    position = np.where(data.measured[:, :3], data.r, np.nan)
    order = np.argsort(-scene.sigmas, kind="stable")
    if only is not None:
        order = order[np.isin(data.numbers[order], only)]
    return [
        JudgedSample(
            sample=int(data.numbers[i]),
            time=data.time[i] if data.has_time else math.nan,
            joints=scene.observations.x[i, : len(scene.model.joints)],
            position=position[i],
            now={kind: column[i] for kind, column in now.items()},
            found=None if found is None else {kind: column[i] for kind, column in found.items()},
            odd=odd.get(data.numbers[i], ""),
            name=data.names.get(int(data.numbers[i]), ""),
        )
        for i in order
    ]


def _list_sample_errors(errors: Errors, scene: Scene) -> dict[str, np.ndarray]:
    return {kind: errors.norms(kind) for kind in ERRORS} | {"sigmas": scene.sigmas}


@dataclass(frozen=True)
class DescribedParameter(ParameterEstimate):
    """A parameter with the name to show, its description and its sigma in tolerances."""

    shown_name: str
    words: str
    sigma_tolerances: float | None


def parameters(result: FitResult) -> dict[str, DescribedParameter]:
    """Describe every parameter, by name."""
    return describe_parameters(result.model, result.parameters())


def describe_parameters(
    model: Model, estimates: Mapping[str, ParameterEstimate]
) -> dict[str, DescribedParameter]:
    """Describe the estimates of a model's parameters, by name. A setting of an effect, such as a
    lead, has not moved from a nominal value: what stood there before was a guess. One that no joint
    has is not listed."""
    table, unused = model.table, model.list_unused_numbers()
    tolerances = dict(zip(table.names, model.usual_tolerance, strict=True))
    settings = model.settings_of(*(one.name for one in model.effects))
    unmoved = {n for n, is_one in zip(table.names, settings, strict=True) if is_one}
    return {
        name: DescribedParameter(
            **vars(p) | ({"nominal": p.value, "moved_tolerances": 0.0} if name in unmoved else {}),
            shown_name=table[name].shown_name,
            words=describe(name, table),
            sigma_tolerances=None if p.sigma is None else p.sigma / tolerances[name],
        )
        for name, p in estimates.items()
        if name not in unused
    }


def combinations(result: FitResult) -> dict[str, list[dict[str, Any]]]:
    """Describe the unidentifiable combinations and the weak directions."""
    seen, table = result.estimate.spectrum, result.model.table
    return {
        "unidentifiable": directions_in_words(seen.unidentifiable, table),
        "weak": directions_in_words(seen.weak, table),
    }


@dataclass(frozen=True)
class Correlation:
    """The correlation of two parameters."""

    parameters: tuple[str, str]
    value: float


def find_correlations(result: FitResult, most: int = 10) -> list[Correlation]:
    """Find the strongest correlations of two free parameters."""
    names = [n for n, free in zip(result.model.table.names, result.free, strict=True) if free]
    with np.errstate(invalid="ignore", divide="ignore"):  # unidentified ones have no sigma
        C = np.triu(np.nan_to_num(result.correlations()), 1)
    pairs = sorted(
        np.argwhere(np.abs(C) > MIN_STRONG_CORRELATION).tolist(), key=lambda ij: -abs(C[tuple(ij)])
    )
    return [Correlation((names[i], names[j]), C[i, j]) for i, j in pairs[:most]]


def smooth_map(drawn: SmoothMap) -> dict[str, Any]:
    """Return the document of the smooth map with its places and its field (m or rad)."""
    return drawn.document() | {"places": drawn.places, "field": drawn.field}
