"""What readings may have meant, and when no such meaning is named."""

import re
from dataclasses import replace

import numpy as np
import pytest
from datasets import measured

import parallel_cal.identification.fit as identification
from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis import fitting
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.fitting import fit
from parallel_cal.identification.column_doubts import doubt_columns
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.observations import observe
from parallel_cal.identification.outliers import describe_far_values
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Noise, new_model
from parallel_cal.recordings.dataset import Dataset

MODEL = new_model("delta24")
LINEAR = replace(new_model("linear_delta"), noise=Noise(joint=1e-5, position=1e-5))


@pytest.fixture(scope="module")
def session():
    return measured()


def doubt(dataset, **limits):
    observations = observe(MODEL, dataset, insist=True)
    there = DevicePoses.of(MODEL, observations)
    return doubt_columns(MODEL, observations, there, "", suspected=True, **limits)


def exchanged(dataset):
    return replace(dataset, q=dataset.q[:, [1, 0, 2]])


def in_millimetres(dataset):
    return replace(dataset, r=1e3 * dataset.r)


def test_positions_in_mm_are_named_only_if_nothing_else_is_wrong(session):
    """Beside exchanged columns, too, m in place of mm makes errors a thousand times smaller. They
    are then still 33 mm, most of the motion: who corrected that alone would be misled."""
    assert "positions are in mm, not m" in doubt(in_millimetres(session))
    assert doubt(exchanged(in_millimetres(session))) == ""


def test_positions_in_inches_are_named(session):
    assert "positions are in inches, not mm" in doubt(replace(session, r=session.r / 25.4))


def test_other_columns_are_named_only_if_they_fit_better_than_what_is_known(session):
    """An error of the robot that explains the samples better than exchanged columns do is likelier
    than those, which leave 0.07 mm before a fit."""
    assert "joint1, joint2 are in the columns of joint2, joint1" in doubt(
        exchanged(session), most=1e-4
    )
    assert doubt(exchanged(session), most=5e-5) == ""


def test_no_other_meaning_is_named_that_explains_hardly_more_than_the_given_one(session):
    """Of many guesses, one is a little better by chance: here that of right readings, with 2 mm of
    noise. Exchanged columns beside noise of 4 mm leave 33 mm, and are still named."""
    noise = np.random.default_rng(0).standard_normal(session.r.shape)
    assert doubt(replace(session, r=session.r + 2e-3 * noise)) == ""
    assert "in the columns of" in doubt(exchanged(replace(session, r=session.r + 4e-3 * noise)))


def test_guesses_about_other_samples_are_judged_anew(session):
    """Those about the same samples are kept."""
    assert doubt(exchanged(session))
    assert doubt(session) == ""
    assert doubt(exchanged(session))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q": np.diag([-1.0, -1.0, 1.0])}, "joint1, joint2 have the other sign (column map: j"),
        ({"q": np.radians(1.0) * np.eye(3)}, "the joints are in rad, not deg (column map: unit)"),
        ({"r": np.diag([1.0, -1.0, 1.0])}, "the frame of the device is left-handed (two"),
    ],
    ids=["signs", "unit", "left-handed"],
)
def test_what_readings_meant_is_named_with_the_entry_of_a_column_map(session, change, words):
    assert words in doubt(
        replace(session, **{name: getattr(session, name) @ M for name, M in change.items()})
    )


def linear_delta(poses=40, around=(0.0, 0.0, 0.1), reach=(0.06, 0.06, 0.08), factor=1.0):
    """Samples of a linear Delta, by Pythagoras: three carriages on upright rails at a radius of 100
    mm (that of the platform subtracted), and rods of 250 mm. All lengths are read `factor` times as
    large."""
    rng = np.random.default_rng(0)
    r = np.array(around) + rng.uniform(-1, 1, (poses, 3)) * reach
    turns = np.radians([0, 120, 240])
    feet = 0.1 * np.column_stack([np.cos(turns), np.sin(turns)])
    away = np.linalg.norm(r[:, None, :2] - feet, axis=2)
    q = r[:, 2:] + np.sqrt(0.25**2 - away**2)
    q, r = (one + 1e-6 * rng.standard_normal((poses, 3)) for one in (q, r))
    return Dataset.from_arrays(LINEAR.joints, factor * q, factor * r, source="delta.csv")


