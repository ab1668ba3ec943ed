"""What a verdict judges: the fits of a search, what the best one leaves, and what lets doubt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import LackOfFit, lack_of_fit
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.diagnosis.noise_shape import NoiseShape
from parallel_cal.diagnosis.remaining import RemainingCondition, find_remaining_condition
from parallel_cal.diagnosis.search import Trial, ratio_of
from parallel_cal.diagnosis.thresholds import (
    CREDIBLE,
    MAX_SWAP_ERROR_RATIO,
    MIN_FAMILY_MEMBERS,
)
from parallel_cal.diagnosis.unusual import UnusualEffect
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.scene import Scene


@dataclass(frozen=True)
class Remainder:
    """What a fit leaves: its residuals as a `field`, whether neighbouring ones are similar
    (`structure`), how they are spread in time and size (`shape`), the `noise` by which they are
    judged, and the recorded `condition` that they depend on."""

    field: Field
    structure: LackOfFit
    shape: NoiseShape
    noise: NoiseLevel
    condition: RemainingCondition | None

    @classmethod
    def of(cls, scene: Scene) -> Remainder:
        residual_field = Field.of(scene)
        structure = lack_of_fit(scene, residual_field)
        shape = NoiseShape.of(scene, residual_field)
        noise = NoiseLevel.of(scene, residual_field, structure.has_structure, shape.correlated)
        condition = find_remaining_condition(scene, shape)
        return cls(residual_field, structure, shape, noise, condition)


@dataclass(frozen=True)
class Doubts:
    """What keeps effects that were found from being the whole explanation.

    `swaps` lists by chosen effect those that fit as well. `refused` says why significant effects
    could not be identified. `robot_or_device` lists effects that an error of the device explains as
    well. `outdone` lists refused effects that would explain the error better than a chosen one,
    with the reason. `wrong_signs` says which significant effects fit only with a sign that physics
    forbids. `unusual` lists effects that are larger than usual. `ambiguous` are sentences about
    effects of the model that another effect would replace without loss. `unseparated` says that
    effects of the device move the robot further than the errors show. `like_drift` lists effects of
    time that explain no more than noise that drifts.
    """

    swaps: Mapping[str, Sequence[str]] = field(default_factory=dict)
    refused: Sequence[str] = ()
    robot_or_device: Sequence[str] = ()
    outdone: Sequence[str] = ()
    wrong_signs: Sequence[str] = ()
    unusual: tuple[UnusualEffect, ...] = ()
    ambiguous: tuple[str, ...] = ()
    unseparated: str = ""
    like_drift: tuple[str, ...] = ()


@dataclass(frozen=True)
class Findings:
    """What a verdict judges: a search that started at `base` and ended at `best`.

    `chi2_before` is chi2/dof of the base, on the rows of the best. `rest` is what the best leaves.
    `probability` is, for each effect found, that the robot has it, or one that may be in its place,
    and `laws` are those that no effect describes, with theirs.
    """

    base: Trial
    best: Trial
    chi2_before: float
    rest: Remainder
    doubts: Doubts
    probability: Mapping[str, float] = field(default_factory=dict)
    laws: Mapping[str, float] = field(default_factory=dict)

    @property
    def final_estimate(self) -> Estimate:
        return self.best.fitted.estimate

    @property
    def share(self) -> float | None:
        """Share of the variance above the noise floor that the chosen effects remove."""
        return share_explained(
            self.chi2_before, self.final_estimate.chi2_per_dof, self.rest.noise.variance
        )

    @property
    def names(self) -> str:
        """`backlash`, `A or B` or a family of lookalikes; several as `(A or B) and C`. Of an effect
        that the model has, a joint has another number: `A with another ratio of joint2`."""
        has = self.base.fitted.model.has_effect
        names = list[str]()
        for one in self.best.chosen:
            name = format_effect_names([one.name, *self.doubts.swaps.get(one.name, [])])
            for joint, _, number in (key.rpartition(".") for key in one.settings):
                name += f" with another {number} of {joint}" if has(one.name) else ""
            names.append(name)
        if len(names) == 1:
            return names[0]
        return " and ".join(f"({name})" if " or " in name else name for name in names)

    @property
    def high_before(self) -> float:
        """The largest chi2/dof that noise makes of the base, in 99 % of the cases."""
        return self.rest.noise.band(self.base.fitted.estimate.dof)[1]

    @property
    def high_after(self) -> float:
        """The largest chi2/dof that noise makes of the best, in 99 % of the cases."""
        return self.rest.noise.band(self.final_estimate.dof)[1]

    @property
    def leaves_more_than_noise(self) -> bool:
        """Whether the residuals of the best are too large for the noise, or have a structure that
        noise has not."""
        too_large = self.final_estimate.chi2_per_dof > self.high_after
        return too_large or self.rest.structure.has_structure or self.rest.condition is not None

    @property
    def sides_from_order(self) -> bool:
        """Whether the sides from which the joints came follow from the order of the samples."""
        return self.best.fitted.dataset.sides_from_order

    @property
    def has_sides(self) -> bool:
        """Whether the samples have the sides from which the joints came."""
        conditions = self.best.fitted.dataset.conditions
        return any(name.startswith("direction.") for name in conditions)

    @property
    def suspected_of_law(self) -> list[str]:
        """Effects found larger than usual, if they leave an error or another effect explains as
        much: then they may only imitate a law that is not in the catalogue."""
        unusual = {one.name for one in self.doubts.unusual}
        names = [c.name for c in self.best.chosen if c.name in unusual]
        doubtful = self.leaves_more_than_noise or any(self.doubts.swaps.get(name) for name in names)
        return names if doubtful else []

    @property
    def imitating(self) -> list[str]:
        """Effects found that are less likely than not, where a law outside the catalogue is."""
        return [name for name, p in self.probability.items() if p < 0.5] if self.laws else []

    @property
    def was_inside_band(self) -> bool:
        """Whether the base needed no effect: its chi2/dof was inside the band, and the effects
        found are either not sure or lower the validation error only a little."""
        inside = self.chi2_before <= self.high_before and not self.rest.noise.is_exceeded
        ratio = ratio_of(self.base, self.best)
        counts = ratio is None or ratio * MAX_SWAP_ERROR_RATIO < 1
        return bool(inside and not (self.is_sure and counts))

    @property
    def is_sure(self) -> bool:
        """Whether the robot has one of the effects found, or one that may be in its place."""
        return max(self.probability.values(), default=0.0) > CREDIBLE


def format_effect_names(names: Sequence[str]) -> str:
    """`A or B`; of three or more of a family `a smooth error of the joint's angle, e.g. A`."""
    family = load_effect(names[0]).family
    own = [name for name in names if family and load_effect(name).family == family]
    if len(own) < MIN_FAMILY_MEMBERS:
        return " or ".join(names)
    others = [name for name in names if name not in own]
    return " or ".join([f"{family}, e.g. {names[0]}", *others])


def share_explained(before: float, after: float, noise: float | None) -> float | None:
    """1 - (s_after^2 - sigma^2) / (s_before^2 - sigma^2), of chi2/dof; None without a noise
    figure, or if `before` is not above the noise."""
    if noise is None or before <= noise:
        return None
    return min(1.0, 1 - (after - noise) / (before - noise))
