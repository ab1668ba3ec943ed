"""What a verdict says: names that people know, the region it holds for, digits that differ."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_hidden as hidden
import virtual_findings as vf
from datasets import JOINTS, measured
from findings import dataset, hiding, sized

import parallel_cal.diagnosis.verdict as verdicts
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.findings import Doubts, Findings, Remainder, format_effect_names
from parallel_cal.diagnosis.noise import NoiseLevel, PureError
from parallel_cal.diagnosis.noise_shape import NoiseShape
from parallel_cal.diagnosis.region import Region
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.diagnosis.unusual import UnusualEffect
from parallel_cal.diagnosis.verdict import (
    QUIETER,
    _describe_noise_floor,
    _noise,
    judge,
)
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import format_distinctly
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.unusual import UnusualSize
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

MODEL = new_model("delta54")


def test_a_number_outside_its_limits_is_shown_with_the_digits_that_say_so():
    assert format_distinctly([1.1712, 0.85, 1.1708]) == ["1.1712", "0.8500", "1.1708"]
    assert format_distinctly([1.30, 1.17]) == ["1.30", "1.17"]


@pytest.mark.parametrize(
    ("names", "laws", "p", "word"),
    [
        ("", {}, {}, "cannot_know"),
        ("", {"law of joint1": 0.97}, {}, "unexplained"),
        ("backlash", {}, {"backlash": 0.7}, "cannot_know"),
        ("backlash", {}, {"backlash": 0.97}, "partly_explained"),
        ("backlash", {"law of joint1": 0.97}, {"backlash": 0.1}, "partly_explained"),
    ],
)
def test_where_no_noise_is_known_the_word_follows_from_what_is_missing_and_what_is_left(
    names, laws, p, word, monkeypatch
):
    """A law stands out of noise of any size: `left: yes` beside `cannot_know` contradicted it."""
    monkeypatch.setattr(
        verdicts,
        "acceptance",
        lambda best, base: SimpleNamespace(
            basis="at held-out poses", after={}, description="error falls", judged=True
        ),
    )
    monkeypatch.setattr(verdicts, "format_errors", lambda errors: "30 um")
    monkeypatch.setattr(verdicts, "is_of_touches", lambda dataset: False)
    rest = Remainder(
        None,
        SimpleNamespace(has_structure=False),
        SimpleNamespace(remarks=()),
        NoiseLevel(None, 0, "", PureError(None, 0)),
        None,
    )
    fitted = SimpleNamespace(
        estimate=SimpleNamespace(chi2_per_dof=1.0, dof=200), dataset=None, held_out=None
    )
    trial = SimpleNamespace(fitted=fitted, chosen=[Chosen(names)] if names else [])
    found = Findings(
        trial,
        trial,
        1.0,
        rest,
        Doubts(),
        p,
        laws,
    )
    fitted.model = SimpleNamespace(has_effect=lambda name: False)
    judged = verdicts._judge(found)
    assert judged.word == word
    assert ("the residuals still have structure" in judged.summary) is bool(laws)
    assert bool(judged.remarks) is not bool(laws)


def test_several_smooth_errors_of_a_joints_angle_are_called_that():
    """Two are named both; of more, one is an example."""
    discs = ["encoder_eccentricity", "encoder_second_harmonic", "encoder_gain"]
    words = "a smooth error of the joint's angle, e.g. encoder_eccentricity"
    assert format_effect_names(discs) == words
    assert format_effect_names([*discs, "device_axes"]) == f"{words} or device_axes"
    assert format_effect_names(discs[:2]) == "encoder_eccentricity or encoder_second_harmonic"
    assert (
        format_effect_names(["backlash", "hysteresis", "latency"])
        == "backlash or hysteresis or latency"
    )


# --------------------------------------------------------------------------- where it holds


def within(side, seed):
    """74 poses and 20 of them again in a cube of `side` (m) in the middle of the workspace."""
    reading, _ = vr.NOMINAL.inverse(vd.targets(74, seed, side=side))
    day = vd.visit(reading, vr.NOMINAL.inverse(vr.NOMINAL.home)[0], 20, seed)
    noise = vr.THESIS_NOISE
    return dataset(vf.samples(day, [], noise, seed), noise)


def test_a_small_cube_says_how_far_off_the_rest_of_the_workspace_may_be():
    region = Region.of(fit(MODEL, within(0.06, 0), hold_out=0))
    np.testing.assert_allclose(region.high - region.low, 0.06, atol=5e-3)
    assert region.beyond > 2 * region.inside
    assert region.description.startswith(" inside x -")
    assert Region.of(fit(MODEL, within(0.12, 0), hold_out=0)) is None


def test_the_region_is_stated_in_the_robots_base_wherever_the_device_stands():
    """The same samples in the frame of a tracker that stands two metres away and is turned."""
    near = within(0.06, 0)
    turned = rotation_matrix(np.array([0.0, 0.0, 1.2]))
    far = replace(near, r=near.r @ turned.T + [2.0, -1.0, 0.5], R=turned @ near.R, frame="tracker")
    here, there = (Region.of(fit(MODEL, data, hold_out=0)) for data in (near, far))
    np.testing.assert_allclose(there.low, here.low, atol=5e-3)
    np.testing.assert_allclose(there.high, here.high, atol=5e-3)
    assert there.beyond == pytest.approx(here.beyond, rel=0.5)


@pytest.mark.wide
def test_the_stated_uncertainty_outside_the_measured_region_matches_the_true_error():
    """Rms of five robots' true errors in the rest of the workspace, beside what was said."""
    reading, _ = vr.NOMINAL.inverse(vd.targets(300, 77))
    _, truth, _ = vr.truth(
        vr.MOCK_UP, [], reading, vr.SampleConditions(*np.zeros((3, 300)), np.zeros((300, 3)))
    )
    said, errors = [], []
    for seed in range(5):
        result = fit(MODEL, within(0.06, seed), hold_out=0)
        region = Region.of(result)
        away = np.abs(truth - (region.low + region.high) / 2)
        outside = (away > 0.6 * (region.high - region.low)).any(axis=1)
        found = Kinematics(result.model).direct(reading[outside])
        errors.append(np.mean(np.sum((found.position - truth[outside]) ** 2, axis=1)))
        said.append(region.beyond**2)
    assert np.mean(errors) == pytest.approx(np.mean(said), rel=0.6)


