"""Recordings of one robot between which the tracker, or its target, was set up anew."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import virtual_arm as va
from arms import nominal, seen
from datasets import measured
from scipy.spatial.transform import Rotation
from test_registration import error_at_unseen_poses, seen_by_a_tracker
from twins import hexapod

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.moved_frames import DEVICE, ZEROS, rank_what_moved
from parallel_cal.identification.observations import observe
from parallel_cal.identification.registration import STATION_EFFECT, DevicePoses
from parallel_cal.identification.stations import LATER_RECORDINGS, has_stations
from parallel_cal.identification.unusual import UnusualSize
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.reporting import text
from parallel_cal.session.steps import add, fitted

FIRST = va.FAR_AWAY
SECOND = replace(
    FIRST, shift=(1.0, 1.5, -0.2), turned=(0.1, 0.3, -2.5), target=(0.02, -0.03, 0.123)
)
SHIFT = np.linalg.norm(np.subtract(SECOND.shift, FIRST.shift))


def recorded(tracker, seed, pose=False, robot=None, n=40):
    session = va.session(robot or va.arm("ur5", 1), n, seed, tracker)
    name = f"tracker{seed}"
    return replace(seen(session, pose, name), sha256=str(seed) * 64, source=name)


def joined(*trackers, **options):
    return join_datasets([recorded(t, seed, **options) for seed, t in enumerate(trackers)])


@cache
def known_of_first():
    """The model that one recording before the first station gives."""
    return fit(nominal("ur5"), recorded(FIRST, 0), hold_out=0).model


def rms(errors):
    return errors.summary.position_rms


@pytest.mark.wide
@pytest.mark.parametrize("pose", [True, False], ids=["pose", "position"])
def test_two_stations_give_the_geometry_of_one_station(pose):
    model = nominal("ur5")
    two, one = fit(model, joined(FIRST, SECOND, pose=pose)), fit(model, recorded(FIRST, 0, pose))
    assert rms(two.held_out) < 1.15 * two.noise_floor.position_rms
    assert 0.8 < two.estimate.chi2_per_dof < 1.2
    # Predictions at unseen poses of the first station, then each parameter within its sigma.
    fresh = seen(va.session(va.arm("ur5", 1), 60, 9, FIRST.exact()), pose, "tracker0")
    errors = [rms(compare(result.model, fresh, joint_sigma=1e-5).errors) for result in (two, one)]
    assert errors[0] < 1.1 * errors[1]
    both = [i for i, name in enumerate(one.model.table.names) if one.free[i]]
    names = [one.model.table.names[i] for i in both if name_is_geometry(one.model, i)]
    found, alone = two.parameters(), one.parameters()
    apart = np.array(
        [
            (found[n].value - alone[n].value) / np.hypot(found[n].sigma, alone[n].sigma)
            for n in names
            if found[n].sigma and alone[n].sigma
        ]
    )
    assert len(apart) > 10
    assert np.abs(apart).max() < 3.5


def name_is_geometry(model, i):
    return model.table[i].group == "geometry"


@pytest.mark.wide
def test_each_station_is_named_with_its_size():
    shown = compare(nominal("ur5"), joined(FIRST, SECOND))
    (words,) = [w for w in shown.dataset.warnings if w.startswith("recording 2 has a station")]
    found = float(words.partition("stands ")[2].partition(" mm")[0])
    assert found == pytest.approx(1e3 * SHIFT, rel=0.01)
    target = float(words.partition("target ")[2].partition(" mm")[0])
    assert target == pytest.approx(53.0, abs=3.0)
    assert "three fixed points of the base" in words


@pytest.mark.wide
def test_stations_are_shown_under_names_that_a_user_knows():
    result = fit(nominal("ur5"), joined(FIRST, SECOND), hold_out=0)
    shown = text.show(result, details=True)
    assert "parallel_cal.identification" not in shown
    assert "recording 2's device frame, x" in shown
    assert "stations of the recordings" in shown
    size = UnusualSize.of(result.model.table[f"{STATION_EFFECT}.recording2.target.z"], 1.0)
    assert size.description.startswith("recording 2's target, z is larger than usual")


@pytest.mark.wide
def test_recordings_of_one_station_need_no_frame_of_their_own():
    model, data = nominal("ur5"), joined(FIRST, FIRST)
    result = fit(model, data)
    assert not has_stations(result.model)
    assert any(w.startswith("the 2 recordings share one station") for w in result.warnings)
    assert rms(result.held_out) < 1.15 * result.noise_floor.position_rms


@pytest.mark.slow
def test_compare_and_fit_show_the_same_errors_before_at_two_stations():
    model, data = nominal("ur5"), joined(FIRST, SECOND)
    shown, result = compare(model, data), fit(model, data)
    assert shown.errors.document() == result.document()["before"]
    assert shown.held_out.summary == result.held_out_before.summary
    again = compare(result.model, data)
    assert again.errors.document()["position_rms"] == pytest.approx(rms(result.after), rel=0.01)


@pytest.mark.wide
def test_an_effect_is_found_and_added_at_two_stations_and_the_file_keeps_the_robot_only():
    robot = va.arm("ur5", 4, hidden=(va.Play(0, backlash=5e-4),))
    data = joined(FIRST, SECOND, robot=robot, n=30)
    found = diagnose(nominal("ur5"), data, effects=["backlash", "encoder_gain", "zero_shift"])
    assert found.effects == ("backlash",)
    first = fitted(nominal("ur5"), data)
    model = parse_model(dump_model(first.model))
    assert not model.effects
    second = add(model, "backlash", data)
    assert [effect.name for effect in second.model.effects] == ["backlash"]
    assert rms(second.result.held_out) < 1.2 * second.result.noise_floor.position_rms
    assert second.document()["held_out_without_effect"]["position_rms"] == pytest.approx(
        rms(first.result.held_out), rel=1e-3
    )


@pytest.mark.parametrize("move", [1e-3, 0.22])
def test_a_fitted_model_on_a_second_station_is_registered_and_says_how_far_it_moved(move):
    known = known_of_first()
    elsewhere = replace(FIRST, shift=tuple(np.add(FIRST.shift, [move, 0.0, 0.0])))
    shown = compare(known, recorded(elsewhere, 3))
    assert rms(shown.given.errors_as_given) == pytest.approx(move, rel=0.1)
    assert rms(shown.errors) < 60e-6
    assert f"stands {1e3 * move:.1f} mm" in shown.registration.description
    assert "three fixed points" in shown.registration.description


def test_a_new_station_keeps_the_covariance_of_the_robot():
    known = known_of_first()
    placed = compare(known, recorded(SECOND, 3)).model
    assert np.array_equal(placed.covariance, known.covariance)
    data = recorded(SECOND, 3)
    again = fit(known, data, refit=["link1.theta"], hold_out=0)
    assert again.registration is not None
    assert rms(again.after) < 60e-6


def test_a_fitted_model_on_its_own_station_is_not_registered_again():
    known = known_of_first()
    shown = compare(known, recorded(FIRST, 3))
    assert shown.registration is None
    assert shown.errors is shown.given.errors_as_given


@pytest.mark.wide
def test_a_delta_at_two_stations_is_as_good_as_at_one():
    one = replace(seen_by_a_tracker(measured(1)), sha256="1" * 64)
    far = replace(measured(2), r=measured(2).r + [0.3, -0.2, 0.1], sha256="2" * 64, frame="b")
    model = new_model("delta54")
    two = fit(model, join_datasets([one, far]), hold_out=0)
    assert has_stations(two.model)
    assert error_at_unseen_poses(two.model) < error_at_unseen_poses(
        fit(model, one, hold_out=0).model
    )


def test_too_many_stations_are_refused_with_their_number():
    trackers = [
        replace(FIRST, shift=tuple(np.add(FIRST.shift, [0.1 * k, 0.0, 0.0])))
        for k in range(LATER_RECORDINGS[-1] + 2)
    ]
    with pytest.raises(FitError, match="recording 5 has a station of its own; expected at most 4"):
        compare(nominal("ur5"), joined(*trackers, n=12))


def error_of_truth(model):
    """Rms error (m) at fresh poses, as a tracker without noise sees them."""
    fresh = seen(va.session(va.arm("ur5", 1), 60, 9, FIRST.exact()), False, "tracker0")
    return rms(compare(model, fresh, joint_sigma=1e-5).errors)


@pytest.mark.wide
def test_a_fitted_model_is_fitted_again_with_a_further_recording():
    """The model knows the first recording: at its held-out poses, its own error is in-sample."""
    both = joined(FIRST, SECOND)
    first = fitted(nominal("ur5"), recorded(FIRST, 0)).model
    again = fitted(first, both)
    assert not again.acceptance.against
    assert again.acceptance.before.position_rms > again.acceptance.after.position_rms
    assert error_of_truth(again.model) < error_of_truth(first)
    assert again.model.history[-1]["dataset"]["recordings"] == [seed * 64 for seed in "01"]
    with pytest.raises(FitError, match="was fitted to these samples before"):
        fitted(again.model, both)


@pytest.mark.wide
def test_fewer_poses_of_a_second_station_that_make_no_better_model_are_refused_with_the_cure():
    first = fitted(nominal("ur5"), recorded(FIRST, 0)).model
    with pytest.raises(
        FitError,
        match="identified from tracker0, and only its frames were fitted to these samples: keep "
        "it, or fit all recordings together",
    ):
        fitted(first, recorded(SECOND, 1))


def test_joined_samples_in_a_file_keep_the_hash_of_each_recording(tmp_path):
    both = joined(FIRST, SECOND)
    both.to_json(tmp_path / "both.json")
    assert Dataset.from_json(tmp_path / "both.json").recordings == ("0" * 64, "1" * 64)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("later", "zeros", "words"),
    [
        (
            replace(FIRST, shift=SECOND.shift, turned=SECOND.turned),
            0.0,
            "likeliest, the device, or the base under the robot, moved (rms error 0.03",
        ),
        (
            FIRST,
            np.array([20e-3, 15e-3, -20e-3, 30e-3, 10e-3, 0.0]),
            "likeliest, the zeros of the joints changed (rms error 0.03",
        ),
        (SECOND, 0.0, "likeliest, device and target moved (rms error 0.03"),
        (
            replace(FIRST, target=SECOND.target),
            0.0,
            "likeliest, but not clearly, the target moved (rms error 0.04",
        ),
    ],
    ids=["device", "zeros", "both", "target"],
)
def test_what_moved_between_recordings_is_ranked_by_the_error_that_each_explanation_leaves(
    later, zeros, words
):
    first, second = recorded(FIRST, 0), recorded(later, 1)
    model = fitted(nominal("ur5"), first).model
    second = replace(second, q=second.q - zeros)
    shown = compare(model, second)
    assert words in shown.registration.description
    [station] = [
        w
        for w in compare(model, join_datasets([first, second])).dataset.warnings
        if "has a station of its own" in w
    ]
    assert words in station


def test_zeros_with_which_the_robot_cannot_be_where_it_was_measured_explain_nothing(monkeypatch):
    """A pose without a solution has no error; it must not count as one that is explained."""
    model, data = new_model("delta54"), measured(1)
    moved = replace(data, r=data.r + np.array([0.02, 0.0, 0.0]))
    there = DevicePoses.of(model, observe(model, moved))
    direct = Kinematics.direct

    def only_as_read(self, q, *arguments):
        read = np.all(np.abs(q - data.q) < 1e-9, axis=1, keepdims=True)
        return direct(self, np.where(read, q, np.nan), *arguments)

    monkeypatch.setattr(Kinematics, "direct", only_as_read)
    ranked = {one.what: one for one in rank_what_moved(model, observe(model, moved), there)}
    assert ranked[ZEROS].rms == pytest.approx(there.compute_rms(there.now))
    assert ranked[DEVICE].rms < 0.1 * ranked[ZEROS].rms


@pytest.mark.wide
def test_zeros_that_no_joint_can_have_are_not_tried(monkeypatch):
    """A device elsewhere would need zeros of metres. Legs of such lengths have no pose: each of
    them would be searched from many starts."""
    robot, rng = hexapod(), np.random.default_rng(1)

    def measure(move, turn):
        r = robot.home + rng.uniform(-0.05, 0.05, (40, 3))
        R = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, (40, 3)))
        T = Rotation.from_rotvec(turn)
        q = robot.inverse(r, R.as_matrix())[0]
        seen = T.apply(r) + move + rng.normal(0, 1e-5, r.shape)
        return Dataset.from_arrays([f"leg{i}" for i in range(1, 7)], q, seen, (T * R).as_matrix())

    known = fit(new_model("stewart42"), measure([2.1, -3.0, 0.4], [0.3, -0.2, 1.1]), hold_out=0)
    asked, direct = [], Kinematics.direct
    monkeypatch.setattr(
        Kinematics, "direct", lambda self, q, *a, **k: asked.append(q) or direct(self, q, *a, **k)
    )
    shown = compare(known.model, measure([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
    assert "likeliest, the device, or the base under the robot, moved" in (
        shown.registration.description
    )
    low, high = np.transpose(known.model.mechanism.joint_limits)
    every = np.concatenate(asked)
    assert np.all((every > low - (high - low)) & (every < high + (high - low)))
