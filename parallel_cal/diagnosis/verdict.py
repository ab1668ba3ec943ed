"""Judge a diagnosis in one word and two short sentences, with what else is to know.

The numbers come from held-out poses and stated or measured noise, not from the fit alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.units import ERROR_UNITS, MM
from parallel_cal.diagnosis.findings import Findings
from parallel_cal.diagnosis.lack_of_fit import LackOfFit
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.diagnosis.region import (
    AT_ONE_HEIGHT,
    Region,
    is_of_touches,
    is_touched_at_one_height,
)
from parallel_cal.diagnosis.thresholds import MAX_ERROR_TO_NOISE_RATIO
from parallel_cal.identification.acceptance import acceptance, format_errors
from parallel_cal.identification.fit_warnings import format_distinctly
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.thresholds import MAX_HELD_ERROR_RATIO, MIN_DOF
from parallel_cal.model.shelf import load_effect
from parallel_cal.model.words import join_words

NO_NOISE = (
    "without a noise figure it is not known whether the explanation is complete: {again} again, or "
    "state the noise if it was measured"
)
QUIETER = "the noise is smaller than stated, as where a pose is the mean of many messages"
NOT_IN_CATALOGUE = "An effect is missing that the catalogue does not describe"
# Verdicts that leave an error which no effect of the catalogue describes.
UNEXPLAINED_VERDICTS = ("unexplained", "partly_explained", "cannot_know")
# Verdicts that find the model incomplete.
AMBER_VERDICTS = ("explained", "partly_explained", "unexplained")


@dataclass(frozen=True)
class Verdict:
    """`at_noise`, `explained`, `partly_explained`, `unexplained` or `cannot_know`, and why.

    `summary` are at most two short sentences. `against` says what keeps the effects found from
    being the whole explanation, `remarks` what else is to know; each a sentence of its own.
    `suspected_of_law` lists effects found that may only imitate a law outside the catalogue.
    `like_drift` lists effects of time that explain the error no better than noise that drifts.
    `needs_sides` is whether the sides from which the joints came must be known for more.
    """

    word: str
    summary: str
    share: float | None = None
    against: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    suspected_of_law: tuple[str, ...] = ()
    like_drift: tuple[str, ...] = ()
    needs_sides: bool = False

    @property
    def text(self) -> str:
        """All of it, where there is room for one text only."""
        return "; ".join([self.summary, *self.against, *self.remarks])


def judge(found: Findings) -> Verdict:
    """Judge the findings.

    Whatever the verdict is, it names the effects that are larger than usual, those that the
    measuring device may cause, and those of the model that another effect would replace.
    """
    verdict = replace(
        _judge(found),
        suspected_of_law=tuple(dict.fromkeys([*found.suspected_of_law, *found.imitating])),
        like_drift=found.doubts.like_drift,
    )
    against = tuple(dict.fromkeys([*verdict.against, *_describe_doubts(found)]))
    return replace(verdict, against=against, remarks=(*verdict.remarks, *found.doubts.ambiguous))


def _judge(found: Findings) -> Verdict:
    """Judge the findings; list what keeps them from being the whole explanation."""
    after, share, names = found.final_estimate, found.share, found.names
    judgement = acceptance(found.best.fitted, found.base.fitted)
    now = f"error {judgement.basis} {format_errors(judgement.after)}"
    fell = judgement.description if found.best.chosen else now
    errors = f"{fell[0].upper()}{fell[1:]}"
    if (dof := found.rest.noise.count_testing_dof(after.dof)) < MIN_DOF:
        beside = " beside those of the replicates" if found.rest.noise.dof else ""
        words = f"{dof} degrees of freedom{beside} are too few for a verdict: measure more poses"
        return Verdict("cannot_know", words)
    if found.best.chosen and not judgement.judged:
        fits = "fit better" if len(found.best.chosen) > 1 else "fits better"
        words = f"{names} {fits}, but there is no validation error. {errors}"
        return Verdict("cannot_know", words, share, remarks=(judgement.against,))
    if found.rest.noise.variance is None:
        verb = "help" if len(found.best.chosen) > 1 else "helps"
        helps = f"{names} {verb}" if names else "no effect of the catalogue helps"
        shows = found.rest.structure.has_structure or found.laws
        but = ", but the residuals still have structure" if shows else ""
        touched = is_of_touches(found.best.fitted.dataset)
        unsure = NO_NOISE.format(again="touch points" if touched else "visit poses")
        word = "cannot_know"
        if found.is_sure or found.laws:  # a law stands out of noise of any size by its shape
            word = "partly_explained" if names else "unexplained"
        remarks = () if found.laws else (unsure,)
        return Verdict(word, f"{helps}{but}. {errors}", share, remarks=remarks)
    if found.rest.field.held > MAX_HELD_ERROR_RATIO:
        return Verdict(
            "unexplained",
            "the measured pose includes coordinates that the model holds at one value: use a "
            f"larger model. They vary by {found.rest.field.held:.0f} sigmas",
            share,
            remarks=(errors,),
        )
    if not found.best.chosen:
        return _nothing_found(found, errors)
    several = len(found.best.chosen) > 1
    against = tuple(_list_objections(found))
    errors += _describe_noise_floor(found)
    if found.rest.noise.is_exceeded and not found.has_sides:
        return _ask_for_sides(found, errors, share)
    if found.was_inside_band:
        chi2, high = format_distinctly([found.chi2_before, found.high_before])
        words = (
            f"the residuals are within the noise without any effect (chi2/dof {chi2}, at most "
            f"{high}). With {names}: {fell}; add "
            f"{'them' if several else 'it'} if this gain matters to you"
        )
        return Verdict("at_noise", words, share, against, _noise(found))
    word = "partly_explained" if against else "explained"
    beside = _describe_only_doubt(found) if against else ""
    words = f"{names} {_describe_share(found)}{beside}. {errors}"
    return Verdict(word, words, share, against, _noise(found))


def _describe_share(found: Findings) -> str:
    """Say how much of the error above the noise floor the effects found account for; a share of an
    excess that chance may have made means nothing."""
    several, high = len(found.best.chosen) > 1, found.high_before
    if found.share is None or found.chi2_before <= high:
        return f"{'together explain' if several else 'explains'} the remaining error"
    verb = "together account" if several else "accounts"
    return f"{verb} for {100 * max(found.share, 0):.0f} % of the error above the noise floor"


def _describe_only_doubt(found: Findings) -> str:
    """Say why effects that leave nothing are only a part of an explanation: their sizes, or the
    device, let doubt that they are the cause."""
    if found.leaves_more_than_noise or found.laws:
        return ""
    doubts = []
    if found.doubts.unusual:
        verb = "is" if len(found.doubts.unusual) == 1 else "are"
        names = " and ".join(one.name for one in found.doubts.unusual)
        doubts.append(f"{names} {verb} larger than usual")
    if found.doubts.robot_or_device or found.doubts.unseparated:
        doubts.append("the robot or the measuring device may be the cause")
    return f"; nothing else is left, but {', and '.join(doubts)}" if doubts else ""


def _ask_for_sides(found: Findings, errors: str, share: float | None) -> Verdict:
    """Judge effects that were found in visits which differ for an unknown reason.

    A joint is mostly reached from below where its readings are large, and from above where they are
    small. A backlash of unknown sides therefore looks like an effect of the readings.
    """
    several = len(found.best.chosen) > 1
    return Verdict(
        "cannot_know",
        f"{found.names} would explain {'parts' if several else 'a part'} of the error, but the "
        f"sides from which the joints came are not known. {errors}",
        share,
        remarks=(
            f"visits of the same pose differ by {found.rest.noise.misstated:.1f} times "
            f"{found.rest.noise.used}: a backlash makes them differ, and imitates "
            f"{'such effects' if several else 'such an effect'}",
        ),
        needs_sides=True,
    )


def _list_objections(found: Findings) -> list[str]:
    """List what keeps the found effects from being the whole explanation."""
    against, chi2 = [], found.final_estimate.chi2_per_dof
    high, structure = found.high_after, found.rest.structure
    if chi2 > high:
        shown = format_distinctly([chi2, high])
        against.append(
            f"the residuals still exceed the noise: chi2/dof is {shown[0]}, and "
            f"{_name_noise(found.rest.noise)} gives at most {shown[1]} (99 % limit)"
        )
        against += _describe_like_drift(found)
    against += _describe_imitated_law(found)
    against += _describe_doubts(found)
    if found.leaves_more_than_noise:  # else no further effect is needed, whatever it would explain
        against += [*found.doubts.outdone, *found.doubts.wrong_signs]
    if found.rest.condition and (found.rest.noise.is_exceeded or chi2 > high):
        against.append(found.rest.condition.description)
    if structure.has_structure:
        against.append(
            f"the residuals still have structure (p = {structure.p_value:.1g}{_size(structure)})"
        )
    return against


def _name_noise(noise: NoiseLevel) -> str:
    """Name what the noise is known from. If it is not stated, a chi2/dof of 1 means nothing."""
    if noise.dof is None:
        return "the stated noise"
    return f"the difference between visits of one pose ({noise.dof} degrees of freedom)"


def _describe_doubts(found: Findings) -> list[str]:
    """Describe effects that are larger than usual, and why `add` may refuse others: robot and
    device are not separated."""
    return [
        *(one.description for one in found.doubts.unusual),
        *_describe_suspected_law(found),
        *map(robot_or_device, found.doubts.robot_or_device),
        *([found.doubts.unseparated] if found.doubts.unseparated else []),
    ]


def _describe_like_drift(found: Findings) -> list[str]:
    """Say which effects of time noise that drifts imitates, and what tells them from it."""
    return [
        f"{name} would explain the error no better than noise of the device or the robot that "
        f"drifts; to tell them, measure {load_effect(name).separated_by}"
        for name in found.doubts.like_drift
    ]


def _describe_imitated_law(found: Findings) -> list[str]:
    """Say which law is likelier than the effects found, which may only imitate it."""
    if not found.imitating:
        return []
    law, p = max(found.laws.items(), key=lambda one: one[1])
    return [
        f"a {law} that is in no catalogue is likelier ({format_percent(p)}), and "
        f"{' and '.join(found.imitating)} may only imitate it: search for it (discover)"
    ]


def _describe_suspected_law(found: Findings) -> list[str]:
    """Advise to search for a law before adding effects that may only imitate it."""
    names = found.suspected_of_law
    if not names:
        return []
    is_one = len(names) == 1
    why = "leaves an error" if is_one else "leave an error"
    if any(found.doubts.swaps.get(name) for name in names):
        why = "is not the only explanation" if is_one else "are not the only explanations"
    return [
        f"{' and '.join(names)} {why}, so the cause may be an effect that is not in the catalogue: "
        "before you add anything, search for its law (discover), and keep the law or the effect, "
        "whichever predicts held-out poses better"
    ]


def robot_or_device(name: str) -> str:
    """Say that the device may cause what an effect of the robot describes, or the robot what an
    effect of the device describes, and which measurement decides."""
    cause = f"the measuring device may cause {name}: usual errors of such a device explain as much"
    if load_effect(name).of_device:
        cause = (
            f"the robot may cause {name}: errors of its joints, or its deflection under the "
            "payload, explain as much"
        )
    return (
        f"robot or device: {cause} (measure the same poses with the device turned or moved aside, "
        "measure them with a second device, measure an artefact of known length, or state the "
        "device's certificate in the model file)"
    )


def _nothing_found(found: Findings, errors: str) -> Verdict:
    chi2, high = found.final_estimate.chi2_per_dof, found.high_after
    noise, refused = _noise(found), tuple(found.doubts.refused[:1])
    if chi2 <= high and found.laws:
        # The noise may be little known, or be large: a law stands out of it by its shape.
        return Verdict(
            "unexplained",
            "the residuals are no larger than the noise, but have a pattern, as noise has not "
            f"({join_words(found.laws)}). {NOT_IN_CATALOGUE}",
            remarks=(errors, *refused, *noise),
        )
    if chi2 <= high and found.rest.noise.is_exceeded:
        return _doubt_noise(found, errors)
    if chi2 <= high and found.rest.noise.dof is not None and found.rest.condition:
        # What moves the robot between visits of a pose passes for noise.
        return Verdict(
            "unexplained",
            "the residuals are no larger than the scatter of revisited poses, but "
            f"{found.rest.condition.description}, as noise does not. {NOT_IN_CATALOGUE}",
            remarks=(errors, *refused, *noise),
        )
    if chi2 <= high:
        words = f"the model explains the measurements down to the noise. {errors}"
        region = Region.of(found.best.fitted)
        where = region.description if region else ""
        if is_touched_at_one_height(found.best.fitted):
            where = AT_ONE_HEIGHT
        advice = [f"no further effect is needed{where}", *_uncertainty(found)]
        if found.doubts.refused:
            advice = list(refused)
        elif found.rest.structure.has_structure:
            advice.append("neighbouring residuals are similar: look at the map")
        return Verdict("at_noise", words, remarks=(*advice, *noise))
    known = " and ".join(effect.name for effect in found.base.fitted.model.effects)
    beside = known and f", beside {known} of the model,"  # what these leave was there before them
    nothing, remarks = f"no effect of the catalogue{beside} explains it", list[str]()
    if found.doubts.refused:
        nothing, remarks = "no effect explains it well", [*refused]
    elif found.doubts.like_drift:
        nothing, remarks = "noise that drifts does", _describe_like_drift(found)
    if size := _size(found.rest.structure, "the smooth part is"):
        remarks.append(size)
    if found.rest.condition:
        remarks.append(found.rest.condition.description)
    return Verdict(
        "unexplained",
        f"chi2/dof {' is above '.join(format_distinctly([chi2, high]))}, but {nothing}. {errors}",
        remarks=(*remarks, *noise),
    )


def _doubt_noise(found: Findings, errors: str) -> Verdict:
    """Judge residuals that are within the scatter of revisited poses, but not within the noise that
    the fit used: the scatter may be noise, or motion of the robot between the visits."""
    ratio = f"by {found.rest.noise.misstated or 1.0:.1f} times {found.rest.noise.used}"
    differ = f"visits of the same pose differ {ratio}"
    if found.rest.condition:
        return Verdict(
            "unexplained",
            f"{differ}, and {found.rest.condition.description}. {NOT_IN_CATALOGUE}",
            remarks=(errors,),
        )
    test = (
        "measure one pose ten times without moving the robot: if this scatters less, the robot "
        "moves; if it scatters as much, state this noise in the model file"
    )
    if found.rest.noise.from_jitter:
        test = (
            "record what differed and diagnose again; if nothing did, because encoders and device "
            "repeat no better, state the noise of repeated visits in the model file"
        )
    remarks = [
        errors,
        "what differed between the visits? If the robot moved (friction, backlash, load, warming), "
        "an effect is missing; if all of it is noise, the model is complete",
        test,
    ]
    if found.sides_from_order:
        remarks.append(
            "the sides from which the joints came were not recorded, but taken from the order of "
            "the rows: if they were others, state them (direction.JOINT) and diagnose again"
        )
    return Verdict(
        "cannot_know",
        f"{differ}, and the difference depends on no recorded condition",
        remarks=(*remarks, *(f"by the residuals, {words}" for words in found.rest.shape.remarks)),
    )


def _noise(found: Findings) -> tuple[str, ...]:
    """Describe the noise if it is not white, or not as stated."""
    words, noise = list(found.rest.shape.remarks), found.rest.noise
    if noise.misstated is not None:
        words.insert(0, f"the noise is {noise.misstated:.1f} times {noise.used}")
    elif _is_quieter_than_stated(found):
        words.insert(0, QUIETER)
    return (f"by the residuals, {' and '.join(words)}",) if words else ()


def _uncertainty(found: Findings) -> list[str]:
    """Describe the part of the validation errors that the model uncertainty makes."""
    result, misstated = found.best.fitted, found.rest.noise.misstated or 1.0
    floors, twice, is_large = dict[str, float](), dict[str, float](), False
    for kind in ERROR_UNITS:
        error, stated = result.held_out.summary.rms(kind), result.noise_floor.rms(kind)
        if error is None or not stated:
            continue
        floor = stated * misstated
        is_large |= error > MAX_ERROR_TO_NOISE_RATIO * floor
        floors[f"{kind}_rms"] = floor
        # The variance that parameters add falls with the number of observations.
        twice[f"{kind}_rms"] = ((min(floor, error) ** 2 + error**2) / 2) ** 0.5
    if not is_large:
        return []
    return [
        f"the noise floor is {format_errors(Summary(**floors))}, and the rest of the error is "
        f"model uncertainty: twice as many poses would reduce the error to about "
        f"{format_errors(Summary(**twice))}"
    ]


def _describe_noise_floor(found: Findings) -> str:
    """Format the noise floor of the validation error, if the noise is as stated."""
    floor = found.best.fitted.noise_floor
    if found.rest.noise.misstated is not None or not floor.is_known:
        return ""
    whose = " by the stated noise" if _is_quieter_than_stated(found) else ""
    return f"; noise floor {format_errors(floor)}{whose}"


def _is_quieter_than_stated(found: Findings) -> bool:
    after = found.final_estimate
    return after.chi2_per_dof < found.rest.noise.band(after.dof)[0]


def _size(structure: LackOfFit, before: str = ",") -> str:
    m = structure.map
    if m.share <= 0:
        return ""
    unit, factor = ERROR_UNITS[m.kind]
    if m.kind == "position":
        return f"{before} {m.size * factor:.0f} {unit} over {m.length / MM:.0f} mm"
    return f"{before} {m.size * factor:.2f} {unit}"
