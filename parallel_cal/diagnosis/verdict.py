"""The verdict in one word and one sentence, from numbers that do not come from the fit alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from parallel_cal.diagnosis.fields import Reference
from parallel_cal.diagnosis.lack_of_fit import LackOfFit
from parallel_cal.diagnosis.search import Trial
from parallel_cal.diagnosis.thresholds import EXPLAINED, FEWEST_DOF, HELD_STILL, LUCK
from parallel_cal.identification.acceptance import acceptance, in_words
from parallel_cal.identification.methods.implicit import Estimate


@dataclass(frozen=True)
class Verdict:
    """`at_noise`, `explained`, `partly_explained`, `unexplained` or `cannot_know`, and why."""

    word: str
    summary: str
    share: float | None
    against: tuple[str, ...] = ()


def share_explained(before: float, after: float, noise: float | None) -> float | None:
    """1 - (s_after^2 - sigma^2) / (s_before^2 - sigma^2), of chi2/dof; None without a noise
    figure, or where nothing was to be explained."""
    if noise is None or before <= noise:
        return None
    return min(1.0, 1 - (after - noise) / (before - noise))


def judge(
    base: Trial, here: Trial, before: float, known: Reference, left: LackOfFit, held: float,
    names: str,
) -> Verdict:  # fmt: skip
    """The verdict on a search that started from `base` and ended at `here`.

    `before` is chi2/dof of the base, on the rows of the model at the end; `held` as in Field;
    `names` are the chosen effects as a person reads them.
    """
    after = here.fitted.estimate
    share = share_explained(before, after.chi2_per_dof, known.variance)
    judgement = acceptance(here.fitted, base.fitted)
    now = f"error {judgement.where} {in_words(judgement.after)}"
    errors = judgement.errors if here.chosen else now
    if after.dof < FEWEST_DOF:
        return Verdict("cannot_know", _few(after.dof), None)
    if here.chosen and not judgement.judged:
        words = f"{names} fits better ({errors}), but cannot be judged at unseen poses"
        return Verdict("cannot_know", f"{words}: {judgement.against}", share)
    if known.variance is None:
        return Verdict("cannot_know", _blind(names, errors, left), share)
    high = known.band(after.dof)[1]
    if held > HELD_STILL:
        return Verdict("unexplained", _held_words(held, errors), share)
    if not here.chosen:
        return _nothing_found(after.chi2_per_dof, high, errors, left)
    against = _guards(share, after, known.variance, high, left)
    if not against:
        told = share is not None and share >= EXPLAINED  # else the excess was mostly luck
        part = f", {share:.0%} of what exceeded the noise" if told else ""
        verb = "explains" if len(here.chosen) == 1 else "together explain"
        return Verdict("explained", f"{names} {verb} the rest{part}: {errors}", share)
    verb = "is" if len(here.chosen) == 1 else "are"
    return Verdict(
        "partly_explained",
        f"{names} {verb} part of it ({errors}), but {'; '.join(against)}",
        share,
        tuple(against),
    )


def _guards(
    share: float | None, after: Estimate, noise: float, high: float, left: LackOfFit
) -> list[str]:
    """What keeps found effects from being the whole explanation."""
    against, chi2 = [], after.chi2_per_dof
    # A small excess is mostly the luck of the draw: its share says nothing within two sigmas.
    beyond_luck = chi2 > noise * (1 + LUCK * (2 / after.dof) ** 0.5)
    if share is not None and share < EXPLAINED and beyond_luck:
        against.append(f"only {max(share, 0):.0%} of the variance beyond the noise is explained")
    if chi2 > high:
        against.append(f"chi2/dof {chi2:.2f} is still above {high:.2f}")
    if left.found:
        against.append(f"structure remains (p = {left.p_value:.1g}{_size(left)})")
    return against


def _nothing_found(chi2: float, high: float, errors: str, left: LackOfFit) -> Verdict:
    if chi2 <= high:
        more = " Neighbouring residuals are alike, though: look at the map." if left.found else ""
        words = f"the model explains the measurements down to their noise ({errors}): stop looking."
        return Verdict("at_noise", words + more, None)
    return Verdict(
        "unexplained",
        f"chi2/dof {chi2:.2f} is above {high:.2f}, but nothing in the catalogue explains it"
        f"{_size(left, '; a smooth part of it')} ({errors})",
        None,
    )


def _size(left: LackOfFit, before: str = ",") -> str:
    m = left.map
    if m.share <= 0:
        return ""
    if m.kind == "position":
        return f"{before} {m.size * 1e6:.0f} um over {m.length * 1e3:.0f} mm"
    return f"{before} {m.size * 3437.75:.2f} arcmin"


def _held_words(held: float, errors: str) -> str:
    return (
        f"what was measured of the pose includes coordinates that the model holds at one value; "
        f"they move by {held:.0f} sigmas ({errors}): use a larger model"
    )


def _few(dof: int) -> str:
    return f"{dof} degrees of freedom are too few to judge by: measure more poses"


def _blind(names: str, errors: str, left: LackOfFit) -> str:
    rest = " and structure remains" if left.found else ""
    found = f"{names} helps" if names else "nothing in the catalogue helps"
    return (
        f"{found} ({errors}){rest}; whether that is all cannot be known without a noise figure: "
        "state noise in the model file, or visit poses again"
    )


def listed(names: Sequence[str], rivals: dict[str, list[str]]) -> str:
    """`backlash` or `A or B`, several joined by `and`."""
    return " and ".join(" or ".join([name, *rivals.get(name, [])]) for name in names)
