"""A campaign whose robot errs by a law outside the catalogue: poses that tell rival laws apart."""

from types import SimpleNamespace

import law_sessions as ls
import numpy as np
import pytest
import virtual_day as vd
import virtual_laws as laws
import virtual_sessions as days

from parallel_cal.campaign import judging
from parallel_cal.campaign.judging import (
    Conclusion,
    Judgement,
    JudgementRequest,
    conclude,
    judge_samples,
)
from parallel_cal.campaign.targets import Target
from parallel_cal.discovery.rivals import pair_laws
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import dump_model, read_model
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.session.session import Session
from parallel_cal.virtual import robot as vr

ROBOT = ls.ROBOTS["delta"]
LATER_NS = 10**12  # between the first samples and further ones
GROWTH = 4e-4  # rad at 1 kg: joint 2 errs with the square of the payload


def judgement(**change):
    known = {
        "samples": 32,
        "verdict": "described",
        "summary": "joint2 errs",
        "effects": (),
        "additions": (),
        "doubt": ("joint2 by payload",),
        "untold": (),
        "suspected": (),
        "missing": (),
        "text": "",
        "before": {"position": 1e-3},
        "unseen": {"position": 1e-4},
        "usual": {"position": 1e-4},
        "laws": ("joint2 by load.joint2",),
        "law_effects": {"law_joint2_a1": "TEXT = 1\n"},
    }
    return Judgement(**known | change)


def measure(readings, payloads, again, seed):
    """Samples of a robot whose second joint errs with the square of the payload, and with nothing
    else: the load on the joint nearly follows the payload."""

    def law(q, loads, at):
        return laws.only(ROBOT.kin, 1, at.payload**2)

    day = vd.visit(
        readings, ROBOT.home, again, seed, dwell=10.0, air=days.wandering, payload=payloads
    )
    return ls.measured(ROBOT, day, [laws.JointLaw(GROWTH, law, False)], ROBOT.noise, seed)


def visit_targets(data, targets, seed):
    """The samples, and those at planned targets."""
    readings = np.array([target.joints for target in targets])
    payloads = np.array([target.conditions.get("payload", 0.2) for target in targets])
    more = measure(readings, payloads, 0, seed)
    return join_datasets([data, more], [0, LATER_NS + int(1e9 * data.time.max())])


@pytest.mark.slow
def test_poses_where_rival_laws_differ_are_measured_until_no_pose_can_tell_those_left():
    payloads = np.where(np.arange(100) * 6 // 100 % 2, 1.2, 0.2)
    data = measure(vr.NOMINAL.inverse(vd.targets(80, 0))[0], payloads, 20, 0)
    model, seen = dump_model(ROBOT.model()), []
    for k in range(6):
        request = JudgementRequest(model, more=8, left=48 - 8 * k, changes={"payload": 1.0}, seed=k)
        seen.append(judge_samples(request, data, np.arange(len(data)) % 20 == 0))
        if seen[-1].untold:
            break
        data = visit_targets(data, seen[-1].targets, 100 + k)
    first, last = seen[0], seen[-1]
    assert {one.verdict for one in seen} == {"described"}
    # At first the load on the joint describes the data as well as the payload, which is the cause.
    assert {"joint2 by load.joint2", "joint2 by payload"} <= {*first.laws, *first.doubt}
    assert not first.untold
    assert not first.is_final(first)
    assert len(first.targets) > 1
    assert all(one.purpose.startswith("to distinguish the laws joint2 ") for one in first.targets)
    assert {one.conditions["payload"] for one in first.targets} <= {0.2, 1.2}
    # At last the cause is named, beside laws that no pose can distinguish from it: the load on
    # another joint is nearly proportional to the payload.
    assert len(data) <= 148
    assert last.laws == ("joint2 by payload",)
    assert {name.partition(" by ")[2] for name in last.doubt} <= {"payload", "load.joint1"}
    assert set(last.untold) == {*last.laws, *last.doubt}
    assert last.is_final(last)
    assert "FoundLaw" in next(iter(last.law_effects.values()))
    assert Judgement.from_document(vars(last) | {"targets": []}).laws == last.laws


def test_a_campaign_goes_on_while_poses_can_tell_a_law_from_its_rivals():
    telling = judgement()
    assert not telling.is_final(telling)
    alike = judgement(untold=("joint2 by load.joint2", "joint2 by payload"))
    assert alike.is_final(alike)
    other = judgement(laws=("joint3 by payload",), doubt=(), untold=())
    assert other.is_final(other)
    assert not other.is_final(alike)


def test_a_judgement_of_an_earlier_release_has_no_law():
    document = vars(judgement()) | {"targets": []}
    del document["laws"], document["law_effects"]
    assert Judgement.from_document(document).laws == ()
    assert Judgement.from_document(document).law_effects == {}


@pytest.mark.parametrize(
    ("change", "needed"),
    [
        ({}, True),
        ({"verdict": "partly_explained"}, False),
        ({"effects": ("backlash",)}, False),  # a person limited the search
        ({"conditions": {"payload": 1.0}}, False),  # an untried condition comes first
    ],
)
def test_a_law_is_searched_for_only_if_the_whole_catalogue_and_every_condition_explain_nothing(
    change, needed
):
    known = {"verdict": "unexplained", "effects": (), "conditions": {}} | change
    found = SimpleNamespace(verdict=SimpleNamespace(word=known["verdict"]))
    targets = [Target((0.0,) * 3, conditions=known["conditions"])]
    assert judging._needs_law(found, JudgementRequest("", effects=known["effects"]), targets) == (
        needed
    )


def test_the_end_writes_the_law_for_a_person_to_review_and_leaves_it_out_of_the_model(
    tmp_path, monkeypatch
):
    Session.new(tmp_path / "c", read_model("config/delta_mockup_nominal.yaml"), [])
    proven = Conclusion("the model's text", "parameters identified")
    monkeypatch.setattr(judging, "_conclude_model", lambda folder, judgements: proven)
    found = conclude(tmp_path / "c", [judgement()])
    file = tmp_path / "c" / "effects" / "law_joint2_a1.py"
    assert file.read_text() == "TEXT = 1\n"
    assert found.text == proven.text
    assert f"parameters identified; a law was found and written to {file}" in found.words
    assert f"'parallel-cal session add {tmp_path / 'c'} law_joint2_a1'" in found.words
    assert conclude(tmp_path / "c", [judgement(law_effects={})]) == proven


def test_a_discovery_without_rival_laws_needs_no_fit_to_say_that_there_is_no_pair():
    law = SimpleNamespace(rivals={})
    assert pair_laws(SimpleNamespace(laws=(law,)), FitOptions()) == []
