"""Noise that is not white, or not as stated, is said to be that, and named as nothing else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import virtual_blind as vb
import virtual_findings as vf
from findings import dataset, quiet, sized
from scipy import stats

from bench.truth import coverage
from parallel_cal.diagnosis import verdict
from parallel_cal.diagnosis.causes import _find_noise
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.findings import Doubts
from parallel_cal.diagnosis.noise import NoiseLevel, PureError
from parallel_cal.diagnosis.remaining import RemainingCondition
from parallel_cal.identification.fit import fit
from parallel_cal.identification.noise_figures import list_noise
from parallel_cal.identification.observations import ESTIMATED
from parallel_cal.model.model import new_model
from parallel_cal.posterior.evidence import Evidence
from parallel_cal.posterior.scene import Scene
from parallel_cal.virtual import robot as vr


def noisy(kind, seed, effects=()):
    """150 samples with noise of a kind, stated as white and of the thesis' size."""
    day, noise = vf.session(seed), vr.THESIS_NOISE
    still = vf.samples(day, effects, quiet(0.0), 0)
    units = kind(len(still["q"]), still["r"], np.random.default_rng([seed, 5]))
    q, r, w = vb.draw(noise, units)
    seen = still | {"q": still["q"] + q, "r": still["r"] + r, "R": vr.turn(w) @ still["R"]}
    return dataset(seen, noise)


def found_in(data):
    return diagnose(new_model("delta54"), data)


def replicates(dof, variance=1.0):
    return NoiseLevel(variance, dof, "replicates", PureError(variance, dof))


@pytest.mark.parametrize(
    ("variance", "structured", "correlated", "believed"),
    [
        (0.25, True, False, True),
        (0.25, False, True, False),  # visits soon after each other share their noise
        (4.0, False, True, True),
        (4.0, True, False, False),  # the robot moved between the visits
    ],
)
def test_visits_that_contradict_the_stated_noise_are_not_always_believed(
    monkeypatch, variance, structured, correlated, believed
):
    monkeypatch.setattr(PureError, "of", lambda scene, field: PureError(variance, 60))
    scene = SimpleNamespace(observations=SimpleNamespace(noise_from={"position": "option"}))
    level = NoiseLevel.of(scene, None, structured, correlated)
    assert (level.variance, level.dof) == ((variance, 60) if believed else (1.0, None))
    assert level.source.startswith("replicates" if believed else "stated")


def test_the_band_of_two_replicates_and_two_other_degrees_of_freedom_is_that_worked_by_hand():
    # F(2, 2) lies below x with probability x / (1 + x), so its 0.5 % and 99.5 % points are 1/199
    # and 199. chi2/dof is the mean of that and of the scatter itself, which is 1.
    assert replicates(2).band(4) == pytest.approx(((1 / 199 + 1) / 2, 100), rel=1e-9)
    assert replicates(2, variance=4).band(4)[1] == pytest.approx(400, rel=1e-9)


@pytest.mark.parametrize(("dof", "of_replicates"), [(150, 10), (150, 30), (522, 8)])
def test_the_band_counts_the_replicates_as_a_part_of_the_residuals(dof, of_replicates):
    # The share of the replicates in chi2 has a beta distribution: neither chi2 nor a plain F.
    share = stats.beta(of_replicates / 2, (dof - of_replicates) / 2).ppf([0.995, 0.005])
    band = replicates(of_replicates).band(dof)
    assert band == pytest.approx(of_replicates / dof / share, rel=1e-6)


@pytest.mark.parametrize("dof", [1, 2, 10, 150])
def test_the_band_of_a_stated_noise_is_that_of_chi2(dof):
    known = NoiseLevel(1.0, None, "stated", PureError(None, 0))
    assert known.band(dof) == pytest.approx(stats.chi2(dof).ppf([0.005, 0.995]) / dof, rel=1e-6)


def test_replicates_alone_cannot_show_an_error_of_the_model():
    assert replicates(10).count_testing_dof(10) == 0
    assert replicates(10).band(10) == (0, np.inf)


@pytest.mark.wide
def test_visits_that_differ_by_more_than_the_stated_noise_may_be_noise_or_motion():
    found = found_in(noisy(vb.twice, 0))
    assert found.verdict.word == "cannot_know"
    assert "visits of the same pose differ by 2.0 times the stated noise" in found.verdict.text
    assert "depends on no recorded condition" in found.verdict.text
    assert not found.effects
    assert found.remaining is None
    assert found.noise.misstated == pytest.approx(2.0, abs=0.2)
    assert found.base.fitted.estimate.chi2_per_dof > 3


@pytest.mark.parametrize(
    ("remaining", "word"),
    [(None, "at_noise"), (RemainingCondition("payload", 1e-28), "unexplained")],
)
def test_what_depends_on_a_condition_is_no_noise_though_revisited_poses_differ_as_much(
    remaining, word, monkeypatch
):
    """Visits under other loads differ by what the load does: without a stated noise, that passed
    for noise, and the verdict was `at_noise`."""
    seen = PureError(1.0, 132)
    noise = NoiseLevel(1.0, seen.dof, "replicates", seen)
    found = SimpleNamespace(
        final_estimate=SimpleNamespace(chi2_per_dof=1.0, dof=850),
        high_after=noise.band(850)[1],
        rest=SimpleNamespace(
            noise=noise,
            condition=remaining,
            shape=SimpleNamespace(remarks=()),
            structure=SimpleNamespace(has_structure=False),
        ),
        doubts=Doubts(refused=("the compliance would have to be negative",)),
        best=SimpleNamespace(fitted=None),
        laws={},
    )
    monkeypatch.setattr(verdict.Region, "of", lambda fitted: None)
    monkeypatch.setattr(verdict, "_uncertainty", lambda found: [])
    monkeypatch.setattr(verdict, "is_touched_at_one_height", lambda fitted: False)
    judged = verdict._nothing_found(found, "error 15.1 um")
    assert judged.word == word
    assert "the compliance would have to be negative" in judged.text


