"""The parts of a diagnosis, each against hand-worked numbers or an independent library."""

import dataclasses
import tracemalloc
from itertools import combinations

import numpy as np
import pytest
from datasets import measured, quiet
from findings import clean, hiding
from scipy import stats
from virtual_findings import KINDS

from parallel_cal.base.confidence import SIGMAS_AT_SIGNIFICANCE_LEVEL, SIGNIFICANCE_LEVEL
from parallel_cal.base.errors import ModelError
from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.diagnosis import catalogue, statistics
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import lack_of_fit, smooth_map
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.diagnosis.patterns import compute_residual_profiles, odd_samples, regions
from parallel_cal.diagnosis.scoring import (
    canonical_correlation,
    f_test,
    log_p_of,
    score,
)
from parallel_cal.diagnosis.search import Chosen, Search
from parallel_cal.diagnosis.statistics import morans_i, runs_test
from parallel_cal.identification.estimate import NoSolutionError
from parallel_cal.identification.fit import UnjudgedFit, fit, fit_unjudged
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model import structure
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_mechanism
from parallel_cal.model.structure import structure_of
from parallel_cal.posterior import scene as scenes
from parallel_cal.posterior.scene import Scene, SharedDerivatives, columns
from parallel_cal.virtual import robot as vr


@pytest.fixture(scope="module")
def here():
    """A fitted model 54 and data without hidden effect."""
    return fitted_scene(measured(0))


def fitted_scene(data, model=None):
    result = fit(model or new_model("delta54"), data, hold_out=0)
    return Scene.of(result.model, data, result.observations, result.free)


# --------------------------------------------------------------------------------- statistics


def test_a_long_row_of_equal_signs_is_too_few_runs_and_a_zigzag_is_not():
    halves = np.r_[np.full(20, 1.0), np.full(20, -1.0)][:, None]
    # 2 runs where 21 are expected with variance 20 * 19 / 39: z = -6.09.
    assert runs_test(halves) == pytest.approx(stats.norm.cdf(-19 / np.sqrt(20 * 19 / 39)), rel=1e-6)
    assert runs_test(np.tile([1.0, -1.0], 20)[:, None]) > 0.999


def test_runs_of_pure_noise_reject_as_often_as_they_should():
    rng = np.random.default_rng(0)
    rejected = [runs_test(rng.normal(size=(100, 3))) < 0.05 for _ in range(400)]
    assert 0.02 < np.mean(rejected) < 0.08


def test_morans_i_finds_a_gradient_and_not_noise():
    rng = np.random.default_rng(1)
    places, group = rng.uniform(size=(120, 3)), np.arange(120)
    noise = rng.normal(size=(120, 3))
    assert morans_i(noise, places, group)[1] > 0.05
    index, p = morans_i(noise + 2 * places, places, group)
    assert index > 0.1
    assert p == 1e-12


def test_repeated_visits_of_a_pose_do_not_count_as_similar_neighbours():
    rng = np.random.default_rng(2)
    places = np.repeat(rng.uniform(size=(30, 3)), 4, axis=0)
    field = np.repeat(rng.normal(size=(30, 3)), 4, axis=0)
    assert morans_i(field, places, np.repeat(np.arange(30), 4))[1] > 0.05
    assert morans_i(field, places, np.arange(120))[1] < 0.01  # what would go wrong


@pytest.mark.parametrize(
    ("clusters", "visits"),
    [(6, 1), (0, 10), *(pytest.param(*one, marks=pytest.mark.wide) for one in ((0, 1), (6, 10)))],
)
def test_white_noise_has_structure_as_rarely_as_stated(clusters, visits):
    """On even and on clustered poses, also if those of one region are visited ten times."""
    alarms, draws = 0, 400
    for seed in range(draws):
        rng = np.random.default_rng([7, seed])
        places = rng.uniform(-1, 1, (60, 3))
        if clusters:
            places = places[np.arange(60) % clusters] + 0.02 * rng.normal(size=(60, 3))
        away = np.linalg.norm(places - places[0], axis=1)
        group = np.repeat(np.arange(60), np.where(away < np.quantile(away, 1 / 3), visits, 1))
        noise = rng.normal(size=(len(group), 3))
        alarms += morans_i(noise, places[group], group, seed=seed)[1] < 0.05
    low, high = stats.binom(draws, 0.05).ppf([0.005, 0.995])
    assert low <= alarms <= high


