"""Until when a calibration can be trusted: five-bars of points and distances (bench/truth/age.py)
drift, and each states its date."""

import json
from dataclasses import replace

import numpy as np
import pytest

import parallel_cal as pc
from bench.truth import age as fleet
from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.cli.main import main
from parallel_cal.fleet.fleet import _list_sessions
from parallel_cal.identification.age import OUTDATED, UNKNOWN, Age, Trust, predict_age
from parallel_cal.identification.drift_estimate import Session, estimate_drift, pool_drifts
from parallel_cal.identification.drift_rate import GROWTHS, PARTS, SCALES, DriftRate
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.update import list_drift_parts, usual_drift
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.reporting.age import describe_age, document_age, is_past

DAY = 86400.0
SIGMA = 1e-6  # m, rad: how well these sessions see each parameter


def sessions_of(parameters, days, model):
    """Sessions that see every parameter, without a fit."""
    rng = np.random.default_rng(0)
    names, n = tuple(model.table.names), len(model.values)
    seen = [p + rng.normal(0, SIGMA, n) for p in parameters]
    known = np.eye(n) / SIGMA**2
    return [
        Session(DAY * day, Evidence(names, p, known, np.zeros(n)))
        for day, p in zip(days, seen, strict=True)
    ]


def walk(growth, scale, days, model, rng):
    """Parameters whose lengths drift by a law, in tenths of a tolerance after 100 days."""
    size = np.where([p.unit == "m" for p in model.table], 0.1 * model.table.tolerance, 0.0)
    t, n = np.array(days) / 100.0, len(size)
    if growth == 0:
        path = rng.normal(0, 0.5**0.5, (len(t), n))
    elif growth == 1:
        path = np.outer(t, rng.standard_normal(n))
    else:
        steps = np.sqrt(np.diff(t, prepend=0.0))[:, None] * rng.standard_normal((len(t), n))
        path = np.cumsum(steps, axis=0)
    return model.values + scale * size * path


@pytest.mark.parametrize("growth", GROWTHS)
def test_sessions_show_how_and_how_far_the_lengths_drift(growth):
    model, days = fleet.nominal(), [0, 1, 3, 10, 30, 100]
    rng = np.random.default_rng(int(10 * growth))
    found = estimate_drift(sessions_of(walk(growth, 1.0, days, model, rng), days, model), model)
    lengths = found.weights[PARTS.index("lengths")]
    assert lengths.sum(axis=1)[GROWTHS.index(growth)] > 0.9
    low, high = (found.quantile(level)["lengths"] for level in (0.025, 0.975))
    assert low <= 1.0 <= high < 3.0
    assert found.quantile(0.975)["others"] < 0.2  # nothing else has moved
    assert (found.span, found.sessions, found.robots) == (100 * DAY, 6, 1)


def rate_of(part, growth, scale, span=100 * DAY):
    """A rate that is known: one part drifts, the others by 1/30 of the usual drift."""
    weights = np.zeros((len(PARTS), len(GROWTHS), len(SCALES)))
    weights[:, 0, 0] = 1.0
    k = PARTS.index(part)
    weights[k] = 0.0
    weights[k, GROWTHS.index(growth), int(np.argmin(np.abs(SCALES - scale)))] = 1.0
    return DriftRate(weights, span, 5)


@pytest.mark.parametrize("growth", [0.5, 1.0])
def test_the_date_is_that_of_robots_that_drift_by_the_law(growth):
    """At the stated date 5 % of five-bars of another hand are beyond the limit, and not before."""
    model, error, limit = fleet.nominal(), 20e-6, 100e-6
    rate = rate_of("zeros", growth, 1.0)
    found = predict_age(model, rate, 0.0, {"position": error}, {"position": limit})
    until = found.trusts[0].until
    assert 0 < until < 100 * DAY
    rng = np.random.default_rng(5)
    q = fleet.turn_to(fleet.NOMINAL, rng.uniform(fleet.LOW, fleet.HIGH, (60, 2)))
    here, beyond = fleet.reach(fleet.NOMINAL, q), 0
    shifts = 0.5e-3 * (until / (100 * DAY)) ** growth * rng.standard_normal((1000, 2))
    for shift in shifts:
        p = fleet.NOMINAL.copy()
        p[[4, 9]] += shift
        moved = np.mean(np.sum((fleet.reach(p, q) - here) ** 2, axis=1))
        beyond += error**2 + moved > limit**2
    assert 0.03 < beyond / len(shifts) < 0.07


