"""A device that stands anywhere, before platforms that hardly turn: no pose tells of its target."""

from dataclasses import replace

import numpy as np
import pytest
from datasets import measured, quiet

from parallel_cal.base.rotation import (
    nearest_rotation,
    quaternion_to_matrix,
    rotation_matrix,
    rotation_vector,
)
from parallel_cal.campaign.judging import JudgementRequest, judge_samples
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.fleet import judging as fleet_judging
from parallel_cal.identification import observations, registration
from parallel_cal.identification.fit import fit
from parallel_cal.identification.frames import IDENTITY_FRAMES
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.identification.registration import (
    DevicePoses,
    register_device,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.simulate import simulate
from parallel_cal.reporting.contents import HeldOutErrors
from parallel_cal.session.steps import add
from parallel_cal.virtual import robot as vr

SHIFT, TURN = np.array([1.2, -1.4, 0.3]), rotation_matrix(np.array([0.3, -0.2, 2.0]))


def seen_by_a_tracker(data, target=(0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0)):
    """The same poses in a frame of its own, of a target put anywhere."""
    r = (data.r + data.R @ np.array(target) - SHIFT) @ TURN
    return replace(data, r=r, R=TURN.T @ data.R @ rotation_matrix(np.array(turned)), frame="far")


def error_at_unseen_poses(model):
    """Rms distance (m) of the robot alone from the virtual one, moved upon each other."""
    fresh = measured(2, noise=quiet())
    ours = Kinematics(model.robot()).direct(fresh.q).position
    ours, theirs = ours - ours.mean(axis=0), fresh.r - fresh.r.mean(axis=0)
    away = theirs - ours @ nearest_rotation(ours.T @ theirs)
    return np.sqrt(np.mean(np.sum(away**2, axis=1)))


@pytest.mark.parametrize(
    "turned", [(0, 0, 0), pytest.param((0.1, 0.4, -0.2), marks=pytest.mark.wide)]
)
def test_a_delta_before_a_tracker_that_stands_anywhere_is_as_good_as_before_its_own(turned):
    data = measured(1)
    own = error_at_unseen_poses(fit(new_model("delta54"), data, hold_out=0).model)
    found = fit(new_model("delta54"), seen_by_a_tracker(data, turned=turned), hold_out=0)
    assert own < 10e-6
    assert error_at_unseen_poses(found.model) < own + 2e-6
    where = found.registration
    assert np.abs(np.array(where.position) - SHIFT).max() < 5e-3
    assert np.abs(np.array(where.target_position)).max() < 1e-3
    assert "does not turn enough to determine it" in where.description


@pytest.mark.wide
@pytest.mark.parametrize("turned", [(0, 0, 0), (0.3, -0.5, 1.0)])
def test_how_a_target_is_turned_on_a_platform_that_never_turns_is_no_error_of_the_robot(turned):
    """delta24 holds no orientation. A fit without the backlash tilts its base by milliradians: that
    was taken for an error of orientation, and parallelogram_errors for its cause."""
    rng = np.random.default_rng(4)
    drawn = replace(new_model("delta24"), noise=Noise(1e-5, 1e-5, 4e-5))
    built = new_model("delta24", effects=["backlash"])
    off = built.table.nominal + 0.3 * built.table.tolerance * rng.standard_normal(len(built.table))
    values = np.where(built.fixed, built.table.nominal, off)
    for i, width in enumerate((0.0, 2e-3, 0.0), start=1):
        values[built.table.index_of(f"backlash.joint{i}.width")] = width
    built = replace(built.with_values(values), noise=drawn.noise)
    data = seen_by_a_tracker(simulate(built, poses=40, seed=4).dataset(), turned=turned)
    found = fit(drawn, data)
    assert found.held_out.summary.orientation_rms < 1e-4
    assert found.before.summary.orientation_rms < 1e-4
    theirs = rotation_matrix(np.array(turned, float))
    ours = quaternion_to_matrix(found.registration.target_quaternion)
    assert np.linalg.norm(rotation_vector(ours.T @ theirs)) < 0.02
    diagnosis = diagnose(found.model, data, effects=["backlash", "parallelogram_errors"])
    assert [one.name for one in diagnosis.best.fitted.model.effects] == ["backlash"]


def test_a_fit_finds_a_target_at_its_stated_position():
    target = (0.05, 0.02, -0.03)
    device = load_sensor("device_frame", target_position=target)
    data = replace(seen_by_a_tracker(measured(1), target), frame="")
    found = fit(new_model("delta54").with_sensors((device,)), data, hold_out=0)
    assert error_at_unseen_poses(found.model) < 12e-6
    assert np.abs(np.array(found.registration.target_position) - target).max() < 2e-3


@pytest.fixture(scope="module")
def far():
    return seen_by_a_tracker(measured(1))


@pytest.fixture(scope="module")
def of_far(far):
    """The fit to it."""
    return fit(new_model("delta54"), far)


@pytest.mark.wide
def test_the_errors_before_a_fit_are_those_that_compare_shows(far, of_far):
    """A fit starts from frames that the robot's free numbers share in: another 0.5 mm off."""
    shown, fitted = compare(new_model("delta54"), far), of_far
    assert shown.registration is not None
    assert fitted.document()["before"] == shown.errors.document()
    assert np.array_equal(fitted.before.position, shown.errors.position)
    assert errors(fitted.start, fitted.observations).summary != shown.errors.summary


@pytest.mark.wide
def test_at_held_out_poses_the_model_before_is_registered_by_the_other_poses(far, of_far):
    model, fitted = new_model("delta54"), of_far
    before = fitted.held_out_before
    for train, test in far.folds(0.25, 0):
        placed, registration = register_device(model, far.select(train))
        assert registration is not None
        unseen = errors(placed, observe(placed, far.select(test)))
        assert before.position[test] == pytest.approx(unseen.position, abs=1e-12)
    assert np.array_equal(before.judged, fitted.held_out.judged)
    assert before.summary.position_rms > fitted.before.summary.position_rms


@pytest.mark.wide
def test_an_effect_added_to_a_registered_robot_is_compared_with_the_model_that_compare_shows(
    far, of_far
):
    model = new_model("delta54")
    step = add(model, "backlash", far, force=True)
    assert step.document()["before"] == compare(model, far).errors.document()
    assert step.document()["held_out"]["before"] == of_far.document()["held_out"]["before"]


@pytest.mark.wide
def test_the_device_stands_where_it_stands_with_an_effect_whoever_adds_it():
    """The lack of the effect moves the device. Where robot and frame are redundant it is held, and
    the robot pays for it."""
    play = vr.Backlash((2e-3, 1.6e-3, 1.2e-3))
    data = seen_by_a_tracker(measured(3, effects=[play], n_poses=60, n_replicates=0))
    model = new_model("delta54")
    begun_with = fit(model, data, effects=["backlash"], hold_out=0).estimate.chi2
    assert add(model, "backlash", data).result.estimate.chi2 == pytest.approx(begun_with, abs=0.01)
    found = diagnose(model, data).best.fitted.estimate.chi2
    assert found == pytest.approx(begun_with, abs=0.01)


@pytest.mark.wide
def test_a_campaign_s_error_before_is_that_of_the_model_registered_by_the_samples_used(far):
    unseen = np.arange(len(far)) % 5 == 0
    model = replace(new_model("delta54"), noise=replace(new_model("delta54").noise, joint=1.2e-4))
    found = judge_samples(JudgementRequest(dump_model(model), effects=("backlash",)), far, unseen)
    placed, _ = register_device(model, far.select(~unseen))
    shown = errors(placed, observe(placed, far.select(unseen))).summary
    assert found.before["position"] == pytest.approx(shown.position_rms, rel=1e-6)


@pytest.mark.wide
def test_report_and_fleet_show_the_registered_model_before_at_held_out_poses(far, of_far):
    found = diagnose(new_model("delta54"), far, effects=("backlash",))
    expected = of_far.held_out_before.summary
    assert HeldOutErrors.of(found).before == expected
    assert fleet_judging._make_row(found)["before"] == expected


@pytest.mark.parametrize(("poses", "displaced"), [(6, False), (60, True)])
def test_frames_that_explain_an_error_of_few_poses_may_do_so_by_chance(poses, displaced):
    """Positions show 9 numbers of a frame and a target, and 6 positions are 18 numbers."""
    rng = np.random.default_rng(1)
    r, R = rng.uniform(-0.2, 0.2, (poses, 3)), rotation_matrix(rng.uniform(-0.5, 0.5, (poses, 3)))
    noise = rng.standard_normal((poses, 3))
    noise -= noise.mean(axis=0)  # so that it adds to the squares of a shift
    noise *= 1e-4 / np.sqrt(np.mean(np.sum(noise**2, axis=1)))
    shift = np.array([1.76e-4, 0.0, 0.0])  # the noise is just less than a quarter of the squares
    there = DevicePoses(
        r=r,
        R=R,
        seen_r=r - shift + noise,
        seen_R=R,
        measured=np.tile(np.arange(6) < 3, (poses, 1)),
        length=0.1,
        target_is_free=True,
        tilts=True,
        poses=poses,
        expected=np.array([1e-3, 1e-3]),
    )
    shifted = replace(IDENTITY_FRAMES, f=shift)
    assert there.is_displaced(shifted, identified=True) == displaced
    assert there.is_misplaced(shifted, identified=True, stated=False) == displaced


@pytest.mark.parametrize("far_away", [False, True])
def test_a_fit_examines_readings_and_predicts_poses_once_for_one_model(monkeypatch, far_away):
    """Registration, comparison and identification share what the given model says."""
    data = seen_by_a_tracker(measured(0)) if far_away else measured(0)
    asked = {"predicted": [], "examined": []}

    def counted(function, name):
        def call(model, *arguments):
            asked[name].append(model)
            return function(model, *arguments)

        return call

    of = staticmethod(counted(registration.DevicePoses.of, "predicted"))
    monkeypatch.setattr(registration.DevicePoses, "of", of)
    monkeypatch.setattr(
        observations, "doubt_readings", counted(observations.doubt_readings, "examined")
    )
    fit(new_model("delta54"), data, hold_out=0)
    for models in asked.values():
        assert models
        assert len({id(model) for model in models}) == len(models)
