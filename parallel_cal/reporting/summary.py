"""The last lines of a command: the errors before and after, the noise, and what is missing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from parallel_cal.base.confidence import format_percent
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.effect import Effect
from parallel_cal.model.shelf import load_effect
from parallel_cal.model.words import join_words
from parallel_cal.reporting.blocks import Cell, Table
from parallel_cal.reporting.contents import list_shown_kinds
from parallel_cal.reporting.names import name_setting, title_of
from parallel_cal.reporting.readable import (
    COMMAND,
    FOUND,
    LABEL,
    ODD,
    error_unit,
    number,
    unit_of,
    value_unit,
    with_sigma,
)

if TYPE_CHECKING:
    from parallel_cal.diagnosis.comparison import Comparison
    from parallel_cal.diagnosis.noise import NoiseLevel
    from parallel_cal.diagnosis.result import Diagnosis
    from parallel_cal.identification.drift_test import Moved
    from parallel_cal.identification.estimate import Estimate
    from parallel_cal.identification.noise_floor import NoiseFloor
    from parallel_cal.identification.recheck import Recheck
    from parallel_cal.model.model import Model
    from parallel_cal.posterior.scene import Scene
    from parallel_cal.session.steps import Step

Writer = Callable[[Summary, Mapping[str, float]], str]
PROGRAM = "parallel-cal"
MAX_MOVED = 4  # parts, or changes, that an update names
HELD_OUT = " (rms at held-out poses)"
IMITATES = "the error falls with it, but something else causes it"
STATED = (
    " by the stated noise; that of the samples is smaller, as where the stated noise is that of "
    "single messages"
)


class Line(NamedTuple):
    """One of the last lines; the mark colours its text."""

    label: str
    text: str
    mark: str = ""


def summarize(result: Any) -> list[Line]:
    """List the last lines of a result; empty for a result without any."""
    # By name: the classes of a diagnosis need not be imported to show a fit.
    functions: dict[str, Callable[[Any], Iterator[Line]]] = {
        "Step": _summarize_step,
        "FitResult": _summarize_fit,
        "Comparison": _summarize_comparison,
        "Diagnosis": _summarize_diagnosis,
    }
    summarizer = functions.get(type(result).__name__)
    return [] if summarizer is None else list(summarizer(result))


def summary_table(lines: Sequence[Line]) -> Table:
    """Make a table of the last lines; it has no headings."""
    rows = [(Cell(one.label, mark=LABEL), Cell(one.text, mark=one.mark)) for one in lines]
    return Table(("", ""), rows)


def list_step(label: str, step: str) -> Iterator[Line]:
    """List the lines of a step, `reason: command`, or one of the two: a command has its own."""
    reason, is_command, words = step.partition(f"{PROGRAM} ")
    if reason:
        yield Line(label, reason.removesuffix(": ") if is_command else step)
    if is_command:
        yield Line("" if reason else label, f"{PROGRAM} {words}", COMMAND)


def name_files(line: Line, names: Mapping[str, str]) -> Line:
    """Replace the placeholders of a step, such as MODEL, by the files of this run."""
    split = [(word.rstrip(",;"), word) for word in line.text.split(" ")]
    words = [names.get(stem, stem) + word[len(stem) :] for stem, word in split]
    return line._replace(text=" ".join(words))


def describe_result_errors(after: Summary, before: Summary | None, noise: Summary) -> str:
    """Say the errors in one line: `from 606 to 37.6 um; noise floor 30 um`."""
    floor = f"; noise floor {format_errors(noise)}" if noise.is_known else ""
    return f"{format_errors(after, before)}{floor}"


def _summarize_step(step: Step) -> Iterator[Line]:
    for line in _summarize_fit(step.result, (step.errors_to_beat, step.sigmas_to_beat)):
        yield line
        if line.label == "after:" and step.name == "add":
            added = str(step.model.history[-1]["effect"]).split("+")
            sized = " and ".join(describe_effect(step.model, name) for name in added)
            yield Line("with:", sized, FOUND)


def _summarize_fit(
    result: FitResult, before: tuple[Summary, Mapping[str, float]] | None = None
) -> Iterator[Line]:
    """Compare with `before`, errors and their standard deviations; the given model by default."""
    after, noise = result.held_out.summary, result.noise_floor
    if before is None:
        given = result.held_out_before
        before = given.summary, result.rms_sigmas(given)
    write = _writer(result.model, after, noise)
    yield Line("before:", write(*before) + HELD_OUT)
    yield Line("after:", write(after, result.rms_sigmas(result.held_out)), FOUND)
    yield from _state_moved(result.drift)
    yield _state_noise(write, result.simulated_noise, result, result.estimate)
    if (odd := result.outliers) is not None:
        verb = "contradicts" if len(odd.titles) == 1 else "contradict"
        samples = "sample" if len(odd.titles) == 1 else "samples"
        why = f"{samples} {join_words(odd.titles)} {verb} all others"
        yield Line("missing:", f"not known, because {why}", ODD)
    else:
        yield _state_missing(result, result.estimate, after, noise)


def _summarize_comparison(comparison: Comparison) -> Iterator[Line]:
    errors, noise = comparison.errors, comparison.noise
    write = _writer(comparison.model, errors.summary, noise)
    yield Line("error:", write(errors.summary, {}) + " (rms)")
    yield _state_noise(write, comparison.noise_floor, comparison, comparison.scene)
    yield _state_missing(comparison, comparison.scene, errors.summary, noise)


def _state_missing(
    judged: FitResult | Comparison, residual: Estimate | Scene, errors: Summary, noise: Summary
) -> Line:
    """Say whether the residual is larger than the noise, and by how much."""
    high, chi2, limit = chi2_band(residual.dof)[1], residual.chi2_per_dof, ""
    if judged.observations.noise_assumed:
        level = _judge_by_revisits(judged)
        if level.variance is None:
            few = "too few" if level.pure_error.dof else "no"
            why = f"the noise is not stated, and {few} poses were visited again"
            return Line("missing:", f"not known, because {why}")
        high, limit = level.band(residual.dof)[1], ", as far as the revisits tell"
    if chi2 > high:
        return Line("missing:", _describe_excess(judged.model, errors, noise), ODD)
    return Line("missing:", f"nothing larger than the noise{limit}")


def _judge_by_revisits(judged: FitResult | Comparison) -> NoiseLevel:
    """Judge the noise by poses that were visited more than once."""
    from parallel_cal.diagnosis.addition import see
    from parallel_cal.diagnosis.field import Field
    from parallel_cal.diagnosis.noise import NoiseLevel

    scene = see(judged) if isinstance(judged, FitResult) else judged.scene
    return NoiseLevel.of(scene, Field.of(scene), structured=False)


def _state_moved(drift: Recheck | None) -> Iterator[Line]:
    """State how far the parts that an update found changed are from the last calibration, and what
    else may have changed in their place."""
    if drift is None or not (likely := drift.likely):
        return
    sizes = ", ".join(_shorten([_write_moved(one, len(likely) == 1) for one in likely[0].shown]))
    names = [
        f"{_write_moved(one.moved[0]) if len(one.moved) == 1 else one.title} "
        f"({format_percent(one.probability)})"
        for one in likely
    ]
    if len(likely) == 1:
        text = sizes or likely[0].title
    else:
        names[0] += f": {sizes}" if sizes and len(likely[0].moved) > 1 else ""
        text = "; or ".join(_shorten(names))
    yield Line("moved:", f"{text} since the last calibration", FOUND)


def _shorten(texts: Sequence[str]) -> list[str]:
    more = [f"{len(texts) - MAX_MOVED} more"] if len(texts) > MAX_MOVED else []
    return [*texts[:MAX_MOVED], *more]


def _write_moved(one: Moved, with_sigmas: bool = False) -> str:
    unit, factor = value_unit(one.unit)
    size = with_sigma(one.value, one.sigma, factor).replace("±", "+-")
    sigmas = f" ({abs(one.value) / one.sigma:.0f} sigma)" if with_sigmas else ""
    return f"{one.title} by {size} {unit}{sigmas}"


def _state_noise(
    write: Writer, noise: NoiseFloor, judged: FitResult | Comparison, residual: Estimate | Scene
) -> Line:
    """State the noise floor and its source: the stated noise, or visits of the same poses.

    The residuals may show that the samples have less noise than is stated.
    """
    shown = write(noise.summary, noise.sigmas)
    if noise.revisits:
        return Line("noise:", f"{shown} by {count_revisits(noise)}")
    small = residual.dof > 0 and residual.chi2_per_dof < chi2_band(residual.dof)[0]
    return Line("noise:", shown + STATED * (small and not judged.observations.noise_assumed))


def describe_effect(model: Model, effect: str, sigmas: Mapping[str, float] | None = None) -> str:
    """Name an effect of a model, with what its numbers say to people: `backlash (largest in joint2:
    2.1 arcmin, others up to 0.9)`, `gear_transmission_error (ratio 17.24 +- 0.20)`. `sigmas` are
    those of its settings, by the names that these have in a diagnosis."""
    sizes, settings = _describe_largest_joint(model, effect), list_settings(model, effect)
    known = {name_setting(key, sigmas or {}): sigma for key, sigma in (sigmas or {}).items()}
    shown = [sizes] if sizes else []
    for key, (values, unit) in settings.items():
        name, factor = value_unit(unit)
        text = " to ".join(f"{factor * value:.5g}" for value in sorted({min(values), max(values)}))
        if key in known and len(values) == 1:
            text = with_sigma(min(values), known[key], factor).replace("±", "+-")
        shown.append(f"{key} {text} {'' if name == '1' else name}".rstrip())
    return f"{effect} ({'; '.join(shown)})" if shown else effect


def list_settings(model: Model, effect: str) -> dict[str, tuple[set[float], str]]:
    """List the numbers of an effect that a diagnosis searches for, such as a lead or a ratio: their
    values in all joints and their unit, by name. Those of a joint that differs have its name."""
    kind = load_effect(effect)
    if type(kind).scan is Effect.scan:
        return {}
    found, unused = dict[str, tuple[set[float], str]](), model.list_unused_numbers()
    each = zip(model.table, model.values.tolist(), model.settings_of(effect), strict=True)
    stated = {
        p.name.removeprefix(f"{effect}."): (p, value)
        for p, value, is_one in each
        if is_one and p.name not in unused
    }
    has_common = f"{effect}.{kind.each}" in model.table.names
    own = [key for key in stated if has_common and kind.is_of_one_joint(key)]
    for key, (p, value) in stated.items():
        is_one = key in own or key == kind.each
        name = name_setting(key, own) if is_one else key.rpartition(".")[2]
        if name in found and found[name][1] != p.unit:  # a slide among joints that turn
            name = f"{name} of {key.rpartition('.')[0]}"
        found.setdefault(name, (set(), p.unit))[0].add(value)
    return found


def _describe_largest_joint(model: Model, effect: str) -> str:
    """Name the joint in which an effect is largest, and its sizes; empty if its parameters do not
    belong to all joints in one unit."""
    sizes, units = dict.fromkeys(model.joints, 0.0), set[str]()
    for p, value, fixed in zip(model.table, model.values, model.fixed, strict=True):
        own, _, rest = p.name.partition(".")
        joint = rest.partition(".")[0]
        if own == effect and joint in sizes and not fixed:
            units.add(p.unit)
            sizes[joint] = math.hypot(sizes[joint], value)
    if len(sizes) < 2 or units not in ({"m"}, {"rad"}):
        return ""
    unit, factor = error_unit(si := units.pop())
    *_, second, first = sorted(sizes, key=sizes.__getitem__)
    if factor * sizes[first] >= 1000:  # no error, but a dimension
        unit, factor = value_unit(si)
    most, others = (number(sizes[name], factor) for name in (first, second))
    return f"largest in {first}: {most} {unit.replace('µ', 'u')}, others up to {others}"


def count_revisits(noise: NoiseFloor) -> str:
    """Return how many visits beyond the first of a pose showed a noise floor, and what their
    conditions leave of them if these differed."""
    left = f" ({noise.dof} degrees of freedom)" if noise.dof < noise.revisits else ""
    return f"{noise.revisits} revisit{'s' * (noise.revisits > 1)} of the same poses{left}"


def _summarize_diagnosis(diagnosis: Diagnosis) -> Iterator[Line]:
    """Answer two questions: what is missing, with probabilities, and whether anything is left."""
    base, best = diagnosis.base.fitted, diagnosis.best.fitted
    now, noise = base.held_out.summary, best.noise_floor
    write = _writer(diagnosis.model, now, noise)
    yield Line("now:", write(now, base.rms_sigmas(base.held_out)) + HELD_OUT)
    if diagnosis.effects:
        errors = write(best.held_out.summary, best.rms_sigmas(best.held_out))
        known = {name: one.sigma for name, one in diagnosis.explanation.settings.items()}
        sized = [describe_effect(best.model, name, known.get(name)) for name in diagnosis.effects]
        yield Line("with it:", f"{errors} with {' and '.join(sized)}", FOUND)
    yield from _state_moved(diagnosis.drift)
    yield _state_noise(write, best.simulated_noise, best, best.estimate)
    likely, imitators = _divide(diagnosis.missing)
    for cause in likely:
        text = _join_rivals(_name_causes(diagnosis, cause["each"]), "{name} {percent}")
        yield Line("missing:", f"{text}{_describe_doubted(cause['settings'])}", ODD)
    if not likely:
        yield Line("missing:", "no effect of the catalogue")
    for cause in imitators:
        text = _join_rivals(cause["each"], "{name} {percent}")
        yield Line("imitates:", f"{text}: {IMITATES}")
    laws = [f"{name} ({format_percent(p)})" for name, p in diagnosis.explanation.laws.items()]
    what = f", described best by an unknown {' and an unknown '.join(laws)}" if laws else ""
    yield Line("left:", f"{diagnosis.left}{what}")
    for number_of_step, step in enumerate(diagnosis.next_steps):
        yield from list_step("then:" if number_of_step else "next:", step)


def describe_missing(diagnosis: Diagnosis) -> str:
    """Say what is missing, with its probability, for people: the first answer of a page."""
    likely, imitators = _divide(diagnosis.missing)
    sentences = [] if likely else ["No known effect is missing"]
    for cause in (*likely, *imitators):
        each = _name_causes(diagnosis, cause["each"], title_of)
        text = _join_rivals(each, "{name}: {percent}")
        text += _describe_doubted(cause["settings"])
        sentences.append(f"{text[0].upper()}{text[1:]}")
        if cause in imitators:
            sentences[-1] += f"; {IMITATES}"
    return "".join(f"{sentence}. " for sentence in sentences).rstrip()


def _name_causes(
    diagnosis: Diagnosis, each: Mapping[str, float], title: Callable[[str], str] = str
) -> dict[str, float]:
    """The probabilities of effects by their titles. What is missing of an effect that the model has
    is a number that a joint has of its own."""
    has = {effect.name for effect in diagnosis.model.effects}
    other = {c.name: name_setting(key) for c in diagnosis.best.chosen for key in c.settings}
    return {
        f"{title(name)} with another {other[name]}"
        if name in has and name in other
        else title(name): p
        for name, p in each.items()
    }


def _divide(missing: Sequence[Mapping[str, Any]]) -> tuple[list[Any], list[Any]]:
    """The causes that the robot may have, and those that imitate one that is not in the
    catalogue."""
    likely = [cause for cause in missing if cause["probability"] > 1 - CREDIBLE]
    return likely, [cause for cause in missing if cause not in likely]


def _describe_doubted(settings: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Name the periods that may be those of a wave, if not only one may be."""
    text = ""
    for name, likely in settings.items():
        rivals = [
            one
            for one in likely
            if one["probability"] > 1 - CREDIBLE and load_effect(name).period(one["values"])
        ]
        if len(rivals) > 1:
            named = (f"{_write(one)} {format_percent(one['probability'])}" for one in rivals)
            text += f"; {', or '.join(named)}"
    return text