def test_what_nobody_has_seen_is_not_extrapolated_and_homing_may_end_it_at_once():
    model, errors = fleet.nominal(), {"position": 20e-6}
    small = predict_age(model, rate_of("zeros", 0.5, 1 / 30), 7.0, errors, {"position": 1e-4})
    assert small.until == 7.0 + 100 * DAY
    assert not small.trusts[0].is_seen
    assert "later is not known" in describe_age(small)
    homed = predict_age(model, rate_of("zeros", 0.0, 1.0), 7.0, errors, {"position": 1e-4})
    assert homed.until == 7.0
    assert "not beyond the session of the calibration" in describe_age(homed)
    with pytest.raises(FitError, match="is not above the validation error"):
        predict_age(model, rate_of("zeros", 0.5, 1.0), 0.0, errors, {"position": 1e-5})
    with pytest.raises(FitError, match="no validation error of the orientation"):
        predict_age(model, rate_of("zeros", 0.5, 1.0), 0.0, errors, {"orientation": 1e-5})


def test_one_session_shows_no_drift_and_a_fleet_lends_its_own():
    model, days = fleet.nominal(), [0, 50, 100]
    alone = sessions_of([model.values], [100], model)
    with pytest.raises(FitError, match="the folder of a fleet"):
        estimate_drift(alone, model)
    rng = np.random.default_rng(3)
    robots = [sessions_of(walk(0.5, 3.0, days, model, rng), days, model) for _ in range(6)]
    pooled = pool_drifts([*robots, alone], model)
    assert (pooled.robots, pooled.sessions) == (6, 18)
    lent = estimate_drift(alone, model, pooled)
    assert np.array_equal(lent.weights, pooled.weights)
    assert 1.7 < lent.quantile(0.5)["lengths"] < 5.5
    assert lent.quantile(0.975)["lengths"] > 9  # one robot's weight stays spread
    # A robot of its own that hardly moves tells more than the fleet.
    calm = sessions_of([model.values] * 3, days, model)
    assert estimate_drift(calm, model, pooled).quantile(0.5)["lengths"] < 0.5
    assert pool_drifts([alone], model) is None


def test_a_model_states_its_age_until_it_is_fitted_again(tmp_path):
    rate = rate_of("lengths", 0.5, 3.0)
    stated = Age(1.7e9, (Trust("position", 3e-5, 1e-4, 1.71e9, True),), rate)
    fit = {"step": "fit", "dataset": {"sha256": "1"}}
    model = replace(fleet.nominal(), history=(fit, stated.entry()))
    write_model(model, tmp_path / "m.yaml")
    read = read_model(tmp_path / "m.yaml")
    found = Age.of_model(read)
    assert (found.calibrated, found.trusts) == (stated.calibrated, stated.trusts)
    assert np.array_equal(found.rate.weights, rate.weights)
    assert not is_past(found, 1.705e9)
    assert is_past(found, 1.72e9)
    assert describe_age(found) == "position error within 100 um until 2024-03-09 16:00 UTC (95 %)"
    assert describe_age(found, 1.72e9).endswith("which is past: measure again")
    assert document_age(found)["trusted"][0]["until"].startswith("2024-03-09T16:00")
    assert Age.of_model(replace(read, history=(*read.history, fit))).unknown == OUTDATED
    assert Age.of_model(replace(read, history=(fit,))).unknown == UNKNOWN
    assert "record a second session" in describe_age(Age.of_model(fleet.nominal()))
    # The usual drift of updates and plans is then that of the robot.
    lengths = list_drift_parts(read)["lengths"]
    k = int(np.argmax(lengths[0]))
    assert usual_drift(read)[k, k] > 8 * usual_drift(replace(read, history=()))[k, k]


