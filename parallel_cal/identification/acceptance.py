"""Decide whether a new model may replace the old one, by one rule for all callers.

The rule compares validation errors. Without held-out poses nothing is proven, however small the
in-sample error is: a larger model always lowers it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.confidence import SIGMAS_AT_SIGNIFICANCE_LEVEL, format_percent
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.observations import blocks
from parallel_cal.identification.prediction_errors import Errors, Summary, held_out_ratio
from parallel_cal.identification.recheck import Recheck
from parallel_cal.identification.thresholds import MAX_NEGLIGIBLE_ERROR_RISE

IN_SAMPLE = (
    "the model was fitted to these samples before, so its own error is in-sample; for the error at "
    "held-out poses its parameters were identified again without these poses"
)

UNCHANGED = (
    ". But only the frames of the device explain this: before, they were fitted without these "
    "poses. At all samples the error is not smaller than before, so the fit did not improve the "
    "robot"
)

DIAGNOSE = "parallel-cal diagnose MODEL RECORDING"
IN_PYTHON = " (in Python: pc.diagnose(model, dataset))"

RIGHT_GEOMETRY = (
    ". Another geometry does not explain the samples better. If more than noise remains, diagnose "
    f"names the missing effect without a fit: {DIAGNOSE}{IN_PYTHON}"
)

IMITATES = f". diagnose names what is missing, and add takes it: {DIAGNOSE}{IN_PYTHON}"

KEEP = "keep MODEL"
CHECK_JOINTS = (
    "check the unit and the drive of each joint (of a printer: whether rotation_distance, gears or "
    "microsteps changed after the touches)"
)
CHECK_MACHINE = (
    "check the mechanism, and the unit, the direction and the drive (spool, screw or belt) of each "
    "joint"
)

# Probability that an updated model is worse. Of 260 virtual robots, 159 were updated by this limit,
# 3 of them wrongly; by 0.1, 142 and 2; by 0.5, 172 and 6 (docs/recheck.md)
MAX_HARM = 0.25
NOISE_OF_THREE_AXES = 3.0  # squared error that noise alone leaves, in units of its variance
FOREIGN_SHARE = 0.5  # of the measured motion: a model with a larger error explains hardly any of it
# Of the motion of joints in m: other sensors, such as a probe, read what is left of this motion
MAX_READING_SHARE = 0.2


@dataclass(frozen=True)
class Acceptance:
    """Errors before and after: at held-out poses if `judged`, else at the samples used.

    `against` says in one sentence why the new model must not replace the old one; empty if it may.
    `device_may_err` is whether the reason is that the measuring device may cause the error. `cure`
    says what to do instead: words, a command with MODEL and RECORDING, or `words: command`.
    """

    before: Summary
    after: Summary
    judged: bool
    against: str = ""
    device_may_err: bool = False
    cure: str = KEEP

    @property
    def description(self) -> str:
        """`error at held-out poses from 37.6 to 32.2 um, 0.457 arcmin before and after`."""
        return f"error {self.basis} {format_errors(self.after, self.before)}"

    @property
    def basis(self) -> str:
        return "at held-out poses" if self.judged else "at the samples used"

    def document(self) -> dict[str, Any]:
        return {"accepted": not self.against, "judged": self.judged, "against": self.against}


def acceptance(
    new: FitResult, old: FitResult | None = None, change: str = "", rise: float = 0.0
) -> Acceptance:
    """Judge whether the validation error falls by more than its own uncertainty, while neither the
    position error nor the orientation error rises.

    `old` is the fit of the same samples that the new model must beat: without the added effect, or
    with the removed one. By default it is the model before `new`. `change` names the change
    (" with 'backlash'"). A `rise` above 0 is for a smaller model: its error may rise by this share.
    """
    before, after = (new.held_out_before if old is None else old.held_out), new.held_out
    squares = np.array([_squared(new, before), _squared(new, after)])
    known = np.isfinite(squares).all(axis=0)
    if not known.any():
        return _refuse_unjudged(new, old)
    then, now = before.select(known).summary, after.select(known).summary
    foreign, check = _describe_foreign_model(new, now)
    if why := _describe_imitation(new, old):
        return Acceptance(then, now, True, f"{why}{foreign}", cure=DIAGNOSE)
    ratio = held_out_ratio(then, now)
    # The fall must exceed the uncertainty of its mean, pose by pose: a fall that half of the poses
    # contradict is chance.
    fall = np.bincount(blocks(new.dataset)[known], (squares[0] - squares[1])[known])
    uncertainty = fall.std() / np.sqrt(len(fall))
    clearly = rise > 0 or fall.mean() > uncertainty
    # A few samples prove a drift by their evidence, which the prior of the last calibration makes
    # precise; at held-out poses they can only contradict it.
    drift = new.drift if old is None else None
    if drift is not None and (why := _describe_useless_update(new, drift)):
        return Acceptance(then, now, True, why, cure=drift.cure)
    risen = dict[str, float]()
    if now.pixel_rms is None and now.position_rms and now.orientation_rms:
        # A mean of both would let one error rise for the fall of the other.
        risen = _find_risen_parts(new, before, after, known, rise)
        ratio = float(np.sqrt(squares[1][known].sum() / squares[0][known].sum()))
    falls = ratio is not None and ratio < 1 + rise
    # The frames alone were fitted, before without the held-out poses: all samples tell that.
    was, total = (np.nansum(_squared(new, one)) for one in (new.before, new.after))
    stuck = old is None and bool(total >= (1 - 1e-6) * was)
    if falls and clearly and not (risen or foreign or stuck):
        return Acceptance(then, now, True)
    misfit = "" if drift is None else _describe_misfit(new, drift)
    drifted = drift is not None and drift.is_shown and not misfit
    if drifted and fall.mean() > -SIGMAS_AT_SIGNIFICANCE_LEVEL * uncertainty and not foreign:
        return Acceptance(then, now, True)
    ratio = max(risen.values(), default=ratio)
    verb = _describe_fall(bool(rise or risen), falls, clearly)
    factor = "" if ratio is None else f"; factor {ratio:.3f}"
    said = "" if drift is None else f"{drift.warnings[0]}; {misfit}"
    advice = _advise(new) if old is None and not foreign else ""
    if stuck and verb == "falls":
        advice = UNCHANGED
    cure = DIAGNOSE if misfit or advice == RIGHT_GEOMETRY else KEEP
    return Acceptance(
        then,
        now,
        True,
        f"{said}the {' and '.join(risen)}{' ' if risen else ''}error at held-out poses "
        f"{verb}{change} ({format_errors(now, then)}{factor}){advice}{foreign}",
        cure=check or cure,
    )


def _refuse_unjudged(new: FitResult, old: FitResult | None) -> Acceptance:
    """Refuse a model without a validation error."""
    used = (new.before if old is None else old.after).summary
    why = "too few poses to hold some out" if new.options.hold_out else "no pose was held out"
    why += ": without a validation error nothing proves that the new model is better"
    cure = "measure more poses" if new.options.hold_out else "hold poses out (--hold-out)"
    if new.options.hold_out * len(np.unique(new.dataset.pose_id)) > 1:
        cure += ", or hold out one pose at a time (--hold-out 0.001)"
        why += f". {cure[0].upper()}{cure[1:]}"
    if new.implausible:
        why, cure = _describe_imitation(new, old), DIAGNOSE
    return Acceptance(used, new.after.summary, False, why, cure=cure)


def _describe_useless_update(new: FitResult, drift: Recheck) -> str:
    """Say that the samples forbid an update, or do not exclude that the updated model is worse than
    the last calibration; empty if neither is so."""
    if drift.forbids_update or drift.expected is None:
        return drift.warnings[0] if drift.forbids_update else ""
    harm = drift.expected.predict_harm(new.model.values - new.start.values)
    if harm <= MAX_HARM:
        return ""
    return (
        f"{drift.warnings[0]}. The updated model would be worse than the last one with a "
        f"probability of {format_percent(harm)}"
    )


def _describe_misfit(new: FitResult, drift: Recheck) -> str:
    """Say that no change of robot and device explains the samples to within their noise, so that
    the evidence of a drift proves nothing; empty if one does."""
    usual = drift.expected.hypotheses.test.variance if drift.expected else 1.0
    chi2 = new.estimate.chi2_per_dof
    if chi2 <= usual * chi2_band(new.estimate.dof)[1]:
        return ""
    return (
        f"but no change explains the samples (chi2/dof is {chi2:.3g}), so a sample is wrong, or an "
        "effect is missing; "
    )


def _describe_fall(rises: bool, falls: bool, clearly: bool) -> str:
    """Say how an error at held-out poses changes."""
    if rises:
        return "rises"
    if not falls:
        return "does not fall"
    return "falls" if clearly else "falls by no more than its own uncertainty"


def _advise(new: FitResult) -> str:
    """Say what samples that contradict all others, or the earlier fits of the given model, mean for
    a comparison with it, and what to do."""
    if new.outliers is not None:
        return f". S{new.outliers.description[1:]}"
    given = new.given
    if given.fits_of_these_samples:
        return f"; {IN_SAMPLE}"
    earlier = dict.fromkeys(str(entry["dataset"].get("source")) for entry in given.earlier_fits)
    if not earlier:
        return RIGHT_GEOMETRY
    sources = ", ".join(earlier)
    if given.known_samples.any():
        return (
            f"; the given model was identified from {sources} before, and for the error at "
            "held-out poses it was identified again from its recordings without these poses"
        )
    frames = ", and only its frames were fitted to these samples" if given.is_registered else ""
    return (
        f"; the given model was identified from {sources}{frames}: keep it, or fit all recordings "
        "together"
    )


def _describe_imitation(new: FitResult, old: FitResult | None) -> str:
    """Say that no such robot has the geometry of a model, and what to do; empty if one may."""
    if not new.implausible:
        return ""
    if new.outliers is not None:
        return f"{new.outliers.description}. With all samples, {new.implausible}"
    return f"{new.implausible}{IMITATES}" if old is None else new.implausible


def _describe_foreign_model(new: FitResult, now: Summary) -> tuple[str, str]:
    """Say that a model explains hardly any of the measured motion, and what to check; empty if it
    explains some."""
    seen = new.dataset.measured[:, :3].all(axis=1)
    if now.position_rms is None or not seen.any():
        sliding = [unit == "m" for unit in new.model.mechanism.joint_units]
        joints = float(np.std(new.dataset.q[:, sliding])) if any(sliding) else 0.0
        if not now.reading_rms or not now.reading_rms > MAX_READING_SHARE * joints > 0:
            return "", ""
        why = f"; the joints themselves move by {1e3 * joints:.4g} mm (rms), so their readings do "
        return f"{why}not belong to these sensors: {CHECK_JOINTS}", CHECK_JOINTS
    motion = float(np.sqrt(np.var(new.dataset.r[seen], axis=0).sum()))
    only_turns = min(new.model.mechanism.moved) >= 3  # then positions scatter by noise alone
    if only_turns or now.position_rms < FOREIGN_SHARE * motion:
        return "", ""
    why = f"; the measured positions themselves scatter by {1e3 * motion:.4g} mm (rms), so the "
    why += "model describes another machine, or the readings are converted wrongly: "
    return f"{why}{CHECK_MACHINE}", CHECK_MACHINE


def _find_risen_parts(
    new: FitResult, before: Errors, after: Errors, known: np.ndarray, rise: float
) -> dict[str, float]:
    """Return `position` or `orientation` with its ratio if that error rises: by the share `rise`,
    or else by more than a hundredth, its own uncertainty and the noise."""
    parts, found = ("position", "orientation"), dict[str, float]()
    pairs = zip(parts, _squared_parts(new, before), _squared_parts(new, after), strict=True)
    for kind, was, now in pairs:
        seen = known & np.isfinite(was + now)
        change = np.bincount(blocks(new.dataset)[seen], (now - was)[seen])
        ratio = float(np.sqrt(now[seen].sum() / was[seen].sum()))
        # Noise is no larger than the error before, whatever is stated: a unit may be wrong.
        noise = min(NOISE_OF_THREE_AXES, float(np.mean(was[seen])))
        exceeds_noise = float(np.mean((now - was)[seen])) > noise
        clearly = exceeds_noise and change.mean() > change.std() / np.sqrt(len(change))
        if ratio >= 1 + (rise or MAX_NEGLIGIBLE_ERROR_RISE) and (rise or clearly):
            found[kind] = ratio
    return found


def _squared(result: FitResult, found: Errors) -> np.ndarray:
    """Squared error (N,) of the pixels of an image; else of the pose in units of the device's
    noise; if no pose was measured, of the readings of sensors, or of the joints."""
    seen = np.isfinite(found.pixel).any(axis=1)
    if seen.any():
        return np.where(seen, np.nansum(found.pixel**2, axis=1), np.nan)
    parts = _squared_parts(result, found)
    if np.isfinite(parts).any():
        return np.where(np.isnan(parts).all(axis=0), np.nan, np.nansum(parts, axis=0))
    read = np.isfinite(found.reading).any(axis=1)
    if read.any():
        return np.where(read, np.nansum(found.reading**2, axis=1), np.nan)
    return np.asarray(np.sum(found.joint**2, axis=1))


def _squared_parts(result: FitResult, found: Errors) -> list[np.ndarray]:
    """Squared errors (N,) of position and of orientation in units of the device's noise."""
    n = len(result.model.joints)
    variance = np.diagonal(result.observations.S, axis1=1, axis2=2)
    return [
        np.sum(e**2, axis=1) / np.mean(variance[:, at], axis=1)
        for e, at in ((found.position, slice(n, n + 3)), (found.orientation, slice(n + 3, n + 6)))
    ]


def format_errors(after: Summary, before: Summary | None = None) -> str:
    """Format rms errors, `before` to `after`; equal figures are not written as a fall."""
    parts = []
    for kind, (unit, factor) in ERROR_UNITS.items():
        now, then = after.rms(kind), before.rms(kind) if before else None
        if now is None:
            continue
        shown, was = _digits(now * factor), "" if then is None else _digits(then * factor)
        if was == shown:
            parts.append(f"{shown} {unit} before and after")
        else:
            parts.append(f"{was and f'from {was} to '}{shown} {unit}")
    return ", ".join(parts) or "not known"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