def _write(setting: Mapping[str, Any]) -> str:
    return " and ".join(f"{key} {value:.4g}" for key, value in setting["values"].items())


def _join_rivals(each: Mapping[str, float], form: str) -> str:
    """Name what a cause may be, each with its probability; these exceed 100 % together if the robot
    may have several."""
    named = [form.format(name=name, percent=format_percent(p)) for name, p in each.items()]
    if sum(round(100 * p) for p in each.values()) > 100:
        named.append("both" if len(each) == 2 else "several of these")
    return ", or ".join(named)


def describe_left(diagnosis: Diagnosis) -> str:
    """Say whether an error is left that no effect found describes: the second answer of a page."""
    else_ = " else" if diagnosis.missing else ""
    if diagnosis.left == "no" and diagnosis.best.fitted.observations.noise_assumed:
        return f"Nothing{else_} shows in the errors. How large the noise is was not stated."
    return {
        "no": f"Nothing{else_} is left: the rest is noise.",
        "yes": f"Something{else_} is left that no known effect describes.",
        "unknown": f"Whether anything{else_} is left is not known.",
    }[diagnosis.left]


def _writer(model: Model, errors: Summary, noise: Summary) -> Writer:
    """Return a function that writes errors and their standard deviations in ASCII."""
    kinds = list_shown_kinds(errors, noise)
    units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))

    def write(shown: Summary, sigmas: Mapping[str, float]) -> str:
        parts = []
        for kind in kinds:
            if shown.rms(kind) is None:
                continue
            name, factor = error_unit(unit_of(kind, units))
            text = f"{with_sigma(shown.rms(kind), sigmas.get(kind), factor)} {name}"
            parts.append(text.replace("±", "+-").replace("µ", "u"))
        return ", ".join(parts) or "not known"

    return write


def _describe_excess(model: Model, errors: Summary, noise: Summary) -> str:
    """Say how large the part of the error is that is not noise."""
    units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    for kind in list_shown_kinds(errors, noise):
        error, floor = errors.rms(kind), noise.rms(kind)
        if error is not None and floor is not None and error > floor:
            name, factor = error_unit(unit_of(kind, units))
            excess = number(math.sqrt(error**2 - floor**2), factor)
            return f"an error of {excess} {name.replace('µ', 'u')} (rms) beside the noise"
    return "an error beside the noise"