@pytest.mark.parametrize(
    "wrong",
    [{"trusted": [{}]}, {"weights": [[1.0]]}, {"span": 0.0}, {"calibrated": 1.8e9}],
)
def test_an_age_that_cannot_be_read_is_refused(wrong):
    stated = Age(1.7e9, (Trust("position", 3e-5, 1e-4, 1.71e9, True),), rate_of("zeros", 0.5, 1))
    model = replace(fleet.nominal(), history=({**stated.entry(), **wrong},))
    with pytest.raises(FitError, match="parallel-cal drift"):
        Age.of_model(model)


def call(*words, code=0):
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    assert ended.value.code in (code, None)


def test_the_command_dates_a_model_by_its_recordings(tmp_path, capsys):
    fleet.write_sessions(tmp_path)
    files = [str(tmp_path / f"month{k}.json") for k in (0, 2, 4)]
    model, aged = str(tmp_path / "m.yaml"), str(tmp_path / "aged.yaml")
    call("drift", str(tmp_path / "drawn.yaml"), *files, code=1)
    assert "never fitted" in capsys.readouterr().err
    call("fit", str(tmp_path / "drawn.yaml"), files[2], "-o", model)
    capsys.readouterr()
    call("drift", model, *files, "--limit-um", "400", "-o", aged, "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["calibrated"] == "2024-03-13T22:13:20+00:00"
    assert found["rate"]["span"] == pytest.approx(120 * DAY)
    assert found["trusted"][0]["limit"] == pytest.approx(400e-6)
    age = Age.of_model(read_model(aged))
    assert age.calibrated == pytest.approx(fleet.START + 4 * fleet.EVERY)
    assert age.until >= age.calibrated
    call("drift", model, *files[:2], code=1)
    assert "none of the recordings is that of the last fit" in capsys.readouterr().err
    call("drift", model, files[2], "--fleet", str(tmp_path), code=1)
    assert "expected a folder that parallel-cal fleet -o wrote" in capsys.readouterr().err


def test_diagnostics_warn_once_the_date_is_past():
    pytest.importorskip("diagnostic_msgs")
    from parallel_cal.nodes.model_server import Attempt, ServedModel
    from parallel_cal.nodes.tally import model_diagnostics

    stated = Age(1.7e9, (Trust("position", 3e-5, 1e-4, 1.71e9, True),), rate_of("zeros", 0.5, 1))
    model = replace(fleet.nominal(), history=(stated.entry(),))
    served = ServedModel(model, None, "", "")

    def at(now, served=served):
        found = model_diagnostics("node", served, Attempt(True, "", "", ""), "", now)
        return found, {item.key: item.value for item in found.values}["calibration"]

    found, words = at(1.705e9)
    assert found.level == found.OK
    assert words == "position error within 100 um until 2024-03-09 16:00 UTC (95 %)"
    found, _ = at(1.72e9)
    assert found.level == found.WARN
    assert "too old: position error within 100 um" in found.message
    found, words = at(1.72e9, ServedModel(fleet.nominal(), None, "", ""))
    assert found.level == found.OK
    assert words.startswith("unknown: no second calibration")


def test_holes_in_mm_are_refused_because_no_robot_reaches_two_of_them():
    with pytest.raises(ModelError, match="expected positions in m on one plate"):
        pc.new_model("delta24", sensors=[pc.sensors.load("sockets", holes=((0, 0, 0), (50, 0, 0)))])


def test_sessions_of_a_fleet_are_those_at_known_times():
    evidence = Evidence.uninformative(("a",))
    rows = [
        {"robot": "r1", "mechanism": "five_bar", "time": time, "evidence": vars(evidence)}
        for time in (3.0, None, 1.0)
    ]
    [found] = _list_sessions(rows, "five_bar")
    assert [one.time for one in found] == [1.0, 3.0]


@pytest.mark.slow
@pytest.mark.parametrize("law", fleet.LAWS)
def test_fleets_of_another_hand_hold_what_they_state(law):
    found = [fleet.follow(law, 1.0, seed) for seed in range(40)]
    promised = [one for one in found if one.days > 0]
    assert len(promised) > 10
    # 95 % of 40: 34 or fewer have a probability of 1.4 %.
    assert sum(one.held for one in promised) >= 0.86 * len(promised)
