"""Identification judged by unseen poses, by chi2 and by the spread of repeated runs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import virtual_day as vd
import yaml
from datasets import JOINTS, as_dataset, measured, quiet, redrawn
from marks import as_slow
from scipy import stats

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.checks import WrongSignError
from parallel_cal.identification.descent import Damping
from parallel_cal.identification.estimate import NormalEquations
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band, list_parameter_warnings
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.identification.prior import Knowledge
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr


@pytest.fixture(scope="module")
def clean():
    return fit(new_model("delta54"), measured(1))


def test_an_effect_seen_at_a_single_pose_does_not_lower_the_validation_error_there():
    data, loaded = measured(1), 5
    there = data.pose_id == data.pose_id[loaded]
    sunk = data.r + np.outer(there, [0.0, 0.0, -1e-3])
    data = replace(data, r=sunk, conditions={**data.conditions, "payload": 20.0 * there})
    result = fit(new_model("delta54").with_effect("payload_sag"), data)
    assert result.after.norms("position")[there].max() < 0.2e-3
    assert result.held_out.norms("position")[there].min() > 0.8e-3


def test_errors_before_are_those_of_the_thesis_mock_up(clean):
    before = clean.document()["before"]
    assert 0.55e-3 < before["position_mean"] < 0.62e-3


def test_held_out_errors_reach_what_the_noise_allows(clean):
    document = clean.document()
    after, floor = document["held_out"]["after"], document["noise_floor"]
    for kind in ("position_mean", "orientation_mean", "joint_mean"):
        assert after[kind] < 1.2 * floor[kind]
    assert document["improvement_held_out"]["position"] > 10
    assert document["improvement_held_out"]["orientation"] > 4


def test_each_fold_needs_one_linearisation_and_agrees_with_a_full_fit_of_the_fold(monkeypatch):
    looks, look = [], Linearisation.__call__
    monkeypatch.setattr(
        Linearisation, "__call__", lambda *given: looks.append(len(given[2])) or look(*given)
    )
    model, data = new_model("delta54"), measured(2)
    result = fit(model, data)
    folds, all_of_them = data.folds(0.25, seed=0), [94] * (result.estimate.iterations + 1)
    assert looks == all_of_them + [len(train) for train, _ in folds]
    for train, test in folds:
        other = fit(model, data.select(train), hold_out=0)
        seen = errors(other.model, result.observations.select(test))
        for kind in ("position", "orientation", "joint"):
            apart = getattr(result.held_out, kind)[test] - getattr(seen, kind)
            assert np.abs(apart).max() < 5e-4 * np.abs(getattr(seen, kind)).max()


def test_chi2_of_a_complete_model_is_one(clean):
    low, high = chi2_band(clean.estimate.dof)
    assert low < clean.estimate.chi2_per_dof < high
    assert clean.estimate.dof == 94 * 6 - 42


def test_noise_floor_is_what_the_true_model_shows():
    data = measured(2)
    truth = compare(new_model("delta54", vr.TABLE_5_18), data)
    floor, shown = truth.noise.document(), truth.errors.document()
    for key in ("position_mean", "position_rms", "orientation_rms", "joint_rms"):
        assert shown[key] == pytest.approx(floor[key], rel=0.15)


def test_platform_size_stays_fixed_and_the_other_42_are_free(clean):
    assert clean.estimate.spectrum.rank == clean.free.sum() == 42
    fixed = {n for n, free in zip(clean.model.table.names, clean.free, strict=True) if not free}
    assert fixed == {f"chain{i}.{n}" for i in (1, 2, 3) for n in ("d_z", "b_x", "b_y", "b_z")}
    assert clean.document()["parameters"]["chain1.b_x"]["sigma"] == 0


def test_a_robot_without_noise_is_found_exactly():
    result = fit(new_model("delta54"), measured(3, noise=quiet()), hold_out=0)
    truth = result.model.table.vector(vr.TABLE_5_18)
    assert np.abs(result.model.values - truth).max() < 1e-8
    assert result.after.norms("position").max() < 1e-9


def test_model_24_is_found_from_position_alone():
    samples = vd.dwell_samples(vr.MOCK_UP, seed=4)
    only_position = np.tile([True, True, True, False, False, False], (len(samples["q"]), 1))
    result = fit(new_model("delta24"), as_dataset(samples, measured=only_position))
    document = result.document()
    assert document["rank"] == 24
    assert document["after"]["orientation_mean"] is None
    assert (
        document["held_out"]["after"]["position_mean"]
        < 1.2 * document["noise_floor"]["position_mean"]
    )


def test_model_54_from_position_alone_names_nothing_it_cannot_know():
    """Orientation unmeasured is projected out: position still improves at unseen poses."""
    samples = vd.dwell_samples(vr.MOCK_UP, seed=4)
    only_position = np.tile([True, True, True, False, False, False], (len(samples["q"]), 1))
    result = fit(new_model("delta54"), as_dataset(samples, measured=only_position), prior=True)
    document = result.document()
    assert document["improvement_held_out"]["position"] > 10
    # The tolerances hold some directions, which take less than a degree of freedom each.
    rank, dof = result.estimate.spectrum.rank, result.estimate.dof
    assert 94 * 3 - rank < dof < 94 * 3
    low, high = document["chi2_band"]
    assert low < result.estimate.chi2_per_dof < high


def test_projecting_out_equals_a_measurement_without_weight():
    """Orientation left out, and orientation measured with a sigma of 3 rad: one estimate."""
    samples = vd.dwell_samples(vr.MOCK_UP, seed=5)
    model = new_model("delta54")
    mask = np.tile([True, True, True, False, False, False], (len(samples["q"]), 1))
    left_out = fit(model, as_dataset(samples, measured=mask), hold_out=0, prior=True)
    vague = as_dataset(samples)
    cov = np.array(vague.pose_cov)
    cov[:, range(3, 6), range(3, 6)] = 3.0**2
    vague = Dataset.from_arrays(
        JOINTS,
        vague.q,
        vague.r,
        vague.R,
        measured=vague.measured,
        pose_cov=cov,
        joint_sigma=vague.joint_sigma,
        pose_id=vague.pose_id,
    )
    weightless = fit(model, vague, hold_out=0, prior=True)
    apart = (left_out.model.values - weightless.model.values) / model.table.tolerance
    assert np.abs(apart).max() < 1e-3


# A robot with perfect parallelograms, all that model 24 knows off by some of its tolerance.
PARALLEL = vr.TABLE_5_12 | {
    "chain1.D_x": 0.0768,
    "chain1.Lb": 0.2404,
    "chain2.theta": 2.099,
    "chain2.La_y": -0.0035,
    "chain3.alpha": 1.565,
    "chain3.La_x": 0.1196,
}


@pytest.mark.wide
@pytest.mark.parametrize(
    ("name", "true", "seen"),
    [as_slow(("delta54", vr.TABLE_5_18, 6)), ("delta24", PARALLEL, 3)],
    ids=["model 54 from full poses", "model 24 from positions"],
)
def test_predicted_sigma_is_the_spread_over_200_noise_seeds(name, true, seen):
    samples = vd.dwell_samples(vr.Delta(true), seed=0)
    mask = np.tile(np.arange(6) < seen, (len(samples["q"]), 1))
    model = new_model(name)
    free = ~model.fixed
    found = []
    with single_threaded():
        for seed in range(200):
            observations = observe(model, as_dataset(redrawn(samples, seed), measured=mask))
            found.append(estimate(model, observations, free))
    spread = np.std([e.values[free] for e in found], axis=0, ddof=1)
    predicted = np.sqrt(np.mean([e.sigma[free] ** 2 for e in found], axis=0))
    ratio = spread / predicted
    assert abs(np.median(ratio) - 1) < 0.05
    assert np.abs(ratio - 1).max() < 0.25
    # ... and the estimates do not lean to one side.
    truth = np.array([true[n] for n in model.table.names])[free]
    bias = (np.mean([e.values[free] for e in found], axis=0) - truth) / (predicted / np.sqrt(200))
    assert np.sqrt(np.mean(bias**2)) < 1.5
    # chi2 is distributed as its name says, and so is the estimates' distance from the truth.
    assert uniform(stats.chi2.sf([e.chi2 for e in found], found[0].dof))
    apart = [e.values[free] - truth for e in found]
    size = [
        d @ np.linalg.solve(e.covariance[np.ix_(free, free)], d)
        for e, d in zip(found, apart, strict=True)
    ]
    assert uniform(stats.chi2.sf(size, free.sum()))


def uniform(p_values):
    return stats.kstest(p_values, "uniform").pvalue > 0.01


def test_unweighted_chains_are_found_one_by_one():
    """Without weights a chain's parameters touch its own rows alone (5.2.1)."""
    model, data = new_model("delta54"), measured(6)
    observations, free = observe(model, data), ~model.fixed
    together = estimate(model, observations, free, weighted=False)
    for chain in ("chain1.*", "chain2.*", "chain3.*"):
        alone = free & model.table.matching([chain])
        found = estimate(model, observations, alone, weighted=False)
        apart = (found.values - together.values)[alone] / model.table.tolerance[alone]
        assert np.abs(apart).max() < 1e-5


