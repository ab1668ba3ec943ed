"""Which effects a session would find: what is planted and measured, sizes tried, the real thing."""

import json
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from clusters import cluster
from datasets import measured as seen

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.cli import main as cli
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.fleet.jobs import FleetError
from parallel_cal.identification.fit import fit
from parallel_cal.model.file.modelfile import dump_model, write_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.simulate import simulate, with_noise
from parallel_cal.reporting.studies import format_power, power_page, power_remarks
from parallel_cal.study import power as study
from parallel_cal.study.planned_session import planned_session
from parallel_cal.study.power import (
    CLEAN_RATIO,
    Detectable,
    SizeResult,
    next_sizes,
    power,
    predict_detectability,
)
from parallel_cal.study.session import PlantedEffect, Question, diagnose_session, simulate_session
from parallel_cal.study.tolerance import model_of
from parallel_cal.virtual import robot as vr

NOISE = Noise(1e-4, 1e-5, None)


def crank(noise=NOISE):
    return replace(new_model("slider_crank"), noise=noise)


def written(folder, model, angles, header="crank"):
    (folder / "plan.csv").write_text("\n".join([header, *(f"{a!r}" for a in angles)]))
    return planned_session(folder / "plan.csv", model, ReadOptions())


@pytest.fixture
def question(tmp_path):
    """A crank at 24 angles, up and down in turn."""
    angles = np.linspace(0.25, 0.6, 24)[np.random.default_rng(0).permutation(24)].tolist()
    model = crank()
    return Question(dump_model(model), written(tmp_path, model, angles))


# ----------------------------------------------------------------------------- the session


def test_a_session_visits_the_plans_poses_in_its_order(question):
    planned = question.planned
    assert len(planned) == 24
    assert sorted(planned.q[:, 0]) == pytest.approx(np.linspace(0.25, 0.6, 24), abs=1e-9)
    np.testing.assert_array_equal(
        planned.conditions["direction.crank"][1:], np.sign(np.diff(planned.q[:, 0]))
    )


def test_a_plans_stops_say_from_which_side_a_pose_is_come_to(tmp_path):
    """Past 0.5 rad and back, to 0.4 from above; from below where the stops are turned round."""
    rows = "crank,past.crank,turn.crank\n0.4,0.3,0.45\n0.4,0.5,0.35\n0.42,0.5,0.3\n"
    (tmp_path / "plan.csv").write_text(rows)
    planned = planned_session(tmp_path / "plan.csv", crank(), ReadOptions(), pace=20.0)
    assert planned.q[:, 0] == pytest.approx([0.4, 0.4, 0.42], abs=1e-9)
    assert np.diff(planned.conditions["time"]) == pytest.approx(20.0, abs=1.0)
    assert planned.conditions["direction.crank"].tolist() == [-1.0, 1.0, 1.0]
    assert planned.conditions["travel.crank"] == pytest.approx([-0.05, 0.05, 0.12], abs=1e-6)


def test_loads_that_a_plan_gives_are_those_of_its_poses(tmp_path):
    model = crank()
    (tmp_path / "plan.csv").write_text("crank,payload\n0.3,0\n0.5,2\n0.4,1\n")
    planned = planned_session(tmp_path / "plan.csv", model, ReadOptions())
    assert planned.conditions["payload"].tolist() == [0.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("joint1\n0.3\n", r"plan\.csv:1: no column crank: the plan is not for this slider_crank"),
        ("crank\n0.3\nmuch\n", r"plan\.csv:3: column crank contains 'much'"),
        (
            "crank\n0.3\n2.5\n",
            r"plan\.csv:3: this slider_crank cannot be assembled with joints 2.5",
        ),
        ("crank,past.crank\n0.3,?\n", r"plan\.csv:2: column past.crank contains '\?'"),
    ],
)
def test_a_plan_that_cannot_be_driven_is_refused(tmp_path, text, words):
    (tmp_path / "plan.csv").write_text(text)
    with pytest.raises(DatasetError, match=words):
        planned_session(tmp_path / "plan.csv", crank(), ReadOptions())


