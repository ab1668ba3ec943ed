"""Judge the laws of a search at held-out poses, as `add` judges an effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from parallel_cal.base.parallel import Runner
from parallel_cal.diagnosis.addition import find_addition
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.findings import share_explained
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.discovery.drivers import PLACES
from parallel_cal.discovery.effect_file import (
    list_coefficients,
    load_text,
    write_effect,
    write_formula,
)
from parallel_cal.discovery.folds import Choice, choose_in_folds
from parallel_cal.discovery.law import Law
from parallel_cal.discovery.names import (
    describe_data,
    describe_law,
    list_ranges,
    name_law,
    name_place,
)
from parallel_cal.discovery.places import DEVICE
from parallel_cal.discovery.screening import Targets
from parallel_cal.discovery.search import Winner
from parallel_cal.discovery.shape import find_shape
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import Step, step_of


@dataclass(frozen=True)
class Proof:
    """Laws that were judged one after the other: the model with those that were accepted, its fit,
    their columns (n, k) beside those of earlier laws, and what is left of the residual."""

    model: Model
    fit: FitResult
    columns: np.ndarray
    left: Targets
    laws: list[Law]
    winners: list[Winner]


def prove_all(
    before: Proof,
    winners: Sequence[tuple[Winner, float]],
    dataset: Dataset,
    options: FitOptions,
    scene: Scene,
    run: Runner,
) -> Proof:
    """Judge laws, each with its limit, beside those that were accepted before."""
    proof = replace(before, laws=[], winners=[winner for winner, _ in winners])
    for winner, threshold in winners:
        choice = choose_in_folds(proof.left, winner.formula, run)
        columns = np.hstack([proof.columns, winner.formula.columns])
        left = Targets.of(scene, scene.residual[:, None], columns)
        law, step = _prove(winner, threshold, choice, proof, left, dataset, options, scene)
        proof.laws.append(law)
        if law.against:
            continue
        # The next fit starts at the values of this one, in the frames that were placed for it.
        start = step.result.start.with_values(step.result.model.values)
        fit = replace(step.result, start=start)
        history = (*proof.model.history, step.model.history[-1])
        model = replace(step.model, history=history)
        proof = replace(proof, model=model, fit=fit, columns=columns, left=left)
    return proof


def _prove(
    winner: Winner,
    threshold: float,
    choice: Choice,
    proof: Proof,
    left: Targets,
    dataset: Dataset,
    options: FitOptions,
    scene: Scene,
) -> tuple[Law, Step]:
    """Judge a law as `add` judges an effect, and describe it with the refitted numbers; `left` is
    what it leaves of the residual."""
    formula = winner.formula
    hypothesis = formula.hypothesis
    sentence, tested = describe_law(hypothesis), list_ranges(hypothesis)
    where = describe_data(dataset, tested)
    name = load_text(write_effect(formula, sentence, where))
    # With the samples in which the law was found.
    find = partial(find_addition, proof.model, name, dataset, knocked=())
    found = find(options, known=(proof.fit, None))
    if found.result.implausible and proof.fit.prior is None:
        # Geometry imitates the law: known sizes decide how much.
        found = find(replace(options, prior=True))
    step = step_of(found, force=True)
    refitted = step.result.parameters()
    coefficients = []
    for c in list_coefficients(formula):
        p = refitted[f"{name}.{c.name}"]
        coefficients.append(replace(c, value=p.value, sigma=None if c.scanned else p.sigma))
    own = {c.name: (c.value, c.sigma) for c in coefficients}
    noise = NoiseLevel.of(scene, Field.of(scene), structured=True).variance
    rivals: dict[str, str] = {}
    for one in winner.equal:
        rival = write_effect(one, describe_law(one.hypothesis), where)
        rivals.setdefault(name_law(one.hypothesis), rival)
    of_device = hypothesis.site.kind == DEVICE
    against, device_may_err = _find_objection(winner, choice, step, name)
    law = Law(
        place=name_place(hypothesis),
        drivers=hypothesis.families,
        formula=write_formula(formula),
        unit=hypothesis.site.unit,
        parameters=tuple(coefficients),
        share=share_explained(proof.left.chi2_per_dof, left.chi2_per_dof, noise),
        before=step.acceptance.before,
        after=step.acceptance.after,
        noise_floor=step.result.noise_floor,
        tested=tested,
        alternatives=tuple(rivals),
        choice=choice,
        evidence=winner.evidence,
        threshold=threshold,
        against=against,
        device_may_err=device_may_err,
        of_device=of_device,
        sentence=sentence,
        text=write_effect(formula, sentence, where, values=own),
        shape=find_shape(scene, formula),
        rivals=rivals,
    )
    return law, step


def _find_objection(winner: Winner, choice: Choice, step: Step, name: str) -> tuple[str, bool]:
    """Return why a law is not proven, empty if it is, and whether the device may cause the error.

    `name` is that of its effect in the `step` that added it.
    """
    if against := step.acceptance.against:
        words = against.replace(f" with '{name}'", "").replace(name, "it")
        return words, step.acceptance.device_may_err
    against = _explain_device(winner)
    device_may_err = bool(against)
    if not against and not choice.is_clear:
        against = (
            "if its form and its constants are chosen without the held-out poses, the error there "
            "falls by no more than its own uncertainty"
        )
    return against, device_may_err


def _explain_device(winner: Winner) -> str:
    """Explain why the measuring device may cause the error of a law; empty if it may not.

    A law of the platform's position alone is a field over the workspace, as a device has it. For a
    law of the device, explain why the robot may cause the error."""
    if winner.formula.hypothesis.site.kind == DEVICE:
        if winner.rival is None:
            return ""
        return (
            "the robot may cause it as well as the measuring device: "
            f"{name_law(winner.rival)} explains nearly as much"
        )
    others = [one.hypothesis for one in winner.equal if one.hypothesis.site.kind == DEVICE]
    if others:
        return f"the measuring device may cause it: {name_law(others[0])} describes it as well"
    if winner.rival is not None:
        return f"the measuring device may cause it: {name_law(winner.rival)} explains more"
    drivers = winner.formula.hypothesis.families
    if set(drivers) <= set(PLACES) and not winner.excludes_device:
        return (
            f"the measuring device may cause it: it depends on {' and '.join(drivers)} alone, as "
            "an error of a device does"
        )
    return ""