@pytest.mark.wide
def test_weights_bring_smaller_errors_than_the_unweighted_merit_of_the_thesis():
    model, truth = new_model("delta54"), new_model("delta54").table.vector(vr.TABLE_5_18)
    error = {True: 0.0, False: 0.0}
    targets = model.mechanism.sample(100, np.random.default_rng(0))
    right = Kinematics(model.with_values(truth)).inverse(targets)
    for seed in range(10):
        observations = observe(model, measured(seed))
        for weighted in error:
            found = estimate(model, observations, ~model.fixed, weighted=weighted)
            pose = Kinematics(model.with_values(found.values)).direct(right.joints)
            error[weighted] += np.linalg.norm(pose.position - targets, axis=1).mean()
    assert error[True] < error[False]


@pytest.mark.wide
@pytest.mark.parametrize(
    ("effect", "hidden"),
    [
        ("backlash", vr.Backlash((3e-4, 2e-4, 2.5e-4))),
        ("encoder_eccentricity", vr.EncoderEccentricity((4e-3, -3e-3, 2e-3), (1e-3, 4e-3, -3e-3))),
    ],
)
def test_adding_the_right_effect_brings_held_out_errors_down_to_noise(effect, hidden):
    data = measured(7, effects=[hidden])
    without = fit(new_model("delta54"), data)
    within = fit(new_model("delta54").with_effect(effect), data)
    assert without.estimate.chi2_per_dof > chi2_band(without.estimate.dof)[1]
    assert within.estimate.chi2_per_dof < chi2_band(within.estimate.dof)[1]
    before, after = (f.held_out.summary.position_rms for f in (without, within))
    assert after < before
    assert after < 1.15 * within.noise_floor.position_rms


