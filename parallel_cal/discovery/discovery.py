"""Discover the law of an error that no effect of the catalogue describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import with_changes
from parallel_cal.base.parallel import Runner, run_on_cores
from parallel_cal.base.progress import Progress, ignore_progress, never_falling
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.columns import check_fitted, naming_wrong_columns
from parallel_cal.diagnosis.diagnose import find_mistrusted_samples
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.stations import DeviceField, find_stations
from parallel_cal.discovery.drivers import (
    Driver,
    list_drivers,
    list_shown_positions,
    name_lags,
    select_for_screening,
)
from parallel_cal.discovery.law import Discovery, Law
from parallel_cal.discovery.names import describe_law
from parallel_cal.discovery.places import (
    list_places,
    list_sites,
)
from parallel_cal.discovery.proof import Proof, prove_all
from parallel_cal.discovery.screening import Screening, Targets
from parallel_cal.discovery.search import Search, Winner, find_thresholds, find_winners
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.thresholds import ENOUGH_SAMPLES, MAX_HELD_ERROR_RATIO
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model
from parallel_cal.model.words import join_words
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions

if TYPE_CHECKING:
    from typing_extensions import Unpack


# Families of drivers whose values a person cannot choose for a pose at rest.
NOT_CHOSEN = ("time", "session", "velocity", "acceleration", "settling")
A_STATION = (
    "a second station: measure the same poses with the device moved and turned, about an axis that "
    "the error does not surround, and give all recordings; an error of the device goes with it"
)
MAX_SHOWN_PARAMETERS = 6  # of a law in its sentence; the table has all


@check_arguments(FitError)
@single_threaded()
def discover(
    model: Model,
    dataset: Dataset,
    *,
    options: FitOptions | None = None,
    progress: Progress | None = None,
    run: Runner = run_on_cores,
    **changes: Unpack[FitKeywords],
) -> Discovery:
    """Find the law of an error that no effect of the catalogue describes.

    The free parameters are identified first. Then each place where an error can enter (each joint,
    each parameter of the mechanism, the platform's pose, the device) is tested with each quantity
    that the error may depend on. No formula is assumed, and the part of the error that geometric
    parameters could imitate is removed first. The best combinations get a formula. A law must
    explain more than the same search finds in simulated sessions with the same noise and no law. It
    must also pass the checks of `add`.

    Parameters
    ----------
    model : Model
    dataset : Dataset
    options : FitOptions, optional
        Options of the identification as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1), which never falls. An
        exception that it raises cancels the search.
    run : callable, optional
        Runs the parts of the search: on all cores of this machine by default, on a Dask cluster
        with `fleet.cluster.run_on_cluster`. The result does not depend on it.
    **changes
        Single options by name, as in `fit`.

    Returns
    -------
    Discovery
        `verdict` is `described`, `robot_or_device`, `suspected` or `nothing`; `laws` are the proven
        laws; `write(path)` writes them as effects that `add` takes.

    Raises
    ------
    FitError
        If the free parameters cannot be identified, or take all equations of the samples.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> pc.discover(model, data).laws[0].drivers
    ('direction',)
    """
    report = never_falling(progress or ignore_progress)
    options = with_changes(options, FitOptions, changes, FitError)
    report("identifying the geometry", 0.0)
    dataset = add_lagged_conditions(name_lags(dataset), dataset)
    base, dataset, options = _identify_geometry(model, dataset, options)
    scene, given = _make_scene(base, dataset)
    if scene.dof < 1:
        raise FitError(
            f"{dataset.source or 'the dataset'}: {len(dataset)} samples determine the free "
            "parameters and leave no equation that could show a law: measure more poses (plan "
            "proposes them), or fix parameters"
        )
    drivers = list_drivers(scene)
    stations = find_stations(scene, given)
    places = list_places(scene, stations)
    device, shown = None, list[Driver]()
    if stations is not None:
        seen = stations.show(scene.seen[:, len(model.joints) :][:, :3])
        device = DeviceField(scene, stations)
        shown = list_shown_positions(seen)
        drivers = [one for one in drivers if one.family != "session"]  # stations change with it
    screening = Screening(scene, list_sites(places), [*select_for_screening(drivers), *shown])
    search = Search(scene, screening, drivers, device, run, report)
    winners = find_winners(search)
    thresholds = find_thresholds(search, winners)
    real = [
        (one, threshold)
        for one, threshold in zip(winners, thresholds, strict=True)
        if one.evidence > threshold
    ]
    nothing = np.zeros((len(scene.residual), 0))
    left = Targets.of(scene, scene.residual[:, None], nothing)
    proofs = [Proof(base.model, base, nothing, left, [], [])]
    for k, (winner, threshold) in enumerate(real):
        report("testing a law at held-out poses", 0.8 + 0.2 * k / len(real))
        prove = partial(prove_all, proofs[-1], dataset=dataset, options=options, scene=scene)
        proof = prove(winner.list_laws(threshold), run=run)
        if winner.alone is not None and any(law.against for law in proof.laws):
            # Without a part that was refused, the law that the parts replaced may be the better.
            alone = prove([(winner.alone, threshold)], run=run)
            proof = min(proof, alone, key=lambda one: one.left.chi2_per_dof)
        proofs.append(proof)
    found = [law for one in proofs for law in one.laws]
    advice = [_advise(scene, winner, drivers) for one in proofs for winner in one.winners]
    held, current = Field.of(scene).held, proofs[-1].model
    return _conclude(model, dataset, found, [words for words in advice if words], current, held)


def _identify_geometry(
    model: Model, dataset: Dataset, options: FitOptions
) -> tuple[FitResult, Dataset, FitOptions]:
    """The fit of the samples, with these and its options: those that a robust loss mistrusts are
    excluded from them."""
    with naming_wrong_columns(model, dataset, options):
        base = fit(model, dataset, options)
    check_fitted(base, model, dataset, options)
    if options.loss != "linear":
        dataset = dataset.excluding(find_mistrusted_samples(base), f"by --loss {options.loss}")
        options = replace(options, loss="linear")
        base = fit(model, dataset, options)
    return base, dataset, options


def _make_scene(base: FitResult, given: Dataset) -> tuple[Scene, Dataset]:
    """The residuals to screen, of all samples or of evenly chosen ones of very many, and these
    samples as they were given: before a fit moved them into one frame of the device."""
    n = len(base.dataset)
    some = np.unique(np.linspace(0, n - 1, min(n, ENOUGH_SAMPLES)).astype(int))
    scene = Scene.of(
        base.model,
        base.dataset.select(some),
        base.observations.select(some),
        base.free,
        within=base.prior,
    )
    return scene, given.select(some)


def _conclude(
    model: Model,
    dataset: Dataset,
    found: Sequence[Law],
    advice: Sequence[str],
    described: Model,
    held: float,
) -> Discovery:
    """The verdict, its sentence, and what to measure next. `held` is by how many sigmas coordinates
    vary that the model holds at one value."""
    laws = tuple(law for law in found if not law.against)
    suspected = tuple(law for law in found if law.against)
    if laws:
        verdict = "described"
    elif any(law.device_may_err for law in suspected):
        verdict = "robot_or_device"
    else:
        verdict = "suspected" if suspected else "nothing"
    words = [_describe_proof(law) for law in laws]
    words += [f"{law.sentence}, but this is not proven: {law.against}." for law in suspected]
    if not words:
        words = [
            "no place and no driver explain more than in sessions with the same noise and without "
            "a law"
        ]
    summary = " ".join(words)
    if any(law.device_may_err for law in suspected):
        advice = [*advice, A_STATION]
    needs_larger_model = held > MAX_HELD_ERROR_RATIO
    if needs_larger_model:
        summary = f"{_explain_larger_model(model, held)} {summary}"
    return Discovery(
        model,
        dataset,
        laws,
        suspected,
        verdict,
        summary,
        tuple(advice),
        described,
        needs_larger_model,
    )


def _explain_larger_model(model: Model, held: float) -> str:
    """Say that a model is too small for what was measured, and which one to use instead."""
    mechanism, larger = model.mechanism, "a larger model"
    if type(mechanism).widen is not Mechanism.widen:
        name, _ = mechanism.widen(mechanism.parameters.mapping(mechanism.parameters.nominal))
        larger = f"the larger model {name}"
    return (
        "The measured pose includes coordinates that the model holds at one value; they vary by "
        f"{held:.0f} sigmas: use {larger} first."
    )


def _describe_proof(law: Law) -> str:
    """The sentence about a proven law."""
    numbers = [
        f"{c.name} {c.value:.3g}{f' +- {c.sigma:.2g}' if c.sigma else ''} {c.unit}"
        for c in law.parameters[:MAX_SHOWN_PARAMETERS]
    ]
    rest = len(law.parameters) - len(numbers)
    terms = ", ".join(numbers) + (f" and {rest} more" if rest else "")
    share = ""
    if law.share is not None:
        share = f" It accounts for {100 * law.share:.0f} % of the error above the noise floor."
    spans = ", ".join(f"{n} {low:.3g} to {high:.3g}" for n, (low, high) in law.tested.items())
    floor = f"; noise floor {format_errors(law.noise_floor)}" if law.noise_floor.is_known else ""
    other = f" Equally good: {', '.join(law.alternatives)}." if law.alternatives else ""
    # Each fold identifies the coefficients again, but not the form of the law and its constants.
    chosen = ["form", *(c.name for c in law.parameters if c.scanned)]
    verb = "was" if len(chosen) == 1 else "were"
    return (
        f"{law.sentence}: {law.formula} ({terms}).{share} Error at held-out poses "
        f"{format_errors(law.after, law.before)}{floor}; {join_words(chosen)} {verb} chosen with "
        f"these poses: residuals there fall to {100 * law.choice.ratio:.1f} %, and to "
        f"{100 * law.choice.ratio_anew:.1f} % if chosen without them. Tested at {spans}.{other}"
    )


def _advise(scene: Scene, winner: Winner, drivers: Sequence[Driver]) -> str:
    """Say which poses tell a law from an equally good one: those that resemble the samples at which
    the two differ most. Empty if there is no other."""
    if not winner.equal:
        return ""
    own, other = (
        scene.project_off_geometry(one.columns) @ one.coefficients.ravel()
        for one in (winner.formula, winner.equal[0])
    )
    apart = np.linalg.norm(scene.by_sample(own - other), axis=1)
    far = np.argsort(-apart)[: max(len(apart) // 10, 3)]
    laws = (describe_law(one.hypothesis) for one in (winner.formula, winner.equal[0]))
    quoted = " and ".join(f"'{law}'" for law in laws)
    equal = f"two laws fit equally well, {quoted}"
    sigmas = float(np.linalg.norm(apart))
    if sigmas < 1.0:
        return (
            f"{equal}: at these samples they predict the same errors (to {sigmas:.1f} sigmas), so "
            "that more poses like these do not decide between them"
        )
    shifts = [
        (float(np.mean(one.values[far]) - np.mean(one.values)) / float(np.std(one.values)), one)
        for one in drivers
        if one.family not in NOT_CHOSEN and np.std(one.values) > 0
    ]
    shifts.sort(key=lambda item: -abs(item[0]))
    where = [f"{'large' if shift > 0 else 'small'} {one.name}" for shift, one in shifts[:2]]
    return (
        f"{equal}: to decide between them, measure more poses with {' and '.join(where)}, where "
        f"they differ most (at these samples by {sigmas:.1f} sigmas)"
    )