def test_lengths_in_m_that_are_taken_for_mm_are_refused_though_they_agree_with_each_other():
    with pytest.raises(FitError, match=r"delta.csv: .* 0\.\d+ % of .* are in m, not mm .*--force"):
        fit(LINEAR, linear_delta(factor=1e-3))
    forced = fit(LINEAR, linear_delta(factor=1e-3), insist=True, hold_out=0)
    assert any("joints and positions are in m, not mm" in w for w in forced.warnings)


def test_a_session_of_a_small_region_is_no_session_in_another_unit():
    small = np.array([0.06, 0.06, 0.08]) / 1000
    GivenModel.of(LINEAR, linear_delta(reach=small))
    GivenModel.of(LINEAR, linear_delta())
    # Spread as little, and no pose of the robot a thousand times as large.
    rng = np.random.default_rng(1)
    odd = linear_delta(factor=1e-3)
    GivenModel.of(LINEAR, replace(odd, r=rng.permutation(odd.r)))


def test_joints_and_positions_in_m_disagree_with_orientations(session):
    """The platform turns as far as it does, whatever the unit of lengths."""
    rng = np.random.default_rng(0)
    stewart = new_model("stewart42")
    r = np.array(stewart.mechanism.home.position) + rng.uniform(-0.03, 0.03, (40, 3))
    R = rotation_matrix(rng.uniform(-0.15, 0.15, (40, 3)))
    q = Kinematics(stewart).inverse(r, R).joints
    data = Dataset.from_arrays(stewart.joints, 1e-3 * q, 1e-3 * r, R)
    with pytest.raises(FitError, match="joints and positions are in m, not mm"):
        GivenModel.of(stewart, data)


def unseen(*blind, z=-9.999):
    """Samples of the linear Delta in which the device wrote -9999 mm for the z that it did not
    see."""
    data = linear_delta()
    r = data.r.copy()
    r[list(blind), 2] = z
    return replace(data, r=r, joint_units=("m", "m", "m"))


def test_the_value_of_a_device_that_saw_nothing_is_named_by_fit():
    """It spoke of exchanged columns where the fit failed, or left the motion unexplained."""
    value = r"z -9999 mm, others [\d.]+ to [\d.]+ mm"
    with pytest.raises(FitError, match=rf"1 sample has values .* {value}\).* exclude=7\. As"):
        fit(LINEAR, unseen(7))


def test_motion_that_is_not_explained_beside_an_outlier_is_put_down_to_it(monkeypatch):
    monkeypatch.setattr(fitting, "describe_unexplained_motion", lambda result: "it misses")
    words = (
        r"^sample 7 \(.*; z -999 mm, others .*\) contradicts .* exclude=7\. With all .*, it misses$"
    )
    with pytest.raises(FitError, match=words):
        fit(LINEAR, unseen(7, z=-0.999), hold_out=0)


def test_a_noise_that_was_estimated_with_far_values_does_not_hide_them(monkeypatch):
    """A cell of -9999 mm was 1.6 sigmas of the noise that was estimated with it: `fit` named no
    sample, and a diagnosis found all of them at the noise."""
    searched = []
    monkeypatch.setattr(
        identification, "search_outliers", lambda *given: searched.append((given[2], given[4]))
    )
    model = replace(LINEAR, noise=Noise())
    result = identification.fit(model, unseen(7, z=-0.999), insist=True, hold_out=0)
    [(seen, known)] = searched
    estimated, assumed = (
        np.sqrt(np.diagonal(one.S, axis1=1, axis2=2)[:, -6:-3].max())
        for one in (result.observations, seen)
    )
    assert known is None
    assert assumed < 1e-3 < estimated


def test_the_value_of_a_device_that_saw_nothing_is_named_by_a_diagnosis():
    value = r"z -9999 mm, others [\d.]+ to [\d.]+ mm"
    found = diagnose(LINEAR, unseen(7), effects=["backlash"])
    assert re.search(rf"sample 7 \(.*; {value}\)", found.verdict.text)
    assert describe_far_values(linear_delta()) == {}
    q = linear_delta().q
    q[4, 1] = 1e7
    named = describe_far_values(replace(unseen(), q=q))
    assert list(named) == [4]
    assert named[4].startswith("joint2 1e+10 mm, others ")


@pytest.mark.wide
@pytest.mark.parametrize("judge", [fit, diagnose])
def test_a_sixth_of_the_samples_without_a_sight_of_the_target_is_named_and_no_column(judge):
    """They are too many to be outliers of a fit."""
    with pytest.raises(
        FitError, match=r"7 samples have .* z -9999 mm.* exclude=2,7,12,19,24,32,38\. As"
    ):
        judge(LINEAR, unseen(2, 7, 12, 19, 24, 32, 38))