def test_backlash_comes_out_with_its_size_and_sign():
    result = fit(
        new_model("delta54").with_effect("backlash"),
        measured(8, effects=[vr.Backlash((3e-4, 2e-4, 0.0))]),
    )
    sigma = dict(zip(result.model.table.names, result.estimate.sigma, strict=True))
    for joint, width in (("joint1", 3e-4), ("joint2", 2e-4), ("joint3", 0.0)):
        name = f"backlash.{joint}.width"
        assert abs(result.model.value(name) - width) < 4 * sigma[name]


def test_duplicate_directions_are_found_and_named():
    """The platform's size b_x and its neighbours cannot be seen with a parallel platform."""
    straight = vr.Delta({**vr.TABLE_5_12})
    data = measured(9, robot=straight, noise=quiet(1e-3))
    result = fit(new_model("delta54"), data, free=["*"], hold_out=0)
    words = " ".join(entry["text"] for entry in result.document()["unidentifiable"])
    assert result.estimate.spectrum.rank < 54
    assert "platform balls" in words
    assert any("do not determine" in w for w in result.warnings)
    lost = result.estimate.lost
    assert lost.any()
    assert np.isinf(result.estimate.sigma[lost]).all()
    first = result.model.table.names[np.flatnonzero(lost)[0]]
    assert result.document()["parameters"][first]["sigma"] is None
    # Nothing that was measured changes when the robot does, along any of them.
    table, before = result.model.table, compare(result.model, data).errors.position
    for combination in result.estimate.spectrum.unidentifiable:
        moved = result.model.values.copy()
        for name, tolerances in combination.items():
            moved[table.index_of(name)] += tolerances * table[name].tolerance
        apart = compare(result.model.with_values(moved), data).errors.position - before
        assert np.abs(apart).max() < 1e-9


