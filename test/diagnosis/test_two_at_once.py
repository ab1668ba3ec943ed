"""Two effects of which one alone would have to be what no such robot has, or what misleads."""

import numpy as np
import pytest
from campaign_cells import SimulatedCell, model_of
from workbench_page import until

from parallel_cal.campaign.trajectory import plan_trajectory
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.model.effect import parse_effects
from parallel_cal.planning.posepool import make_pool
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.session.session import Session
from parallel_cal.session.steps import add

SHORT = (0.22e-3, 1.0e-3)  # m: ways beyond any slide's play, over which a wind-up is not complete


def visited(seed, names, poses):
    """A Stewart platform as drawn, and samples of one that hides effects: poses in its workspace,
    each followed by one a short way further."""
    cell, model = SimulatedCell("stewart", seed, names), model_of("stewart")
    rng, samples = np.random.default_rng(seed), []
    for q in make_pool(model, 3 * poses, rng, symmetric=False).poses.joints[:poses]:
        step = rng.choice([-1, 1], len(q)) * rng.uniform(*SHORT, len(q))
        for stop in (q, q + step):
            cell.move(plan_trajectory([cell.joints(), stop], model.mechanism), lambda: None)
            samples.append(cell.sample(lambda: None).dataset)
    return model, join_datasets(samples, [1] * len(samples))


@pytest.fixture(scope="module")
def both():
    """Screws with 0.08 to 0.17 mm of play whose nuts wind up by 0.05 to 0.09 mm."""
    return visited(404, ["backlash", "wind_up"], 20)


@pytest.fixture(scope="module")
def found(both):
    return diagnose(*both)


@pytest.mark.wide
def test_play_alone_is_named_as_larger_than_usual_where_a_wind_up_beside_it_explains_no_more(found):
    assert found.verdict.word == "partly_explained"
    assert found.effects == ("backlash",)
    reasons = {entry.name: entry.reason for entry in found.entries}
    [backlash] = found.unusual
    assert "larger than usual" in backlash.description
    assert not reasons["backlash"]  # it is named, not refused
    assert "the joint would turn back while its drive continues" in reasons["hysteresis"]


@pytest.mark.wide
def test_both_are_added_at_once_if_the_owner_asks_for_them(both):
    alone, together = (add(both[0], text, both[1]) for text in ("backlash", "backlash+hysteresis"))
    assert together.model.history[-1]["effect"] == "backlash+hysteresis"
    errors = [step.result.held_out.summary.position_rms for step in (alone, together)]
    assert errors[1] < 1.02 * errors[0]


@pytest.mark.wide
def test_the_workbench_offers_two_effects_together(tmp_path):
    from parallel_cal.workbench.bench import Bench

    model, data = visited(400, ["screw_wobble", "backlash"], 30)
    data.to_json(tmp_path / "samples.json")
    Session.new(tmp_path / "s", model, [tmp_path / "samples.json"])
    bench = Bench(tmp_path / "s")
    until(lambda: not bench.working, "the first look")
    bench.begin("fit")
    until(lambda: not bench.busy, "fit")
    offered = bench.view["offered"]
    assert set(offered["effects"]) == {"backlash", "screw_pitch_error"}
    bench.begin("add", offered["text"])
    until(lambda: not bench.busy, "add")
    assert not bench.failed, bench.message
    assert {effect.name for effect in Session(tmp_path / "s").model.effects} == {
        "backlash",
        "screw_pitch_error",
    }
    assert bench.view["offered"] is None


@pytest.mark.wide
def test_a_rival_that_would_turn_a_joint_back_is_no_doubt():
    """0.1 mm of play is a wind-up of 0.05 mm that is complete after 0.03 mm, but for that."""
    model, data = visited(403, ["backlash"], 20)
    found = diagnose(model, data)
    assert found.effects == ("backlash",)
    assert not found.swaps
    assert "the joint would turn back" in found.explanation.absurd["hysteresis"]
    assert found.measure_next.plan is None


@pytest.mark.wide
def test_a_lead_is_found_beside_the_other_effect():
    model, data = visited(400, ["screw_wobble", "backlash"], 30)
    found = diagnose(model, data, effects=["backlash", "screw_pitch_error"])
    [screw] = [one for one in found.best.chosen if one.name == "screw_pitch_error"]
    assert screw.settings["lead"] == pytest.approx(5e-3, abs=4e-6)
    assert "backlash" in found.effects


def test_several_effects_are_named_in_one_word():
    assert parse_effects("backlash") == [("backlash", {})]
    assert parse_effects("gear:ratio=8e+1+my.own+hysteresis:joint1.width=1e-3") == [
        ("gear", {"ratio": 80.0}),
        ("my.own", {}),
        ("hysteresis", {"joint1.width": 1e-3}),
    ]
