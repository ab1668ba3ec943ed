"""What is planned can be measured, and measuring it settles what was in doubt."""

from dataclasses import replace

import numpy as np
import pytest
from findings import travel
from settling import DOUBTS, settled

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis.decision import Undecided, plan_decision
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.diagnosis.separate import explain_separation
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Noise, new_model
from parallel_cal.planning.plan import plan
from parallel_cal.planning.posepool import make_pool
from parallel_cal.planning.schedule import Schedule
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

NOISE = Noise(vr.THESIS_NOISE.joint, vr.THESIS_NOISE.position, vr.THESIS_NOISE.orientation)


@pytest.fixture(scope="module")
def winding():
    """A plan for drives that wind up."""
    return plan(replace(new_model("delta54"), noise=NOISE).with_effect("hysteresis"), 16, pool=200)


def test_each_joint_approaches_from_its_last_reversal_on_the_planned_path(winding):
    """Driven in any order: what a joint did before its two stops is all the same."""
    poses, names = winding.document()["poses"], [f"travel.joint{i}" for i in (1, 2, 3)]
    order = np.random.default_rng(0).permutation(len(poses))
    stops = [[*(s["joints"] for s in poses[i]["by_way_of"]), poses[i]["joints"]] for i in order]
    stations = np.concatenate([[np.zeros(3)], *stops])
    driven = np.column_stack([travel(way) for way in np.diff(stations, axis=0).T])[2::3]
    wanted = [[poses[i]["conditions"][name] for name in names] for i in order]
    np.testing.assert_allclose(driven, wanted, atol=1e-9)


def test_ways_are_short_and_long(winding):
    ways = np.abs(winding.a).max(axis=1)
    assert ways.min() < 5e-3
    assert ways.max() > 50e-3


def test_a_path_that_would_be_too_short_is_planned_at_its_real_length():
    model = new_model("delta54").with_effect("hysteresis")
    pool = make_pool(model, 50, np.random.default_rng(1), symmetric=False)
    least = np.array([2e-3, 0.0, 30e-3])
    longer = pool.lengthen_approach(model, least)
    before, after = pool.approach.ways, longer.approach.ways
    assert np.array_equal(np.sign(after), np.sign(before))
    assert np.array_equal(np.abs(after), np.maximum(np.abs(before), least))
    assert (np.abs(before) < least).any()
    names = [f"travel.joint{i}" for i in (1, 2, 3)]
    travelled = longer.a[:, [model.conditions.index(name) for name in names]]
    assert np.array_equal(travelled, after)


def test_a_pool_takes_up_a_travel_that_the_caller_asks_for():
    model = new_model("delta54").with_effect("hysteresis")
    least = np.array([2e-3, 0.0, 10e-3])
    pool = make_pool(model, 50, np.random.default_rng(1), symmetric=False, least_travels=least)
    assert (np.abs(pool.approach.ways) > least).all()
    stops = [pool.approach.waypoints(i)[1].joints for i in range(len(pool.poses))]
    np.testing.assert_allclose(pool.poses.joints - stops, pool.approach.ways, atol=1e-12)


def test_an_approach_takes_up_a_backlash_whichever_of_two_rivals_the_model_contains():
    model, data = measured_after_long_moves()
    plans = {}
    for effect, rival in (("backlash", "hysteresis"), ("hysteresis", "backlash")):
        fitted = fit(model.with_effect(effect), data, hold_out=0)
        sets = {name: Chosen(name) for name in (effect, rival)}
        doubt = Undecided.between(Trial((Chosen(effect),), fitted), sets)
        plan = plan_decision(doubt, data.conditions, 20, 20, anywhere, enough=0.0)
        travels = plan.a[:, [doubt.model.conditions.index(f"travel.leg{i}") for i in LEGS]]
        assert (np.abs(travels) > doubt.least_travels).all()
        plans[effect] = (doubt, plan)
    (first, one), (second, other) = plans.values()
    np.testing.assert_allclose(first.least_travels[1:4:2], [0.15e-3, 0.1e-3], atol=10e-6)
    np.testing.assert_allclose(second.least_travels, first.least_travels, atol=10e-6)
    assert first.entropy == second.entropy == pytest.approx(np.log(2))
    assert one.after == pytest.approx(other.after, rel=0.25)
    assert one.after < 0.7 * first.entropy


