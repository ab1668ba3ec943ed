"""Populations from what robots tell: against hand-worked numbers and drawn fleets."""

import numpy as np
import pytest
from scipy.stats import f

from parallel_cal.fleet.drift import trend
from parallel_cal.fleet.population import population, separate_outliers
from parallel_cal.identification.evidence import Evidence

NAMES = ("a", "b", "c")


def told(estimate, covariance):
    A = np.linalg.inv(np.atleast_2d(covariance))
    return Evidence(NAMES[: len(A)], np.zeros(len(A)), A, A @ np.atleast_1d(estimate))


def fleet(n, seed, mean, spread, skewed=True):
    """n robots, each seen with a covariance of its own; of some only one combination is seen."""
    rng, k = np.random.default_rng(seed), len(mean)
    truths, robots = [], []
    for i in range(n):
        root = rng.standard_normal((k, k)) * 0.5 + np.eye(k) * 0.3
        truths.append(mean + spread * rng.standard_normal(k))
        covariance = root @ root.T
        one = told(truths[-1] + root @ rng.standard_normal(k), covariance)
        if skewed and i % 4 == 0:
            d = rng.standard_normal(k)
            d /= np.linalg.norm(d)
            seen = d @ truths[-1] + 0.2 * rng.standard_normal()
            one = Evidence(one.names, one.centre, np.outer(d, d) / 0.04, d * seen / 0.04)
        robots.append(one)
    return robots


def test_of_equally_known_robots_mean_and_spread_are_those_of_the_estimates():
    """Worked by hand: 1, 2, 3, 6 +- 1 have mean 3 and variance 14/3, of which 1 is noise."""
    found = population([told(x, 1.0) for x in (1.0, 2.0, 3.0, 6.0)])
    assert found.mean == pytest.approx([3.0], rel=0.02)  # the drawing says 0 +- 10
    assert found.spread**2 == pytest.approx([14 / 3 - 1], rel=0.02)
    assert found.sigma == pytest.approx([np.sqrt(14 / 3 / 4)], rel=0.02)
    assert found.low[0] < found.spread[0] < found.high[0]


def test_robots_that_differ_by_their_noise_alone_have_no_spread():
    found = population([told(x, 1.0) for x in (2.5, 3.0, 3.2, 2.9)])
    assert found.spread[0] < 0.01
    assert found.low[0] == 0.0
    assert 0.3 < found.high[0] < 2.5


def test_a_direction_without_data_has_unknown_uncertainty():
    d = np.array([1.0, 1.0]) / np.sqrt(2)
    found = population([Evidence(NAMES[:2], np.zeros(2), np.outer(d, d), d * x) for x in range(6)])
    sigma = np.sqrt([d @ found.covariance @ d, 1.0])
    across = np.array([1.0, -1.0]) / np.sqrt(2)
    assert np.sqrt(across @ found.covariance @ across) == pytest.approx(10.0, rel=0.01)
    assert sigma[0] < 1.0


@pytest.mark.wide
def test_intervals_hold_what_was_drawn():
    """Of 600 spreads 95 % should lie inside, of 600 means, whose sigmas do not know how uncertain
    the spreads are, a little fewer."""
    mean, spread = np.array([0.5, -1.0, 0.0]), np.array([0.4, 0.8, 0.2])
    inside = []
    for k in range(200):
        found = population(fleet(40, [k % 5, k // 5], mean, spread))
        held = (found.low < spread) & (spread < found.high)
        inside.append([held, np.abs(found.mean - mean) < 1.96 * found.sigma])
    spreads, means = np.mean(inside, axis=(0, 2))
    assert 0.92 < spreads < 0.98
    assert 0.88 < means < 0.97


def test_two_faulty_robots_are_named_with_their_parameter_and_do_not_widen_the_spread():
    mean, spread = np.array([0.5, -1.0, 0.0]), np.array([0.4, 0.8, 0.2])
    robots = fleet(24, 3, mean, spread)
    for i, shift in ((5, [0.0, 0.0, 6.0]), (17, [-8.0, 0.0, 0.0])):
        one = robots[i]
        robots[i] = Evidence(
            one.names, one.centre, one.information, one.pull + one.information @ np.array(shift)
        )
    found = separate_outliers(robots, 0.01)
    assert sorted(found.outlying) == [5, 17]
    assert [found.outlying[i][0].parameter for i in (5, 17)] == [2, 0]
    assert found.outlying[5][0].size == pytest.approx(6.0, abs=3 * found.outlying[5][0].sigma)
    assert np.all(found.population.spread < 2 * spread)


@pytest.mark.wide
def test_in_sound_fleets_hardly_a_robot_is_named():
    named = [
        len(separate_outliers(fleet(20, [9, k], np.zeros(3), np.full(3, 0.5)), 0.01).outlying)
        for k in range(20)
    ]
    assert sum(named) <= 2  # of 400 robots; 1 % of the fleets may name one


# ----------------------------------------------------------------------------- drift


def test_a_drift_is_named_with_its_rate():
    """b grows by 2 in 10 s, seen to 0.1 in each of five recordings."""
    rng = np.random.default_rng(0)
    times = np.arange(5) * 2.5
    told_ = [
        told(np.array([1.0, 0.2 * t, -1.0]) + 0.1 * rng.standard_normal(3), 0.01 * np.eye(3))
        for t in times
    ]
    found = trend(told_, list(times))
    assert found.parameter == 1
    assert found.rate == pytest.approx(0.2, abs=3 * found.sigma)
    # sqrt(0.01 / sum (t - mean)^2) = 0.1 / sqrt(62.5)
    assert 0.0126 <= found.sigma < 0.025
    assert found.p_value < 1e-6


def test_recordings_that_scatter_more_than_their_noise_enlarge_the_sigma_of_a_drift():
    """10 per second, and 3, -3, -3, 3 beside it, each +- 1: chi2 36 of 2 degrees of freedom."""
    off = (3.0, -3.0, -3.0, 3.0)
    found = trend([told(10.0 * k + s, 1.0) for k, s in enumerate(off)], range(4))
    assert found.rate == pytest.approx(10.0)
    assert found.sigma == pytest.approx((36 / 2 / 5) ** 0.5)  # sum of squared times: 5 s^2
    quiet = trend([told(10.0 * k, 1.0) for k in range(4)], range(4))
    assert quiet.sigma == pytest.approx(5**-0.5)


def test_a_drift_among_three_parameters_pays_for_all_of_them():
    drifting = [told([1.0 * k, 0.0, 0.0], np.eye(3)) for k in range(4)]
    found = trend(drifting, range(4))
    assert found.gain == pytest.approx(5.0)
    assert found.p_value == pytest.approx(3 * f.sf(5.0, 1, 3 * 3 - 1))


def test_what_differs_without_growing_is_no_drift():
    rng = np.random.default_rng(1)
    p_values = [
        trend([told(rng.standard_normal(3), 0.01 * np.eye(3)) for _ in range(4)], range(4)).p_value
        for _ in range(50)
    ]
    assert np.mean(np.array(p_values) < 0.01) <= 0.04
    assert trend([told(1.0, 1.0)] * 2, [0, 1]) is None
    assert trend([told(1.0, 1.0)] * 3, [5, 5, 5]) is None
