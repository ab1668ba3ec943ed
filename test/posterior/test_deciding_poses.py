"""Measurements that decide between sets of causes: hand-worked numbers and a simulated mixture."""

import numpy as np
import pytest

from parallel_cal.posterior.decision import Rival, choose_deciding_poses, compute_entropy


def rival(p, mean, spread):
    """What a set of causes predicts of poses of one row each."""
    return Rival(p, np.array(mean, float)[:, None], np.array(spread, float)[:, None, :])


def test_the_bound_of_two_sets_with_known_predictions_is_that_worked_by_hand():
    # Unit noise, means 4 apart: B = 16/8 = 2, so I = -log((1 + exp(-2))/2) = 0.5662 nats.
    apart = [rival(0.5, [0.0], [[0.0]]), rival(0.5, [4.0], [[0.0]])]
    [pose], [entropy] = choose_deciding_poses(apart, 1, 0.0)
    assert (pose, entropy) == (0, pytest.approx(np.log(2) - 0.5662, abs=1e-4))
    # Both uncertain by a variance of 8 along the one coefficient: V = 9 and B = 16/72.
    vague = [rival(0.5, [0.0], [[8**0.5]]), rival(0.5, [4.0], [[8**0.5]])]
    expected = np.log(2) + np.log((1 + np.exp(-16 / 72)) / 2)
    assert choose_deciding_poses(vague, 1, 0.0)[1] == [pytest.approx(expected)]


def test_a_pose_at_which_the_sets_agree_tells_nothing_however_uncertain_they_are():
    # Pose 1 would tell most of the coefficients, and pose 0 alone tells the sets apart.
    sets = [rival(0.7, [0.0, 3.0], [[0.1], [9.0]]), rival(0.3, [3.0, 3.0], [[0.1], [9.0]])]
    chosen, entropy = choose_deciding_poses(sets, 2, 0.0)
    assert chosen[0] == 0
    alike = [rival(0.7, [0.0, 3.0], [[0.1], [9.0]]), rival(0.3, [0.0, 3.0], [[0.1], [9.0]])]
    flat = choose_deciding_poses(alike, 2, 0.0)[1]
    np.testing.assert_allclose(flat, compute_entropy(np.array([0.7, 0.3])))
    assert entropy[0] < flat[0]


def test_it_ends_as_soon_as_enough_is_expected():
    K = 20
    sets = [rival(0.5, np.zeros(K), np.zeros((K, 1))), rival(0.5, np.full(K, 2), np.zeros((K, 1)))]
    chosen, entropy = choose_deciding_poses(sets, K, 0.2)
    # Each pose adds 4/8 to B; of B = 2.5 and 2.0 the entropies are 0.079 and 0.127: four are
    # enough, and three are not (0.201).
    assert len(set(chosen)) == len(chosen) == 4
    assert entropy[2] == pytest.approx(np.log(1 + np.exp(-1.5)))
    assert entropy[2] > 0.2 > entropy[3]


def test_the_bound_is_above_the_entropy_that_simulated_measurements_leave():
    rng = np.random.default_rng(3)
    K, k = 6, 3
    p = np.array([0.6, 0.3, 0.1])
    sets = [Rival(one, rng.normal(0, 1, (K, 2)), rng.normal(0, 1, (K, 2, k))) for one in p]
    chosen, entropy = choose_deciding_poses(sets, K, 0.0)
    for n in (1, 3, K):
        rows = chosen[:n]
        means = np.array([one.mean[rows].ravel() for one in sets])
        covariances = [
            np.eye(2 * n) + X @ X.T for X in (one.spread[rows].reshape(2 * n, k) for one in sets)
        ]
        left = []
        for i, (m, V) in enumerate(zip(means, covariances, strict=True)):
            y = rng.multivariate_normal(m, V, 4000)
            logs = np.array(
                [
                    np.log(q)
                    - np.linalg.slogdet(W)[1] / 2
                    - np.einsum("si,ij,sj->s", y - c, np.linalg.inv(W), y - c) / 2
                    for q, c, W in zip(p, means, covariances, strict=True)
                ]
            )
            posterior = np.exp(logs - np.logaddexp.reduce(logs, axis=0))
            left.append(p[i] * np.mean(-np.log(posterior[i])))
        true = sum(left)  # E[H(i | y)] = E[-log p(i | y)]
        assert true - 0.02 < entropy[n - 1] < true + 0.25
    assert np.all(np.diff(entropy) <= 1e-9)