def anywhere(joints):
    return np.ones(len(joints), bool)


LEGS = range(1, 7)


def measured_after_long_moves():
    """Return a hexapod, and samples of one with 0.15 mm of backlash in leg 2 and 0.1 mm in leg 4.
    Each pose was approached over more than 0.5 mm."""
    noise = Noise(dict.fromkeys((f"leg{i}" for i in LEGS), 5e-6), 30e-6, 50e-6)
    model = replace(new_model("stewart42"), noise=noise)
    rng, both = np.random.default_rng(3), model.with_effect("backlash").with_effect("hysteresis")
    widths = {"backlash.leg2.width": 0.15e-3, "backlash.leg4.width": 0.1e-3}
    values = [widths.get(n, v) for n, v in zip(both.table.names, both.values, strict=True)]
    both = both.with_values(np.array(values))
    pool = make_pool(both, 150, rng, symmetric=False, least_travels=0.5e-3)
    at = dict(zip(both.conditions, pool.a.T, strict=True))
    poses, n = Kinematics(both).direct(pool.poses.joints, at), len(pool.a)
    data = Dataset.from_arrays(
        both.joints,
        pool.poses.joints + rng.normal(0, 5e-6, (n, 6)),
        poses.position + rng.normal(0, 30e-6, (n, 3)),
        rotation_matrix(rng.normal(0, 50e-6, (n, 3))) @ poses.rotation,
        measured=np.ones((n, 6), dtype=bool),
        pose_cov=np.diag([30e-6**2] * 3 + [50e-6**2] * 3),
        joint_sigma=5e-6,
        conditions=at,
        source="virtual robot",
    )
    return model, data


def test_a_schedule_is_cold_warm_and_cold_again_as_fast_as_the_temperature_was_seen_to_change():
    """4 K in 1000 s were recorded, a sample in 10 s: blocks of 20 poses last 200 s."""
    time = np.arange(0.0, 1001.0, 10.0)
    course = Schedule.after({"time": time, "temperature": 18 + 0.004 * time}, 20)
    assert course.temperature.tolist() == [18.0, 22.0, 18.0]
    assert course.begin.tolist() == [2000.0, 3200.0, 4400.0]
    assert course.step == 10.0


def test_a_plan_changes_a_constant_temperature_by_4_kelvin():
    course = Schedule.after({"time": np.arange(10.0), "temperature": np.full(10, 21.0)}, 5)
    assert course.temperature.tolist() == [21.0, 25.0, 21.0]


def test_advice_is_for_the_pair_that_is_in_doubt():
    assert "short" in explain_separation("hysteresis", "latency")
    for pair in (("backlash", "hysteresis"), ("hysteresis", "backlash")):
        assert "once by a short move, just longer than the backlash" in explain_separation(*pair)
        assert "both directions" not in explain_separation(*pair)
    assert explain_separation("base_drift", "thermal_expansion") == explain_separation(
        "thermal_expansion", "base_drift"
    )


@pytest.mark.wide
@pytest.mark.parametrize("pair", DOUBTS)
def test_the_planned_poses_distinguish_two_effects_that_the_first_recording_cannot(pair):
    """bench/truth/settle.py draws twenty of each. Usual growth is told from drift at once."""
    first, then = settled(DOUBTS[pair], IN_DOUBT[pair])
    assert first == ("settled" if pair == "thermal/drift" else "in doubt")
    assert then.startswith("settled")


IN_DOUBT = {"eccentricity/gain": 0, "thermal/drift": 0, "backlash/hysteresis": 0}


@pytest.mark.slow
@pytest.mark.parametrize("pair", DOUBTS)
def test_the_planned_poses_distinguish_two_effects_in_nine_of_ten_robots(pair):
    ends = [settled(DOUBTS[pair], seed)[1] for seed in range(20)]
    assert sum(end.startswith("settled") for end in ends) >= 18
