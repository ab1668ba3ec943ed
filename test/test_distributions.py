"""Tails of distributions and the minimum of a function, compared with those of SciPy."""

import numpy as np
import pytest
from scipy import special, stats
from scipy.optimize import minimize_scalar

from parallel_cal.base.distributions import (
    chi2_below,
    chi2_tail,
    f_log_tail,
    f_quantile,
    minimise_between,
)

F = np.concatenate([[0.0], np.geomspace(1e-6, 1e4, 60)])


@pytest.mark.parametrize("q", [1, 2, 3, 12, 60])
@pytest.mark.parametrize("dof", [1, 7, 30, 500, 20_000, 300_000])
def test_the_tail_of_f_is_that_of_scipy(q, dof):
    tail = special.betainc(dof / 2, q / 2, dof / (dof + q * F))
    below = special.betainc(q / 2, dof / 2, q * F / (dof + q * F))
    seen = tail > 1e-280
    # Each where it is exact: a tail near 1 has lost the digits of its distance from 1.
    expected = np.where(
        tail > 0.5, np.log1p(-np.minimum(below, 0.6)), np.log(np.maximum(tail, 1e-300))
    )
    many = f_log_tail(F, q, dof)
    single = [f_log_tail(one, q, dof) for one in F]
    np.testing.assert_allclose(many, single, rtol=1e-11)
    np.testing.assert_allclose(many[seen], expected[seen], rtol=1e-9)
    assert np.isfinite(many).all()
    assert (np.diff(many) <= 0).all()


def test_the_tail_of_f_has_a_closed_form_for_two_degrees_of_freedom():
    for dof in (3, 100, 4000):
        for value in (0.1, 60.0, 1e6):
            expected = -dof / 2 * np.log1p(2 * value / dof)
            assert f_log_tail(value, 2, dof) == pytest.approx(expected, rel=1e-12)


def test_an_f_of_any_size_has_a_tail():
    assert f_log_tail(0.0, 3, 50) == 0.0
    assert f_log_tail(np.inf, 3, 50) == -np.inf
    np.testing.assert_array_equal(f_log_tail(np.array([0.0, np.inf]), 3, 50), [0.0, -np.inf])
    assert np.isfinite(f_log_tail(1e290, 3, 50))


@pytest.mark.parametrize(("q", "dof"), [(1, 4), (3, 60), (250, 31), (5000, 200)])
def test_a_quantile_of_f_is_that_of_scipy(q, dof):
    for share in (0.005, 0.5, 0.995):
        expected = special.fdtri(q, dof, share)
        assert f_quantile(q, dof, share) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 80, 1000, 50_000])
def test_both_tails_of_chi_squared_are_those_of_scipy(dof):
    x = np.concatenate([[0.0], stats.chi2.ppf(np.linspace(0.001, 0.999, 40), dof), [9 * dof + 90]])
    np.testing.assert_allclose(chi2_tail(dof, x), special.chdtrc(dof, x), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(chi2_below(dof, x), special.chdtr(dof, x), rtol=1e-9, atol=1e-15)
    assert chi2_tail(dof, x[5]) == pytest.approx(special.chdtrc(dof, x[5]), rel=1e-9)
    assert chi2_tail(dof, np.inf) == 0.0
    assert np.isnan(chi2_tail(dof, np.nan))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x - 0.3) ** 2,
        lambda x: np.cos(5 * x) + 0.1 * x,
        lambda x: abs(x - 0.71),
        lambda x: x,
        lambda x: -x,
        lambda x: 1.0,
        lambda x: (x + 0.2) ** 4 - x,
    ],
)
def test_a_minimum_is_found_in_the_same_place_by_the_same_evaluations_as_by_scipy(function):
    seen = []

    def watched(x):
        seen.append(x)
        return function(x)

    found = minimise_between(watched, -1.0, 2.0, 1e-4)
    ours = seen.copy()
    seen.clear()
    how = {"xatol": 1e-4}
    expected = minimize_scalar(watched, bounds=(-1.0, 2.0), method="bounded", options=how)
    np.testing.assert_allclose(ours, seen, rtol=0, atol=1e-8)
    assert found == pytest.approx(expected.x, abs=1e-8)
