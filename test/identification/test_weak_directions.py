"""Where the data tell less than the tolerances do: tolerances stand in there, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_day as vd
from datasets import as_dataset, measured, quiet
from test_unmeasured import only
from virtual_setups import random_delta

from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.descent import minimise
from parallel_cal.identification.estimate import EstimationProblem
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.linearisation import System
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import ASSUMED, observe
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

ALL = new_model("delta54")


def sight(seed=0, **session):
    """A whole Delta, seen by a device that shows positions alone."""
    data = only("x y z", measured(seed, **session))
    return observe(ALL, data)


@pytest.mark.parametrize("seed", range(3))
def test_positions_alone_identify_the_whole_delta(seed):
    """Its platform's tilt is not seen: a dozen directions run off without a hold."""
    found = estimate(ALL, sight(seed), ~ALL.fixed, None)
    assert found.iterations < 20
    low, high = chi2_band(found.dof)
    assert low < found.chi2_per_dof < high
    away = (found.values - ALL.table.nominal) / ALL.table.tolerance
    assert np.abs(away).max() < 3
    elsewhere = compare(ALL.with_values(found.values), measured(7))
    assert elsewhere.errors.summary.position_rms < 1.3 * elsewhere.noise.position_rms


def test_it_is_reported_in_one_line_and_in_the_document():
    result = fit(ALL, only("x y z", measured(0)), hold_out=0)
    said = [w for w in result.warnings if w.startswith("these samples hardly determine")]
    document = result.document()
    assert len(said) == 1
    assert f"{len(document['weak'])} combinations" in said[0]
    assert document["weak"][-1]["text"] in said[0]  # the weakest first
    for part in (
        "the tolerances decided",
        "not a result of the measurement",
        "measure more varied",
    ):
        assert part in said[0]
    assert document["priors"] == "weak"
    assert len(document["unidentifiable"]) == 1
    none = fit(new_model("delta24"), measured(0), hold_out=0)
    assert none.document()["weak"] == []
    assert not any("these samples hardly determine" in w for w in none.warnings)


def test_what_the_data_tell_comes_out_as_without_any_prior():
    """With a thousandth of the noise that is stated, everything is linear: tolerances a hundred
    times as wide leave the same numbers, to a twentieth of their scatter, along each direction
    that the data see better than the tolerances; along the others they run off."""
    draw = vd.dwell_samples(vr.Delta({**vr.TABLE_5_12}), seed=1, noise=quiet(1e-3))
    observations, free = observe(ALL, only("x y z", as_dataset(draw))), ~ALL.fixed
    found = estimate(ALL, observations, free, None)
    vague = Prior(ALL.table.names, ALL.table.nominal, np.diag((100 * ALL.table.tolerance) ** 2))
    without = estimate(ALL, observations, free, vague)
    seen, apart = found.spectrum, (found.values - without.values)[free]
    scatter = 1e-3 / seen.singular_values
    along = np.abs(seen.directions @ (apart / ALL.table.tolerance[free])) / scatter
    strong = seen.singular_values > 1
    assert strong.sum() == 30
    assert along[strong].max() < 0.05
    assert along[~strong].max() > 0.5


@pytest.mark.wide
def test_sigmas_are_the_spread_over_robots_and_noise():
    ratio, rng = [], np.random.default_rng(0)
    table, free = ALL.table, ~ALL.fixed
    with single_threaded():
        for seed in range(30):
            true = table.nominal + free * table.tolerance * rng.standard_normal(len(table))
            robot = vr.Delta({**vr.TABLE_5_12, **table.mapping(true)})
            found = estimate(ALL, sight(seed, robot=robot), free, None)
            known = free & np.isfinite(found.sigma)
            ratio.append(((found.values - true) / np.where(known, found.sigma, np.inf))[known])
    rms = np.sqrt(np.mean(np.concatenate(ratio) ** 2))
    assert 0.85 < rms < 1.15


def test_only_the_ratio_of_assumed_noise_counts_for_what_is_held():
    """Ten times the figures that nobody measured: the same estimates."""
    seen = sight(2)
    assumed = replace(seen, noise_from={"joint": ASSUMED, "pose": ASSUMED})
    loud = replace(assumed, S=100 * assumed.S)
    one, ten = (estimate(ALL, o, ~ALL.fixed, None) for o in (assumed, loud))
    assert one.chi2_per_dof == pytest.approx(100 * ten.chi2_per_dof, rel=1e-3)
    assert np.abs((one.values - ten.values) / ALL.table.tolerance).max() < 1e-3
    assert len(one.spectrum.weak) == len(ten.spectrum.weak) > 5


def test_a_floor_that_is_rough_is_a_floor():
    """Rounding as rough as 1e-2 sigma always promises a little more: eight steps that gain nothing
    of chi2 = 1e4 are the end."""
    model = new_model("slider_crank")
    free = np.arange(len(model.table)) == 0
    tolerance, steps = model.table.tolerance[0], []

    def reach(values, before, step):
        away = (values[0] - model.table.nominal[0]) / tolerance
        steps.append(away)
        residual = np.array([[100.0, 50 * (away - 1) + 0.01 * (-1) ** len(steps)]])
        return System(residual, np.array([[[0.0], [50 / tolerance]]]), np.array([2]), np.copy)

    found = minimise(EstimationProblem(model, free), reach, "")
    assert found.iterations < 20
    assert (found.values[0] - model.table.nominal[0]) / tolerance == pytest.approx(1, abs=1e-3)


def update_of(n, seed, share=0.02):
    """A fit to few samples of an independent Delta whose dimensions are known to a share of their
    tolerances, which is the prior."""
    model, rng = new_model("delta24"), np.random.default_rng([seed, n])
    joint, tracker = 2e-5, 30e-6
    r = rng.uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (n, 3))
    data = Dataset.from_arrays(
        model.joints,
        random_delta(seed, share).inverse(r)[0] + rng.normal(0, joint, (n, 3)),
        r + rng.normal(0, tracker, (n, 3)),
        measured=[True] * 3 + [False] * 3,
        pose_cov=np.diag([tracker**2] * 3 + [1e6] * 3),
        joint_sigma=[joint] * 3,
    )
    known = Prior(
        model.table.names, model.table.nominal, np.diag((share * model.table.tolerance) ** 2)
    )
    return estimate(model, observe(model, data), ~model.fixed, known)


def mean_chi2(n, seeds):
    """Mean chi2 per degree of freedom, with its standard deviation."""
    found = [update_of(n, seed) for seed in range(seeds)]
    dof = sum(float(one.informative.sum()) - one.spectrum.taken for one in found)
    assert all(0 < one.dof <= 3 * n for one in found)
    return sum(one.chi2 for one in found) / dof, (2 / dof) ** 0.5


def test_a_prior_of_all_parameters_takes_only_the_degrees_of_freedom_that_it_does_not_hold():
    """Nine residuals of three samples beside 24 parameters: counted one by one, none remained."""
    mean, sigma = mean_chi2(3, 12)
    assert abs(mean - 1) < 3 * sigma < 0.6
    loose = update_of(3, 0, share=1.0)
    assert loose.spectrum.taken == pytest.approx(9, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 6, 12, 24])
def test_the_mean_of_chi2_per_degree_of_freedom_is_one_with_a_prior(n):
    mean, sigma = mean_chi2(n, 150)
    assert abs(mean - 1) < 3 * sigma < 0.15