@pytest.mark.wide
def test_visits_that_differ_by_more_than_the_jitter_within_dwells_are_not_at_noise():
    """Nothing is stated: the jitter within a dwell is half of what the visits of a pose show."""
    data, noise = noisy(vb.twice, 0), vr.THESIS_NOISE
    jitter = [*[noise.position] * 3, *[noise.orientation] * 3]
    unstated = replace(
        data,
        joint_sigma=None,
        pose_cov=np.zeros_like(data.pose_cov),
        scatter_q=np.full_like(data.q, noise.joint),
        scatter_pose=np.tile(jitter, (len(data), 1)),
    )
    found = found_in(unstated)
    assert found.verdict.word == "cannot_know"
    assert "differ by 2.0 times the jitter within dwells" in found.verdict.text
    assert "what differed between the visits?" in found.verdict.text
    assert "no further effect is needed" not in found.verdict.text
    assert found.noise.is_exceeded
    assert not found.effects


@pytest.mark.parametrize("seed", [0, 3])
def test_jitter_within_dwells_is_no_noise_by_which_residuals_are_errors(seed):
    """The joints scatter by a fifth of their noise at rest, and the device states its own."""
    data, noise = noisy(vb.white, seed), vr.THESIS_NOISE
    jitter = replace(data, joint_sigma=None, scatter_q=np.full_like(data.q, noise.joint / 5))
    alone = jitter.select(np.unique(jitter.pose_id, return_index=True)[1])
    found = found_in(alone)
    assert not found.effects
    assert not found.explanation.laws
    joints, *_ = list_noise(found.model, found.best.fitted.observations)
    assert (joints.name, joints.source) == ("joints", ESTIMATED)
    assert joints.value == pytest.approx(noise.joint, rel=0.15)


@pytest.mark.wide
def test_noise_half_as_large_as_stated_hides_no_play():
    half = vf.KINDS["backlash"].make(0.1e-3, np.random.default_rng(0))
    found = found_in(noisy(lambda *a: 0.5 * vb.white(*a), 0, [half]))
    assert found.effects == ("backlash",)
    assert found.noise.misstated == pytest.approx(0.5, abs=0.06)


@pytest.mark.wide
def test_noise_that_wanders_is_no_drift():
    found = found_in(noisy(vb.correlated, 0))
    assert not found.effects
    assert found.noise_shape.correlated
    assert "noise is correlated over" in found.verdict.text
    drift = next(e for e in found.entries if e.name == "base_drift")
    assert "shuffled" in drift.reason or "indistinguishable from drift" in drift.reason


@pytest.mark.wide
def test_drifting_noise_is_not_taken_for_compliance_when_loads_change_slowly():
    """Two loads in turn, three times each: a device that wanders is now higher, now lower."""
    found = found_in(noisy(vb.correlated, 5))
    assert not found.effects
    give = next(e for e in found.entries if e.name == "joint_compliance")
    assert give.candidate.varies_slowly
    assert not next(e for e in found.entries if e.name == "backlash").candidate.varies_slowly


@pytest.mark.wide
def test_a_drift_in_white_noise_is_still_a_drift():
    day, kind = vf.session(1), vf.KINDS["base drift"]
    drift = sized(kind.make, kind.size, 0.8, day, vr.THESIS_NOISE, 1)
    found = found_in(noisy(vb.white, 1, [drift]))
    assert found.effects == ("base_drift",)
    assert not found.noise_shape.correlated


@pytest.mark.wide
def test_noise_that_grows_outwards_is_reported_as_growing():
    found = found_in(noisy(vb.growing, 0))
    assert not found.effects
    assert found.noise_shape.grows_from_centre
    assert found.verdict.word == "cannot_know"  # the noise exceeds the stated one, too
    assert "visits of the same pose differ by 2.2 times the stated noise" in found.verdict.text
    assert "times larger far from the centre" in found.verdict.text


@pytest.mark.parametrize(("variance", "contradicted"), [(1.4, False), (1.6, True), (0.6, True)])
def test_replicates_that_may_be_luck_contradict_no_stated_noise(variance, contradicted):
    """150 degrees of freedom: 1.4 has a chance of 9e-4, 1.6 of 4e-6 and 0.6 of 3e-5."""
    assert PureError(variance, 150).contradicts_stated_noise is contradicted


def test_visits_of_one_pose_count_once_by_hand():
    """R = 60 of 60 replicates, L = 400 or 200 of the other 90 of 150 degrees of freedom.

    p(L | R) is a t distribution: -(60 + 90)/2 log((1 + 400/60) / (1 + 200/60)) = -75 log(23/13).
    With the visits in the prior and in the residual it was -(60 + 150)/2 log(520 / 320).
    """
    session = coverage.draw_session(np.random.default_rng([77, 0]), replicates=40)
    unstated = replace(
        session.data, pose_cov=np.full_like(session.data.pose_cov, np.nan), joint_sigma=None
    )
    found = fit(new_model("five_bar"), unstated, hold_out=0)
    scene = Scene.of(found.model, found.dataset, found.observations, found.free)
    variance, nu = _find_noise(scene)
    of_visits = PureError.of(scene, Field.of(scene))
    assert of_visits.dof > 60
    assert variance == pytest.approx(of_visits.variance)
    large, small = (Evidence(60.0 + rest, 150, nu).log_p for rest in (400.0, 200.0))
    assert large - small == pytest.approx(-75 * np.log(23 / 13), rel=0.02)
    assert large - small != pytest.approx(-105 * np.log(520 / 320), rel=0.1)
