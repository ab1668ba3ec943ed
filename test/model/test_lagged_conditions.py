"""Parts that warm up later than the sensor: lagged conditions of samples, models and answers."""

import sys
from dataclasses import replace

import findings
import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.discovery.drivers import name_lags
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.answers import named_conditions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import list_substitutes, parse_lag, parse_part
from parallel_cal.model.model import new_model
from parallel_cal.recordings.lagged import add_lagged_conditions, compute_lagged
from parallel_cal.session.steps import add

LATE = """from parallel_cal import Effect, Parameter


class Late(Effect):
    needs = ("temperature.lag300",)
    physics = source = "a test"

    def parameters(self, mechanism):
        return [Parameter("gain", "rad/K", 0.0, 1e-4)]

    def ideal(self, seen, e, at, mechanism):
        return seen.with_q(seen.q + e.gain * (at["temperature.lag300"] - 20))
"""


@pytest.fixture
def late(tmp_path, monkeypatch):
    """An effect whose parts follow the temperature with a time constant of 300 s."""
    (tmp_path / "late_of_a_test.py").write_text(LATE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "late_of_a_test"
    sys.modules.pop("late_of_a_test", None)


def test_a_lagged_condition_is_named_by_its_time_constant_in_seconds():
    assert parse_lag("temperature.lag540") == ("temperature", 540.0)
    for other in ("temperature", "temperature.lag0", "temperature.lag", "payload.lag5"):
        assert parse_lag(other) is None


def test_a_part_may_have_a_temperature_of_its_own_and_a_lag():
    assert parse_part("temperature.arms") == ("temperature", "arms")
    assert parse_lag("temperature.arms.lag480") == ("temperature.arms", 480.0)
    for other in ("temperature", "temperature.lag480", "temperature.arms.lag480", "payload.arms"):
        assert parse_part(other) is None
    assert list_substitutes("temperature.arms.lag480") == ["temperature.arms", "temperature"]
    assert list_substitutes("temperature.lag480") == ["temperature"]
    assert list_substitutes("direction.joint1") == []


def test_a_part_without_a_sensor_has_the_general_temperature_where_others_have_sensors():
    names = ["temperature.arms", "temperature.rods", "temperature.rods.lag300"]
    plain = findings.clean(0)
    assert "temperature.arms" not in add_lagged_conditions(names, plain).conditions
    warm = replace(
        plain, conditions={**plain.conditions, "temperature.arms": np.full(len(plain), 35.0)}
    )
    found = add_lagged_conditions(names, warm).conditions
    np.testing.assert_array_equal(found["temperature.arms"], 35.0)
    np.testing.assert_array_equal(found["temperature.rods"], plain.conditions["temperature"])
    lagged = add_lagged_conditions(["temperature.lag300"], plain).conditions["temperature.lag300"]
    np.testing.assert_array_equal(found["temperature.rods.lag300"], lagged)


def test_a_lagged_temperature_follows_a_ramp_and_a_step_as_the_differential_equation_says():
    time = np.array([0.0, 10.0, 40.0, 400.0])
    ramp = compute_lagged(0.1 * time, time, 50.0, np.zeros(4))
    np.testing.assert_allclose(ramp, 0.1 * (time - 50 * (1 - np.exp(-time / 50))), rtol=1e-12)
    after = np.array([0.0, 1e-9, 20.0, 300.0])
    step = compute_lagged(np.array([0.0, 1, 1, 1]), after, 100.0, np.zeros(4))
    np.testing.assert_allclose(step, 1 - np.exp(-after / 100), atol=1e-9)


def test_every_session_begins_settled_and_the_order_of_the_samples_does_not_matter():
    time, air = np.arange(6.0), np.array([20.0, 24, 24, 30, 34, 34])
    session = np.array([0, 0, 0, 1, 1, 1])
    whole = compute_lagged(air, time, 2.0, session)
    assert whole[0] == 20
    assert whole[3] == 30
    order = np.array([4, 0, 5, 2, 3, 1])
    mixed = compute_lagged(air[order], time[order], 2.0, session[order])
    np.testing.assert_array_equal(mixed, whole[order])


def test_samples_that_are_chosen_later_keep_the_lagged_temperature_of_the_whole_recording():
    data = findings.clean(0)
    whole = add_lagged_conditions(["temperature.lag300"], data)
    again = add_lagged_conditions(["temperature.lag300"], whole.select(np.arange(0, 150, 7)))
    expected = whole.conditions["temperature.lag300"][::7]
    np.testing.assert_array_equal(again.conditions["temperature.lag300"], expected)
    assert (
        add_lagged_conditions(["temperature.lag300"], replace(data, conditions={})).conditions == {}
    )


def test_time_constants_of_a_search_lie_between_a_few_samples_and_the_recording():
    data = findings.clean(0)
    lags = [parse_lag(name)[1] for name in name_lags(data)]
    assert 30 < lags[0] < 60
    assert 700 < lags[-1] <= np.ptp(data.time)
    np.testing.assert_allclose(np.diff(np.log2(lags)), 0.25, atol=0.02)
    steady = {**data.conditions, "temperature": np.full(len(data), 21.0)}
    assert name_lags(replace(data, conditions=steady)) == []


@pytest.mark.wide
def test_an_effect_of_a_lagged_temperature_is_added_and_identified(late):
    data = findings.clean(1)
    lagged = add_lagged_conditions(["temperature.lag300"], data).conditions["temperature.lag300"]
    moved = replace(data, q=data.q - 2e-4 * (lagged - 20)[:, None])
    step = add(new_model("delta54"), late, moved)
    found = step.result.parameters()[f"{late}.gain"]
    assert abs(found.value - 2e-4) < 4 * found.sigma < 2e-5
    again = fit(step.model, moved)
    assert again.held_out.summary.position_rms < 1.05 * again.noise_floor.position_rms


def test_a_lagged_temperature_that_is_not_stated_is_settled_at_the_temperature(late):
    model = new_model("delta54", {f"{late}.gain": 1e-3}, [late])
    kinematics, q = Kinematics(model), np.zeros((1, 3)) + 0.5
    stated, settled, neutral = (
        kinematics.direct(q, at).position
        for at in ({"temperature.lag300": 25.0}, {"temperature": 25.0}, {})
    )
    np.testing.assert_array_equal(stated, settled)
    assert np.abs(stated - neutral).max() > 1e-4
    assert named_conditions(model, [("temperature.lag300", 25.0)]) == {"temperature.lag300": 25.0}
    with pytest.raises(ModelError, match=r"no condition 'temperature\.later'"):
        named_conditions(model, [("temperature.later", 25.0)])


def test_a_node_follows_the_temperature_as_the_recorded_samples_do(late):
    pytest.importorskip("parallel_cal_msgs")
    from parallel_cal.nodes.stream_memory import Memory

    model, memory = new_model("delta24", effects=[late]), Memory(1e-4)
    time = np.array([0.0, 60.0, 90.0, 400.0, 1000.0])
    air = np.array([20.0, 24.0, 24.0, 30.0, 22.0])
    expected = compute_lagged(air, time, 300.0, np.zeros(5))
    for t, value, lagged in zip(time, air, expected, strict=True):
        memory.on_condition(model, "temperature", value, t)
        known = memory.conditions(model)
        assert known["temperature.lag300"] == pytest.approx(lagged, rel=1e-12)
    assert np.ptp(expected) > 3.0
    assert memory.unheard(model) == []
