"""Whether a robot has drifted since its calibration; the robot is one of points and rods."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from virtual_setups import random_delta

import parallel_cal as pc
from parallel_cal.base.confidence import format_percent
from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.identification.drift_test import (
    DEVICE,
    SCALES,
    Change,
    DriftTest,
    Part,
    probabilities,
    read_calibration,
)
from parallel_cal.identification.noise_figures import noise_in_use
from parallel_cal.identification.observations import LAST
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.recheck import recheck
from parallel_cal.identification.update import recall_noise
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.summary import summarize
from parallel_cal.session.steps import fitted
from parallel_cal.virtual.stewart import Stewart

JOINT, TRACKER = 2e-5, 30e-6


def session(n, rng, zeros=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), stated=True):
    """Samples of a Delta whose zeros (rad) and whose tracker (m) have shifted."""
    r = rng.uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (n, 3))
    q = random_delta(0).inverse(r)[0] + zeros + rng.normal(0, JOINT, (n, 3))
    noise = {"pose_cov": np.diag([TRACKER**2] * 3 + [1e6] * 3), "joint_sigma": [JOINT] * 3}
    return Dataset.from_arrays(
        new_model("delta24").joints,
        q,
        r + shift + rng.normal(0, TRACKER, (n, 3)),
        measured=[True] * 3 + [False] * 3,
        pose_id=np.arange(n),
        source="virtual tracker",
        **(noise if stated else {}),
    )


@cache
def calibrated():
    model = replace(new_model("delta24"), noise=Noise(JOINT, TRACKER))
    result = pc.fit(model, session(100, np.random.default_rng(1)), hold_out=0.0)
    return replace(result.model, history=(result.history_entry(),))


def made_test(rng, n=4, rows=3):
    """Two single changes, both of them, the device, and the device with one of them, beside an
    error of the calibration in all directions."""
    root = rng.normal(size=(n, n))
    singles = [Change(name, name, np.eye(n)[:, [k]]) for k, name in enumerate("ab")]
    device = Change(DEVICE, DEVICE, np.eye(n)[:, 2:], device=DEVICE)
    alone = (*singles, Change("both", "both", np.eye(n)[:, :2]), device)
    counted = np.column_stack([one.factor for one in singles]) * 2.0
    C0 = 0.3 * root @ root.T
    changes = (*alone, singles[0].with_device(device))
    return DriftTest(changes, C0, 1.0, np.eye(n), counted, ("a", "b"))


def test_the_factors_are_ratios_of_the_densities_of_all_residuals():
    rng = np.random.default_rng(3)
    test, J, y = made_test(rng), rng.normal(size=(9, 4)), rng.normal(size=9)
    A, b = J.T @ J, -J.T @ y
    logs, singles = test.log_factors(A, b[:, None])

    def density(covariance, mean=0.0):
        return multivariate_normal(np.zeros(9) + mean, np.eye(9) + J @ covariance @ J.T).logpdf(y)

    none = density(test.C0)
    *alone, both = test.changes
    for k, change in enumerate(alone):
        wider = [density(test.C0 + s**2 * change.factor @ change.factor.T) for s in SCALES]
        assert logs[0, k, 0] == pytest.approx(np.array(wider) - none)
        assert np.isneginf(logs[0, k, 1:]).all()
    # Robot and device have changed by sizes of their own.
    robot, device = both.factor @ both.factor.T, both.beside.factor @ both.beside.factor.T
    for t, beside in enumerate(SCALES):
        wider = [density(test.C0 + s**2 * robot + beside**2 * device) for s in SCALES]
        assert logs[0, -1, t] == pytest.approx(np.array(wider) - none)
    for k, single in enumerate(test.singles.T):
        two = [density(test.C0, J @ single), density(test.C0, -J @ single)]
        assert singles[0, k] == pytest.approx(np.logaddexp(*two) - np.log(2) - none)


def test_before_the_samples_robot_and_device_change_independently():
    test = made_test(np.random.default_rng(3))
    nothing = np.zeros((4, 4))
    look = test.look(0, nothing, nothing[0])
    a, _, _, device, both = look.by_change
    assert look.unchanged == pytest.approx(0.5)
    assert both * look.unchanged == pytest.approx(a * device)


def test_the_harm_of_an_update_is_the_share_of_possible_robots_that_it_makes_worse():
    found = recheck(calibrated(), session(6, np.random.default_rng(4), zeros=(6e-4,) * 3))
    known, rng = found.expected.hypotheses, np.random.default_rng(1)
    probability, means, covariances = map(np.array, zip(*known, strict=True))
    probability /= probability.sum()
    n, cases = len(known.tolerance), rng.choice(len(probability), 4000, p=probability)
    drawn = np.array([rng.multivariate_normal(means[k], covariances[k])[:n] for k in cases])
    T = known.test.typical[:n, :n]
    for size in (0.5, 1.0, 1.8):
        change = size * (probability @ means)[:n]
        worse = np.einsum("ki,ij,kj->k", drawn - change, T, drawn - change)
        better = np.einsum("ki,ij,kj->k", drawn, T, drawn)
        given = np.zeros(len(known.free))
        given[known.free] = known.tolerance * change
        share = np.mean(worse > better)
        assert found.expected.predict_harm(given) == pytest.approx(share, abs=0.02)
        assert 0.001 < share < 0.9


def test_a_part_is_as_uncertain_as_the_size_of_its_change():
    test, rng = made_test(np.random.default_rng(3)), np.random.default_rng(5)
    part = Part("a", 2.0, "m")
    changes = (replace(test.changes[0], parts=(part,)), *test.changes[1:])
    test = replace(test, changes=changes)
    J = rng.normal(size=(3, 4))
    A, b = J.T @ J, rng.normal(size=4)
    cases = [one for one in test.list_cases(test.look(1, A, b)) if one.change == 0]
    [every] = test.estimate(cases, A, b)
    share = np.array([one.probability for one in cases])
    share /= share.sum()
    each = [test.estimate([one], A, b)[0] for one in cases]
    value = share @ [one.value for one in each]
    spread = share @ [one.sigma**2 + (one.value - value) ** 2 for one in each]
    assert (every.value, every.sigma) == (pytest.approx(value), pytest.approx(spread**0.5))


def test_whoever_looks_after_each_sample_is_wrong_no_more_often_than_the_certainty_says():
    rng, sessions, limit = np.random.default_rng(4), 4000, 0.8
    test = made_test(rng)
    root = np.linalg.cholesky(test.C0)
    alarms, missed = np.zeros((2, sessions), bool)
    errors = root @ rng.normal(size=(4, sessions))
    A, still, moved = np.zeros((4, 4)), np.zeros((4, sessions)), np.zeros((4, sessions))
    for _ in range(12):
        J = rng.normal(size=(2, 4))
        seen = J @ errors + rng.normal(size=(2, sessions))
        A = A + J.T @ J
        still, moved = still - J.T @ seen, moved - J.T @ (seen + J @ test.singles[:, :1])
        unchanged, _ = probabilities(test.log_factors(A, still)[0] + test.log_prior)
        alarms |= 1 - unchanged >= limit
        missed |= test.log_factors(A, moved)[1][:, 0] <= np.log(1 / limit - 1)
    bound = (1 - limit) / limit  # 0.25
    assert 0.02 < alarms.mean() < bound
    assert 0.02 < missed.mean() < bound


def test_a_zero_that_jumped_is_named_after_few_samples():
    found = recheck(calibrated(), session(12, np.random.default_rng(5), (0.0, 2e-3, 0.0)))
    assert found.verdict == "drifted"
    assert next(iter(found.parts)) == "zero of joint2"
    assert found.looks[0].unchanged < 1e-3  # that something moved shows at once; which, later
    samples, verdict = found.decision
    assert (samples <= 6, verdict) == (True, "drifted")
    assert "likeliest: zero of joint2" in found.warnings[0]
    [moved] = found.shown
    assert (moved.title, moved.unit) == ("zero of joint2", "rad")
    assert abs(moved.value + 2e-3) < 3 * moved.sigma < 1e-3  # the readings shifted by 2 mrad
    assert found.expected.growth < 2
    assert found.document()["looks"][-1]["drifted"] == pytest.approx(found.outcomes["drifted"])


def test_all_changes_that_may_be_the_cause_are_named_with_their_probabilities():
    few = recheck(calibrated(), session(4, np.random.default_rng(4), (0.0, 2e-3, 0.0)))
    share = [one.probability for one in few.likely]
    assert 0.3 < share[0] < 0.9
    assert sum(share[:-1]) < 0.95 <= sum(share)
    assert share == pytest.approx(list(few.parts.values())[: len(share)])
    assert few.shown == few.likely[0].shown
    document = few.document()
    assert document["moved"] == document["likely"][0]["moved"]
    assert [one["change"] for one in document["likely"]] == list(few.parts)[: len(share)]
    fit = pc.fit(
        calibrated(),
        session(4, np.random.default_rng(4), (0.0, 2e-3, 0.0)),
        update=True,
        hold_out=0,
    )
    [line] = [one.text for one in summarize(fit) if one.label == "moved:"]
    for one in few.likely[:3]:
        assert one.title in line
        assert f"({format_percent(one.probability)})" in line


def test_without_a_drift_the_robot_is_said_to_be_unchanged_before_all_poses_are_measured():
    found = recheck(calibrated(), session(24, np.random.default_rng(6)))
    assert found.decision[1] == "unchanged"
    assert 4 <= found.decision[0] < 20
    assert not found.is_shown
    assert not found.shown
    surer = replace(found, certainty=0.999)
    assert surer.decision[0] > found.decision[0]
    assert found.warnings == ("the samples show no drift since the last calibration",)
    # A few samples could not show what counts.
    few = recheck(calibrated(), session(2, np.random.default_rng(6)))
    assert few.verdict == "undecided"
    assert "least excluded" in few.warnings[0]


def test_a_tracker_that_was_moved_is_no_drift_of_the_robot():
    moved = session(12, np.random.default_rng(7), shift=(0.3e-3, -0.2e-3, 0.0))
    found = recheck(calibrated(), moved)
    assert found.verdict == "device_moved"
    assert next(iter(found.parts)) == DEVICE
    assert found.warnings[0].startswith("the measuring device moved")


def test_a_calibration_that_left_more_than_noise_lets_expect_more_today():
    model = calibrated()
    assert read_calibration(replace(model, history=())) == (0, 1.0)
    entry = model.history[0] | {"chi2_per_dof": 4.0}
    update = entry | {"samples": 8, "chi2_per_dof": 0.1}
    worse = replace(model, history=(entry, update))
    assert read_calibration(worse) == (100, 4.0)
    today = session(12, np.random.default_rng(8), (0.4e-3, 0.0, 0.0))
    sure, doubtful = (recheck(one, today).outcomes["drifted"] for one in (model, worse))
    assert doubtful < sure


def test_a_drift_needs_a_calibration_a_noise_and_a_certainty():
    today = session(5, np.random.default_rng(9))
    with pytest.raises(FitError, match="no covariance of one"):
        recheck(replace(new_model("delta24"), noise=Noise(JOINT, TRACKER)), today)
    with pytest.raises(FitError, match="nobody stated the noise"):
        recheck(
            replace(calibrated(), noise=Noise()),
            session(5, np.random.default_rng(9), stated=False),
        )
    with pytest.raises(FitError, match=r"certainty 0\.3: expected a probability above 0\.5"):
        recheck(calibrated(), today, certainty=0.3)


def test_an_update_knows_the_noise_that_the_last_calibration_estimated(tmp_path):
    """Today's few samples would count the error of a device that moved as noise, and the fit of the
    robot would follow it."""
    samples = session(100, np.random.default_rng(1), stated=False)
    calibration = fitted(new_model("delta24"), samples, False)
    pc.write_model(calibration.model, tmp_path / "robot.yaml")
    model = pc.read_model(tmp_path / "robot.yaml")
    assert model.noise == Noise()
    used = noise_in_use(model, calibration.result.observations)
    known = recall_noise(model).noise
    assert known.joint["rad"] == pytest.approx(used.joint["rad"])
    assert (known.position, known.orientation) == (pytest.approx(used.position), None)
    still, moved, jumped = (
        session(24, np.random.default_rng(12), *change, stated=False)
        for change in ((), ((0.0, 0.0, 0.0), (0.3e-3, 0.0, 0.0)), ((0.0, 2e-3, 0.0),))
    )
    found = [
        fitted(model, one, True, options=FitOptions(update=True)) for one in (still, moved, jumped)
    ]
    verdicts = [one.result.drift.verdict for one in found]
    assert verdicts[0] == "unchanged"
    assert verdicts[1] in ("device_moved", "changed")
    assert verdicts[2] == "drifted"
    assert [bool(one.acceptance.against) for one in found] == [True, True, False]
    assert found[2].model.noise == Noise()  # what was estimated is not stated for that
    assert LAST in found[2].result.observations.noise_from.values()


def test_a_session_updates_the_last_calibration_and_counts_its_samples_once(tmp_path):
    session_of = pc.Session.new(tmp_path, calibrated(), [], fitting=FitOptions(update=True))
    today = session(8, np.random.default_rng(10), (0.0, 2e-3, 0.0))
    session_of.take(today.to_json)
    first = session_of.fit()
    assert "likeliest: zero of joint2" in first.drift
    assert first.recheck["decision"]["verdict"] == "drifted"
    assert pc.Session(tmp_path).state.recheck == first.recheck
    sigma = session_of.model.covariance.copy()
    assert session_of.fit().drift == first.drift
    assert session_of.model.covariance == pytest.approx(sigma)
    rows = session_of.plan(6).read_text().splitlines()
    # The order is that of an update of the last calibration, not of the samples of today.
    noise = Noise(**session_of.state.weights)
    same = pc.plan(replace(calibrated(), noise=noise), 6, update=True)
    assert rows[-6:] == same.csv().splitlines()[-6:]


@pytest.mark.parametrize(
    ("moved", "said"),
    [
        ({}, "the samples show no drift"),
        ({"shift": (3e-4, 0.0, 0.0)}, "the measuring device moved"),
    ],
)
def test_an_update_writes_no_model_of_a_robot_that_did_not_drift(moved, said):
    result = pc.fit(calibrated(), session(40, np.random.default_rng(7), **moved), update=True)
    assert acceptance(result).against.startswith(said)


def test_an_effect_that_the_last_calibration_lacked_begins_an_update_as_unknown():
    """It had no covariance, and the update ended with "no covariance of one"."""
    today = session(30, np.random.default_rng(3))
    today = replace(today, q=today.q / 1.003)
    result = pc.fit(calibrated(), today, update=True, effects=["encoder_gain"])
    table, sigma = result.model.table, np.sqrt(np.diag(result.model.covariance))
    for joint in calibrated().joints:
        at = table.index_of(f"encoder_gain.{joint}.gain")
        assert abs(result.model.values[at] - 0.003) < 3 * sigma[at] < 2e-3
        assert result.options.prior.covariance[at, at] >= table.prior_sigma[at] ** 2
    # The parameters of the robot are known as well as before.
    assert (sigma[:24] <= 1.25 * np.sqrt(np.diag(calibrated().covariance))).all()


def test_samples_that_place_the_device_say_nothing_about_a_drift():
    """A zero of joint 2 that a device which stands where it stood would show."""
    moved = session(24, np.random.default_rng(5), zeros=(0.0, 1e-3, 0.0), shift=(0.2, -0.1, 0.05))
    result = pc.fit(calibrated(), moved, update=True)
    assert result.registration is not None
    assert result.drift is None
    assert any("placed the measuring device" in words for words in result.warnings)


def actual_error(model, zeros=(0.0, 0.0, 0.0)):
    """Rms position error (m) at poses that no fit used, of a robot whose zeros have shifted."""
    r = np.random.default_rng(11).uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (50, 3))
    away = pc.Kinematics(model).direct(random_delta(0).inverse(r)[0] + zeros).position - r
    return float(np.sqrt((away**2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("moved", "samples", "seed", "is_better"),
    [({"zeros": (6e-4,) * 3}, 12, 4, True), ({"shift": (1e-4, 1e-4, 0.0)}, 4, 6, False)],
)
def test_an_update_that_may_be_worse_is_not_written(moved, samples, seed, is_better):
    """All zeros together, or the tracker: few poses do not tell which."""
    result = pc.fit(
        calibrated(), session(samples, np.random.default_rng(seed), **moved), update=True
    )
    change = result.model.values - result.start.values
    kept, updated = (actual_error(m, moved.get("zeros", 0.0)) for m in (calibrated(), result.model))
    assert (updated < kept) == is_better
    harm = result.drift.expected.predict_harm(change)
    assert harm < 0.01 if is_better else harm > 0.9
    against = acceptance(result).against
    assert (f"worse than the last one with a probability of {format_percent(harm)}" in against) == (
        not is_better
    )


@pytest.mark.parametrize("seed", [6, 9])
def test_a_knocked_sample_is_no_drift_that_an_update_takes(seed):
    """`all parts` had followed it, with 99 %, and the updated model was written."""
    today = session(12, np.random.default_rng(seed))
    r = today.r.copy()
    r[3] += 4e-4, 3e-4, 0.0
    result = pc.fit(calibrated(), replace(today, r=r), update=True)
    assert result.drift.verdict == "drifted"
    assert actual_error(result.model) > actual_error(calibrated())
    refused = acceptance(result)
    assert "but no change explains the samples (chi2/dof is" in refused.against
    assert refused.cure.startswith("parallel-cal diagnose")


BOTH = {"zeros": (0.0, 5e-3, 0.0), "shift": (5e-4, -3e-4, 2e-4)}


def test_a_zero_and_a_tracker_that_both_moved_are_both_named_and_the_update_places_the_tracker():
    """`all parts` was named, and the update took the tracker to stand."""
    step = fitted(calibrated(), session(24, np.random.default_rng(8), **BOTH), update=True)
    drift = step.result.drift
    assert (drift.verdict, drift.places_device) == ("drifted", True)
    assert drift.likely[0].name == f"{DEVICE} and zero of joint2"
    assert drift.likely[0].probability > 0.85
    found = {one.title: one for one in drift.shown}
    assert abs(found["zero of joint2"].value + 5e-3) < 3 * found["zero of joint2"].sigma < 2e-3
    for axis, true in zip("xyz", BOTH["shift"], strict=True):
        one = found[f"shift along {axis} of the {DEVICE}"]
        assert abs(one.value - true) < 3 * one.sigma < 0.15e-3
    assert drift.warnings[0].startswith(
        f"the {DEVICE} moved since the last calibration, and the robot drifted, too (> 99 %;"
    )
    assert step.model.sensors[0].name == "device_frame"
    kept, updated = (actual_error(m, BOTH["zeros"]) for m in (calibrated(), step.model))
    assert updated < 0.2 * kept


@pytest.mark.parametrize("seed", [7, 9, 10])
def test_a_tracker_that_moved_beside_a_zero_does_not_pull_the_update(seed):
    """A zero ten times as far as usual, and a tracker a third: with one size for both, that the
    tracker moved was not decided, and the update took it to stand."""
    result = pc.fit(calibrated(), session(24, np.random.default_rng(seed), **BOTH), update=True)
    assert result.drift.likely[0].name == f"{DEVICE} and zero of joint2"
    kept, updated = (actual_error(m, BOTH["zeros"]) for m in (calibrated(), result.model))
    assert updated < 0.35 * kept
    assert not acceptance(result).against


def test_a_device_that_moved_may_hide_a_drift_of_the_robot():
    """The third leg by three usual drifts, which the device imitates."""
    model, today = calibrated_hexapod(), hexapod_session(16, 2, target=(5e-4, 3e-4, 0.0))
    found = recheck(model, today)
    assert found.verdict == "device_moved"
    assert 0.05 < found.outcomes["drifted"] < 0.5
    share = format_percent(found.outcomes["drifted"])
    assert f", and the robot may have drifted, too ({share}; likeliest: " in found.warnings[0]


def test_an_answer_that_is_not_decided_names_both_causes_and_what_tells_them_apart():
    found = recheck(calibrated(), session(4, np.random.default_rng(4), zeros=(6e-4,) * 3))
    robot, moved = found.outcomes["drifted"], found.outcomes["device_moved"]
    assert f"the robot drifted ({format_percent(robot)})" in found.warnings[0]
    both = sum(p for name, p in found.parts.items() if f"{DEVICE} and" in name)
    device = format_percent(moved + both * (1 - found.outcomes["unchanged"]))
    assert f"the measuring device moved ({device}), or both" in found.warnings[0]
    assert "Measure a fixed target" in found.warnings[0]
    more = found.document()["more_samples"]
    assert 0 < more < 10
    assert f"About {more} more poses" in found.warnings[0]
    enough = recheck(calibrated(), session(4 + more, np.random.default_rng(4), zeros=(6e-4,) * 3))
    assert enough.verdict == "drifted"


@cache
def calibrated_hexapod():
    model = replace(new_model("stewart42"), noise=Noise(1e-5, 1e-5, 1e-4))
    result = pc.fit(model, hexapod_session(80, 1), prior=True, hold_out=0.0)
    return replace(result.model, history=(result.history_entry(),))


def hexapod_session(n, seed, target=(0.0, 0.0, 0.0), leg=0.0):
    """Samples of a hexapod of points and legs whose target (m) or first leg (m) has shifted."""
    rng, model = np.random.default_rng(seed), new_model("stewart42")
    robot = Stewart(dict(zip(model.table.names, model.table.nominal.tolist(), strict=True)))
    r, R = poses_in_workspace(model.mechanism, n, rng)
    q = robot.inverse(r, R)[0] + rng.normal(0, 1e-5, (n, 6))
    q[:, 0] += leg
    shown = r + R @ np.array(target) + rng.normal(0, 1e-5, (n, 3))
    turned = rotation_matrix(rng.normal(0, 1e-4, (n, 3))) @ R
    return Dataset.from_arrays(
        model.joints,
        q,
        shown,
        turned,
        pose_cov=np.diag([1e-10] * 3 + [1e-8] * 3),
        joint_sigma=[1e-5] * 6,
        pose_id=np.arange(n),
        source=f"virtual tracker {seed}",
    )


def test_a_target_that_was_moved_is_no_drift_of_the_robot_for_fit_and_diagnose_alike():
    model, today = calibrated_hexapod(), hexapod_session(16, 2, target=(5e-4, 3e-4, 0.0))
    result = pc.fit(model, today, update=True)
    assert result.drift.verdict == "device_moved"
    assert result.drift.warnings[0].startswith("the target of the device moved")
    assert acceptance(result).cure == "keep MODEL, and put the target of the device back"
    for moved, true in zip(result.drift.shown, (5e-4, 3e-4), strict=True):
        assert abs(moved.value - true) < 3 * moved.sigma < 3e-5
    [line] = [one.text for one in summarize(result) if one.label == "moved:"]
    assert " %): shift along x of the target of the device by 0.50" in line
    assert line.endswith(" since the last calibration")
    found = pc.diagnose(model, today, update=True)
    assert found.effects == ("target_offset",)
    assert found.next_steps[0] == acceptance(result).cure
    assert found.next_steps[1].startswith("if it stays there, add what was found: parallel-cal add")


def test_an_update_waits_for_a_target_that_moved_with_a_zero_and_add_places_it():
    model, today = calibrated_hexapod(), hexapod_session(16, 2, (5e-4, 3e-4, 0.0), leg=1e-3)
    result = pc.fit(model, today, update=True)
    assert result.drift.verdict == "drifted"
    assert result.drift.likely[0].name == "target of the device and zero of leg1"
    refused = acceptance(result)
    assert "add the effect target_offset to the model" in refused.against
    assert refused.cure.endswith("parallel-cal add MODEL target_offset RECORDING -o BETTER.yaml")
    placed = pc.add(model, "target_offset", today, update=True).model
    assert placed.value("target_offset.o_x") == pytest.approx(5e-4, abs=5e-5)


def displaced_session(backlash=0.0):
    """Samples whose device has moved, and whose drives have a backlash (rad)."""
    found = session(20, np.random.default_rng(12), shift=(2e-3, -1.5e-3, 1e-3))
    side = np.sign(np.random.default_rng(1).normal(size=found.q.shape))
    sides = {f"direction.{joint}": side[:, k] for k, joint in enumerate(calibrated().joints)}
    q = found.q + side * backlash / 2
    return replace(found, q=q, conditions={**found.conditions, **sides})


def test_no_effect_is_said_to_be_missing_where_only_the_device_moved():
    """Effects imitated it, each with 79 to 99 %."""
    found = pc.diagnose(calibrated(), displaced_session(), update=True)
    assert found.drift.verdict == "device_moved"
    assert (found.effects, found.missing, found.left) == ((), [], "no")
    assert found.verdict.word == "at_noise"
    assert found.next_steps == ("keep MODEL, and put the measuring device back",)


def test_what_is_missing_beside_a_moved_device_is_named():
    model, today = calibrated(), displaced_session(backlash=5e-4)
    found = pc.diagnose(model, today, update=True)
    assert (found.drift.verdict, found.effects) == ("device_moved", ("backlash",))
    keep, added = found.next_steps
    assert keep == "keep MODEL, and put the measuring device back"
    assert added.startswith(
        "if it stays there, add what was found: parallel-cal add MODEL backlash"
    )
    step = pc.add(model, "backlash", today, update=True)
    assert step.model.sensors[0].name == "device_frame"
    best = found.best.fitted.held_out.summary.position_rms
    assert step.result.held_out.summary.position_rms == pytest.approx(best)


def test_a_fit_that_places_the_device_holds_the_robot_to_its_last_calibration():
    """The frames were fitted beside a robot near its drawing, and lay millimetres off."""
    placing = calibrated().with_sensors((load_sensor("device_frame"),))
    found = pc.fit(placing, displaced_session(), update=True)
    assert found.estimate.chi2_per_dof < 1.5
    assert found.registration.position == pytest.approx([-2e-3, 1.5e-3, -1e-3], abs=1e-4)
    assert np.abs(found.registration.quaternion[:3]).max() < 5e-4


def test_samples_that_the_model_was_fitted_to_are_not_counted_again_as_an_update():
    model, today = calibrated_hexapod(), hexapod_session(16, 3, leg=1e-3)
    today = replace(today, sha256="of these samples")
    updated = fitted(model, today, update=True)
    assert not updated.acceptance.against
    for again in (pc.fit, pc.diagnose):
        with pytest.raises(FitError, match="would count them twice: give the model from before"):
            again(updated.model, today, update=True)


def test_a_part_that_moved_is_named_in_words_with_its_size():
    model, away = calibrated(), 1e-3
    rod = "chain2.Lb"
    values = model.values + away * np.isin(model.table.names, [rod])
    r = np.random.default_rng(1).uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (16, 3))
    q = pc.Kinematics(model.with_values(values)).inverse(r).joints
    today = replace(session(16, np.random.default_rng(1)), q=q, r=r)
    found = recheck(model, today)
    assert next(iter(found.parts)) == rod
    assert "likeliest: rod length of chain 2" in found.warnings[0]
    assert found.shown[0].title == "rod length of chain 2"
    assert found.shown[0].value == pytest.approx(away, abs=3 * found.shown[0].sigma)
    assert found.document()["moved"][0]["unit"] == "m"
