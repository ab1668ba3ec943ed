"""Ten sessions of a foreign generator on which verdicts went wrong once (shared/data/verdicts).

The generator shares nothing with the package. Each session is a table with its column map and the
model to start from; the README beside them says what is hidden and what should be said.
"""

from pathlib import Path

import numpy as np
import pytest

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.session.steps import add

SESSIONS = Path(__file__).parents[3] / "shared" / "data" / "verdicts"

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
    assert any("backlash" in one["effects"] for one in diagnosed("positions_model24").missing)


def test_friction_that_grows_with_the_load_leaves_something_that_depends_on_payload():
    found = diagnosed("friction_with_load")
    assert found.verdict.word == "partly_explained"
    assert found.remaining.name == "payload"
    assert "what remains depends on payload" in found.verdict.text


@pytest.mark.slow
def test_arms_of_different_warmth_leave_something_that_depends_on_temperature():
    found = diagnosed("arm_temperatures")
    assert found.verdict.word == "partly_explained"  # the arms' mean growth is a part of it
    assert found.remaining.name == "temperature"


def test_sticking_that_shows_between_visits_is_not_called_noise():
    found = diagnosed("sticking")
    assert found.verdict.word in ("partly_explained", "cannot_know")
    assert "the noise is 1.9 times the stated noise" in found.verdict.text


def test_correlated_noise_is_at_noise():
    found = diagnosed("correlated")
    assert found.verdict.word == "at_noise"
    assert "the noise is correlated over" in found.verdict.text


def compute_true_error(name, model):
    """Position error (m, rms) at poses that nobody measured, in the frame of the device."""
    table = np.genfromtxt(SESSIONS / f"{name}.truth.csv", delimiter=",", names=True)
    q, true = (np.column_stack([table[c] for c in names]) for names in (("q0", "q1", "q2"), "xyz"))
    found = Kinematics(model).direct(q).position
    return np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1)))


def test_a_base_that_leans_away_from_the_load_is_named_and_added():
    model, data = session("leaning_base")
    found = diagnose(model, data)
    assert found.verdict.word == "explained"
    assert found.effects == ("base_compliance",)
    added = add(model, "base_compliance", data).model
    assert -2e-3 < added.value("base_compliance.lean_x") < -0.5e-3
    assert -2e-3 < added.value("base_compliance.lean_y") < -0.5e-3
    without = compute_true_error("leaning_base", fit(model, data).model)
    assert compute_true_error("leaning_base", added) < 0.7e-6 < 1.4e-6 < without


@pytest.mark.slow
def test_add_accepts_the_named_effects_together_and_one_by_one():
    model, data = session("three_effects")
    found = diagnose(model, data)
    assert len(found.additions) == 3
    at_once = add(model, "+".join(found.additions), data)
    for one in found.additions:
        model = add(model, one, data).model
    assert model.values == pytest.approx(at_once.model.values, abs=2e-5)
