"""Noise that is not white is recognised as such, and white noise is not."""

import numpy as np
import pytest

from parallel_cal.diagnosis.noise_shape import NoiseShape, noise_shape

N = 150


def drawn(seed):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((N, 6)), 10.0 * np.arange(N), rng.uniform(-0.06, 0.06, (N, 3))


@pytest.mark.parametrize(
    ("p", "inflation", "correlated"), [(1e-4, 2.0, True), (1e-4, 1.2, False), (0.5, 2.0, False)]
)
def test_a_correlation_must_be_certain_and_change_a_sigma_to_count(p, inflation, correlated):
    shape = NoiseShape(0.1, p, 30.0, 1.0, 1.0, inflation)
    assert shape.correlated is correlated
    assert bool(shape.remarks) is correlated


@pytest.mark.wide
def test_white_noise_has_no_shape_but_for_one_time_in_a_hundred():
    shapes = [noise_shape(*drawn(seed)) for seed in range(60)]
    assert sum(s.correlated for s in shapes) <= 3
    assert sum(s.grows_from_centre for s in shapes) <= 3
    assert np.mean([s.correlation for s in shapes]) == pytest.approx(0, abs=0.01)


def test_noise_of_which_nine_tenths_stay_is_correlated_over_ten_samples():
    memories = []
    for seed in range(10):
        white, time, places = drawn(seed)
        z = white.copy()
        for k in range(1, N):
            z[k] = 0.9 * z[k - 1] + np.sqrt(1 - 0.81) * white[k]
        shape = noise_shape(z, time, places)
        assert shape.correlated
        memories.append(shape.memory)
    # e^(-10 s / T) = 0.9 gives T = 95 s; means over 150 samples shorten it a little
    assert 50 < np.median(memories) < 110
    assert shape.remarks[0].startswith("the noise is correlated over")


def test_noise_three_times_larger_outside_is_reported():
    for seed in range(10):
        z, time, places = drawn(seed)
        away = np.linalg.norm(places, axis=1)
        shape = noise_shape(z * (1 + 2 * away / away.max())[:, None], time, places)
        assert shape.grows_from_centre
        assert not shape.correlated
        # the outer third lies about 0.85, the inner 0.4 of the way out: 2.7 / 1.8
        assert shape.growth == pytest.approx(1.5, abs=0.35)


def test_the_order_in_which_samples_are_given_does_not_matter():
    z, time, places = drawn(0)
    k = np.random.default_rng(1).permutation(N)
    one, other = noise_shape(z, time, places), noise_shape(z[k], time[k], places[k])
    assert one.correlation == pytest.approx(other.correlation)
    assert one.growth == pytest.approx(other.growth)


def test_too_few_samples_and_no_residuals_say_nothing():
    z, time, places = drawn(0)
    assert not noise_shape(z[:5], time[:5], places[:5]).remarks
    assert not noise_shape(0 * z, time, places).remarks