def test_the_nearest_places_are_the_same_by_a_tree_and_by_all_distances(monkeypatch):
    """A robot that is back at a place is there twice: neither visit is its own neighbour."""
    places = np.random.default_rng(0).normal(size=(300, 6))
    twice = np.concatenate([places, places[:40]])
    scaled = twice / twice.std(axis=0)
    distances = []
    for most in (0, len(twice)):
        monkeypatch.setattr(statistics, "MAX_PLACES_WITHOUT_TREE", most)
        near = statistics.nearest(twice, 7)
        assert (near != np.arange(len(twice))[:, None]).all()
        assert (near[:40] == 300 + np.arange(40)[:, None]).any(axis=1).all()
        # Of twins that are equally far, either may be the last neighbour.
        distances.append(np.sort(np.linalg.norm(scaled[near] - scaled[:, None], axis=2)))
    np.testing.assert_allclose(*distances, rtol=1e-12)
    monkeypatch.setattr(statistics, "MAX_PLACES_WITHOUT_TREE", 0)
    same = statistics.nearest(np.zeros((30, 2)), 7)
    assert (same != np.arange(30)[:, None]).all()


def test_permutations_find_the_tail_of_a_known_distribution():
    """Copies of a chi-square variable with 8 degrees of freedom, and of a normal one: far outside
    all copies the p-value is that of the distribution, up to the sampling of its moments."""
    rng = np.random.default_rng(0)
    copies = np.column_stack([rng.chisquare(8, 999), rng.standard_normal(999)])
    for p in (1e-5, 1e-8):
        seen = stats.chi2(8).isf(p), stats.norm.isf(p)
        found = statistics.permutation_p_values(seen, copies)
        assert np.log10(found) == pytest.approx([np.log10(p)] * 2, rel=0.25)
    # Inside, it is the share of the copies, and not all of them are needed.
    read = iter(copies)
    found = statistics.permutation_p_values((stats.chi2(8).isf(0.3), stats.norm.isf(0.1)), read)
    assert found == pytest.approx([0.3, 0.1], rel=0.5)
    assert 200 < len(list(read)) < 900