def test_prior_keeps_what_the_data_cannot_see_at_its_nominal_value():
    data = measured(10, robot=vr.Delta({**vr.TABLE_5_12}))
    result = fit(new_model("delta54"), data, free=["*"], prior=True, hold_out=0)
    moved = (result.model.values - result.model.table.nominal) / result.model.table.tolerance
    assert np.abs(moved).max() < 3
    assert np.isfinite(result.estimate.sigma).all()


def test_too_few_poses_say_how_many_are_needed():
    data = measured(0).select(np.arange(6))
    with pytest.raises(
        FitError, match=r"5 different poses give 30 equations, but 42 parameters.*at least 7"
    ):
        fit(new_model("delta54"), data)


def test_one_pose_repeated_is_one_pose():
    data = measured(0)
    same = data.select(np.zeros(50, dtype=int))
    with pytest.raises(FitError, match="1 different poses give 6 equations"):
        fit(new_model("delta54"), same)


def free_after(**masks):
    return fit(new_model("delta54"), measured(0), hold_out=0, prior=True, **masks).free.sum()


def test_masks_free_and_fix_by_pattern_and_the_narrower_one_wins():
    assert free_after(free=["*.d_z"]) == 45
    assert free_after(fix=["chain1.*"]) == 28
    assert free_after(fix=["*"], free=["chain1.Lb", "chain2.Lb"]) == 2
    assert free_after(free=["*"], fix=["*.b_?"]) == 45


def test_masks_that_contradict_each_other_or_leave_nothing_are_errors():
    with pytest.raises(FitError, match=r"chain1.Lb: free and fix both match; remove one"):
        free_after(free=["chain1.Lb"], fix=["chain1.Lb"])
    with pytest.raises(FitError, match=r"chain1.Lb: free and fix both match"):
        free_after(free=["*.Lb"], fix=["chain1.L?", "chain1.D_x"])
    with pytest.raises(FitError, match="no parameter is free"):
        free_after(fix=["*"])
    with pytest.raises(Exception, match="no parameter matches 'leg1"):
        free_after(free=["leg1.*"])


def test_missing_joints_conditions_and_methods_are_clear_errors():
    model, data = new_model("delta54"), measured(0)
    with pytest.raises(FitError, match=r"no method 'magic': expected one of .*implicit"):
        fit(model, data, method="magic")
    renamed = Dataset.from_arrays(("a", "b", "c"), data.q, data.r, data.R, pose_cov=data.pose_cov)
    with pytest.raises(
        FitError, match="joint joint1, joint2, joint3 is missing; recorded are a, b, c"
    ):
        fit(model, renamed)
    bare = Dataset.from_arrays(JOINTS, data.q, data.r, data.R, pose_cov=data.pose_cov)
    with pytest.raises(FitError, match=r"direction.joint1.*was not recorded, but.*backlash"):
        fit(model.with_effect("backlash"), bare, joint_sigma=1e-4)
    with pytest.raises(FitError, match="joint sigma -1"):
        fit(model, bare, joint_sigma=-1)


def test_an_absurd_parameter_is_a_failed_fit():
    data = measured(0)
    with pytest.raises(
        FitError,
        match=r"chain1.La_x was identified as 0.13.* m, \+2\d.* tolerances from its nominal 0.1199",
    ):
        fit(new_model("delta54"), replace(data, r=1.1 * data.r), hold_out=0)