@pytest.mark.wide
def test_stop_looking_refers_to_the_region_that_was_measured():
    assert "no further effect is needed inside x -" in diagnose(MODEL, within(0.06, 1)).verdict.text
    assert "no further effect is needed inside" not in diagnose(MODEL, within(0.12, 1)).verdict.text


@pytest.mark.wide
def test_the_summary_states_model_uncertainty_and_the_error_with_twice_as_many_poses():
    day = vf.session(2, n_poses=20, n_replicates=6)
    found = diagnose(MODEL, dataset(vf.samples(day, [], vr.THESIS_NOISE, 2), vr.THESIS_NOISE))
    assert found.verdict.word == "at_noise"
    # Each error that the verdict states is split, in the same order.
    error, floor, twice = (
        [float(v) for v in re.findall(r"([\d.]+) (?:um|arcmin)", words)]
        for words in re.search(
            r"Error at held-out poses (.+?); .*the noise floor is (.+?), and the rest of the "
            r"error is model uncertainty: twice as many poses would reduce the error to about (.+)",
            found.verdict.text,
        ).groups()
    )
    assert len(error) == len(floor) == len(twice) == 2
    assert all(b < c < a for a, b, c in zip(error, floor, twice, strict=True))


# --------------------------------------------------------------------------- what it may name


@pytest.mark.wide
def test_an_effect_found_in_residuals_within_the_noise_leaves_the_verdict_at_noise():
    day, kind = vf.session(0), vf.KINDS["backlash"]
    faint = sized(kind.make, kind.size, 0.2, day, vr.THESIS_NOISE, 0)
    found = diagnose(MODEL, dataset(vf.samples(day, [faint], vr.THESIS_NOISE, 0), vr.THESIS_NOISE))
    assert found.base.fitted.estimate.chi2_per_dof < found.band[1]
    assert found.effects == ("backlash",)
    assert found.verdict.word == "at_noise"
    assert "add it if this gain matters to you" in found.verdict.text


@pytest.mark.wide
def test_the_summary_states_the_noise_floor():
    data = measured(0, effects=[vr.Backlash((3e-4, 2.5e-4, 2e-4))], n_poses=110)
    summary = diagnose(MODEL, data, effects=["backlash"]).verdict.text
    assert "; noise floor 2" in summary or "; noise floor 3" in summary


def test_the_order_of_samples_is_no_time():
    data = measured(1)
    unordered = Dataset.from_arrays(
        JOINTS,
        data.q,
        data.r,
        data.R,
        measured=data.measured,
        pose_cov=data.pose_cov,
        joint_sigma=data.joint_sigma,
        pose_id=data.pose_id,
    )
    scene = Trial((), fit(MODEL, unordered, hold_out=0)).scene
    drift = candidate(scene, "base_drift")
    assert drift.reason == "cannot be tested: no time recorded"
    field = Field.of(scene)
    wandering = replace(field, noise_units=np.cumsum(field.noise_units, axis=0))
    assert not NoiseShape.of(scene, wandering).correlated


