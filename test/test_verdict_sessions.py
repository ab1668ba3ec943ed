"""Ten sessions of a foreign generator on which verdicts went wrong once (shared/data/verdicts).

The generator shares nothing with the package. Each session is a table with its column map and the
model to start from; the README beside them says what is hidden and what should be said.
"""

from pathlib import Path

import pytest

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.session.steps import add

SESSIONS = Path(__file__).parents[2] / "shared" / "data" / "verdicts"

pytestmark = [
    pytest.mark.wide,
    pytest.mark.skipif(not SESSIONS.exists(), reason=f"{SESSIONS} is not here"),
]


def session(name):
    model = read_model(SESSIONS / f"{name}.model.yaml")
    return model, import_csv(SESSIONS / f"{name}.csv", SESSIONS / f"{name}.columns.yaml")


def diagnosed(name):
    return diagnose(*session(name))


@pytest.mark.parametrize(
    ("name", "verdict", "effects"),
    [
        ("eccentricity_and_axes", "explained", {"encoder_eccentricity", "device_axes"}),
        ("eccentricity_and_gear", "explained", {"encoder_eccentricity", "gear_transmission_error"}),
        ("warmth", "explained", {"thermal_expansion"}),
    ],
)
def test_hidden_effects_are_named(name, verdict, effects):
    found = diagnosed(name)
    assert found.verdict.word == verdict
    assert set(found.effects) == effects


def test_a_gears_ratio_is_found_again_once_another_effect_is_known():
    [gear] = [c for c in diagnosed("eccentricity_and_gear").best.chosen if c.fixed]
    assert gear.settings["ratio"] == pytest.approx(33, abs=0.2)


def test_backlash_is_found_from_positions_alone_with_the_small_model():
    assert "backlash" in diagnosed("positions_model24").effects


def test_friction_that_grows_with_the_load_leaves_something_that_depends_on_payload():
    found = diagnosed("friction_with_load")
    assert found.verdict.word == "partly_explained"
    assert found.remaining.name == "payload"
    assert "what remains depends on payload" in found.verdict.summary


def test_arms_of_different_warmth_leave_something_that_depends_on_temperature():
    found = diagnosed("arm_temperatures")
    assert found.verdict.word == "unexplained"
    assert found.remaining.name == "temperature"


def test_sticking_that_shows_between_visits_is_not_called_noise():
    found = diagnosed("sticking")
    assert found.verdict.word == "cannot_know"
    assert "visits of the same pose differ by 1.9 times the stated noise" in found.verdict.summary


def test_correlated_noise_is_at_noise():
    found = diagnosed("correlated")
    assert found.verdict.word == "at_noise"
    assert "the noise is correlated over" in found.verdict.summary


def test_a_base_that_leans_the_wrong_way_teaches_the_robot_nothing():
    """The sign of gravity decides: other effects would only imitate the leaning base."""
    found = diagnosed("leaning_base")
    assert found.verdict.word == "unexplained"
    assert not found.effects
    assert "base_compliance.lean_x would have to be -0.00087" in found.verdict.summary
    assert "check the directions that the model file states (gravity" in found.verdict.summary


def test_add_accepts_the_named_effects_together_and_one_by_one():
    model, data = session("three_effects")
    found = diagnose(model, data)
    assert len(found.additions) == 3
    at_once = add(model, "+".join(found.additions), data)
    for one in found.additions:
        model = add(model, one, data).model
    assert model.values == pytest.approx(at_once.model.values, abs=2e-5)