def test_a_factor_that_all_lengths_share_is_said_and_refused():
    """The fit leaves only noise, but units or the device are wrong, and not every dimension."""
    data = measured(0)
    with pytest.raises(FitError, match=r"all lengths would be 10 % larger than drawn; check units"):
        fit(new_model("delta54"), replace(data, r=1.1 * data.r), hold_out=0)
    small = fit(new_model("delta54"), replace(data, r=1.02 * data.r), hold_out=0)
    said = [w for w in small.warnings if w.startswith("all lengths would be 2")]
    assert said == [w for w in small.warnings if "the scale of the measuring device" in w]
    assert len(said) == 1
    right = fit(new_model("delta54"), data, hold_out=0)
    assert not any("all lengths" in w for w in right.warnings)


def drawn_otherwise(**factors):
    """A delta54 with other nominal values, by the factors of the parameters in each chain."""
    file = yaml.safe_load(dump_model(new_model("delta54")))
    for name, entry in file["parameters"].items():
        factor = factors.get(name.partition(".")[2], 1.0)
        entry |= {"value": factor * entry["value"], "nominal": factor * entry["nominal"]}
    return parse_model(yaml.safe_dump(file, sort_keys=False))


def test_wrong_dimensions_of_a_drawing_are_accepted_if_only_noise_is_left():
    """Arms that are drawn 6 % too long: 14 tolerances, which all data show alike."""
    data, right = measured(0), fit(new_model("delta54"), measured(0), hold_out=0)
    found = fit(drawn_otherwise(La_x=1.06), data, hold_out=0)
    assert found.estimate.chi2 == pytest.approx(right.estimate.chi2, rel=1e-4)
    said = [w for w in found.warnings if "It was accepted, with a larger tolerance" in w]
    assert len(said) == 3
    assert said[0].startswith("chain1.La_x was identified as 0.119")
    assert not any("chain1.La_x moved" in w for w in found.warnings)
    assert not found.implausible
    assert found.model.usual_tolerances["chain1.La_x"] == 5e-4
    again = parse_model(dump_model(found.model))
    assert dump_model(again) == dump_model(found.model)
    assert (again.tolerances, again.usual_tolerances) == (
        found.model.tolerances,
        found.model.usual_tolerances,
    )
    assert not any("accepted" in w for w in fit(again, data, hold_out=0).warnings)
    # A model with effects, noise that nobody stated and a fit that leaves an error prove nothing.
    model = drawn_otherwise(La_x=1.06)
    noisy = replace(data, r=data.r + 1e-3 * np.sin(40 * data.r[:, [1, 2, 0]]))
    unstated = replace(data, pose_cov=np.full_like(data.pose_cov, np.nan))
    for wrong, samples in (
        (model.with_effect("backlash"), data),
        (model, noisy),
        (model, unstated),
    ):
        assert "tolerances from its nominal" in fit(wrong, samples, hold_out=0).implausible
    with pytest.raises(FitError, match=r"La_x was identified as 0.1"):
        fit(model, data, hold_out=0, usual_only=True)


def test_an_effect_larger_than_usual_is_what_the_data_show():
    wide, data = vr.Backlash((3e-2, 2e-2, 2.5e-2)), measured(0)
    model = new_model("delta54").with_effect("backlash")
    found = fit(model, measured(7, effects=[wide]), hold_out=0)
    assert found.model.value("backlash.joint1.width") == pytest.approx(3e-2, rel=0.02)
    assert "mrad; usual up to 3)" in found.unusual["backlash.joint1.width"].description
    stretched = replace(data, r=data.r * [1.01, 1, 1])
    axes = new_model("delta54").with_effect("device_axes")
    found = fit(axes, stretched, fix=["chain*"], hold_out=0)
    assert any(name.startswith("device_axes.scale_") for name in found.unusual)


