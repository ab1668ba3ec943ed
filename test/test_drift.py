"""Noise that drifts is told from effects that change slowly by their likelihoods."""

import numpy as np
import pytest
import virtual_blind as vb
import virtual_findings as vf
from findings import dataset, sized

from bench import new_effects as ne
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.drift import ErrorSeries, compute_drift_log_likelihood
from parallel_cal.diagnosis.thresholds import DRIFT_MEMORIES, DRIFT_VARIANCES
from parallel_cal.model.model import new_model

TIME = np.cumsum(np.random.default_rng(0).uniform(9, 12, 120))


def session(error, columns):
    sigma = np.full((len(TIME), 1), 2e-6)
    return ErrorSeries(error[:, None], sigma, columns[:, None, :], TIME)


def gain_of_a_steady_drift(error):
    """How much likelier the errors become with a slope, next to an unknown mean."""
    mean = np.ones((len(TIME), 1))
    slope = np.column_stack([mean, TIME / TIME[-1]])
    return compute_drift_log_likelihood(session(error, slope)) - compute_drift_log_likelihood(
        session(error, mean)
    )


def test_the_filter_finds_the_likelihood_of_the_dense_covariance():
    """Without free parameters, against the determinant and inverse of the whole matrix."""
    rng = np.random.default_rng(1)
    error = 2e-6 * (rng.standard_normal(len(TIME)) + np.cumsum(rng.standard_normal(len(TIME))) / 3)
    step = np.median(np.diff(TIME))

    def dense(memory, variance):
        apart = np.abs(TIME[:, None] - TIME)
        C = np.eye(len(TIME)) + variance * np.exp(-apart / (step * memory))
        squares = error @ np.linalg.solve(C, error) / len(TIME)
        return -len(TIME) / 2 * np.log(squares) - np.linalg.slogdet(C)[1] / 2

    expected = max(dense(m, v) for m in DRIFT_MEMORIES for v in (0.0, *DRIFT_VARIANCES))
    found = compute_drift_log_likelihood(session(error, np.zeros((len(TIME), 0))))
    assert found == pytest.approx(expected, rel=1e-9)


def test_a_slope_in_white_noise_exceeds_drift_and_a_walk_does_not():
    slopes, walks = [], []
    for seed in range(8):
        rng = np.random.default_rng([seed, 2])
        white = 2e-6 * rng.standard_normal(len(TIME))
        slopes.append(gain_of_a_steady_drift(white + 9e-6 * TIME / TIME[-1]))
        walk = np.cumsum(rng.standard_normal(len(TIME)))
        walks.append(gain_of_a_steady_drift(white + 1e-6 * walk))
    assert min(slopes) > 7
    assert max(walks) < 5


def test_what_was_not_measured_says_nothing():
    error = np.random.default_rng(3).standard_normal(len(TIME)) * 2e-6
    half = np.where(np.arange(len(TIME)) % 2, error, 0.0)
    nothing = np.zeros((len(TIME), 0))
    whole, some = (compute_drift_log_likelihood(session(e, nothing)) for e in (error, half))
    assert some == pytest.approx(whole / 2, rel=0.05)


def wandering(seed, size=7e-6, effects=()):
    """150 samples of a device that walks at random, next to effects of the robot."""
    day = vf.session(seed)
    seen = vf.samples(day, [vb.Wander(size, seed), *effects], vf.FINE, seed)
    return dataset(seen, vf.FINE)


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(20, 23))
def test_a_device_that_walks_at_random_is_not_learned(seed):
    found = diagnose(new_model("delta54"), wandering(seed))
    assert not found.effects
    assert "the noise is correlated over" in found.verdict.summary
    drift = next(e for e in found.entries if e.name == "base_drift")
    assert "indistinguishable from drift" in drift.reason


@pytest.mark.wide
def test_backlash_is_named_beside_a_device_that_walks_at_random():
    play = vf.KINDS["backlash"].make(0.3e-3, np.random.default_rng(4))
    found = diagnose(new_model("delta54"), wandering(24, effects=[play]))
    assert found.effects == ("backlash",)


@pytest.mark.wide
@pytest.mark.parametrize("kind", ["base drift", "thermal growth"])
def test_a_true_drift_is_named_in_white_noise(kind):
    day, one = vf.session(25), vf.KINDS[kind]
    hidden = sized(one.make, one.size, 0.4, day, one.noise, 25)
    found = diagnose(
        new_model("delta54"), dataset(vf.samples(day, [hidden], one.noise, 25), one.noise)
    )
    assert set(found.effects) <= set(one.names)
    assert found.effects


@pytest.mark.wide
def test_a_verdict_says_which_effect_explains_no_more_than_drift_and_what_tells_them():
    """Lines that creep by one sigma, in a session of five hours without a pose again at its end."""
    robot, creep = ne.ROBOTS["four lines"], ne.sized(ne.ROBOTS["four lines"], ne.KINDS["creep"], 6)
    found = diagnose(robot.model(), robot.measured([creep], 6))
    assert found.verdict.word == "unexplained"
    assert found.verdict.like_drift == ("line_creep",)
    assert "again and again over several hours" in found.verdict.summary
