"""Two effects of which one alone would have to be what no such robot has, or what misleads."""

import numpy as np
import pytest
from campaign_cells import SimulatedCell, model_of
from workbench_page import until

from parallel_cal.campaign.trajectory import plan_trajectory
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.search import Chosen, Search
from parallel_cal.diagnosis.separate import rank_rival_pairs
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.effect import parse_effects
from parallel_cal.planning.posepool import make_pool
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.session.session import Session
from parallel_cal.session.steps import add

NAMES = ("backlash and hysteresis", "hysteresis and backlash")
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
def test_play_and_wind_up_of_one_drive_are_found_where_each_alone_would_be_too_large(both, found):
    assert found.verdict.word == "explained"
    assert set(found.effects) == {"backlash", "hysteresis"}
    reasons = {entry.name: entry.reason for entry in found.entries}
    assert "larger than usual" in reasons["backlash"]
    assert "the joint would turn back while its drive continues" in reasons["hysteresis"]


@pytest.mark.wide
def test_they_are_added_at_once_with_the_settings_that_were_found(both, found):
    best = found.best.fitted.model
    step = add(both[0], "+".join(found.additions), both[1])
    assert step.model.history[-1]["effect"] == "+".join(found.effects)
    assert step.model.values == pytest.approx(best.values, abs=1e-7)


@pytest.mark.wide
def test_the_workbench_offers_them_together(both, tmp_path):
    from parallel_cal.workbench.bench import Bench

    model, data = both
    data.to_json(tmp_path / "samples.json")
    Session.new(tmp_path / "s", model, [tmp_path / "samples.json"])
    bench = Bench(tmp_path / "s")
    until(lambda: not bench.busy, "the first look")
    bench.begin("fit")
    until(lambda: not bench.busy, "fit")
    assert bench.view["together"]["names"] in NAMES
    bench.begin("add", bench.view["together"]["text"])
    until(lambda: not bench.busy, "add")
    assert not bench.failed, bench.message
    assert {effect.name for effect in Session(tmp_path / "s").model.effects} == {
        "backlash",
        "hysteresis",
    }
    assert bench.view["together"] is None


@pytest.mark.wide
def test_a_rival_that_would_turn_a_joint_back_is_no_doubt():
    """0.1 mm of play is a wind-up of 0.05 mm that is complete after 0.03 mm, but for that."""
    model, data = visited(403, ["backlash"], 20)
    found = diagnose(model, data)
    assert found.effects == ("backlash",)
    rivals = {"backlash": ["hysteresis"]}
    widths = [
        doubt.model.value("hysteresis.leg1.width")
        for doubt in rank_rival_pairs(found.best, rivals, found.ranked)
    ]
    assert sorted(widths) == pytest.approx([1e-4, 3e-4])


@pytest.mark.wide
def test_a_setting_that_was_found_without_the_other_effect_is_found_again_beside_it():
    model, data = visited(400, ["screw_wobble", "backlash"], 30)
    options = FitOptions()
    search = Search(model, lambda extended, insist: fit(extended, data, options), lambda *_: None)
    astray = Chosen("screw_pitch_error", (("lead", 4.99e-3),))
    trial = search.rescan_settings(
        search.fit(Chosen("backlash"), astray),
        lambda without: [candidate(without.scene, name) for name in ("screw_pitch_error",)],
    )
    assert trial.names == ("backlash", "screw_pitch_error")
    assert trial.chosen[1].settings["lead"] == pytest.approx(5e-3, abs=4e-6)
    assert trial.fitted.estimate.chi2 < search.fit(Chosen("backlash"), astray).fitted.estimate.chi2


def test_several_effects_are_named_in_one_word():
    assert parse_effects("backlash") == [("backlash", {})]
    assert parse_effects("gear:ratio=8e+1+my.own+hysteresis:joint1.width=1e-3") == [
        ("gear", {"ratio": 80.0}),
        ("my.own", {}),
        ("hysteresis", {"joint1.width": 1e-3}),
    ]