def test_what_is_planted_errs_as_worked_by_hand(tmp_path):
    """At 100 mm the slider moves by 129.90 mm a radian of the crank (test_study_tolerance): half a
    play of 0.3 mrad makes 19.5 um; the noise is the model's."""
    angle = float(np.arccos(0.86875))
    model = replace(crank(Noise(1e-4, 1e-5, None)), fixed=np.ones(3, bool))
    planned = written(tmp_path, model, [angle, angle - 0.01] * 100)
    question = Question(dump_model(model), planned)
    data, rms = simulate_session(question, PlantedEffect("backlash", 1.0, 0))
    assert rms == pytest.approx(19.5e-6, rel=0.03)
    assert simulate_session(question, PlantedEffect("backlash", 2.0, 0))[1] == pytest.approx(
        2 * rms, rel=1e-3
    )
    assert np.std(data.q - planned.q) == pytest.approx(1e-4, rel=0.2)
    true = np.where(planned.conditions["direction.crank"] > 0, 1, -1) * rms + planned.r[:, 0]
    assert np.sqrt(np.mean((data.r[:, 0] - true) ** 2)) == pytest.approx(1e-5, rel=0.2)
    clean, nothing = simulate_session(question, PlantedEffect("", 0.0, 0))
    assert nothing == 0
    assert np.sqrt(np.mean((clean.r - planned.r)[:, 0] ** 2)) == pytest.approx(1e-5, rel=0.2)


def test_a_session_of_one_number_is_the_same_robot_and_noise_with_any_size(question):
    small, large, other = (
        simulate_session(question, PlantedEffect("encoder_eccentricity", size, k))[0]
        for size, k in ((0.1, 3), (4.0, 3), (0.1, 4))
    )
    np.testing.assert_array_equal(small.q, large.q)
    assert np.abs(small.q - other.q).max() > 1e-5
    assert np.abs(small.r - large.r).max() > 1e-4


def test_lines_that_hold_a_platform_by_more_than_it_needs_fit_each_other():
    """What a drifting stand does to the pose shows at the lines' own lengths: 0.1 um/s tolerance
    for a minute."""
    model = with_noise(new_model("cable"))
    planned = simulate(model, 20, quiet=True).dataset()
    question = Question(dump_model(model), planned)
    assert 1e-6 < simulate_session(question, PlantedEffect("base_drift", 1.0, 0))[1] < 20e-6
    data, nothing = simulate_session(question, PlantedEffect("", 0.0, 0))
    assert nothing == 0
    assert np.abs(data.q - planned.q).max() > 1e-3  # a robot of its own


# ----------------------------------------------------------------------------- sizes


def tried(**found):
    """`_30=2`: of size 0.3, two of four."""
    return [SizeResult(float(k[1:]) / 100, 4, n, {}, 1e-5) for k, n in found.items()]


def test_sizes_are_tried_until_most_and_few_find_it():
    assert next_sizes(0.3, []) == [0.3]
    assert next_sizes(30.0, []) == [5.0]  # nothing that far is of such a robot
    assert next_sizes(0.3, tried(_30=4)) == [0.212]
    assert next_sizes(0.3, tried(_30=3)) == [0.424, 0.212]
    assert next_sizes(0.3, tried(_30=1)) == [0.424]
    assert next_sizes(0.3, tried(_30=1, _42=4)) == []
    assert next_sizes(5.0, tried(_500=0)) == [7.07]
    assert next_sizes(5.0, tried(_500=0, _707=0)) == []
    assert next_sizes(0.8, tried(_10=4)) == []  # an eighth of what was predicted is enough


def test_the_smallest_size_is_one_above_which_all_are_found():
    one = Detectable("x", tried=tuple(tried(_10=2, _14=1, _20=3, _28=4)))
    assert one.smallest(0.5).size == 0.20
    assert one.smallest(0.9).size == 0.28
    assert Detectable("x", tried=tuple(tried(_10=4, _14=1))).smallest(0.5) is None


