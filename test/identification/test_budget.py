"""The error budget names what was hidden; ISO 9283's figures against hand-worked ones."""

import json
from dataclasses import replace

import numpy as np
import pytest
import virtual_setups as vs
from scipy import stats

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.budget import iso_9283
from parallel_cal.identification.fit import fit
from parallel_cal.identification.prediction_errors import Errors, compute_rms_sigmas
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.simulate import simulate
from parallel_cal.reporting.tables import iso_sentence
from parallel_cal.session.steps import fitted
from parallel_cal.virtual import robot as vr

SIGMA, ARCSEC, PLAY = 15e-6, vr.ARCSEC, 1e-3


@pytest.fixture(scope="module")
def result():
    """A virtual Delta with play of 1 mrad, its identification with backlash."""
    rng = np.random.default_rng(5)
    robot, n = vs.random_delta(4), 90
    r = rng.uniform((-0.05, -0.05, 0.16), (0.05, 0.05, 0.24), (n, 3))
    direction = rng.choice([-1.0, 1.0], (n, 3))
    stood, R = robot.inverse(r)
    q = stood + direction * PLAY / 2 + rng.normal(0, 25 * ARCSEC, (n, 3))
    turn = rng.normal(0, 20 * ARCSEC, (n, 3))
    model = new_model("delta54", effects=["backlash"])
    data = Dataset.from_arrays(
        model.joints,
        q,
        r + rng.normal(0, SIGMA, (n, 3)),
        np.array([vr.turn(w) for w in turn]) @ R,
        pose_cov=np.diag([SIGMA**2] * 3 + [(20 * ARCSEC) ** 2] * 3),
        joint_sigma=np.full(3, 25 * ARCSEC),
        conditions={
            f"direction.{name}": d for name, d in zip(model.joints, direction.T, strict=True)
        },
    )
    return fit(model, data), robot, stood, r, direction


def test_a_budget_ranks_parts_by_what_each_removes_and_no_part_is_negative(result):
    found, *_ = result
    position, orientation = found.budgets
    assert [b.kind for b in found.budgets] == ["position", "orientation"]
    assert [p.name for p in position.parts] == ["geometry", "backlash", "noise", "rest"]
    assert position.held_out
    assert (position.samples, position.poses) == (90, 90)
    # The error of the nominal model has one standard deviation, here and in every other place.
    assert position.total == pytest.approx(found.held_out_before.summary.position_rms)
    assert position.sigma == pytest.approx(found.rms_sigmas(found.held_out_before)["position"])
    for part in (*position.parts, *orientation.parts):
        assert part.removed >= 0
        assert part.sigma > 0


def test_an_effect_removes_what_a_fit_without_it_is_worse_at_held_out_poses(result):
    found, *_ = result
    without = fit(found.start.without_effect("backlash"), found.dataset)
    squares = [one.held_out.summary.position_rms**2 for one in (without, found)]
    backlash = next(p for p in found.budgets[0].parts if p.name == "backlash")
    assert backlash.removed == pytest.approx(np.sqrt(squares[0] - squares[1]), rel=1e-3)
    assert 0.02 < backlash.sigma / backlash.removed < 0.5


def test_an_effect_that_is_not_in_the_robot_removes_nothing_within_its_sigma(result):
    found, *_ = result
    larger = fit(found.start.with_effect("encoder_eccentricity"), found.dataset)
    parts = {p.name: p for p in larger.budgets[0].parts}
    idle = parts["encoder_eccentricity"]
    assert 0 <= idle.removed < 3 * idle.sigma
    assert idle.removed < 0.3 * parts["backlash"].removed


def test_noise_is_no_larger_than_the_error_that_remains():
    model = read_model("config/delta_mockup_nominal.yaml")  # it states more noise than there is
    found = fit(model, load_dataset("bags/delta_thermal", joints=model.joints))
    parts = {p.name: p for p in found.budgets[0].parts}
    error = found.held_out.summary.position_rms
    assert found.noise_floor.position_rms > error
    assert parts["noise"].removed == pytest.approx(error)
    assert parts["rest"].removed == 0.0