def test_structure_is_significant_beside_any_number_of_tests():
    """A p-value of 1/1000 is the least that 999 permutations give. Twelve tests, as of a hexapod,
    would raise it above 0.01, however similar neighbours are."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (150, 3))
    field = np.sin(3 * places) + 0.3 * rng.standard_normal((150, 3))
    _, p = morans_i(field, places, np.arange(150))
    assert 12 * p < 1e-6


def test_morans_i_of_very_many_samples_needs_no_matrix_of_all_pairs():
    rng = np.random.default_rng(0)
    places, group = rng.normal(size=(20_000, 3)), np.arange(20_000)
    tracemalloc.start()
    index, p = morans_i(np.sin(places) + rng.normal(size=places.shape), places, group)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert index > 0.1
    assert p == 1e-12
    assert peak < 1e8  # bytes; all pairs take 3.2e9


def test_bands_hold_what_is_no_more_than_chance():
    assert 2 * stats.norm.sf(SIGMAS_AT_SIGNIFICANCE_LEVEL) == pytest.approx(
        SIGNIFICANCE_LEVEL, rel=1e-3
    )


@pytest.mark.parametrize(("F", "q", "dof"), [(0.3, 3, 40), (1.0, 1, 7), (12.0, 6, 300)])
def test_the_p_value_of_an_f_test_is_scipys(F, q, dof):
    assert log_p_of(F, q, dof) == pytest.approx(stats.f.logsf(F, q, dof), rel=1e-6)


def test_the_p_value_keeps_its_order_where_it_underflows():
    logs = [log_p_of(F, 3, 500) for F in (300.0, 3000.0, 30000.0, 3e5, 3e7)]
    assert np.all(np.diff(logs) < -50)
    # Where both are finite the leading term of the series is the whole of it.
    assert log_p_of(60.0, 2, 4000) == pytest.approx(-2000 * np.log1p(2 * 60 / 4000), rel=1e-9)


def test_the_f_test_of_a_planted_direction_is_the_regression_of_a_textbook():
    rng = np.random.default_rng(3)
    U = np.linalg.qr(rng.normal(size=(50, 2)))[0]
    r = rng.normal(size=50) + 3 * U[:, 0]
    F, log_p = f_test(r, U, dof=50)
    rest = r - U @ (U.T @ r)
    expected = ((r @ r - rest @ rest) / 2) / (rest @ rest / 48)
    assert pytest.approx(expected) == F
    assert log_p == pytest.approx(stats.f.logsf(expected, 2, 48))


# ------------------------------------------------------------------------------------- scenes


def test_regressors_are_taken_where_the_model_puts_the_platform(here):
    """Guard against circularity: not at the measured pose, whose noise would explain itself."""
    pose = Kinematics(here.model).direct(here.x[:, :3])
    assert np.array_equal(here.x[:, 3:6], pose.position)
    assert np.abs(here.observations.x[:, 3:6] - pose.position).max() > 20e-6


def test_the_residual_of_a_complete_model_is_noise_in_noise_units(here):
    assert here.chi2_per_dof == pytest.approx(1, abs=0.15)
    assert here.dof == here.residual.size - here.basis.shape[1]
    z = Field.of(here).noise_units
    assert np.mean(z**2) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("name", ["backlash", "hysteresis", "payload_sag", "base_drift"])
def test_columns_of_a_new_effect_include_the_effects_that_the_model_already_has(name):
    data = clean(0)
    model = new_model("delta54").with_effect("joint_compliance").with_effect("encoder_gain")
    values = model.values + model.table.tolerance * np.linspace(-1, 1, len(model.values))
    model, observations = model.with_values(values), observe(model, data)
    beside = Scene.of(model, data, observations, ~np.asarray(model.fixed))
    extended = model.with_effect(name)
    new = extended.table.matching([f"{name}.*"]) & ~np.asarray(extended.fixed)
    whole = extended.structure.columns(tuple(np.flatnonzero(new).tolist()))
    by_v = whole(beside.x, observe(extended, data).a, extended.values)[0]
    J = beside.whitener @ by_v.reshape(len(data), new.sum(), -1).transpose(0, 2, 1)
    expected = J.reshape(len(beside.residual), -1) * extended.table.tolerance[new]
    B = columns(extended, beside, new)
    assert np.abs(B - expected).max() < 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("beside", [None, "backlash"])
def test_a_larger_models_further_numbers_have_columns_in_a_scene_of_their_own(beside):
    model = new_model("delta24")
    model = model.with_effect(beside) if beside else model
    found = candidate(fitted_scene(clean(0), model), "parallelogram_errors")
    assert found.testable
    assert found.scene.model.mechanism.name == "delta54"
    assert found.score.q == 42 - 24


def test_the_number_of_effects_beside_it_does_not_change_what_is_built_for_one(here, monkeypatch):
    built, build = [], structure.dense
    monkeypatch.setattr(structure, "dense", lambda *a: built.append(a[0]) or build(*a))
    for beside in ("device_axes", "target_offset"):
        scene = fitted_scene(here.dataset, here.model.with_effect(beside))
        candidate(scene, "encoder_eccentricity")
    assert built.count("seen_by") <= 1


def test_columns_are_finite_differences_of_the_residuals(here):
    extended = here.model.with_effect("backlash")
    new = extended.table.matching(["backlash.*"])
    B = columns(extended, here, new)
    k = extended.table.index_of("backlash.joint2.width")
    values = extended.values.copy()
    values[k] += 1e-6
    observations = observe(extended, here.dataset)
    moved = [
        Linearisation(extended, observations, new, True)(v, here.x).residual.reshape(-1)
        for v in (extended.values, values)
    ]
    slope = (moved[1] - moved[0]) / 1e-6 * extended.table.tolerance[k]
    assert np.abs(slope - B[:, 1]).max() < 1e-3 * np.abs(slope).max()


def test_geometry_swallows_an_encoders_gain_but_not_its_play(here):
    """Guard 3: on a Delta a few per cent of a gain survive, and most of a backlash."""
    gain, play = (candidate(here, name).score for name in ("encoder_gain", "backlash"))
    assert gain.remaining < 0.1
    assert play.remaining > 0.8


def test_an_effect_correlates_fully_with_itself_and_not_with_another_effect(here):
    play, again = (candidate(here, "backlash").score.U for _ in range(2))
    drift = candidate(here, "base_drift").score.U
    assert canonical_correlation(play, again) == pytest.approx(1)
    assert canonical_correlation(play, drift) < 0.7


@pytest.mark.parametrize(("size", "visible"), [(10.0, 0), (1e4, 1)])
def test_what_geometry_leaves_of_a_large_effect_is_seen_however_small_its_share(
    here, size, visible
):
    """The sum found an effect by the thousandth that geometry leaves, and the list called it
    invisible."""
    geometry, rest = np.random.default_rng(0).normal(size=(2, len(here.residual), 1))
    rest = here.project_off_geometry(rest)
    imitated = geometry - here.project_off_geometry(geometry)
    column = imitated / np.linalg.norm(imitated) + 1e-3 * rest / np.linalg.norm(rest)
    assert score(here, size * column).q == visible


def test_random_columns_score_as_chance_has_it(here):
    rng = np.random.default_rng(0)
    p = [score(here, rng.normal(size=(len(here.residual), 5))).p_value for _ in range(400)]
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_replicates_know_the_noise_without_any_model(here):
    known = NoiseLevel.of(here, Field.of(here), False)
    assert known.source == "stated (dataset)"
    assert known.pure_error.variance == pytest.approx(1, abs=0.3)
    # twenty visits again of six components, less what three directions and time take
    assert known.pure_error.dof == (20 - 4) * 6


def test_a_noise_that_nobody_states_is_taken_from_replicates():
    data = measured(1)
    here = fitted_scene(data)
    guessed = dataclasses.replace(
        here.observations,
        S=here.observations.S / 4,
        noise_from={"joint": "scatter within dwells", "pose": "scatter within dwells"},
    )
    there = Scene.of(here.model, data, guessed, here.free)
    known = NoiseLevel.of(there, Field.of(there), False)
    assert known.variance == pytest.approx(4, abs=1.2)
    low, high = known.band(there.dof)
    assert low < there.chi2_per_dof < high


# ------------------------------------------------------------------------------------- refits


def test_shared_derivatives_are_computed_once(monkeypatch):
    computed = []

    def compute(scale):
        computed.append(scale)
        return np.array([1, 2]), scale * np.array([[1.0, 2.0], [0.0, 3.0]])

    shared = SharedDerivatives()
    for _ in range(2):
        used, found = shared.get(("backlash", 1), lambda: compute(1.0))
        assert (used.tolist(), found.tolist()) == ([1, 2], [[1, 2], [0, 3]])
    assert shared.get(("backlash", 2), lambda: compute(2.0))[1][1, 1] == 6
    assert computed == [1.0, 2.0]
    # What does not fit into the memory is computed anew.
    monkeypatch.setattr(scenes, "MAX_SHARED_BYTES", 8 * 4 - 1)
    small = SharedDerivatives()
    for _ in range(2):
        assert small.get("lag", lambda: compute(3.0))[1][0, 0] == 3
    assert computed == [1.0, 2.0, 3.0, 3.0]


@pytest.mark.wide
def test_a_scan_that_shares_derivatives_finds_the_same_setting():
    """The scene with backlash takes the derivatives of a scan from the one without it."""
    data = measured(0, effects=[vr.Backlash((3e-4, 2.5e-4, 2e-4))])
    search = Search(
        new_model("delta54"),
        lambda model, insist, *_: fit_unjudged(model, data, FitOptions()),
        lambda *_: None,
    )
    candidate(search.fit(judged=False).scene, "gear_transmission_error")
    scene = search.fit(Chosen("backlash"), judged=False).scene
    assert scene.shared is not None
    alone = dataclasses.replace(scene, shared=None)
    one, other = (candidate(s, "gear_transmission_error") for s in (scene, alone))
    assert one.settings == pytest.approx(other.settings)
    assert one.log_p == pytest.approx(other.log_p)


def test_the_structures_of_a_diagnosis_of_three_effects_are_kept_for_the_next():
    mechanism = load_mechanism("delta54")
    names = [n for n in list_plugins("effects") if not load_effect(n).applies(mechanism)]
    trios = [tuple(map(load_effect, trio)) for trio in list(combinations(names, 3))[:400]]
    first = structure_of(mechanism, trios[0])
    for trio in trios:
        structure_of(mechanism, trio)
    assert structure_of(mechanism, trios[0]) is first


def test_a_fit_whose_validation_fails_is_no_trial(monkeypatch):
    data = measured(1, n_poses=30, n_replicates=0)

    def fail(unjudged, progress=None):
        raise NoSolutionError("a fold has no solution")

    search = Search(
        new_model("delta54"),
        lambda model, insist, *_: fit_unjudged(model, data, FitOptions()),
        lambda *_: None,
    )
    assert search.fit(judged=False).result is not None
    monkeypatch.setattr(UnjudgedFit, "judge", fail)
    failed = search.fit()
    assert (failed.result, failed.reason, failed.unsolved) == (None, "a fold has no solution", True)


# ---------------------------------------------------------------------------------- structure


def test_a_smooth_map_finds_the_size_and_the_scale_of_a_wave_and_nothing_in_noise():
    data = measured(2, noise=quiet(), n_poses=150, n_replicates=0)
    wave = 100e-6 * np.sin(2 * np.pi * data.r[:, :1] / 0.12) * [0, 0, 1]
    here = fitted_scene(data)
    pushed = dataclasses.replace(here.observations)
    pushed.x[:, 3:6] += wave
    there = Scene.of(here.model, data, pushed, np.zeros_like(here.free))
    found = smooth_map(there, Field.of(there))
    assert found.share > 0.9
    assert found.size == pytest.approx(71e-6, rel=0.15)
    assert 0.005 < found.length < 0.06


def test_noise_has_no_lack_of_fit(here):
    left = lack_of_fit(here, Field.of(here))
    assert not left.has_structure
    assert left.map.share < 0.1


def test_a_wild_sample_is_named_and_no_other():
    data = measured(3)
    data.r[17] += [0.5e-3, 0, 0]
    here = fitted_scene(data)
    odd = odd_samples(here, Field.of(here))
    assert [one.sample for one in odd if one.outlier] == [17]
    assert odd[0].sigmas > 5
    # As in the table of samples: of the noise, and not of the typical residual.
    assert odd[0].sigmas == here.sigmas[17]
    loud = dataclasses.replace(here, residual=3 * here.residual)
    assert odd_samples(loud, Field.of(here))[0].sigmas == pytest.approx(3 * odd[0].sigmas)
    assert odd[0].time == data.time[17]


def test_the_condition_that_the_errors_depend_on_is_listed_first():
    data = measured(4, effects=[vr.Backlash((1e-3, 0.0, 0.0))])
    here = fitted_scene(data)
    entries = compute_residual_profiles(here, Field.of(here))
    assert entries[0].name == "direction.joint1"
    assert entries[0].strength > 5
    assert entries[0].at.tolist() == [-1.0, 1.0]
    assert sum(region.samples for region in regions(here, Field.of(here))) == len(data)


FAULTY = """
from parallel_cal import Effect, Parameter