def as_if(found_from):
    """A cluster that finds an effect from a size on, and keeps what it is asked."""
    asked = []

    def each(_, do, calls):
        for k, (question, one) in reversed([*enumerate(calls)]):
            asked.append(one)
            named = one.effect and one.size >= found_from
            other = one.number == 1 and one.effect == ""
            wrong = one.effect and one.size > found_from / 2
            effects = [one.effect] if named else ["base_drift"] if other or wrong else []
            yield (
                k,
                {
                    "inputs": question.hash_inputs(),
                    **vars(one),
                    "error": 1e-5 * one.size,
                    "swaps": {},
                    "effects": effects,
                    "verdict": "",
                    "reason": "",
                },
            )

    return asked, each


def test_a_study_ends_where_it_knows_goes_on_where_it_was_and_counts_false_alarms(
    question, tmp_path, monkeypatch
):
    monkeypatch.setattr(study, "cluster", lambda *given: nullcontext())
    asked, each = as_if(0.8)
    monkeypatch.setattr(study, "run_each", each)
    found = power(question, ["backlash"], 4, folder=tmp_path / "out")
    (one,) = found.effects
    assert one.smallest(0.5) is one.smallest(0.9)
    assert 0.8 <= one.smallest(0.9).size < 0.8 * 2**0.5 + 0.01
    assert one.tried[0].found == 0
    assert (found.clean, found.false_alarms) == (8, {"base_drift": 1})
    assert found.sessions == len(asked) == len(set(asked))
    assert max(Counter((one.effect, one.size) for one in asked).values()) == 8
    assert "false alarms in 8 sessions without any effect: base_drift in 1" in format_power(found)
    assert "backlash is mistaken for base_drift in 4 of 16 sessions" in format_power(found)
    assert "Effects that 24 poses of slider_crank detect" in power_page(found)
    lines = (tmp_path / "out" / "sessions.jsonl").read_text().splitlines()
    cut = "\n".join([*lines[:-3], lines[-3][:20]])  # a crash in the middle of a line
    (tmp_path / "out" / "sessions.jsonl").write_text(cut)
    before = len(asked)
    again = power(question, ["backlash"], 4, folder=tmp_path / "out")
    assert len(asked) == before + 3
    assert again.document() == found.document()
    power(replace(question, seed=1), ["backlash"], 4, folder=tmp_path / "out")
    assert len(asked) > before + 10  # another question


def test_what_cannot_be_planted_is_named(question, tmp_path):
    with pytest.raises(
        ModelError, match=r"effect 'rust' does not exist.*available effects: .*backlash"
    ):
        power(question, ["rust"], 2, folder=tmp_path / "out")


def test_what_fails_is_a_row_with_its_reason(question):
    row = diagnose_session(
        replace(question, model=dump_model(new_model("stewart42"))), PlantedEffect("", 0, 0)
    )
    assert row["reason"]
    assert row["effects"] == []
    with pytest.raises(FleetError, match=r"but 9\.9 is needed"):
        diagnose_session(replace(question, version="9.9"), PlantedEffect("", 0.0, 0))


@pytest.mark.slow
def test_the_prediction_is_what_the_evidence_of_a_diagnosis_shows(question):
    """Of 60 sessions with play of the predicted size half, or 90 %, make it as probable as a
    diagnosis asks; a share of 60 is uncertain by 0.07."""
    model = model_of(question.model)

    def see(one):
        found = fit(model, simulate_session(question, one)[0])
        return Scene.of(found.model, found.dataset, found.observations, found.free)

    def is_named(one):
        made = Causes.of(see(one), ["backlash"], kinds=()).sum
        nothing = made.evidence((), made.nu)
        return made.rank(nothing)[0].log_p - nothing.log_p > np.log(0.95 / 0.05)

    found = predict_detectability(question, candidate(see(PlantedEffect("", 0.0, 0)), "backlash"))
    for size, share in zip(found.predicted, (0.5, 0.9), strict=True):
        named = [is_named(PlantedEffect("backlash", size, k)) for k in range(60)]
        assert np.mean(named) == pytest.approx(share, abs=0.2)