def test_a_parameter_that_moved_far_is_named_with_its_sigma():
    """So that a reader knows whether the data or the noise moved it."""
    model = new_model("delta54")
    far = np.where(np.array(model.table.names) == "chain1.La_x", 6.0, 0.0)
    moved = model.with_values(model.table.nominal + far * model.table.tolerance)
    spectrum = SimpleNamespace(unidentifiable=())
    for share, words in (
        (0.5, "chain1.La_x moved +6.0 tolerances from nominal (sigma 0.5 tolerances)"),
        (np.inf, "chain1.La_x moved +6.0 tolerances from nominal, but the data do not determine"),
    ):
        result = SimpleNamespace(sigma=share * model.table.tolerance, spectrum=spectrum)
        [shown] = list_parameter_warnings(moved, result, far > 0)
        assert shown.startswith(words)


def test_the_size_of_an_effect_that_the_data_determine_is_a_result_and_no_warning():
    model = new_model("delta54").with_effect("backlash")
    is_width = np.array([name.startswith("backlash.joint1") for name in model.table.names])
    large = model.with_values(model.values + 8.0 * is_width * model.table.tolerance)
    spectrum = SimpleNamespace(unidentifiable=())
    for share, warned in ((0.2, False), (5.0, True), (np.inf, True)):
        result = SimpleNamespace(sigma=share * model.table.tolerance, spectrum=spectrum)
        assert bool(list_parameter_warnings(large, result, is_width)) == warned


def test_a_sign_that_physics_forbids_is_refused():
    wrong = measured(7, effects=[vr.Backlash((-3e-3, -2e-3, -2.5e-3))])
    with pytest.raises(
        WrongSignError,
        match=r"^backlash.joint\d.width would have to be -0.00\d+ rad, but its physics allows no "
        r"negative value: check the recorded direction and travel of the joints \(their sign, the "
        r"order of the visits\), and whether the encoders sit behind the gears$",
    ) as refused:
        fit(new_model("delta54").with_effect("backlash"), wrong, hold_out=0)
    assert refused.value.effect == "backlash"  # which a diagnosis then leaves out


def test_a_covariance_that_no_noise_has_is_refused_with_its_sample():
    data = measured(0)
    strange = np.array(data.pose_cov)
    strange[7, 0, 1] = strange[7, 1, 0] = -3 * strange[7, 0, 0]
    with pytest.raises(FitError, match=r"sample 7: .*covariance is not symmetric, or .*negative"):
        fit(new_model("delta54"), replace(data, pose_cov=strange))
    upper = np.array(data.pose_cov)
    upper[3, 0, 1] = 0.5 * upper[3, 0, 0]
    with pytest.raises(FitError, match="sample 3: the recorded pose covariance is not symmetric"):
        fit(new_model("delta54"), replace(data, pose_cov=upper))


def test_a_joint_that_never_moved_is_named_as_what_the_data_hardly_tell():
    others = np.random.default_rng(0).uniform(0.2, 0.9, (60, 2))
    reading = np.insert(others, 0, 0.53, axis=1)
    r, R = vr.MOCK_UP.forward(reading)
    q, away, turn = vr.THESIS_NOISE.draw(np.random.default_rng(1), 60)
    samples = {"q": reading + q, "r": r + away, "R": vr.turn(turn) @ R, "time": np.arange(60.0)}
    data = as_dataset(samples | {"direction": reading, "pose_index": np.arange(60)})
    result = fit(new_model("delta24"), data, hold_out=0)
    weak = [w for w in result.warnings if w.startswith("these samples hardly determine")]
    assert len(weak) == 1
    assert "of chain 1" in weak[0]
    assert "chain 2" not in weak[0]
    assert result.document()["priors"] == "weak"
    known = fit(new_model("delta24"), data, hold_out=0, prior=True)
    assert np.isfinite(known.estimate.sigma).all()
    assert known.document()["priors"] == "all"


@pytest.mark.wide
def test_a_start_far_off_is_no_obstacle():
    wild = {f"chain{i}.Lb": 1e-4 for i in (1, 2, 3)}
    near, far = (fit(new_model("delta54", p), measured(0), hold_out=0) for p in ({}, wild))
    apart = (far.model.values - near.model.values)[near.free] / near.estimate.sigma[near.free]
    assert np.abs(apart).max() < 1e-3