class Faulty(Effect):
    physics = source = "none"

    def parameters(self, mechanism):
        return [Parameter("size", "m", 0.0, {tolerance})]

    def ideal(self, seen, e, at, mechanism):
        return seen
"""


@pytest.mark.parametrize(
    ("tolerance", "words"),
    [
        ("0.0", "faulty0.size: tolerance is 0.0, expected above 0"),
        ("1 / 0", "faulty1: ZeroDivision"),
    ],
)
def test_a_faulty_user_effect_raises_an_error_and_is_not_skipped(
    tmp_path, monkeypatch, tolerance, words
):
    name = "faulty0" if tolerance == "0.0" else "faulty1"
    package = tmp_path / "of_mine"
    package.mkdir()
    (package / f"{name}.py").write_text(FAULTY.format(tolerance=tolerance))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModelError, match=words):
        list_effects_to_test(new_model("delta54"), also=[f"of_mine.{name}"])


def test_effects_of_which_none_applies_are_an_error_as_with_add():
    words = "effect screw_pitch_error does not apply to delta54: it has no prismatic joint"
    with pytest.raises(ModelError, match=words):
        list_effects_to_test(new_model("delta54"), only=["screw_pitch_error", "line_sag"])
    some = ["screw_pitch_error", "backlash"]  # the first one is listed with the reason
    assert list_effects_to_test(new_model("delta54"), only=some) == some


def test_the_number_of_an_effect_is_searched_for_in_a_part_of_many_samples(monkeypatch):
    """Its score is that of all of them."""
    data, _ = hiding([KINDS["gear ripple"]], 1.0, seed=5)
    scene, searched = fitted_scene(data), []
    whole = candidate(scene, "gear_transmission_error")
    choose = catalogue.choose_setting

    def noted(part, *given):
        searched.append(len(part.dataset))
        return choose(part, *given)

    monkeypatch.setattr(catalogue, "choose_setting", noted)
    monkeypatch.setattr(catalogue, "MAX_DIAGNOSED_SAMPLES", 80)
    monkeypatch.setattr("parallel_cal.posterior.scene.MIN_POSES_OF_PART", 40)
    found = candidate(scene, "gear_transmission_error")
    assert searched == pytest.approx([75], abs=5)
    assert found.settings["ratio"] == pytest.approx(whole.settings["ratio"], rel=4e-3)
    assert found.score.log_p == pytest.approx(whole.score.log_p, rel=0.1)
    assert found.scene is scene