@pytest.mark.slow
def test_two_workers_a_killed_scheduler_and_one_process_say_the_same(question, tmp_path):
    pytest.importorskip("distributed")
    asked = (question, ["backlash"], 2)
    with cluster(tmp_path, 2) as workers:

        def kill_it(stage, done):
            if done > 0.7 and workers.scheduler.poll() is None:
                workers.kill(workers.scheduler)

        given = {"folder": tmp_path / "there", "scheduler": workers.address}
        with pytest.raises(FleetError, match="connection to the scheduler is lost"):
            power(*asked, **given, progress=kill_it)
    kept = len((tmp_path / "there" / "sessions.jsonl").read_text().splitlines())
    assert kept > 2
    begun = []
    (tmp_path / "again").mkdir()
    with cluster(tmp_path / "again", 2) as workers:
        there = power(
            *asked,
            folder=tmp_path / "there",
            scheduler=workers.address,
            progress=lambda stage, done: begun.append(done),
        )
    assert begun[0] == pytest.approx(
        kept / (CLEAN_RATIO * 2)
    )  # sessions without any effect come first
    here = power(*asked, folder=tmp_path / "here", workers=1)
    assert here.document() == there.document()
    rows = (
        sorted((tmp_path / name / "sessions.jsonl").read_text().splitlines())
        for name in ("here", "there")
    )
    assert next(rows) == next(rows)
    (one,) = here.effects
    assert one.predicted[0] / 2 < one.smallest(0.5).size < 3 * one.predicted[0]


@pytest.mark.wide
def test_the_command_gives_page_numbers_and_clear_errors(question, tmp_path, capsys):
    write_model(crank(), tmp_path / "crank.yaml")
    words = ["study", "power", str(tmp_path / "plan.csv"), str(tmp_path / "crank.yaml")]
    out = ["-o", str(tmp_path / "out"), "--sessions", "2", "--effect", "device_bump", "--json"]
    with pytest.raises(SystemExit) as ended:
        cli.main([*words, *out])
    document = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert [one["effect"] for one in document["effects"]] == ["device_bump"]
    assert document["effects"][0]["unit"] == "m"
    assert json.loads((tmp_path / "out" / "power.json").read_text()) == document
    assert 'id="detectable-effects"' in (tmp_path / "out" / "power.html").read_text()
    with pytest.raises(SystemExit) as ended:
        cli.main([*words[:2], str(tmp_path / "no.csv"), words[3]])
    assert ended.value.code == 1
    assert "no.csv" in capsys.readouterr().err


@pytest.mark.slow
def test_robots_built_another_way_are_found_out_where_the_study_says_so(tmp_path):
    """Virtual Delta robots with play 1.5 times as large as what 90 % are found with are all found
    out, those with a fifth are not."""
    given = vr.THESIS_NOISE
    noise = Noise(given.joint, given.position, given.orientation)
    model = replace(new_model("delta54"), noise=noise)
    question = Question(dump_model(model), seen(0, n_poses=40, n_replicates=8))
    (one,) = power(question, ["backlash"], 4, folder=tmp_path).effects
    play = one.smallest(0.9).size * one.tolerance
    for times, right in ((1.5, True), (0.2, False)):
        for seed in range(1, 4):
            hidden = [vr.Backlash((times * play,) * 3)]
            found = diagnose(model, seen(seed, n_poses=40, n_replicates=8, effects=hidden))
            names = {n for name in found.effects for n in (name, *found.swaps.get(name, ()))}
            assert ("backlash" in names) is right


def test_remarks_name_what_cannot_be_tested_but_not_what_does_not_apply():
    found = study.Power(
        Question("", seen(0, n_poses=8)),
        (
            Detectable("base_drift", "no time was recorded"),
            Detectable("spool_buildup", "cannot occur: no cables", applies=False),
        ),
        0,
        Counter(),
    )
    remarks = "\n".join(power_remarks(found))
    assert "base_drift: no time was recorded" in remarks
    assert "spool_buildup" not in remarks
