"""The standard deviation of the rms error at held-out poses, about that at poses like these."""

import numpy as np
import pytest

from bench.truth import coverage
from parallel_cal.identification.error_jacobians import differentiate_errors
from parallel_cal.identification.fit import fit
from parallel_cal.identification.held_out_uncertainty import FoldedErrors
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.prediction_errors import compute_rms_sigmas, errors
from parallel_cal.model.model import new_model
from parallel_cal.recordings.simulate import simulate

FOLDS = 4


def test_four_readings_of_one_mean_in_two_folds_by_hand():
    """e_1 = n_1 - (n_3 + n_4) / 2 has the variance 3/2, the covariances 1/2 with e_2 of its fold
    and -1 with e_3 and e_4: tr(C^2) = 4 * 9/4 + 4 * 1/4 + 8 = 18. The mean of all four has the
    variance 1/4: 2 (4/4)^2. In sum (2 * 18 + 2) / 4^2."""
    one = np.ones((4, 1, 1))
    folded = FoldedErrors(
        one, one, np.array([0, 0, 1, 1]), np.arange(4), np.full((1, 1), 0.25), np.full((2, 1, 1), 2)
    )
    assert folded.compute_variance(np.full(4, 1.5)) == pytest.approx(38 / 16)


def test_one_pose_that_alone_knows_a_parameter_leaves_it_unknown():
    J = np.array([1.0, 0, 0, 0]).reshape(4, 1, 1)
    information = np.array([1.0, 0]).reshape(2, 1, 1)
    folded = FoldedErrors(
        np.ones((4, 1, 1)), J, np.array([0, 0, 1, 1]), np.arange(4), np.ones((1, 1)), information
    )
    assert folded.compute_variance(np.ones(4)) is None


def _slopes(u):
    """Two components at places u (n, 2), each a quadratic polynomial with its own parameters."""
    x, y = u.T
    terms = np.column_stack([np.ones(len(u)), x, y, x * y, x**2, y**2])
    none = np.zeros_like(terms)
    return np.stack([np.hstack([terms, none]), np.hstack([none, terms])], axis=1)


def _draw_linear(rng, poses, visits, missing):
    """A cross-validation of a linear model, by numpy alone: (rms - true rms, sigma, old sigma)."""
    further, group = rng.uniform(-1, 1, (1000, 2)), np.repeat(np.arange(poses), visits)
    u, phase = rng.uniform(-1, 1, (poses, 2))[group], rng.uniform(0, 6, 2)
    J = _slopes(u)

    def wave(at):
        return missing * np.sin(4 * at + phase)

    y = wave(u) + rng.normal(size=(len(u), 2))
    fold, e = (rng.permutation(poses) % FOLDS)[group], np.empty_like(y)
    for k in range(FOLDS):
        used = fold != k
        found = np.linalg.lstsq(J[used].reshape(-1, 12), y[used].ravel(), rcond=None)[0]
        e[~used] = y[~used] - J[~used] @ found
    each = J.transpose(0, 2, 1) @ J
    found = np.linalg.lstsq(J.reshape(-1, 12), y.ravel(), rcond=None)[0]
    left = wave(further) - _slopes(further) @ found
    true = np.sqrt(np.mean(np.sum(left**2, axis=1)) + 2)
    information = np.stack([each[fold == k].sum(axis=0) for k in range(FOLDS)])
    S = np.broadcast_to(np.eye(2), (len(u), 2, 2))
    squares = np.sum(e**2, axis=1)
    folded = FoldedErrors(S, J, fold, group, np.linalg.inv(each.sum(axis=0)), information)
    rms = np.sqrt(squares.mean())
    return rms - true, np.sqrt(folded.compute_variance(squares)) / (2 * rms)


@pytest.mark.parametrize(("poses", "visits", "missing"), [(40, 1, 0.0), (40, 2, 0.0), (40, 1, 1.0)])
def test_the_interval_holds_the_error_at_further_poses_of_a_linear_model(poses, visits, missing):
    rng = np.random.default_rng(7)
    away, sigma = np.array([_draw_linear(rng, poses, visits, missing) for _ in range(400)]).T
    assert np.mean(np.abs(away) < 1.96 * sigma) > 0.9
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(np.std(away), rel=0.2)


@pytest.mark.parametrize("name", ["delta54", "five_bar"])
def test_the_derivatives_of_errors_are_their_differences(name):
    nominal = new_model(name)
    data = simulate(nominal, 6, seed=2).dataset()
    result = fit(nominal, data, hold_out=0, prior=True)
    model, seen, free = result.model, result.observations, result.free
    linearise = Linearisation(model, seen, free, weighted=True)
    # At the predicted pose, where both are exact
    _, rows, by_free = linearise.blocks(model.values, linearise.start())
    found = differentiate_errors(model, seen, rows, by_free)
    for k in np.flatnonzero(free)[::3]:
        step = 1e-4 * model.table.tolerance[k] * (np.arange(len(free)) == k)
        moved = [errors(model.with_values(model.values + s * step), seen) for s in (1, -1)]
        column = int(np.sum(free[:k]))
        for kind in ("position", "joint"):
            if not found[kind].known.any():
                continue
            slope = (getattr(moved[1], kind) - getattr(moved[0], kind)) / (2 * step.sum())
            own = found[kind].by_parameter[:, :, column]
            assert own == pytest.approx(slope, abs=0.02 * max(np.abs(own).max(), 1e-9))


def test_only_held_out_errors_count_the_parameters_that_folds_share():
    session = coverage.draw_session(np.random.default_rng([77, 1]))
    result = fit(new_model("five_bar"), session.data)
    scatter = compute_rms_sigmas(result.held_out, np.arange(len(session.data)))
    assert result.rms_sigmas(result.held_out)["position"] > 1.05 * scatter["position"]
    assert result.rms_sigmas(result.after) == compute_rms_sigmas(
        result.after, np.arange(len(session.data))
    )