# --------------------------------------------------------------------------- the noise floor


@pytest.mark.parametrize(
    ("chi2", "words"),
    [(1.0, "; noise floor 7 um"), (0.06, "; noise floor 7 um by the stated noise")],
)
def test_a_noise_floor_that_the_residuals_contradict_is_said_to_be_that_of_the_stated_noise(
    chi2, words
):
    """A verdict said 1.7 um of error beside a noise floor of 7.1 um."""
    found = SimpleNamespace(
        rest=SimpleNamespace(
            noise=NoiseLevel(1.0, None, "stated (model file)", None),
            shape=SimpleNamespace(remarks=()),
        ),
        final_estimate=SimpleNamespace(chi2_per_dof=chi2, dof=200),
        best=SimpleNamespace(fitted=SimpleNamespace(noise_floor=Summary(position_rms=7e-6))),
    )
    assert _describe_noise_floor(found) == words
    remarks = [f"by the residuals, {QUIETER}"] if chi2 < 1 else []
    assert list(_noise(found)) == remarks


# --------------------------------------------------------------------------- gears


@pytest.mark.wide
@pytest.mark.parametrize("seed", [0, 4])
def test_a_gear_of_20_teeth_is_not_taken_for_one_of_10(seed):
    """Its ripple is the second harmonic of half the ratio, too."""
    ripple = hidden.GearRipple((4e-4, 3e-4, 3.5e-4), (0.3, 1.2, 2.0), 20.0)
    data = dataset(vf.samples(vf.session(seed), [ripple], vr.THESIS_NOISE, seed), vr.THESIS_NOISE)
    one = candidate(Trial((), fit(MODEL, data, hold_out=0)).scene, "gear_transmission_error")
    sigma = one.sigma["ratio"]
    assert 0.05 < sigma < 0.2
    assert one.settings["ratio"] == pytest.approx(20.0, abs=3 * sigma)


def findings_of(found):
    """What the verdict of a diagnosis judges, without doubts, rivals and laws."""
    return replace(found.findings, doubts=Doubts(), probability={}, laws={})


def test_residuals_with_a_law_are_not_at_noise_however_large_the_noise_may_be():
    """A band of few revisits is wide; the shape of what is left tells more than its size."""
    samples = vf.samples(vf.session(0), [], vr.THESIS_NOISE, 0)
    found = diagnose(MODEL, dataset(samples, vr.THESIS_NOISE))
    assert (found.verdict.word, found.left) == ("at_noise", "no")
    findings = findings_of(found)
    assert judge(findings).word == "at_noise"
    lawful = judge(replace(findings, laws={"law of joint1": 0.995}))
    assert lawful.word == "unexplained"
    assert "(law of joint1)" in lawful.summary


def test_what_no_robot_has_is_no_objection_where_nothing_is_left():
    """Beside an effect that leaves only noise, it does not matter what a lookalike would gain."""
    data = hiding([vf.KINDS["backlash"]], 1.0, 0)[0]
    found = diagnose(MODEL, data)
    assert (found.verdict.word, found.left) == ("explained", "no")
    words = "hysteresis would explain the error better, but no robot has so much of it"
    findings = replace(findings_of(found), doubts=Doubts(outdone=(words,)))
    assert judge(findings).word == "explained"
    assert "nothing else is left" not in judge(findings).summary
    # A doubt about the size alone does not contradict that all of the error is accounted for.
    size = UnusualSize("backlash.joint1", 9e-3, 0.0, 3e-3, "rad")
    summary = found.best.fitted.held_out.summary
    worn = UnusualEffect("backlash", (size,), None, summary, None, True)
    doubted = judge(replace(findings, doubts=replace(findings.doubts, unusual=(worn,))))
    assert doubted.word == "partly_explained"
    words_of_size = "; nothing else is left, but backlash is larger than usual. Error at"
    assert words_of_size in doubted.summary
    unclear = replace(findings.doubts, robot_or_device=("backlash",))
    device = judge(replace(findings, doubts=unclear))
    assert "nothing else is left, but the robot or the measuring device may be" in device.summary
    on_payload = SimpleNamespace(description="the residuals depend on the payload")
    doubtful = judge(replace(findings, rest=replace(findings.rest, condition=on_payload)))
    assert doubtful.word == "partly_explained"
    assert words in doubtful.against
