"""A campaign with the virtual robot: what it finds, what stops it, how it goes on."""

import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from campaign_cells import SimulatedCell, model_of
from marks import keep

from parallel_cal.base.errors import ModelFileError
from parallel_cal.campaign.campaign import Campaign
from parallel_cal.campaign.cell import CellError, Control, Sample
from parallel_cal.campaign.checking import Checker
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.journal import FILE, CampaignError, find_unfinished
from parallel_cal.campaign.judging import Conclusion, Judgement, JudgementRequest, conclude
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.status import Curve, CurvePoint, Outcome, write_improved_model
from parallel_cal.campaign.targets import (
    Target,
    first_targets,
    get_condition_range,
    select_rarer,
    select_spread_out,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model, read_model
from parallel_cal.model.mechanism import Box
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.session import Session

DELTA = model_of("delta")
TEXT = dump_model(DELTA)
SLIP = Path(__file__).parent / "models" / "slip_model.yaml"  # written once, and never read again


class Killed(BaseException):
    """What no handler of the package may swallow, as a SIGKILL."""


def quick(question, dataset, unseen, tell=None):
    """A judgement without a diagnosis, which takes seconds: nothing found, two more poses."""
    joints = DELTA.mechanism.home.joints
    more = [Target(tuple(q + 0.01 * k for q in joints), purpose="more") for k in range(2)]
    targets = tuple(more) if question.more else ()
    return Judgement(
        len(dataset),
        "unexplained",
        "nothing is known",
        (),
        (),
        (),
        (),
        (),
        ("time",),
        question.model,
        {"position": 2e-3},
        {"position": 1e-3},
        {"position": 1e-3},
        targets,
    )


def work(function, *given):
    """Judgements in no time, and no model to write."""
    if function.__name__ == "judge_samples":
        return quick(*given)
    return Conclusion("", "nothing was written")


def campaign(folder, cell, goal, tell=lambda status: None, work=work, **more):
    return Campaign(folder, TEXT, goal, cell, tell, work, **more)


# ------------------------------------------------------------------ before it goes anywhere


def test_an_unknown_effect_is_reported_before_the_robot_moves(tmp_path):
    cell = SimulatedCell()
    outcome = campaign(tmp_path, cell, Goal(effects=("banana",))).run()
    assert "banana" in outcome.message
    assert not cell.sent


def test_samples_without_usable_weights_are_reported_after_the_first(tmp_path):
    class Unsure(SimulatedCell):
        def sample(self, go_on):
            d = super().sample(go_on).dataset
            covariance = np.eye(6) + 2 * np.eye(6, k=1)
            return Sample(Dataset.from_arrays(d.joint_names, d.q, d.r, d.R, pose_cov=covariance))

    cell = Unsure()
    outcome = Campaign(tmp_path, dump_model(DELTA), Goal(), cell, work=work).run()
    assert "the recorded pose covariance is not symmetric" in outcome.message
    assert len(cell.sent) == 1


def test_every_status_has_the_errors_from_the_initial_model_on(tmp_path):
    heard = []

    def judge(function, *given):
        if function.__name__ != "judge_samples":
            return work(function, *given)
        judgement = quick(*given)
        added = ("backlash",) if judgement.samples > 16 else ()
        return replace(judgement, effects=added, additions=added, floor={"position": 3e-4})

    campaign(tmp_path, SimulatedCell(), Goal(poses=20), heard.append, judge).run()
    assert heard[0].curve == Curve()
    last = heard[-1].curve
    assert (last.kind, last.noise) == ("position", 3e-4)
    assert last.points[0] == CurvePoint(0, 2e-3)
    assert last.points[-1] == CurvePoint(20, 1e-3, ("backlash",))
    assert [one.poses for one in last.points] == sorted({one.poses for one in last.points})


# ------------------------------------------------------------------ where it goes


def test_a_robot_that_rests_where_it_was_sent_may_be_read_a_little_inside(tmp_path, monkeypatch):
    """Of what is forbidden; further off it has not arrived."""

    class Beside(SimulatedCell):
        off = 1e-4

        def joints(self):
            return super().joints() + self.off * bool(self.sent)

        def move(self, trajectory, go_on):
            if len(self.sent) == 4:
                raise CellError("enough")
            super().move(trajectory, go_on)

    def inside(guard, q):
        ends = [trajectory.positions[-1] for trajectory in cell.sent] or [q]
        return "" if any(np.allclose(q, end, atol=1e-9) for end in ends) else "inside the box"

    monkeypatch.setattr(Guard, "describe_violation", inside)
    cell = Beside()
    assert "enough" in campaign(tmp_path / "1", cell, Goal()).run().message
    cell = Beside()
    cell.off = 0.05
    found = campaign(tmp_path / "2", cell, Goal()).run().message
    assert "was sent to" in found


def test_places_are_spread_from_the_middle_to_the_corners():
    places = np.array([[x, y] for x in range(5) for y in range(5)], float)
    chosen = {tuple(places[i]) for i in select_spread_out(places, 5)}
    assert chosen == {(2, 2), (0, 0), (4, 4), (0, 4), (4, 0)}


def test_the_first_poses_are_of_three_kinds_and_may_all_be_gone_to():
    """42 parameters at 6 equations a pose: twice as many are 14, beside 6 that no fit sees and 4
    visits from the other side."""
    guard = Guard.of(DELTA)
    targets = first_targets(guard, 80)
    free = int((~np.asarray(DELTA.fixed)).sum())
    fitted = [t for t in targets if not t.unseen]
    again = [t for t in targets if "other side" in t.purpose]
    assert len(targets) - len(fitted) == 6
    assert len(again) == 4
    assert len(fitted) - len(again) == max(12, -(-2 * free // 6))
    for target in targets:
        assert guard.is_allowed(np.array([target.joints, *target.via])).all()
    for target in again:
        first = next(t for t in fitted if t.joints == target.joints and t is not target)
        assert first.via == target.via[::-1]
        from_one, from_other = (np.sign(np.subtract(t.joints, t.via[-1])) for t in (first, target))
        assert (from_one == -from_other).all()


def test_a_condition_is_brought_to_the_end_at_which_less_was_measured():
    air = np.array([22.0, 22.5, 21.9, 25.8])
    low, high = get_condition_range(air, 4.0)
    assert (low, high) == (21.9, 25.9)
    assert select_rarer(air, (low, high)) == high
    assert select_rarer(np.array([0.0, 1.0, 1.0]), (0.0, 1.0)) == 0.0


# ------------------------------------------------------------------ what it finds


def judgement(**change):
    known = {
        "samples": 32,
        "verdict": "explained",
        "summary": "",
        "effects": ("backlash",),
        "additions": (),
        "doubt": (),
        "untold": (),
        "suspected": (),
        "missing": (),
        "text": "",
        "before": {},
        "unseen": {},
        "usual": {},
    }
    return Judgement(**known | change)


def test_it_ends_when_eight_more_poses_have_changed_nothing():
    before = judgement(samples=24)
    assert not before.is_final(None)
    assert judgement().is_final(before)
    assert not judgement(verdict="partly_explained").is_final(before)
    assert not judgement(effects=("hysteresis",)).is_final(before)
    heavier = (Target((0.5, 0.5, 0.5), conditions={"payload": 1.0}),)
    assert not judgement(targets=heavier).is_final(before)


def test_it_goes_on_while_an_effect_is_suspected():
    suspecting = judgement(suspected=("thermal_expansion",))
    assert not suspecting.is_final(suspecting)


def test_a_campaign_ends_if_no_pose_can_distinguish_two_effects_in_either_order():
    pair = ("encoder_eccentricity", "encoder_second_harmonic")
    one, other = (
        judgement(effects=(name,), doubt=(rival,), untold=pair)
        for name, rival in (pair, pair[::-1])
    )
    assert one.is_final(other)
    assert not judgement(effects=pair[:1], doubt=pair[1:]).is_final(one)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A Delta with play in its gears, calibrated by itself from its nominal model."""
    cell = SimulatedCell("delta", 2, ["backlash"])
    said = []
    one = Campaign(tmp_path_factory.mktemp("campaign"), TEXT, Goal(60), cell, said.append)
    return one, one.run(), cell, said


@pytest.mark.wide
def test_a_hidden_effect_is_found_distinguished_from_its_lookalike_and_proven(calibrated):
    one, outcome, _cell, said = calibrated
    assert outcome.success, outcome.message
    assert outcome.verdict == "explained"
    assert one.judgements[-1].effects == ("backlash",)
    assert not one.judgements[-1].doubt
    assert [effect.name for effect in parse_model(outcome.text).effects] == ["backlash"]
    states = [state for state, _ in itertools.groupby(status.state for status in said)]
    assert states[:5] == ["planning", "moving", "sampling", "moving", "sampling"]
    assert states[-1] == "done"


@pytest.mark.wide
def test_the_written_model_is_as_good_as_the_noise_where_nothing_was_measured(calibrated, tmp_path):
    """Judged by the virtual robot itself, at poses of its own drawing."""
    _one, outcome, cell, _ = calibrated
    file = tmp_path / "robot.yaml"
    file.write_text(TEXT)
    written = write_improved_model(outcome, str(file))
    assert written.path == str(file)
    assert (tmp_path / "robot.yaml.previous").read_text() == TEXT
    rng, off = np.random.default_rng(5), {}
    for name, model in (("before", DELTA), ("after", read_model(file))):
        errors = []
        for q in rng.uniform(0.35, 0.7, (20, 3)):
            sign = rng.choice([-1.0, 1.0], 3)
            at = {f"direction.{j}": s for j, s in zip(model.joints, sign, strict=True)}
            true = cell.cell.true_pose(q, sign)[0]
            errors.append(np.linalg.norm(Kinematics(model).direct(q, at).position - true))
        off[name] = np.sqrt(np.mean(np.square(errors)))
    assert off["before"] > 5e-4
    assert off["after"] < 4e-5


@pytest.mark.wide
def test_the_error_at_unseen_poses_falls_to_the_noise_judgement_by_judgement(
    calibrated,
):
    one, outcome, _, _ = calibrated
    samples, unseen = zip(*outcome.curve, strict=True)
    assert samples[0] == 0
    assert list(samples[1:]) == [j.samples for j in one.judgements]
    assert unseen[0] > 15 * unseen[-1]
    assert unseen[-1] < 2 * 29e-6  # what 10 um and 25 arcsec come to in this robot


@pytest.mark.wide
def test_everything_is_a_session_that_the_workbench_opens(calibrated):
    one, outcome, _, _ = calibrated
    session = Session(one.folder)
    assert len(session.samples) == outcome.samples
    steps = [state.step for state in session.history()]
    assert steps[-2:] == ["fit", "add backlash"]


@pytest.mark.slow
def test_a_person_is_asked_for_the_load_that_the_robot_cannot_put_on_itself(tmp_path):
    cell = SimulatedCell("delta", 5, ["shaft_twist"])
    goal = Goal(60, payload=1.0)
    said = []
    one = Campaign(tmp_path, TEXT, goal, cell, said.append)
    outcome = one.run()
    asked = [question for status in said for question in status.questions]
    assert [(q.condition, q.value, q.unit) for q in asked] == [
        ("payload", 1.0, "kg"),
        ("payload", 0.0, "kg"),
    ]
    assert cell.asked == ["change payload from 0 to 1 kg", "change payload from 1 to 0 kg"]
    assert outcome.verdict == "explained"
    assert one.judgements[-1].effects == ("joint_compliance",)


@pytest.mark.slow
def test_load_and_warmth_are_looked_at_one_at_a_time_by_the_same_eight_poses(tmp_path):
    """What a load does goes when it is taken off again: no bump of the device does."""
    cell = SimulatedCell("delta", 701, ["soft_frame"])
    one = Campaign(tmp_path, TEXT, Goal(payload=2.0, warmer=10.0, seed=701), cell)
    outcome = one.run()
    assert [dict(target.conditions) for target in one.judgements[0].targets] == [
        *[{"payload": 2.0}] * 4,
        *[{"payload": 0.0, "temperature": pytest.approx(32.0, abs=0.2)}] * 4,
    ]
    assert len(cell.asked) == 2
    assert outcome.success, outcome.message
    assert one.judgements[1].effects == one.judgements[-1].effects == ("payload_sag",)
    assert not any(judgement.doubt for judgement in one.judgements)


def test_what_was_found_is_not_written_where_the_error_at_unseen_poses_has_risen(tmp_path):
    """A frame softer than any that is known was taken for arms that give and a bumped tracker."""
    early = replace(quick(JudgementRequest("early"), [None] * 24, None), unseen={"position": 20e-6})
    late = replace(early, samples=80, unseen={"position": 44e-6}, text="late")
    found = conclude(tmp_path, [early, late])
    assert found.text == "early"
    assert "the model is that of 24 poses" in found.words
    assert "rose by a factor of 2.2" in found.words


@pytest.mark.slow
def test_the_last_pose_of_all_is_under_the_load_where_both_would_take_two(tmp_path):
    goal = Goal(25, payload=2.0, warmer=10.0)
    one = Campaign(tmp_path, TEXT, goal, SimulatedCell())
    outcome = one.run()
    assert outcome.samples == 25, outcome.message
    assert [dict(target.conditions) for target in one.judgements[0].targets] == [{"payload": 2.0}]


@pytest.mark.slow
def test_an_effect_that_was_named_first_gives_way_to_one_that_fits_clearly_better(tmp_path):
    """Eighteen numbers of the screws' pitch explain most of six legs' cross-talk; beside a frame
    that gives, nothing that is added makes up for the rest. The model does not state what drives
    the legs: that they may be spools costs eight poses."""
    cell = SimulatedCell("stewart", 704, ["soft_frame", "cross_talk"])
    goal = Goal(payload=2.0, warmer=10.0, reach=2.0, seed=704)
    one = Campaign(tmp_path, dump_model(model_of("stewart")), goal, cell)
    outcome = one.run()
    assert outcome.success, outcome.message
    assert {*one.judgements[-1].effects} == {"payload_sag", "encoder_crosstalk"}
    assert outcome.samples <= 56


@pytest.mark.slow
def test_a_frame_that_gives_and_warm_parts_are_both_found_with_no_more_load_than_was_allowed(
    tmp_path,
):
    """Eight poses in the warmth are too few to prove what they show: it goes on."""
    cell = SimulatedCell("stewart", 1, ["warmth", "soft_frame"])
    one = Campaign(tmp_path, dump_model(model_of("stewart")), Goal(payload=1.0, warmer=4.0), cell)
    outcome = one.run()
    assert outcome.success, outcome.message
    assert set(one.judgements[-1].effects) == {"payload_sag", "thermal_expansion"}
    assert not one.judgements[-1].doubt
    assert max(target.conditions.get("payload", 0.0) for target in one.targets) == 1.0


@pytest.mark.slow
def test_it_stops_measuring_for_what_no_pose_in_the_workspace_shows(tmp_path):
    """Over half a turn of the arms one wave a turn and two are nearly one."""
    one = Campaign(tmp_path, TEXT, Goal(100), SimulatedCell("delta", 0, ["eccentricity"]))
    outcome = one.run()
    last = one.judgements[-1]
    assert outcome.success, outcome.message
    assert outcome.samples < 80
    assert "encoder_eccentricity" in {*last.effects, *last.doubt}
    assert last.doubt
    assert "no poses can distinguish" in outcome.message


@pytest.mark.wide
def test_where_the_better_model_sees_it_outside_the_robot_goes_home_by_the_one_before(tmp_path):
    home, narrow = DELTA.mechanism.home.joints, parse_model(TEXT)
    middle = Kinematics(narrow).direct(home).position
    narrow.mechanism.workspace = Box(tuple(middle - 0.01), tuple(middle + 0.01))

    def narrowing(function, *given):
        found = work(function, *given)
        return replace(found, text=dump_model(narrow)) if isinstance(found, Judgement) else found

    cell = SimulatedCell()
    one = campaign(tmp_path, cell, Goal(poses=28), work=narrowing)
    outcome = one.run()
    assert outcome.message.startswith("28 poses were measured")
    np.testing.assert_allclose(cell.sent[24].positions[-1], home)


# ------------------------------------------------------------------ its budget


def test_limits_of_poses_and_minutes_are_kept_and_what_is_missing_is_reported(tmp_path):
    one = campaign(tmp_path, SimulatedCell(), Goal(poses=20))
    outcome = one.run()
    assert len(one.samples) == 20
    assert not outcome.success
    assert outcome.message.startswith(
        "20 poses were measured, the maximum that was allowed: nothing is known; time"
    )


def test_an_error_that_is_small_enough_ends_it(tmp_path):
    outcome = campaign(tmp_path, SimulatedCell(), Goal(poses=40, enough=1.5e-3)).run()
    assert outcome.success
    assert outcome.message.startswith("the error at the validation poses is small enough")
    assert outcome.samples == 24


# ------------------------------------------------------------------ what it does not put up with


def fails(tmp_path, match, after=1, poses=20, **change):
    """A change to the cell after so many samples, which must end the campaign, robot at rest."""
    cell = SimulatedCell()
    one = campaign(tmp_path, cell, Goal(poses=poses))
    measure, stopped = cell.sample, []

    def sample(go_on):
        found = measure(go_on)
        if len(one.samples) == after:
            cell.cell.change(**change)
        return found

    cell.sample, cell.stop = sample, lambda: stopped.append(1)
    outcome = one.run()
    assert not outcome.success
    assert not outcome.ended
    assert match in outcome.message
    assert stopped
    assert len(one.samples) == after + 1  # the one that is wrong is none
    return outcome


def test_a_robot_that_does_not_move_is_noticed(tmp_path):
    fails(tmp_path, "joint does not move", drives_off=True)


def test_an_axis_or_an_encoder_that_is_stuck_is_noticed_by_name(tmp_path):
    outcome = fails(tmp_path / "axis", "joint2 was sent to", stuck_axis=2)
    assert "an obstacle blocks it" in outcome.message
    fails(tmp_path / "encoder", "joint3 was sent to", stuck_encoder=3)


def test_crossed_axes_are_noticed_at_the_first_move(tmp_path):
    fails(tmp_path, "was sent to", crossed_axes=True)


def test_a_collision_is_noticed(tmp_path):
    box = (np.array([-0.1, -0.1, 0.0]), np.array([0.1, 0.1, 0.4]))
    fails(tmp_path, "an obstacle blocks it", obstacles=(box,))


def test_a_lost_and_a_changed_target_are_noticed(tmp_path):
    fails(tmp_path / "lost", "no pose was received", lost_target=True)
    said = fails(tmp_path / "changed", "a target that was lost or changed", swapped_target=True)
    assert "should have" in said.message


def after_three(folder, **usual):
    """A campaign after three poses, which are held against the robot as drawn from here on."""
    cell = SimulatedCell()
    one = campaign(folder, cell, Goal(poses=20))
    while len(one.samples) < 3:
        assert one._step() is None
    one._checker = Checker(parse_model(one.model), usual)
    return one, cell


def test_a_sample_with_a_large_error_is_kept_if_the_previous_pose_is_measured_again_unchanged(
    tmp_path,
):
    """As drawn it is a millimetre off."""
    one, _ = after_three(tmp_path, position=50e-6)
    before = list(one.samples)[-1]
    assert one._step() is None
    odd, again = list(one.samples)[-2:]
    assert one.targets[again].joints == one.targets[before].joints
    assert "to check whether anything moved" in one.targets[again].purpose
    here, there = (one.samples[k].dataset.r[0] for k in (before, again))
    assert np.linalg.norm(here - there) < 50e-6
    one.close()
    reopened = campaign(tmp_path, SimulatedCell(), Goal(poses=20))
    assert [*reopened.samples] == [*one.samples]
    assert reopened.targets[again] == one.targets[again]
    reopened.close()
    assert odd == 3


def test_a_slip_is_not_taken_for_a_model_error(tmp_path):
    one, cell = after_three(tmp_path, position=50e-6)
    cell.cell.change(slipped=5e-3)
    with pytest.raises(CellError, match="a slip"):
        one._step()
    assert len(one.samples) == 3
    one.close()


@pytest.mark.wide
def test_a_slip_of_half_a_degree_is_noticed_once_the_model_is_identified(calibrated, tmp_path):
    one, *_ = calibrated
    checker = one._checker
    good = list(one.samples.values())[-1].dataset
    checker.check(good, good.q[0], None)
    reached = Kinematics(checker._model)
    slipped = reached.direct(good.q[0] + [0.5 * np.pi / 180, 0, 0]).position
    away = slipped - reached.direct(good.q[0]).position
    with pytest.raises(CellError, match=r"position is .* um from the model's prediction"):
        checker.check(good.__class__(**{**vars(good), "r": good.r + away}), good.q[0], None)


def test_a_pose_without_an_allowed_path_is_skipped_with_the_reason(tmp_path):
    """A target that was planned before a box was put around it."""
    one = campaign(tmp_path, SimulatedCell(), Goal(poses=20))
    beyond = Target((1.9, 1.9, 1.9), purpose="made by hand")
    one.targets = [beyond, *first_targets(one._guard, 20)]
    outcome = one.run()
    assert list(one.left_out) == [0]
    assert "workspace" in one.left_out[0]
    assert outcome.samples == 20


def test_too_few_poses_are_refused_with_the_number_that_is_enough(tmp_path):
    outcome = campaign(tmp_path, SimulatedCell(), Goal(poses=18)).run()
    assert not outcome.success
    assert "18 poses are too few for 42 free parameters: at least 19" in outcome.message


# ------------------------------------------------------------------ held, ended, killed


def numbers(one):
    return [(k, *s.dataset.q[0]) for k, s in one.samples.items()]


def test_it_pauses_in_the_middle_of_a_motion_and_resumes_with_the_same_pose(tmp_path):
    cell, control, said = SimulatedCell(), Control(), []

    def tell(status):
        said.append(status.state)
        if status.state == "paused":
            control.resume()

    one = campaign(tmp_path, cell, Goal(poses=20), tell, control=control)
    drive, moves = cell.move, itertools.count()

    def move(trajectory, go_on):
        if next(moves) == 3:
            control.pause()
        drive(trajectory, go_on)

    cell.move = move
    outcome = one.run()
    assert said.count("paused") == 1
    assert outcome.samples == 20
    assert list(one.samples) == list(range(20))


def test_abort_stops_the_robot_and_asking_again_goes_on(tmp_path):
    cell, control = SimulatedCell(), Control()
    one = campaign(tmp_path, cell, Goal(poses=20), control=control)
    drive, moves, stopped = cell.move, itertools.count(), []

    def move(trajectory, go_on):
        if next(moves) == 5:
            control.abort()
        drive(trajectory, go_on)

    cell.move, cell.stop = move, lambda: stopped.append(1)
    outcome = one.run()
    assert stopped
    assert not outcome.ended
    assert "aborted on request" in outcome.message
    one.close()
    cell.move = drive
    again = campaign(tmp_path, cell, Goal(poses=20))
    assert numbers(again) == numbers(one)
    assert again.run().samples == 20


class LimitSwitch(SimulatedCell):
    """Its first joint stops at 0.75 rad, which the model file does not state."""

    def joints(self):
        return np.minimum(super().joints(), [0.75, np.inf, np.inf])


@pytest.mark.wide
def test_a_campaign_that_a_limit_switch_stopped_goes_on_within_the_limit_that_was_stated(tmp_path):
    cell = LimitSwitch()
    one = campaign(tmp_path / "a", cell, Goal(poses=20))
    outcome = one.run()
    one.close()
    assert "joint1 was sent to" in outcome.message
    assert "state that limit (low, high) in the model file" in outcome.message
    narrow = parse_model(TEXT)
    (low, _), *others = narrow.mechanism.joint_limits
    narrow.mechanism.joint_limits = ((low, 0.74), *others)
    text = dump_model(narrow)
    assert find_unfinished(tmp_path, text) == tmp_path / "a"
    cell.sent.clear()
    again = Campaign(tmp_path / "a", text, Goal(poses=20), cell, work=work)
    measured = len(again.samples)
    outcome = again.run()
    again.close()
    assert outcome.ended
    assert len(again.samples) > measured
    assert cell.sent
    assert all(sent.positions[1:, 0].max() < 0.7401 for sent in cell.sent)
    assert any("joint1 at 0." in why for why in again.left_out.values())
    third = Campaign(tmp_path / "a", text, Goal(poses=20), cell, work=work)
    for judged in third.judgements:
        assert parse_model(judged.text).mechanism.joint_limits[0] == (low, 0.74)
    third.close()


@pytest.mark.parametrize("folder", ["a", pytest.param("afresh", marks=pytest.mark.wide)])
def test_a_robot_at_its_limit_switch_leaves_it_for_a_limit_that_was_stated_with_a_margin(
    tmp_path, folder
):
    """It stands 0.04 rad beyond the limit, 1.4 % of the joint's range, and was refused."""
    cell = LimitSwitch()
    one = campaign(tmp_path / "a", cell, Goal(poses=20))
    assert "state that limit" in one.run().message
    one.close()
    assert cell.joints()[0] == 0.75
    narrow = parse_model(TEXT)
    (low, _), *others = narrow.mechanism.joint_limits
    narrow.mechanism.joint_limits = ((low, 0.71), *others)
    cell.sent.clear()
    again = Campaign(tmp_path / folder, dump_model(narrow), Goal(poses=20), cell, work=work)
    measured = len(again.samples)
    outcome = again.run()
    again.close()
    assert outcome.ended, outcome.message
    assert len(again.samples) > measured
    assert all(sent.positions[-1, 0] < 0.7101 for sent in cell.sent)


@pytest.mark.wide
@pytest.mark.parametrize(
    "state",
    keep(["planning", "moving", "sampling", "judging", "done"], "sampling", "judging"),
)
def test_killed_in_any_state_it_goes_on_and_measures_nothing_twice(tmp_path, state):
    times = {"planning": [0], "judging": [0, 1]}.get(state, [0, 4])
    cell, measured = SimulatedCell(), []
    measure = cell.sample

    def sample(go_on):
        found = measure(go_on)
        measured.append(found.dataset.q[0])
        return found

    cell.sample = sample

    def kill(count, wanted, status):
        if status.state == state and next(count) == wanted:
            raise Killed

    for wanted in times:
        one = campaign(tmp_path, cell, Goal(poses=20), partial(kill, itertools.count(), wanted))
        with pytest.raises(Killed):
            one.run()
        one.close()
        if state == "done":
            break
    one = campaign(tmp_path, cell, Goal(poses=20))
    outcome = one.run()
    assert outcome.samples == 20
    assert sorted(one.samples) == list(range(20))
    kept = [s.dataset.q[0] for s in one.samples.values()]
    assert np.unique(kept, axis=0).shape == (20, 3)
    assert len(measured) == 20  # each was measured once, and is there
    assert np.array_equal(kept, measured)


def test_a_line_that_a_crash_cut_off_is_a_sample_that_was_not_taken(tmp_path):
    cell = SimulatedCell()
    one = campaign(tmp_path, cell, Goal(poses=20))
    one.run()
    one.close()
    lines = (tmp_path / FILE).read_text().splitlines()
    kept = [line for line in lines if "end" not in json.loads(line)]
    samples = [i for i, line in enumerate(kept) if "sample" in json.loads(line)]
    text = "\n".join(kept[: samples[-1]]) + "\n" + kept[samples[-1]][:-30]
    (tmp_path / FILE).write_text(text)
    again = campaign(tmp_path, cell, Goal(poses=20))
    assert len(again.samples) == 19
    assert again.run().samples == 20


@pytest.mark.wide
def test_a_stored_judgement_that_cannot_be_read_is_set_aside_and_its_samples_judged_anew(
    tmp_path, caplog
):
    """The model of a judgement of ours: a lag four of its sigmas below zero."""
    judged_samples = []

    def count_judgements(function, *given):
        if function.__name__ == "judge_samples":
            judged_samples.append(len(given[1]))
        return work(function, *given)

    first = campaign(tmp_path, SimulatedCell(), Goal(poses=60))
    while not first.judgements:
        assert first._step() is None
    first._step()  # one of the two poses that this judgement has planned
    first.close()
    known, planned = numbers(first), len(first.targets)
    lines = [json.loads(line) for line in (tmp_path / FILE).read_text().splitlines()]
    for line in lines:
        if "judged" in line:
            line["judged"]["text"] = SLIP.read_text()
    (tmp_path / FILE).write_text("".join(json.dumps(line) + "\n" for line in lines))

    said = []
    again = campaign(tmp_path, SimulatedCell(), Goal(poses=60), said.append, count_judgements)
    (warning,) = again.warnings
    assert str(tmp_path / FILE) in warning
    assert "effects.1.parameters.leg1.lag.value: -2.35" in warning
    assert numbers(again) == known
    more = [k for k in range(planned) if k not in again.samples]
    assert {again.left_out[k] for k in more} == {"planned by a judgement that is ignored"}
    outcome = again.run()
    again.close()
    assert warning in caplog.text
    assert warning in {status.reason for status in said}
    assert judged_samples[0] == len(known)  # before it goes anywhere
    assert outcome.ended
    assert outcome.document["warnings"] == [warning]

    last = campaign(tmp_path, SimulatedCell(), Goal(poses=60), work=work)
    assert last.warnings == []  # it has been judged anew
    assert [*last.samples] == [*again.samples]
    assert last.targets == again.targets
    last.close()


class SlippedTarget(SimulatedCell):
    """Its target slips on the platform by 1.2 mm after 14 samples."""

    taken = 0

    def sample(self, go_on):
        self.taken += 1
        sample = super().sample(go_on)
        if self.taken <= 14:
            return sample
        d = sample.dataset
        return Sample(replace(d, r=d.r + d.R[0] @ [1e-3, -6e-4, 3e-4]), sample.start_ns)


@pytest.mark.wide
def test_a_slipped_target_is_named_and_ends_no_campaign(tmp_path):
    """Without the slip, no geometry fits: leg2.C_z would have to be 17 mm off."""
    one = Campaign(
        tmp_path,
        dump_model(model_of("stewart")),
        Goal(poses=24, effects=("device_bump", "backlash", "encoder_gain")),
        SlippedTarget("stewart", 4, ("backlash",)),
    )
    outcome = one.run()
    one.close()
    assert outcome.ended
    assert outcome.document["effects"][0] == "device_bump"
    assert outcome.message.count("no geometry fits the samples without device_bump") == 1
    judged = one.judgements[-1]
    assert judged.additions[0].startswith("device_bump:time=")
    text = parse_model(judged.text)
    moved = text.table.mapping(text.values)
    shift = [moved[f"device_bump.v_{axis}"] for axis in "xyz"]
    assert np.allclose(shift, [1e-3, -6e-4, 3e-4], atol=3e-4)


@pytest.mark.wide
def test_samples_that_no_model_describes_are_judged_so_and_the_first_poses_are_measured_again(
    tmp_path,
):
    """The target slips, and nobody asks whether it did."""
    given = Goal(poses=40, effects=("backlash",))
    text = dump_model(model_of("stewart"))
    one = Campaign(tmp_path, text, given, SlippedTarget("stewart", 4, ("backlash",)))
    while not one.judgements:
        assert one._step() is None
    (judged,) = one.judgements
    assert judged.verdict == "unexplained"
    assert judged.summary.startswith("no model describes the 24 samples: ")
    assert judged.effects == ()
    assert judged.text == one.model
    before = one.dataset.select(~one.validation_mask).q[:14]  # before the slip
    assert len(judged.targets) == 8
    for target in judged.targets:
        assert np.abs(before - target.joints).max(axis=1).min() < 1e-6
    one.close()
    again = Campaign(tmp_path, one.model, given, SimulatedCell("stewart", 4))
    assert again.judgements == one.judgements
    again.close()


def test_the_last_model_of_a_campaign_without_a_geometry_is_that_of_its_best_judgement(tmp_path):
    """A session whose samples no geometry fits; nothing is written without a better model."""
    one = campaign(tmp_path, SimulatedCell(), Goal(poses=20))
    for _ in range(3):
        one._step()
    Session(tmp_path).take(one.dataset.to_json)  # too few samples to identify anything
    judged = quick(JudgementRequest(TEXT), one.dataset, one.validation_mask)
    worse = replace(judged, unseen={"position": 3e-3})
    one.close()
    found = conclude(tmp_path, [judged])
    assert found.text == judged.text
    assert "the model is that of 3 poses" in found.words
    found = conclude(tmp_path, [worse])
    assert found.text == ""
    assert "nothing was written" in found.words


def test_a_model_that_cannot_be_read_begins_no_campaign(tmp_path):
    with pytest.raises(ModelFileError, match=r"leg1\.lag\.value: -2\.35"):
        Campaign(tmp_path / "new", SLIP.read_text(), Goal(), SimulatedCell(), work=work)
    assert not (tmp_path / "new").exists()


def test_a_campaign_does_not_replace_a_model_file_by_one_that_cannot_be_read(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(TEXT)
    outcome = Outcome(True, "done", text=SLIP.read_text())
    with pytest.raises(ModelFileError, match=r"robot\.yaml \(not written\).*leg1\.lag\.value"):
        write_improved_model(outcome, str(path))
    assert path.read_text() == TEXT
    assert [*tmp_path.iterdir()] == [path]


def test_a_folder_is_of_one_campaign_at_a_time_and_of_one_model(tmp_path):
    one = campaign(tmp_path / "a", SimulatedCell(), Goal(poses=20))
    with pytest.raises(CampaignError, match="another process uses this campaign"):
        campaign(tmp_path / "a", SimulatedCell(), Goal(poses=20))
    assert find_unfinished(tmp_path, TEXT) == tmp_path / "a"
    other = dump_model(DELTA.with_effect("backlash"))
    assert find_unfinished(tmp_path, other) is None
    one.run()
    one.close()
    assert find_unfinished(tmp_path, TEXT) is None
    with pytest.raises(CampaignError, match="another model"):
        Campaign(tmp_path / "a", other, Goal(), SimulatedCell())
