"""The short-cut set-up: a Delta identified from its own encoders (sections 4.2.7 and 5.4.5).

The platform is removed, and balls of two arms are joined by one of the robot's rods. This is an
RSSR loop with two encoders. `fit` identifies each loop; together they give model 54.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.fit import FitResult, fit, summarise_parameters
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.observability import Spectrum, directions_in_words, spectrum
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.short_cut.combining import closures, fit_combined
from parallel_cal.short_cut.loop import Loop, loop_dataset, loop_model, recorded_home
from parallel_cal.short_cut.unidentifiable import blind_spots


@dataclass(frozen=True)
class LoopResult:
    """The identification of one loop; `rank` of its nine parameters are identifiable."""

    loop: Loop
    fit: FitResult
    rank: int


@dataclass(frozen=True)
class Combination:
    """A Delta (model 54) with its covariance from loops.

    Directions that no loop determines keep nominal value and tolerance; `unseen` describes them.
    """

    model: Model
    loops: tuple[LoopResult, ...]
    chi2: float
    dof: int
    spectrum: Spectrum
    unseen: tuple[str, ...]

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / self.dof if self.dof > 0 else float("nan")

    def document(self) -> dict[str, Any]:
        """Return the JSON document of `parallel-cal short-cut`; SI units, None if unknown.

        A loop's errors before and after are those of the whole Delta's model: `orientation` is the
        error of the second arm's angle computed from the first, `joint` that of the first from the
        second.
        """
        sigma = np.sqrt(np.diag(np.asarray(self.model.covariance)))
        return {
            "loops": [self._loop(found) for found in self.loops],
            "parameters": to_json_value(summarise_parameters(self.model, sigma, self.model.fixed)),
            "chi2_per_dof": self.chi2_per_dof if self.dof > 0 else None,
            "chi2_band": list(chi2_band(self.dof)),
            "dof": self.dof,
            "rank": self.spectrum.rank,
            "free": int(np.sum(~self.model.fixed)),
            "unidentifiable": [{"text": what} for what in self.unseen],
            "weak": directions_in_words(self.spectrum.weak, self.model.table),
            "warnings": list(self.warnings),
        }

    def _loop(self, found: LoopResult) -> dict[str, Any]:
        fitted = found.fit.document()
        combined = loop_model(self.model, found.loop, found.fit.model.mechanism.home)
        keys = ("samples", "before", "parameters", "chi2_per_dof", "noise_from", "dataset")
        return {
            "loop": str(found.loop),
            "rank": found.rank,
            **{key: fitted[key] for key in keys},
            "after": errors(combined, found.fit.observations).document(),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings: what the loops do not determine, and whether they contradict each other."""
        words = [f"the loops cannot tell {what}" for what in self.unseen]
        low, high = chi2_band(self.dof)
        if self.dof > 0 and not low <= self.chi2_per_dof <= high:
            words.append(
                f"chi2/dof {self.chi2_per_dof:.2f} of all loops is outside {low:.2f}..{high:.2f}: "
                "they contradict each other (was an encoder set to zero in between?) or the noise "
                "is not the stated one"
            )
        return tuple(words)


@single_threaded()
def short_cut(
    robot: Model,
    recordings: Sequence[tuple[Loop, Dataset]],
    *,
    fix: Iterable[str] = (),
    joint_sigma: float | None = None,
    relinearise: bool = True,
) -> Combination:
    """Identify model 54 of a Delta (24 or 54) from recordings of its arms' readings in loops.

    `fix` are patterns of known parameters, such as the lengths of two measured rods (`chain1.Lb`,
    `chain1.dLb`): angles do not determine the size. FitError if an arm is in no loop or a loop
    cannot be identified.
    """
    name, extra = robot.mechanism.name, len(robot.effects) + len(robot.sensors)
    if name not in ("delta24", "delta54") or extra:
        raise FitError(
            f"the model is {name} with {extra} effects and sensors; expected delta24 or delta54 "
            "with neither: loops tell the geometry alone"
        )
    robot = robot.widen() if name == "delta24" else robot
    robot = replace(robot, fixed=robot.fixed | robot.table.matching(fix))
    missing = {0, 1, 2} - {arm for loop, _ in recordings for arm in loop.arms}
    if missing:
        names = ", ".join(str(arm + 1) for arm in sorted(missing))
        raise FitError(f"no loop holds arm {names}: record it tied to another arm")
    found = [identify(robot, loop, data, joint_sigma) for loop, data in recordings]
    return combine(robot, found, relinearise)


@single_threaded()
def identify(
    robot: Model,
    loop: Loop,
    dataset: Dataset,
    joint_sigma: float | None = None,
) -> LoopResult:
    """Identify one loop by the weighted implicit method.

    The Delta's tolerances are priors; the rod's length is fixed.
    """
    try:
        data = loop_dataset(robot, loop, dataset, joint_sigma)
        model = loop_model(robot, loop, recorded_home(data))
        result = fit(model, data, prior=True, hold_out=0)
        if result.implausible:
            raise FitError(f"its geometry is implausible: {result.implausible}")
    except FitError as error:
        raise FitError(f"loop {loop}: {error}") from None
    _, A = closures(result)(result.model.values)
    seen = spectrum(A, model.table, np.ones(A.shape[1], dtype=bool), prior=False)
    return LoopResult(loop, result, seen.rank)


@single_threaded()
def combine(robot: Model, loops: Sequence[LoopResult], relinearise: bool = True) -> Combination:
    """Combine all loops to one Delta; FitError if the result is implausible.

    covariance = (sum G^T A^T A G + T^-2)^-1, with A^T A the inverse of a loop's covariance,
    G = d g/dp and T the tolerances.
    """
    found = fit_combined(robot, [(k.loop, k.fit) for k in loops], relinearise)
    r, J, free = found.residual, found.jacobian, ~robot.fixed
    seen = spectrum(J, robot.table, free, prior=True)
    covariance = np.zeros((len(robot.table), len(robot.table)))
    covariance[np.ix_(free, free)] = seen.covariance
    model = robot.with_values(found.values, covariance)
    # Dimensions that are implausible together indicate wrongly named loops.
    sigma = np.sqrt(np.diag(np.asarray(model.covariance)))
    for p, value, own, fixed in zip(model.table, model.values, sigma, model.fixed, strict=True):
        low, high = p.plausible_range(own)
        if not (fixed or low <= value <= high):
            raise FitError(
                f"together the loops put {p.name} to {value:.6g} {p.unit} (plausible {low:.6g} to "
                f"{high:.6g}), though each is plausible alone: is a ball or rod named wrongly, or "
                "was an encoder set to zero in between?"
            )
    datasets = [k.fit.dataset for k in loops]
    step = {
        "step": "short-cut",
        "loops": [str(k.loop) for k in loops],
        "samples": sum(k.fit.samples for k in loops),
        "dataset": [{"source": d.source, "sha256": d.sha256} for d in datasets],
    }
    model = replace(model, history=(*robot.history, step))
    unseen = blind_spots([k.loop for k in loops], model, J)
    dof = round(len(r) - seen.taken)
    return Combination(model, tuple(loops), float(r @ r), dof, seen, unseen)
