"""An effect of the model that another effect would replace without loss stays ambiguous."""

import re

import pytest

import parallel_cal as pc
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.session.steps import add

MODEL = "config/delta_mockup_nominal.yaml"


def add_to(effect, bag):
    model = pc.read_model(MODEL)
    data = pc.load_dataset(bag, joints=model.joints)
    return add(model, effect, data).model, data


def diagnose_with(effect, bag):
    return diagnose(*add_to(effect, bag))


@pytest.mark.wide
def test_backlash_stays_ambiguous_after_it_was_added():
    found = diagnose_with("backlash", "bags/delta_backlash")
    assert found.verdict.word == "at_noise"
    assert {one.effect: one.names for one in found.ambiguous} == {"backlash": ["hysteresis"]}
    assert "backlash or hysteresis: the samples do not tell" in found.verdict.text
    plan = found.measure_next.plan
    assert plan.between == ("backlash", "hysteresis")
    assert plan.certainty.now < plan.certainty.then
    assert f"{len(plan.poses)} planned poses would" in found.verdict.text
    assert f"(with a probability of {plan.certainty.then:.2f})" in found.verdict.text
    hysteresis = next(e for e in found.entries if e.name == "hysteresis")
    assert "do not distinguish it from backlash of the model" in hysteresis.reason
    assert found.document()["ambiguous"] == {"backlash": ["hysteresis"]}


@pytest.mark.wide
def test_an_effect_without_a_lookalike_is_not_ambiguous():
    found = diagnose_with("thermal_expansion", "bags/delta_thermal")
    assert found.ambiguous == ()
    assert "do not tell which" not in found.verdict.text


@pytest.mark.wide
def test_the_signed_part_of_the_report_keeps_the_ambiguity():
    text = pc.page(pc.report(*add_to("backlash", "bags/delta_backlash")))
    signed = text.split('<section id="certificate">')[1].split("</section>")[0]
    assert "backlash or hysteresis: the samples do not tell which of them the robot has" in signed
    assert re.search(r"\d+ planned poses would (not yet )?tell", signed)
