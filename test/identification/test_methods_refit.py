"""Partial re-calibration, priors from an earlier fit, and losses that mistrust bad samples."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_day as vd
from datasets import as_dataset, measured, redrawn

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.fit import fit
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.refit import add_consider_covariance
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.session.steps import fitted
from parallel_cal.virtual import robot as vr

MM = 1e-3
OFFSETS = "chain?.La_y"  # across the arm: what a joint's zero moves
SHIFT = np.array([4e-3, -3e-3, 2e-3])  # of the joints' zeros after homing anew, rad
BAD = [3, 30, 60]


def few(seed):
    """Five poses of the re-homed robot."""
    samples = redrawn(vd.dwell_samples(vr.MOCK_UP, seed=7), seed)
    first = np.unique(samples["pose_index"], return_index=True)[1][:5]
    return rehomed(as_dataset({k: v[first] for k, v in samples.items()}))


def rehomed(data):
    return replace(data, q=data.q + SHIFT)


def unseen(shift=0.0):
    """Joint readings and positions of the true robot at poses that no fit has seen."""
    samples = vd.dwell_samples(vr.MOCK_UP, seed=99)
    return samples["reading"] + shift, samples["true_r"]


def error(model, true):
    joints, position = true
    return np.linalg.norm(Kinematics(model).direct(joints).position - position, axis=1).mean()


@pytest.fixture(scope="module")
def calibrated():
    return fit(new_model("delta54"), measured(0), hold_out=0).model


def test_five_poses_bring_a_rehomed_robot_back(calibrated):
    result = fit(calibrated, few(0), refit=[OFFSETS], hold_out=0)
    assert error(calibrated, unseen(SHIFT)) > 0.5 * MM
    assert error(result.model, unseen(SHIFT)) < 0.02 * MM
    noise = mean_error(calibrated, measured(99))
    assert mean_error(result.model, rehomed(measured(99))) < 1.3 * noise
    kept = ~result.free
    assert result.free.sum() == 3
    assert (result.model.values[kept] == calibrated.values[kept]).all()
    assert (result.model.fixed == calibrated.fixed).all()


def test_the_parameters_kept_keep_their_covariance_in_the_model_file(calibrated, tmp_path):
    write_model(calibrated, tmp_path / "before.yaml")
    before = read_model(tmp_path / "before.yaml")
    result = fit(before, few(0), refit=[OFFSETS], hold_out=0)
    write_model(result.model, tmp_path / "after.yaml")
    after, kept = read_model(tmp_path / "after.yaml"), np.ix_(~result.free, ~result.free)
    assert np.allclose(after.covariance[kept], before.covariance[kept], rtol=1e-9, atol=0)
    assert (np.linalg.eigvalsh(after.covariance) > -1e-18).all()
    parameters = result.document()["parameters"]
    assert parameters["chain1.Lb"]["sigma"] == pytest.approx(
        np.sqrt(before.covariance[np.diag_indices(54)])[before.table.index_of("chain1.Lb")]
    )


@pytest.mark.wide
@pytest.mark.parametrize("draws", [50, pytest.param(200, marks=pytest.mark.slow)])
def test_the_sigma_of_refitted_parameters_is_their_spread_over_draws(draws):
    """Both sessions are measured anew in every draw: the kept parameters err, too."""
    first, model = vd.dwell_samples(vr.MOCK_UP, seed=0), new_model("delta54", vr.TABLE_5_12)
    offsets, free, found = model.table.matching([OFFSETS]), ~model.fixed, []
    others = model.table.matching(["chain?.Lb", "chain?.D_x"])
    with single_threaded():
        for seed in range(draws):
            start = estimate(model, observe(model, as_dataset(redrawn(first, seed))), free)
            start = model.with_values(start.values, start.covariance)
            observations = observe(model, few(1000 + seed))
            again = estimate(start, observations, offsets)
            found.append(add_consider_covariance(start, observations, offsets, again))
    values = np.array([e.values for e in found])
    covariance = np.mean([e.covariance for e in found], axis=0)
    spread = np.cov(values.T)
    ratio = np.sqrt(np.diag(spread)[offsets] / np.diag(covariance)[offsets])
    assert np.abs(ratio - 1).max() < 3 / np.sqrt(2 * draws)
    alone = np.mean([e.spectrum.covariance for e in found], axis=0)
    assert (np.sqrt(np.diag(spread)[offsets] / np.diag(alone)) > 1.15).any()  # not the few poses
    scale = np.sqrt(np.outer(np.diag(covariance)[offsets], np.diag(covariance)[others]))
    apart = (spread - covariance)[np.ix_(offsets, others)] / scale
    assert np.abs(apart).max() < 4 / np.sqrt(draws)


def test_a_model_never_identified_cannot_be_refitted():
    with pytest.raises(FitError, match="the model has none: identify all parameters first"):
        fit(new_model("delta54"), few(0), refit=[OFFSETS])
    with pytest.raises(FitError, match="do not combine it with free or fix"):
        fit(new_model("delta54"), few(0), refit=[OFFSETS], fix=["chain1.*"])


@pytest.mark.parametrize("method", ["linear", "cascaded", "semiparametric", "sensitivity"])
def test_methods_that_do_not_settle_take_neither_loss_nor_refit(method, calibrated):
    with pytest.raises(FitError, match=f"'{method}' is not one: use implicit or forward"):
        fit(calibrated, few(0), method=method, refit=[OFFSETS])
    with pytest.raises(FitError, match=r"the loss 'huber' needs an iterative method that weights"):
        fit(calibrated, measured(0), method=method, loss="huber")


def test_two_sessions_one_after_the_other_are_both_at_once():
    """An earlier result as prior holds what the earlier data said."""
    model = new_model("delta54", vr.TABLE_5_18)
    whole, poses = measured(1), np.arange(94)
    first, second = whole.select(poses % 2 == 0), whole.select(poses % 2 == 1)
    start = fit(model, first, hold_out=0).model
    both = fit(start, second, hold_out=0, prior=Prior.from_model(start))
    at_once = fit(model, whole, hold_out=0)
    apart = (both.model.values - at_once.model.values)[both.free]
    apart /= at_once.estimate.sigma[both.free]
    assert np.abs(apart).max() < 0.3  # the earlier one was linearised where it ended
    assert np.median(np.abs(apart)) < 0.05
    assert both.estimate.sigma[both.free] == pytest.approx(
        at_once.estimate.sigma[both.free], rel=0.02
    )


def test_a_prior_makes_one_pose_enough(calibrated):
    one = few(0).select(np.arange(1))
    with pytest.raises(FitError, match="1 different poses give 6 equations"):
        fit(calibrated, one, hold_out=0)
    sure = Prior.from_model(calibrated)
    result = fit(calibrated, measured(3).select(np.arange(1)), hold_out=0, prior=sure)
    free, before = result.free, np.sqrt(np.diag(calibrated.covariance))
    assert (result.estimate.sigma[free] <= before[free] * (1 + 1e-9)).all()
    assert (np.abs(result.model.values - calibrated.values)[free] < 3 * before[free]).all()


def test_a_prior_that_knows_a_free_parameter_exactly_is_an_error(calibrated):
    exact = Prior(calibrated.table.names, calibrated.values, np.zeros_like(calibrated.covariance))
    with pytest.raises(FitError, match="singular: fix the parameters"):
        fit(calibrated, measured(0), prior=exact)
    with pytest.raises(FitError, match="no covariance to use as a prior"):
        Prior.from_model(new_model("delta54"))


def mean_error(model, data):
    return compare(model, data).document()["position_mean"]


def spoilt():
    data = measured(0)
    r = np.array(data.r)
    r[BAD] += np.array([[1.5, 0, 0], [0, -2, 0], [0, 0.7, 1.2]]) * MM
    return data, replace(data, r=r)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("loss", "bias"), [("huber", 1.5), ("soft_l1", 1.5), ("cauchy", 1.1), ("arctan", 1.1)]
)
def test_three_gross_outliers_are_named_and_do_no_harm(loss, bias):
    """The first two never let go of a sample altogether, which shows where nothing else errs."""
    clean, bad = spoilt()
    true = unseen()
    well = fit(new_model("delta54"), clean, hold_out=0)
    best = error(well.model, true)
    pulled = fit(new_model("delta54"), bad, hold_out=0)
    held = fit(new_model("delta54"), bad, hold_out=0, loss=loss)
    assert error(pulled.model, true) > 3 * best
    assert error(held.model, true) < bias * best
    judge = measured(99)
    assert mean_error(held.model, judge) < 1.1 * mean_error(well.model, judge)
    document = held.document()
    assert document["loss"] == loss
    assert sorted(d["sample"] for d in document["down_weighted"]) == BAD
    assert {d["time"] for d in document["down_weighted"]} == set(bad.time[BAD])
    assert all(0 < d["weight"] < 0.5 for d in document["down_weighted"])
    assert any(w.startswith(f"samples down-weighted by loss {loss}:") for w in held.warnings)
    assert pulled.document()["down_weighted"] == []


def test_the_history_says_what_was_refitted_with_which_loss_and_mistrusted(calibrated, tmp_path):
    spoilt = few(0)
    wrong = np.array(spoilt.r)
    wrong[2] += 3 * MM
    step = fitted(
        calibrated, replace(spoilt, r=wrong), refit=[OFFSETS], loss="cauchy", hold_out=0, force=True
    )
    write_model(step.model, tmp_path / "model.yaml")
    entry = read_model(tmp_path / "model.yaml").history[-1]
    assert entry["loss"] == "cauchy"
    assert entry["refit"] == [f"chain{i}.La_y" for i in (1, 2, 3)]
    assert entry["down_weighted"] == [2]
    plain = fitted(calibrated, measured(1), hold_out=0, force=True).model.history[-1]
    assert not {"loss", "refit", "down_weighted"} & plain.keys()


def test_refitting_with_assumed_noise_scales_only_what_is_new(calibrated):
    """The parameters kept keep their covariance, and what it adds does not depend on the guess."""
    bare, sigma = few(0), vr.THESIS_NOISE
    bare = replace(bare, pose_cov=np.zeros_like(bare.pose_cov), joint_sigma=None)
    found = []
    for size in (1.0, 7.0):
        guess = Noise(size * sigma.joint, size * sigma.position, size * sigma.orientation, True)
        found.append(
            fit(replace(calibrated, noise=guess), bare, refit=[OFFSETS], hold_out=0).estimate
        )
    assert found[0].covariance == pytest.approx(found[1].covariance, rel=1e-3, abs=1e-16)


def test_an_unknown_loss_is_a_clear_error():
    with pytest.raises(FitError, match=r"no loss 'tukey'; there are linear, huber"):
        fit(new_model("delta54"), measured(0), loss="tukey")