def test_a_fit_far_beyond_its_noise_settles_all_the_same():
    """Readings 10 mrad off at random, 500 sigmas: curvature counts as much as slopes."""
    model, data = new_model("delta24"), measured(0)
    off = 0.01 * np.random.default_rng(0).standard_normal(data.q.shape)
    observations = observe(model, replace(data, q=data.q + off))
    found = estimate(model, observations, ~model.fixed)
    assert found.iterations < 100
    again = estimate(model.with_values(found.values), observations, ~model.fixed)
    apart = (again.values - found.values)[~model.fixed] / found.sigma[~model.fixed]
    assert np.abs(apart).max() < 1e-2 * np.sqrt(found.chi2_per_dof)


def test_a_damped_step_is_not_taken_for_the_end():
    """Next to a curved valley's floor only short steps lower chi2; the end is far."""
    model, data = new_model("delta54"), measured(0)
    observations, free = observe(model, data), ~model.fixed
    linearise = Linearisation(model, observations, free, weighted=True)
    system = linearise(model.values, linearise.start())
    tolerance = model.table.tolerance[free]
    normal = NormalEquations(
        system, model.values, tolerance, Knowledge.of(False, model.table, free)
    )
    step, promised = normal.step(1e12)
    assert np.abs(step / tolerance).max() < 1e-8
    assert promised < 1e-10 * system.chi2
    assert not normal.has_converged


def test_steps_that_fail_in_turn_raise_the_damping_ever_faster():
    """From a step that hardly any damping shortens to one of a tenth in five trials."""
    damping, tried = Damping(), []
    while damping.size < 10:
        damping = damping.after(fall=-1.0, promised=1.0)
        tried.append(damping.size)
    assert len(tried) == 5
    assert np.all(np.diff(np.diff(np.log(tried))) > 0)
    fell = damping.after(fall=0.4, promised=1.0)  # less than half: curvature
    assert fell == Damping(3 * damping.size)
    assert fell.after(fall=0.9, promised=1.0) == Damping(fell.size / 5)


def test_worst_sample_comes_first_in_a_comparison():
    rows = compare(new_model("delta54"), measured(0)).document()["rows"]
    norms = [row["position_norm"] for row in rows]
    assert norms == sorted(norms, reverse=True)
    assert len(rows) == 94


def test_identification_jacobian_is_the_finite_difference_of_the_residuals():
    model, data = new_model("delta54").with_effect("backlash"), measured(0)
    observations, free = observe(model, data), np.ones(len(model.values), dtype=bool)
    linearise = Linearisation(model, observations, free, weighted=True)
    phi, _, J = linearise.blocks(model.values, observations.x)
    for k in range(len(model.values)):
        step = 1e-6
        moved = model.values + step * np.eye(len(model.values))[k]
        difference = (linearise.blocks(moved, observations.x)[0] - phi) / step
        assert np.abs(difference - J[:, :, k]).max() < 1e-4


def test_a_tilt_that_the_model_excludes_is_reported_although_chi2_does_not_see_it():
    result = fit(new_model("delta24"), measured(4), hold_out=0)
    assert result.estimate.chi2_per_dof < 1.3
    (words,) = [w for w in result.warnings if "holds the orientation at one value" in w]
    assert words.startswith("the orientation error is ")
    assert not any("holds it" in w for w in fit(new_model("delta54"), measured(4)).warnings)


def test_an_estimate_outside_its_range_is_refused_only_beyond_three_of_its_own_sigmas():
    """A play of zero comes out negative half of the time; one far below zero is none."""
    leading = vr.Backlash((-4e-4, -4e-4, -4e-4))
    for seed in range(3):
        result = fit(new_model("delta54").with_effect("backlash"), measured(seed), hold_out=0)
        assert abs(result.model.value("backlash.joint1.width")) < 0.2e-3
    with pytest.raises(FitError, match=r"^backlash.joint1.width would have to be -0.0003"):
        fit(
            new_model("delta54").with_effect("backlash"),
            measured(1, effects=[leading]),
            hold_out=0,
        )