def test_the_sigma_of_an_rms_is_the_scatter_of_repeated_measurements():
    rng, n = np.random.default_rng(3), 60
    none = np.full((n, 3), np.nan)
    found, sigmas = [], []
    for _ in range(300):
        # Two visits of each pose share the error of the pose.
        e = np.repeat(rng.normal(0, 1e-5, (n // 2, 3)), 2, axis=0)
        errors = Errors(e, none, none, none, none, none)
        found.append(errors.summary.position_rms)
        sigmas.append(compute_rms_sigmas(errors, np.repeat(np.arange(n // 2), 2))["position"])
    assert np.mean(sigmas) == pytest.approx(np.std(found), rel=0.15)


def test_an_effects_own_part_is_what_the_virtual_robot_moves_by_it(result):
    found, robot, stood, r, direction = result
    backlash = next(p for p in found.budgets[0].parts if p.name == "backlash")
    h = 1e-6
    slopes = np.stack([robot.inverse(r + h * axis)[0] - stood for axis in np.eye(3)], axis=2) / h
    moved = np.linalg.solve(slopes, PLAY / 2 * direction[:, :, None])[:, :, 0]
    expected = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    assert backlash.alone == pytest.approx(expected, rel=0.15)


E, NONE = (
    np.array([[3e-5, 0, 0], [1e-5, 0, 0], [2e-5, 0, 0], [0, 4e-5, 0]]),
    np.full((4, 3), np.nan),
)
GROUP = np.array([0, 0, 0, 1])


def test_iso_9283_of_a_pose_visited_thrice_and_one_visited_once():
    [found] = iso_9283(Errors(E, NONE, NONE, NONE, NONE, NONE), GROUP)
    assert found.accuracy_mean == pytest.approx(3e-5)  # 20 and 40 um
    assert found.accuracy_sigma == pytest.approx(1e-5)
    assert found.accuracy_max == pytest.approx(4e-5)
    l = np.sqrt(3 / 2) * np.array([1e-5, 1e-5, 0])  # about the barycentre, unbiased
    # Three visits have two degrees of freedom: the variance is twice that of the three distances.
    assert found.repeatability == pytest.approx(l.mean() + 3 * np.sqrt(2) * l.std())
    assert (found.repeated_poses, found.visits, found.poses, found.samples) == (1, 3, 2, 4)
    assert not found.sides_known


def test_visits_from_different_sides_are_no_repetition():
    errors = Errors(E, NONE, NONE, NONE, NONE, NONE)
    [found] = iso_9283(errors, GROUP, np.array([0, 1, 1, 0]))
    # The second and the third visit have the same distance from their barycentre: no scatter.
    assert found.visits == 2
    assert found.repeatability is None
    assert "only one pose was visited twice from the same side" in iso_sentence(found)
    [found] = iso_9283(errors, GROUP, np.array([0, 1, 2, 0]))
    assert found.repeatability is None
    assert "no pose was visited twice from the same side" in iso_sentence(found)


@pytest.mark.parametrize("visits", [[2] * 10, [1] * 10 + [30], [2, 3, 10, 1] * 5])
def test_the_repeatability_depends_on_the_noise_and_not_on_how_often_poses_were_visited(visits):
    rng, group = np.random.default_rng(0), np.repeat(np.arange(len(visits)), visits)
    none, found = np.full((len(group), 3), np.nan), []
    for _ in range(400):
        e = rng.normal(0, 1e-5, (len(group), 3))
        [one] = iso_9283(Errors(e, none, none, none, none, none), group)
        found.append((one.repeatability, one.repeatability_sigma))
    value, sigma = np.mean(found, axis=0)
    distance = stats.chi(3, scale=1e-5)
    assert value == pytest.approx(distance.mean() + 3 * distance.std(), rel=0.03)
    assert sigma == pytest.approx(np.std(found, axis=0)[0], rel=0.12)


def test_figures_after_iso_9283_are_of_held_out_poses_with_their_counts(result):
    found, *_ = result
    figures = found.iso_9283[0]
    norms = found.held_out.norms("position")
    assert figures.accuracy_mean == pytest.approx(norms.mean())
    words = iso_sentence(figures)
    assert words.startswith("after ISO 9283, position: accuracy AP ")
    assert "at 90 samples of 90 held-out poses" in words
    assert f"+- {1e6 * figures.accuracy_sigma:.1f} um" in words


@pytest.mark.wide
def test_the_command_prints_both(run_cli, tmp_path):
    asked = ("fit", "config/delta_mockup_nominal.yaml", "bags/delta_clean")
    shown = run_cli(*asked, "--hold-out", "0", "--details")
    assert "position error of " in shown
    assert "moves the platform by" in shown
    assert "after ISO 9283, position: accuracy AP" in shown
    assert "94 samples of 74 poses (not held out)" in shown
    document = json.loads(run_cli(*asked, "--hold-out", "0", "--json"))
    assert document["budget"][0]["parts"][0]["name"] == "geometry"
    assert document["iso_9283"][0]["poses"] == 74


@pytest.mark.wide
def test_the_nominal_model_has_one_error_before_and_after_its_fit():
    """Nothing states where the device stands: the nominal model is judged registered, also where
    the budget of a fitted model states its error."""
    nominal = new_model("stewart42")
    errors = np.random.default_rng(3).normal(size=len(nominal.values)) * nominal.table.tolerance
    data = simulate(nominal.with_values(nominal.values + errors), 50, seed=1).dataset()
    first = fit(nominal, data)
    again = fit(first.model, data)
    expected = first.held_out_before.summary.position_rms
    assert first.given.errors_as_given.summary.position_rms > 2 * expected
    for result in (first, again):
        assert result.nominal_errors.summary.position_rms == pytest.approx(expected)
        assert result.budgets[0].total == pytest.approx(expected)


def test_the_figures_of_a_comparison_say_whether_a_fit_of_the_model_used_the_samples():
    nominal = new_model("delta24")
    errors = 0.3 * np.random.default_rng(3).normal(size=24) * nominal.table.tolerance
    robot = nominal.with_values(nominal.values + errors)
    used, unused = (simulate(robot, 20, seed=seed).dataset() for seed in (1, 2))
    model = fitted(nominal, used, hold_out=0, force=True).model
    assert "20 poses (not held out), noise" in iso_sentence(compare(model, used).iso_9283[0])
    for judged in (nominal, model):
        [figures] = compare(judged, unused).iso_9283[:1]
        assert "20 poses (no fit of this model used them), noise" in iso_sentence(figures)
    placed = "(no fit of this model used them, except for the device's frame)"
    assert placed in iso_sentence(replace(figures, frames_fitted=True))
    # The history of a model that was fitted in Python and not by a step does not know the samples.
    without = fit(nominal, used, hold_out=0).model
    assert "(not held out)" in iso_sentence(compare(without, unused).iso_9283[0])
