"""The views of a session's state as plain data, computed in the worker process."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.comparison import Comparison, compare
from parallel_cal.diagnosis.diagnose import diagnose_fitted
from parallel_cal.diagnosis.entries import Entry
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.signature import Signature, signature
from parallel_cal.diagnosis.thresholds import MAX_DIAGNOSED_SAMPLES
from parallel_cal.identification.budget import NOISE, REST, Budget, Iso9283
from parallel_cal.identification.fit import FitResult, summarise_parameters
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.given_model import fits_of
from parallel_cal.identification.observations import blocks
from parallel_cal.identification.prediction_errors import Summary, compute_rms_sigmas
from parallel_cal.identification.thresholds import MIN_DOF
from parallel_cal.model.model import Model
from parallel_cal.reporting import (
    contents,
    drawings,
    image_figures,
    images,
    results,
    tables,
)
from parallel_cal.reporting.blocks import as_rows
from parallel_cal.reporting.figures import select_evenly
from parallel_cal.reporting.machine import (
    ErringPart,
    describe_erring_parts,
    draw_machine,
    find_erring_parts,
)
from parallel_cal.reporting.markup import sentence
from parallel_cal.reporting.names import name_effects, name_step
from parallel_cal.reporting.readable import (
    with_sigma,
    write_micro,
)
from parallel_cal.reporting.recorded import describe_measurement
from parallel_cal.reporting.report import Report, report, report_of
from parallel_cal.reporting.summary import describe_left, describe_missing
from parallel_cal.session.history import State
from parallel_cal.session.session import Session
from parallel_cal.session.steps import fitted
from parallel_cal.workbench.picture_views import (
    MachineStage,
    View,
    list_pictures,
    view_field,
    view_machine,
    view_machine_of,
    view_pattern,
    view_picture,
    view_residuals,
)

# Samples on a page. A browser needs seconds to draw more, and more hide each other.
MAX_SHOWN_SAMPLES, MAX_WORST_SAMPLES = 400, 150
# Samples from which a preliminary view of many is made: their numbers come in seconds.
MAX_PRELIMINARY_SAMPLES = 2000
NUMBERS_ONLY: View = {
    "effects": [],
    "ambiguous": {},
    "candidates": [],
    "offered": None,
    "untested": [],
    "knocked": {},
}
FIT_TILES = ("before this step", "now", "noise floor")


def fit_some_samples(session: Session) -> Iterator[View]:
    """Make preliminary views of a fit from a part of many samples: its numbers, the pictures of its
    residuals, its verdict, then those of what it lacks; none if there are few. The fit of all
    samples takes minutes."""
    if (some := session.dataset_of_some(MAX_PRELIMINARY_SAMPLES)) is None:
        return
    how = session.options_for(some)
    step = fitted(session.model, some, True, options=how)
    result, part = step.result, _describe_part(len(some), session)
    known = (step.errors_to_beat, result.held_out.summary, result.noise_floor)
    errors, sigmas = dict(zip(FIT_TILES, known, strict=True)), result.rms_sigmas(result.held_out)
    words = f"preliminary fit of {part}; fitting all samples"
    numbers = _make_numbers(words, errors, sigmas)
    yield NUMBERS_ONLY | numbers
    shown = _make_comparison_view(compare(result.model, some, how.joint_sigma)) | numbers
    yield shown
    found = diagnose_fitted(session.model, some, result)
    yield _mark_preliminary(shown | _make_answers_view(found), part)
    yield _mark_preliminary(_make_report_view(report_of(found, vars(how))), part)


def view_some_samples(session: Session) -> View | None:
    """Make the view of the present state from a part of many samples; None if there are few."""
    if (some := session.dataset_of_some(MAX_PRELIMINARY_SAMPLES)) is None:
        return None
    how = session.options_for(some)
    if session.state.errors:
        made = _make_report_view(report(session.model, some, options=how, hold_out=how.hold_out))
    else:
        made = _make_comparison_view(compare(session.model, some, how.joint_sigma))
    return _mark_preliminary(made, _describe_part(len(some), session))


def _mark_preliminary(made: View, part: str) -> View:
    """Say in the verdict that a view is preliminary; nothing is offered before it is final."""
    verdict = made["verdict"]
    words = f"preliminary, from {part}: {verdict['words']}"
    return made | {"verdict": verdict | {"words": words, "is_preliminary": True}}


def _describe_part(count: int, session: Session) -> str:
    return f"{count} of {len(session.dataset)} samples, evenly spread over the recording"


def glance(session: Session) -> View | None:
    """Make the preliminary view of a fitted model, before its diagnosis.

    With many samples it has the numbers of the fit only: its residuals take as long as the fit.
    """
    state = session.state
    if not (session.recordings and state.errors):
        return None
    dataset = session.dataset
    shown = NUMBERS_ONLY
    if len(dataset) <= MAX_SHOWN_SAMPLES:
        shown = _make_comparison_view(compare(session.model, dataset, session.options.joint_sigma))
    words = f"{name_step(state.step)}: running the diagnosis"
    return shown | _make_numbers(words, _known_errors(state), state.sigmas)


def _known_errors(state: State) -> dict[str, Summary]:
    """The errors that a state keeps, by the names of their tiles."""
    known = zip(FIT_TILES, (state.before, state.errors, state.noise), strict=True)
    return {name: Summary(**errors) for name, errors in known if errors}


def _make_numbers(words: str, errors: Mapping[str, Summary], sigmas: Mapping[str, float]) -> View:
    """Make the preliminary verdict and the numbers of a fit; `sigmas` are those of "now"."""
    kinds = [k for k in ("position", "orientation", "reading") if errors["now"].rms(k)]
    tiles = [
        tables.make_tile(name, one, kinds, {}, sigmas=sigmas if name == "now" else None)
        for name, one in errors.items()
    ]
    return {
        "verdict": {"words": words},
        "tiles": to_json_value(tiles),
        "advice": [],
    }


def view(session: Session, progress: Progress) -> View:
    """Make the view of the session's present state.

    A model that was not fitted to these samples is only compared with them. Any other model is
    diagnosed, and the state records its verdict. A diagnosis may use only a part of the samples: an
    evenly spread part of many, or all but those that are far from all others. The errors and the
    parameters are nevertheless those of all, as the model has them. Without samples the view has
    only the robot.
    """
    if not session.recordings:
        return _make_empty_view(session.model)
    if not session.state.errors:
        return _make_comparison_view(
            compare(session.model, session.dataset, session.options.joint_sigma)
        )
    part = session.dataset_of_some(MAX_DIAGNOSED_SAMPLES)
    data = session.dataset if part is None else part
    how = session.options_for(data)
    found = report(session.model, data, progress=progress, options=how, hold_out=how.hold_out)
    verdict, made = found.diagnosis.verdict, _make_report_view(found)
    remark = "" if part is None else f" (diagnosis of {_describe_part(len(part), session)})"
    knocked = None if part is not None else [one.sample for one in found.diagnosis.knocked]
    session.record_verdict(session.state, verdict.word, f"{verdict.text}{remark}", knocked)
    if part is None and not knocked:
        return made
    return made | _make_numbers_of_all(session, made, remark)


def _make_empty_view(model: Model) -> View:
    """Make the view of a session without samples: the robot that it is about."""
    mechanism = model.mechanism
    # "Delta robot, complete calibration model with ..." describes delta54.
    described = inspect.getmodule(type(mechanism)).__doc__ or ""
    kind = " ".join(re.split(r" \(|[,.:]", described.strip(), maxsplit=1)[0].split())
    name = f"{kind} ({mechanism.name})" if kind else mechanism.name
    return {
        "robot": f"Robot of this session: {name}, {len(model.joints)} joints.",
        "machine": to_json_value(draw_machine(model)),
    }


def _make_numbers_of_all(session: Session, made: View, remark: str) -> View:
    """Make what a diagnosis of a part must not replace: errors and parameters of all samples.

    Figures that only the fit of the part has (budget, ISO 9283, chi2/dof) are omitted.
    """
    model, verdict = session.model, made["verdict"]
    sigma = np.full(len(model.values), np.nan)
    if model.covariance is not None:
        sigma = np.sqrt(np.diag(model.covariance))
    numbers = _make_numbers("", _known_errors(session.state), session.state.sigmas)
    # The error on which the verdict is based stands beside that of all samples, under its name.
    judged = [
        tile | {"name": f"now, without sample {', '.join(map(str, made['knocked']))}"}
        for tile in made["tiles"]
        if made["knocked"] and tile["name"] == "now"
    ]
    fixed = np.asarray(model.fixed)
    parameters = contents.describe_parameters(model, summarise_parameters(model, sigma, fixed))
    return {
        "verdict": verdict | {"words": f"{verdict['words']}{remark}"},
        "tiles": [*numbers["tiles"][:2], *judged, *numbers["tiles"][2:]],
        "counts": f"all errors: rms at {session.state.samples} samples; ± 1 sigma",
        "budget": None,
        "iso": [],
        "chi2": "",
        "parameters": as_rows(tables.parameter_table(parameters)),
    }


def _make_comparison_view(found: Comparison) -> View:
    kinds = [k for k in ("position", "orientation", "reading") if found.errors.summary.rms(k)]
    in_sample = any(fits_of(found.model, found.dataset))
    where = "in-sample error" if in_sample else "error at all samples"
    name, groups = "now, in-sample" if in_sample else "now", blocks(found.dataset)
    sigmas = compute_rms_sigmas(found.errors, groups)
    tiles = [tables.make_tile(name, found.errors.summary, kinds, {}, where, sigmas=sigmas)]
    count, poses = len(found.dataset), len(np.unique(found.dataset.pose_id))
    counts = f"{count} samples of {poses} poses; ± 1 sigma"
    if found.given.is_registered:
        # The error that a fit has to lower: "now" contains the registration to the same poses.
        held_out, sigmas = found.held_out.summary, compute_rms_sigmas(found.held_out, groups)
        label = found.given.label
        tiles.append(tables.make_tile(label, held_out, kinds, {}, sigmas=sigmas))
        counts += (
            f". The frames of the device were estimated from the same poses ({name}), or from "
            f"poses other than those of the error ({label})."
        )
    if found.noise.is_known:
        floor = tables.make_tile(
            "noise floor", found.noise, kinds, {}, where, sigmas=found.noise_floor.sigmas
        )
        tiles.append(floor)
    mechanism = found.model.mechanism
    units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
    residuals = contents.Residuals.of(found.scene, found.field)
    residuals, shown = _select_shown(residuals, found.scene.sigmas)
    samples = contents.compared_samples(found, residuals.sample)
    now = MachineStage("now", found.errors, found.errors.summary)
    return {
        "shown": shown,
        "verdict": {"words": _compared_words(found)},
        "tiles": to_json_value(tiles),
        "counts": counts,
        "budget": None,
        "iso": _iso(found.iso_9283),
        "chi2": "",
        "warnings": [write_micro(words) for words in found.dataset.warnings],
        "measured": describe_measurement(found.scene.model, found.dataset, found.observations),
        "machine": view_machine(found.model, found.scene, residuals, [now]),
        "field": view_field(residuals),
        "residuals": view_residuals(residuals, found.residual_profiles),
        "pictures": list(list_pictures(residuals, found.scene, None)),
        "samples": _samples(samples, residuals, kinds or ["joint"], units),
        "effects": _list_effects(found.model),
        "ambiguous": {},
        "knocked": {},
        "names": _names(found.dataset.names),
        "candidates": [],
        "offered": None,
        "untested": [],
        "parameters": None,
        "separation": None,
        "advice": ["Press Fit: identify the geometry first, then look at the remaining error."],
        "cannot_tell": [],
    }


def _compared_words(found: Comparison) -> str:
    if any(fits_of(found.model, found.dataset)):
        return (
            "The model is compared with the measurements that it was fitted to: its error is "
            "in-sample. Press Fit for the validation error."
        )
    if any(entry.get("step") == "fit" for entry in found.model.history):
        return "The model is compared with the measurements. Press Fit for the validation error."
    return "The model is compared with the measurements. It is not fitted yet: press Fit."


def _make_answers_view(found: Diagnosis) -> View:
    """Make what a diagnosis says in numbers and sentences, before any picture or table of it."""
    now, errors = found.base.fitted, contents.HeldOutErrors.of(found)
    units = dict(zip(found.model.joints, found.model.mechanism.joint_units, strict=True))
    erring = find_erring_parts(found.effects, contents.parameters(found.best.fitted))
    offered, plan = found.addition or found.doubted, found.measure_next.plan
    testing_dof = found.noise.count_testing_dof(found.best.fitted.estimate.dof)
    return NUMBERS_ONLY | {
        "verdict": _verdict(found),
        "answers": _answers(found, erring),
        "tiles": to_json_value([*tables.error_tiles(errors, found.effects, units)]),
        "counts": _counts(errors),
        "chi2": _chi2(now),
        "warnings": [write_micro(words) for words in dict.fromkeys(now.warnings)],
        "effects": _list_effects(found.model),
        "ambiguous": {one.effect: one.names for one in found.ambiguous},
        "knocked": {one.sample: one.size for one in found.knocked},
        "offered": offered
        and {"effects": [one.name for one in offered.effects], "text": offered.text},
        "with_effects": vars(errors.found) if errors.found else None,
        "separation": plan.csv(found.model) if plan else None,
        "deciding_poses": len(plan.poses) if plan else 0,
        "needs_poses": testing_dof < MIN_DOF,
        "find_law": found.leaves_an_error,
        "advice": [
            words for words in found.measure_next.advice if plan is None or words not in plan.how
        ],
    }


def _make_report_view(found: Report) -> View:
    """Make the view of a diagnosis with all its pictures and tables."""
    diagnosis, units = found.diagnosis, found.provenance.joint_units
    now = diagnosis.base.fitted  # the model of this state; the effects found are only proposed
    identified = contents.parameters(now)
    tested = [entry for entry in diagnosis.entries if entry.candidate.testable]
    erring = find_erring_parts(diagnosis.effects, found.parameters)
    residuals, shown = _select_shown(found.residuals, diagnosis.base.scene.sigmas)
    return _make_answers_view(diagnosis) | {
        "shown": shown,
        "budget": _budget(now.budgets[0]) if now.budgets else None,
        "iso": [*map(write_micro, images.describe_robot_error(now)), *_iso(now.iso_9283)],
        "measured": describe_measurement(now.model, diagnosis.dataset, now.observations),
        "machine": view_machine_of(found, residuals, erring),
        "field": view_field(residuals),
        "residuals": view_residuals(residuals, found.along),
        "pictures": [
            *(
                view_picture(one.name, one.words, one.figure)
                for one in image_figures.draw_cameras(now)
            ),
            *list_pictures(residuals, diagnosis.base.scene, _find_first_pattern(diagnosis)),
        ],
        "samples": _samples(found.samples, residuals, found.errors.kinds, units),
        "names": _names(diagnosis.dataset.names),
        "candidates": _list_candidates(diagnosis, tested, residuals.sample),
        "untested": [
            {"name": e.name, "why": e.reason} for e in diagnosis.entries if not e.candidate.testable
        ],
        "parameters": as_rows(tables.parameter_table(identified)),
        "drawing": to_json_value(drawings.drawing(diagnosis.model, found=identified)),
        "cannot_tell": [one["text"] for one in contents.combinations(now)["unidentifiable"]],
    }


def _list_candidates(
    diagnosis: Diagnosis, tested: list[Entry], shown: np.ndarray
) -> list[dict[str, Any]]:
    """The rows of the effects that were tested, with what the page shows of each besides."""
    rows = as_rows(tables.candidate_table(diagnosis, tested))["rows"]
    return [
        row
        | {
            "found": entry.name in diagnosis.effects,
            "probable": entry.probable,
            "pattern": view_pattern(entry, diagnosis.model, shown),
        }
        for row, entry in zip(rows, tested, strict=True)
    ]


def _find_first_pattern(diagnosis: Diagnosis) -> Signature | None:
    """Return the pattern of the first effect found that has one."""
    by_name = {entry.name: entry.candidate for entry in diagnosis.entries}
    chosen = (by_name[name] for name in diagnosis.effects if name in by_name)
    return next((signature(one) for one in chosen if one.score), None)


def _names(names: Mapping[int, str]) -> dict[str, str]:
    """The names of samples by number; the keys of JSON are texts."""
    return {str(number): name for number, name in names.items()}


def _list_effects(model: Model) -> list[str]:
    return [effect.name for effect in model.effects]


def _select_shown(
    residuals: contents.Residuals, sigmas: np.ndarray
) -> tuple[contents.Residuals, str]:
    """Select the samples that the page shows, and say which; `sigmas` (N,) are their sizes."""
    n = len(residuals.sample)
    if n <= MAX_SHOWN_SAMPLES:
        return residuals, ""
    worst = np.argsort(-sigmas, kind="stable")[:MAX_WORST_SAMPLES]
    kept = np.zeros(n, dtype=bool)
    kept[worst] = True
    others = np.flatnonzero(~kept)
    kept[others[select_evenly(len(others), MAX_SHOWN_SAMPLES - len(worst))]] = True
    words = (
        f"The views and the table show {np.count_nonzero(kept)} of {n} samples: the {len(worst)} "
        "worst, and others evenly spread over the recording. Only these can be marked."
    )
    return residuals.select(kept), words


def _verdict(found: Diagnosis) -> View:
    """Describe the verdict: its word, its sentences, and what else is to know."""
    said = results.describe_verdict(found)
    return {
        "word": said.word,
        "label": said.label,
        "words": sentence(name_effects(said.summary)),
        "remarks": [sentence(name_effects(words)) for words in said.remarks],
    }


def _samples(
    samples: Sequence[contents.JudgedSample],
    residuals: contents.Residuals,
    kinds: Sequence[str],
    joint_units: Mapping[str, str],
) -> View:
    """List the samples in the order of the residuals, which the figures share."""
    by_number = {one.sample: one for one in samples}
    in_order = [by_number[int(number)] for number in residuals.sample]
    return as_rows(tables.sample_table(in_order, kinds, joint_units))


def _counts(errors: contents.HeldOutErrors) -> str:
    if not errors.samples:
        return "no pose was held out: there is no validation error"
    counts = tables.describe_counts(errors.samples, errors.poses, True)
    return f"all errors: rms at {counts}; ± 1 sigma"


def _budget(budget: Budget) -> View:
    """Describe the parts of a budget as `geometry 603 ± 25 µm`, the largest first."""
    unit, factor = tables.ascii_unit(budget.kind)
    parts = [
        f"{'remaining ' * (part.name in (NOISE, REST))}{part.name} "
        f"{with_sigma(part.removed, part.sigma, factor)} {unit}"
        for part in budget.parts
        if part.removed is not None
    ]
    total = f"{with_sigma(budget.total, budget.sigma, factor)} {unit}"
    return {
        "title": write_micro(
            f"error of the nominal model {total}, removed by (parts add in squares: 3 and 4 make 5)"
        ),
        "parts": [write_micro(part) for part in parts],
        "about": write_micro(tables.budget_sentence(budget)),
    }


def _chi2(result: FitResult) -> str:
    """Describe chi2/dof and its band, which is not known if the noise is only estimated."""
    estimate = result.estimate
    if estimate.dof <= 0:
        return "chi2/dof not known: as many parameters as measurements"
    text = f"chi2/dof {estimate.chi2_per_dof:.2f}"
    if result.observations.noise_assumed:
        return f"{text}, by noise that was estimated from the residuals"
    low, high = chi2_band(estimate.dof)
    return f"{text}, {low:.2f} to {high:.2f} for a complete model with the stated noise"


def _iso(figures: Sequence[Iso9283]) -> list[str]:
    return [write_micro(tables.iso_sentence(one)) for one in figures]


def _answers(diagnosis: Diagnosis, erring: Sequence[ErringPart]) -> View:
    """Answer what is missing and whether anything is left, with the sizes of what was found."""
    return {
        "missing": describe_missing(diagnosis),
        "sizes": describe_erring_parts(erring, diagnosis.model.joints),
        "left": describe_left(diagnosis),
        "is_left": diagnosis.left,
    }
